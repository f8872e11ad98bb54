"""Recipes as a user starts them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest

from .. import copies
from ..copies import RECIPES
from ..learner import make_learner as make_learner

ROOT = RECIPES.parent
# Ray's workers read the variable.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (os.environ.get("PYTHONPATH"), str(RECIPES))))

SHORT_LEARNING = (
    "num_envs=2",
    "evaluate_episodes=1",
    "task.steps=20",
    "trainer.frames_per_batch=20",
    "trainer.random_frames=40",
    "trainer.evaluate_frames=40",
    "trainer.batch_size=16",
    "trainer.updates_per_frame=0.1",
    "trainer.compile=false",
)
"""Options of the recipes that learn policies, with which they take seconds."""


@pytest.fixture(scope="session")
def start() -> Callable[..., subprocess.Popen]:
    """Start a recipe in the background."""
    return _start


@pytest.fixture(scope="session")
def run() -> Callable[..., tuple[int, str, str]]:
    """Exit code, output and errors of a recipe."""
    return _run


def _start(*options: str, recipe: str = "forward_model") -> subprocess.Popen:
    """Start a recipe in the background."""
    pytest.importorskip("hydra")
    command = [sys.executable, str(RECIPES / f"{recipe}.py"), *options]
    environment = os.environ | {"WANDB_MODE": "offline"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # Shells let what they start in the background ignore Ctrl-C, and so would the recipe.
    return subprocess.Popen(command, env=environment, preexec_fn=_listen_to_ctrl_c, **pipes)


def _listen_to_ctrl_c() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _run(*options: str, recipe: str = "forward_model") -> tuple[int, str, str]:
    """Exit code, output and errors of a recipe."""
    process = _start(*options, recipe=recipe)
    output, errors = process.communicate(timeout=600)
    return process.returncode, output, errors


def _load(recipe: str) -> ModuleType:
    """Return a recipe as a module; skip the test without hydra."""
    pytest.importorskip("hydra")
    return copies.load(recipe)


@pytest.fixture(scope="session")
def load() -> Callable[[str], ModuleType]:
    """Function that loads a recipe by name, as a module."""
    return _load


@pytest.fixture(scope="session")
def compose() -> Callable[..., Any]:
    """A recipe's configuration, with options."""
    pytest.importorskip("hydra")
    return lambda recipe, *options: copies.compose(recipe, options)


@pytest.fixture
def call(capfd, compose) -> Callable[..., tuple[int, str, str]]:
    """Run a recipe in this process, without Hydra's command line, for runs shorter than the recipe's imports."""

    def call(*options: str, recipe: str) -> tuple[int, str, str]:
        module, config = _load(recipe), compose(recipe, *options)
        capfd.readouterr()
        code = 0
        try:
            module.main(config)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        return code, *capfd.readouterr()

    return call

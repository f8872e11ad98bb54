"""Recipes that are interrupted anywhere and resumed end with the numbers of uninterrupted runs."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torchrl.data import ReplayBuffer
from tqdm import tqdm

from _common.episodes import Episodes
from torchrl_gn.atomic import read_json
from torchrl_gn.envs import SceneEnv
from torchrl_gn.evaluation import evaluate_errors
from torchrl_gn.training import ScheduledOptimizer, load_pretrained, tensor_files
from torchrl_gn.training.checkpoint import read_tensors
from torchrl_gn.training.tensor_files import load_tensors

pytestmark = pytest.mark.slow  # programs from start to end

SMALL = ("system=pendulum", "data.train=20", "data.validation=5", "data.test=5", "threads=1", "steps=60")
SMALL += ("model.hidden=8", "+model.latent=4", "unroll_fraction=0.3", "noise=1e-3")
TIMES = ("seconds", "share", "wall_clock")


def numbers_of(folder: Path) -> tuple[dict, dict]:
    """Tensors of a finished run's checkpoint, and its metrics and losses, but for times."""
    tensors, _ = read_tensors(folder / "checkpoint" / "checkpoint.safetensors")
    del tensors["description"]  # it has times and the run folder
    metrics = read_json(folder / "metrics.json")
    training = load_pretrained(folder).training
    kept = {name: value for name, value in metrics.items() if not any(time in name for time in TIMES)}
    return tensors, {**kept, "losses": training["curves"]["loss"], "validated": training["progress"]["validated"]}


@pytest.fixture(autouse=True, scope="module")
def without_pictures(load) -> Iterator[None]:
    """Videos take longer than the rest."""

    def report(model, test, folder, *, scene, horizons):
        return evaluate_errors(model, test, horizons=horizons), []

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(load("forward_model"), "report", report)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory, load, compose) -> tuple[dict, dict]:
    """Numbers of an uninterrupted training."""
    folder = tmp_path_factory.mktemp("whole")
    load("forward_model").main(compose("forward_model", *SMALL, f"run_dir={folder}"))
    return numbers_of(folder)


POINTS = {  # of a step that is whole when its number is saved
    "a batch was drawn": (ReplayBuffer, "sample", 13, signal.SIGINT, 12),  # the first is for the normalisers
    "half of the optimisers stepped": (torch.optim.Adam, "step", 22, signal.SIGTERM, 22),
    "all optimisers stepped": (ScheduledOptimizer, "step", 31, signal.SIGINT, 31),
    "the last step": (ScheduledOptimizer, "step", 60, signal.SIGINT, 60),
}


@pytest.mark.parametrize("point", POINTS)
def test_an_interrupted_training_ends_in_the_same_numbers(point, whole, tmp_path, call, ctrl_c):
    """Interrupted once more while it saves."""
    options = (*SMALL, f"run_dir={tmp_path}")
    owner, name, count, number, step = POINTS[point]
    ctrl_c(owner, name, count, number)
    ctrl_c(tensor_files, "digest_of", 1)
    code, _, errors = call(*options, recipe="forward_model")
    assert code == 128 + number, errors
    assert "Interrupted; progress is saved in" in errors
    assert load_pretrained(tmp_path).training["progress"]["step"] == step
    code, _, errors = call(*options, recipe="forward_model")
    assert code == 0, errors
    tensors, numbers = numbers_of(tmp_path)
    assert tensors.keys() == whole[0].keys()
    assert [name for name in tensors if not torch.equal(tensors[name], whole[0][name])] == []
    assert numbers == whole[1]


@pytest.mark.parametrize(
    ("owner", "name"), [("planner", "forward"), ("env", "step"), ("episodes", "record"), ("bar", "update")]
)
def test_an_interrupted_step_of_an_episode_is_recorded_whole_or_not_at_all(owner, name, tmp_path, load, call, ctrl_c):
    """Interrupted once more while it saves."""
    where = {"planner": load("mpc").RandomControl, "env": SceneEnv, "episodes": Episodes, "bar": tqdm}[owner]
    options = ("system=pendulum", "planner=random", "episodes=2", "steps=12", "video=false")
    code, _, errors = call(*options, f"run_dir={tmp_path / 'whole'}", recipe="mpc")
    assert code == 0, errors
    ctrl_c(where, name, 5)
    ctrl_c(tensor_files, "digest_of", 1)
    code, _, errors = call(*options, f"run_dir={tmp_path / 'run'}", recipe="mpc")
    assert code == 130 and "Interrupted; progress is saved in" in errors
    steps = 4 if owner in ("planner", "env") else 5
    assert load_tensors(tmp_path / "run" / "random.safetensors")["action"].shape[1] == steps
    code, _, errors = call(*options, f"run_dir={tmp_path / 'run'}", recipe="mpc")
    assert code == 0, errors
    whole, resumed = (load_tensors(tmp_path / folder / "random.safetensors") for folder in ("whole", "run"))
    del whole["seconds"], resumed["seconds"]
    assert whole.keys() == resumed.keys()
    assert [key for key in whole if not torch.equal(whole[key], resumed[key])] == []

"""Every command that the README and the docs tell to type is one that its program takes."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

from torchrl_gn import viewer
from torchrl_gn.__main__ import main

from ..copies import NAMES, RECIPES, compose

hydra = pytest.importorskip("hydra")

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^ *```sh\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`((?:python )?recipes/[\w/]+\.py [^`]+)`")
PROGRAMS = ("python", "torchrun", "torchrl-gn", "ray", "git", "pip")
NESTED = {  # options that hold options of other recipes
    ("compare", "overrides"): "forward_model",
    ("mlp_baseline", "overrides"): "forward_model",
    ("data_shift", "overrides"): "forward_model",
    ("learning_curves", "overrides"): "svg",
    ("suite", "overrides"): "shac",
    ("benchmarks/planning", "overrides"): "mpc",
    ("plan_and_learn", "planning"): "mpc",
    ("plan_and_learn", "training"): "forward_model",
    ("plan_and_learn", "valuing"): "value",
}


def scripts(page: Path) -> list[str]:
    """Return a page's commands, without those that make the environment: CI runs these from the README."""
    text = page.read_text()
    inline = ["python " + found.removeprefix("python ") for found in INLINE.findall(text)]
    return [block for block in [*BLOCK.findall(text), *inline] if ".venv" not in block and ".ci/" not in block]


def commands(script: str, folder: Path) -> list[list[str]]:
    """Return the words of each command that a shell runs. The shell is real; its programs only log their arguments."""
    log = folder / "commands"
    log.write_text("")
    for name in PROGRAMS:
        program = folder / name
        program.write_text(f"#!/bin/sh\nprintf '%s\\037' {name} \"$@\" >>'{log}'\necho >>'{log}'\n")
        program.chmod(0o755)
    environment = os.environ | {"PATH": f"{folder}{os.pathsep}{os.environ['PATH']}"}
    # <time> stands for a name, not for a file to read.
    script = re.sub(r"<(\w+)>", r"\1", script)
    subprocess.run(["bash", "-euc", script], cwd=folder, env=environment, check=True, timeout=300)
    return [line.split("\x1f")[:-1] for line in log.read_text().splitlines()]


def module(name: str) -> ModuleType:
    """Return the module that ``python -m`` runs; of a package, its ``__main__``."""
    found = importlib.util.find_spec(name)
    assert found is not None, f"python -m finds no {name}"
    return importlib.import_module(f"{name}.__main__" if found.submodule_search_locations else name)


def check_options(recipe: str, options: list[str]) -> None:
    """Check options by Hydra, which refuses unknown options and unknown names of experiments, presets and tasks."""
    config = compose(recipe, options)
    unknown = set(config.get("only") or ()) - set(
        config.get({"compare": "variants", "suite": "tasks"}.get(recipe, "agents"), ())
    )
    assert not unknown, f"recipes/{recipe}.py knows no {sorted(unknown)}"
    for (outer, key), inner in NESTED.items():
        if outer == recipe and config[key]:
            compose(inner, config[key])


@pytest.mark.parametrize("recipe", NAMES)
def test_every_recipe_helps_and_logs(recipe):
    source = RECIPES / f"{recipe}.py"
    options = source.parent / "config" / f"{source.stem}.yaml"
    assert "@with_help\n@hydra.main(" in source.read_text()
    if recipe in ("publish", "report"):  # they make a file of a model and pages, and have no run
        return
    assert "\nlogger: none" in options.read_text()
    assert re.search(r"(finish_run|report_sweep|report_learning)\(.* tracker,", source.read_text())


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in PAGES if scripts(page)], ids=lambda page: str(page.relative_to(ROOT))
)
def test_commands_are_understood(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(viewer, "serve", lambda source, **options: None)  # it serves until Ctrl-C
    for script in scripts(page):
        typed = commands(script, tmp_path)
        assert typed, f"nothing to run in {script!r}"
        for program, *words in typed:
            if program == "torchrl-gn":
                main(words)
            elif program not in ("ray", "git", "pip"):
                place = next((index for index, word in enumerate(words) if word.startswith("recipes/")), None)
                if words[0] == "-m":
                    module(words[1]).parse(words[2:])
                elif place is None:
                    assert words[0] == "-" or (ROOT / words[0]).is_file(), words
                else:
                    recipe = words[place].removeprefix("recipes/").removesuffix(".py")
                    assert recipe in NAMES, words
                    check_options(recipe, words[place + 1 :])


@pytest.mark.parametrize(
    ("recipe", "option"),
    [
        ("svg", "horizons=1"),
        ("compare", "experiment=none"),
        ("compare", "only=[dflt]"),
        ("compare", "overrides=['model.skp=true']"),
    ],
)
def test_others_are_not(recipe, option):
    with pytest.raises((hydra.errors.HydraException, AssertionError)):
        check_options(recipe, [option])

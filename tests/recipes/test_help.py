"""Output of a recipe's `--help`."""

from __future__ import annotations

import importlib
import sys

import pytest

from _common.command_line import commented_options

YAML = """# Options of a recipe.
size: 3            # of something

data:
  folder: null     # where
  hydra: 1         # an option of that name

hydra:
  run: {dir: .}
  job:
    chdir: false

defaults:
  - task: swimmer6 # or another
  - _self_
  - override hydra/job_logging: disabled
"""

RECIPE = """'''What it does.

    how it is called

What came out.
'''
from functools import wraps
from _common import with_help

ran = []


@with_help
@lambda function: wraps(function)(lambda: ran.append(True))
def main():
    pass
"""


def test_options_keep_their_comments_and_lose_what_hydra_is_told():
    kept = """# Options of a recipe.
size: 3            # of something

data:
  folder: null     # where
  hydra: 1         # an option of that name

defaults:
  - task: swimmer6 # or another
"""
    assert commented_options(YAML) == kept
    assert commented_options(YAML.replace("  - task: swimmer6 # or another\n", "")) == kept.split("\ndefaults:")[0]


@pytest.mark.parametrize("word", ["--help", "-h", "size=4"])
def test_help_is_the_first_lines_and_the_options(word, tmp_path, monkeypatch, capsys):
    group = tmp_path / "config" / "task"
    group.mkdir(parents=True)
    (group / "swimmer6.yaml").write_text("steps: 200   # in an episode\n")
    (group / "whole.yaml").write_text("# @package _global_\nsize: 5\n")
    (tmp_path / "config" / "small_recipe.yaml").write_text(YAML)
    (tmp_path / "small_recipe.py").write_text(RECIPE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "small_recipe", raising=False)
    recipe = importlib.import_module("small_recipe")

    def output(*words: str) -> str:
        monkeypatch.setattr(sys, "argv", ["small_recipe.py", *words])
        recipe.main()
        return capsys.readouterr().out

    said = output(word)
    if word == "size=4":
        assert recipe.ran and not said
    else:
        options = f"What it does.\n\n    how it is called\n\nWhat came out.\n\n{commented_options(YAML)}\n"
        task = "What task=swimmer6 sets, named task.<option>:\n\nsteps: 200   # in an episode\n"
        assert not recipe.ran and said == options + task
        assert output("task=whole", word) == options + "What task=whole sets:\n\nsize: 5\n"
        with pytest.raises(SystemExit, match=r"task=none is not known; use one of \['swimmer6', 'whole'\]"):
            output("task=none", word)

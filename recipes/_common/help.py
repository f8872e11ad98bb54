"""A recipe's `--help`."""

from __future__ import annotations

import functools
import inspect
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ParamSpec, TypeVar

from _common.options import unknown_options

P = ParamSpec("P")
R = TypeVar("R")


def with_help(main: Callable[P, R]) -> Callable[P, R | None]:
    """Make `--help` print a recipe's docstring and commented options, and suggest names for mistyped options.

    Put it above ``@hydra.main``, whose own help has neither. It reads the options from ``config/<recipe>.yaml`` beside
    the recipe, and from the file of each group in its defaults (``config/task/swimmer6.yaml``) or on the command line.
    """

    @functools.wraps(main)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R | None:
        recipe = Path(inspect.getfile(inspect.unwrap(main)))
        if not {"--help", "-h"} & set(sys.argv[1:]):
            try:
                return main(*args, **kwargs)
            except SystemExit as end:
                for hint in unknown_options(sys.argv[1:], recipe) if end.code == 1 else ():
                    sys.stderr.write(f"{hint}\n")
                raise
        said = (sys.modules[main.__module__].__doc__ or "").strip()
        text = (recipe.parent / "config" / f"{recipe.stem}.yaml").read_text()
        sys.stdout.write("\n".join([f"{said}\n", commented_options(text), *_groups(text, recipe.parent / "config")]))

    return wrapped


def commented_options(text: str) -> str:
    """Return the text of an options file without Hydra's own settings."""
    text = re.sub(r"^hydra:.*\n(?:[ \t]+.*\n?)*", "", text, flags=re.MULTILINE)
    text = re.sub(r"^ *- (?:_self_|override hydra/).*\n?", "", text, flags=re.MULTILINE)
    text = re.sub(r"^defaults:[^\n]*\n(?![ \t]*- )", "", text, flags=re.MULTILINE)
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def _groups(text: str, folder: Path) -> Iterator[str]:
    """Yield the texts of the groups' files, chosen by the defaults or on the command line."""
    asked = dict(word.split("=", 1) for word in sys.argv[1:] if "=" in word)
    for group, default in re.findall(r"^ *- (\w+): (\w+)", text, flags=re.MULTILINE):
        name = asked.get(group, default)
        if not (file := folder / group / f"{name}.yaml").exists():
            others = sorted(path.stem for path in (folder / group).glob("*.yaml"))
            raise SystemExit(f"{group}={name} is not known; use one of {others}.")
        text, marker = file.read_text(), "# @package _global_\n"
        named = "" if text.startswith(marker) else f", named {group}.<option>"
        yield f"What {group}={name} sets{named}:\n\n{text.removeprefix(marker)}"

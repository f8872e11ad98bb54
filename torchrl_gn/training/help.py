"""What a recipe's `--help` says."""

from __future__ import annotations

import functools
import inspect
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def with_help(main: Callable[P, R]) -> Callable[P, R | None]:
    """Let `--help` show what a recipe's first lines say, and its options with the comments beside them.

    Put it above ``@hydra.main``, whose own help has neither. Options are read from ``config/<recipe>.yaml`` beside the
    recipe's file.
    """

    @functools.wraps(main)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R | None:
        if not {"--help", "-h"} & set(sys.argv[1:]):
            return main(*args, **kwargs)
        recipe = Path(inspect.getfile(inspect.unwrap(main)))
        said = (sys.modules[main.__module__].__doc__ or "").strip()
        options = commented_options((recipe.parent / "config" / f"{recipe.stem}.yaml").read_text())
        sys.stdout.write(f"{said}\n\n{options}")

    return wrapped


def commented_options(text: str) -> str:
    """A recipe's options as its file has them, without what it tells Hydra itself."""
    text = re.sub(r"^hydra:.*\n(?:[ \t]+.*\n?)*", "", text, flags=re.MULTILINE)
    text = re.sub(r"^ *- (?:_self_|override hydra/).*\n?", "", text, flags=re.MULTILINE)
    text = re.sub(r"^defaults:[^\n]*\n(?![ \t]*- )", "", text, flags=re.MULTILINE)
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"

"""Options of a recipe as plain values, and refusals of bad ones before work begins."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from omegaconf import DictConfig, OmegaConf

from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.training import plain_config
from torchrl_gn.training.optimizers import Preset

_PRESETS = list(get_args(Preset))
# What options of these names must be, wherever they stand.
_RULES: list[tuple[str, Callable[[Any], bool], str]] = [
    (r"optimizer", lambda value: value in _PRESETS, f"one of {_PRESETS}"),
    (r"(.*_)?lr", lambda value: 0 < value < math.inf, "a positive, finite number"),
    (r"(.*_)?batch_size|unroll_steps|threads|patience", lambda value: value >= 1 and value == int(value), "1 or more"),
    (r"unroll_fraction", lambda value: 0 <= value <= 1, "a share, 0 to 1"),
    (r"noise|checkpoint_seconds", lambda value: 0 <= value < math.inf, "0 or a positive, finite number"),
]


def as_list(value: Any) -> list[Any]:
    """Return an option as a list: a single value (``only=default``) as a list of one, null as an empty one."""
    if value is None:
        return []
    plain = plain_config({"value": value})["value"]
    return plain if isinstance(plain, list) else [plain]


def check_options(cfg: Mapping[str, Any]) -> None:
    """Raise ValueError, naming it, for an optimiser, rate, batch or the like that no recipe could use; null passes."""
    for name, value in flat(plain_config(cfg)):
        for pattern, fits, wanted in _RULES:
            if value is None or isinstance(value, list) or not re.fullmatch(pattern, name.split(".")[-1]):
                continue
            try:
                good = not isinstance(value, bool) and fits(value)
            except (TypeError, ValueError, OverflowError):  # no number
                good = False
            if not good:
                raise ValueError(f"{name}={value} must be {wanted}.")


def unknown_options(words: Sequence[str], recipe: Path) -> list[str]:
    """Of words of a recipe's command line that set options it does not have, what to write instead."""
    folder = recipe.parent / "config"
    known = set(_keys(folder / f"{recipe.stem}.yaml", ""))
    for file in folder.glob("*/*.yaml"):
        whole = file.read_text().startswith("# @package _global_")
        known |= {file.parent.name, *_keys(file, "" if whole else f"{file.parent.name}.")}
    # An option of a group may stand without the group's name.
    short = {name.split(".")[-1]: name for name in sorted(known, reverse=True)} | {name: name for name in known}
    hints = []
    for key in (word.split("=", 1)[0] for word in words if "=" in word and not word.startswith(("+", "~", "hydra"))):
        if key in known:
            continue
        near = difflib.get_close_matches(key, short, 1)
        hints.append(f"There is no option {key!r}" + (f"; did you mean {short[near[0]]!r}?" if near else "."))
    return hints


def _keys(file: Path, prefix: str) -> Iterator[str]:
    for name, _ in flat(OmegaConf.to_container(OmegaConf.load(file)), prefix, groups=True):  # pyright: ignore
        yield name


def flat(values: Any, prefix: str = "", *, groups: bool = False) -> Iterator[tuple[str, Any]]:
    """Names and values of options, with ``groups`` those of groups too."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.", groups=groups)
        if groups or not isinstance(value, Mapping):
            yield f"{prefix}{name}", value


def scene_options(cfg: DictConfig) -> dict[str, Any]:
    """Options of ``load_scene`` that a recipe has."""
    plain = plain_config(cfg)
    return {key: plain[key] for key in ("timestep", "action_bounds", "wide_starts")}


def load_system(cfg: DictConfig, system: str) -> Scene:
    """The scene of a recipe's system; ValueError if its actuators have no bounds."""
    scene = load_scene(system, **scene_options(cfg))
    if scene.unbounded:
        raise ValueError(
            f"{system!r} has actuators without bounds, {list(scene.unbounded)}: give action_bounds=[-1,1], say, or one"
            f' by one "action_bounds={{{scene.unbounded[0]}: [-1, 1]}}"; the same to train, plan and learn policies.'
        )
    return scene

"""Options of a recipe as plain values, and checks that refuse bad ones before work begins."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from torchrl_gn.data.random_controls import Pace
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.training import plain_config
from torchrl_gn.training.optimizers import Preset
from torchrl_gn.training.tracking import LoggerKind

_PRESETS, _LOGGERS, _PACES = (list(get_args(choices)) for choices in (Preset, LoggerKind, Pace))
_CLOCKS = ["wall", "processor"]


def _whole(value: Any, least: int) -> bool:
    return value >= least and value == int(value)


# Rules for options of these names at any depth: pattern, test and wording; in a list, for every element.
_RULES: list[tuple[str, Callable[[Any], bool], str]] = [
    (r"optimizer", lambda value: value in _PRESETS, f"one of {_PRESETS}"),
    (r"logger", lambda value: value in _LOGGERS, f"one of {_LOGGERS}"),
    (r"clock", lambda value: value in _CLOCKS, f"one of {_CLOCKS}"),
    (r"data\.pace", lambda value: value in _PACES, f"one of {_PACES}"),
    (r"(.*_)?lr|(.*_)?minutes|timestep", lambda value: 0 < value < math.inf, "a positive, finite number"),
    (
        r"(.*_)?batch_size|unroll_steps|threads|patience|steps|length|episodes|rollouts|trajectories|sequences|num_envs"
        r"|collectors|jobs|repeats|candidates|top_k|members|(data|random|swimming|episodes)\.(train|validation|test)"
        r"|data\.variants|(.*_)?hidden|latent|(.*_)?frames",
        lambda value: _whole(value, 1),
        "a whole number, 1 or more",
    ),
    (
        r"(.*_)?seed|seeds|horizons?|rounds|updates|delay|history|burn_in|warm_up|physics_fit|model_steps",
        lambda value: _whole(value, 0),
        "a whole number, 0 or more",
    ),
    (r"unroll_fraction|wide_starts", lambda value: 0 <= value <= 1, "a share, 0 to 1"),
    (r"noise|checkpoint_seconds", lambda value: 0 <= value < math.inf, "0 or a positive, finite number"),
]
_NULLABLE = ("minutes", "steps")  # in every recipe


def chosen_names(only: Any, known: Collection[str], kind: str, *, remedy: str = "") -> list[str]:
    """Return the names that ``only=`` lists, all known ones for null.

    Raises:
        ValueError: if a name is not known; the message begins with ``kind`` and ends with ``remedy``.
    """
    chosen = as_list(only) or list(known)
    if unknown := [name for name in chosen if name not in known]:
        raise ValueError(f"{kind} {unknown} are not known; use some of {list(known)}{remedy}.")
    return chosen


def as_list(value: Any) -> list[Any]:
    """Return an option as a list: a single value (``only=default``) as a list of one, null as an empty list."""
    if value is None:
        return []
    plain = plain_config({"value": value})["value"]
    return plain if isinstance(plain, list) else [plain]


def check_options(cfg: Mapping[str, Any], recipe: Path | None = None) -> None:
    """Raise ValueError for an option that no recipe could use, before anything is written; the message names it.

    Options of known names have allowed ranges. Any other option must have the type of its default in the recipe's
    ``config/<recipe>.yaml``. Null and words (``lag=auto``) pass if the option's comment there mentions them.
    """
    options, lists = dict(flat(plain_config(cfg))), set()
    for name, default, words in _defaults(recipe):
        if default == []:  # the default does not tell the kind of its elements
            lists.add(name)
        if name in options and (wanted := _wanted(options[name], default, words)):
            raise ValueError(f"{name}={_shown(options[name])} must be {wanted}.")
    for name, value in options.items():
        for pattern, fits, wanted in _RULES if name not in lists else ():
            if not re.fullmatch(rf"(.*\.)?({pattern})", name):
                continue
            for each in _leaves(value):
                try:
                    good = each is None or (not isinstance(each, bool) and fits(each))
                except (TypeError, ValueError, OverflowError):  # not a number
                    good = False
                if not good:
                    raise ValueError(f"{name}={_shown(value)} must be {wanted}.")


def _leaves(value: Any) -> list[Any]:
    return [leaf for each in value for leaf in _leaves(each)] if isinstance(value, list) else [value]


def _shown(value: Any) -> str:
    return "null" if value is None else str(value)


def _defaults(recipe: Path | None) -> Iterator[tuple[str, Any, set[str]]]:
    """Yield names of a recipe's options, their defaults, and the words of their comments."""
    if recipe is None or not (file := recipe.parent / "config" / f"{recipe.stem}.yaml").exists():
        return
    text, loaded = file.read_text(), OmegaConf.to_container(OmegaConf.load(file))
    for name, default in flat(loaded):
        # The option's line, and the lines of comments after it.
        own = re.search(rf"^[^#\n]*\b{re.escape(name.split('.')[-1])}:.*(\n\s*#.*)*", text, re.MULTILINE)
        yield name, default, {*re.findall(r"[a-z]\w*", own[0] if own else ""), *(["null"] if name in _NULLABLE else [])}


def _wanted(value: Any, default: Any, words: set[str]) -> str | None:
    """Describe the type that a value must have, given its default; None if the value has it."""
    if default is None or (isinstance(default, str) and "${" in default) or _shown(value) in words - {str(default)}:
        return None
    if value is None:
        return None if isinstance(default, (list, Mapping)) else f"given, such as {default}"
    if isinstance(default, bool):
        return None if isinstance(value, bool) else "true or false"
    kinds = {str(type(each).__name__) for each in _leaves(value)}
    if isinstance(default, (int, float)):
        return None if kinds <= {"int", "float"} else "a number"
    if isinstance(default, str):
        return "a name" if kinds & {"bool", "int", "float"} else None
    return None


def unknown_options(words: Sequence[str], recipe: Path) -> list[str]:
    """Return a hint for each word of a recipe's command line that sets an unknown option."""
    folder = recipe.parent / "config"
    known = set(_keys(folder / f"{recipe.stem}.yaml", ""))
    for file in folder.glob("*/*.yaml"):
        whole = file.read_text().startswith("# @package _global_")
        known |= {file.parent.name, *_keys(file, "" if whole else f"{file.parent.name}.")}
    # An option of a group may be written without the group's name.
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
    """Yield names and values of options; with ``groups``, of groups too."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.", groups=groups)
        if groups or not isinstance(value, Mapping):
            yield f"{prefix}{name}", value


def refuse_without_effect(
    cfg: DictConfig, recipe: Path, names: Sequence[str], *, because: str, trained: Mapping[str, Any] | None = None
) -> None:
    """Refuse options of a training that does not take place.

    Args:
        cfg: the recipe's options.
        recipe: the recipe's file.
        names: the options; ``"data"`` names all of its group, and ``"load.masses"`` one.
        because: what has no training: ``"checkpoint=PATH"``.
        trained: options that the model was trained with; these may be given again.

    Raises:
        ValueError: if one is on the command line or differs from its default, and is not its value in ``trained``.
    """
    now, before = dict(flat(plain_config(cfg))), dict(flat(trained or {}))
    defaults = {name: default for name, default, _ in _defaults(recipe)}
    words = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    passed = {word.split("=", 1)[0].lstrip("+") for word in words}
    idle = [
        f"{name}={_shown(value)}" + (f" (trained with {_shown(before[name])})" if name in before else "")
        for name, value in now.items()
        if {name, name.split(".")[0]} & set(names)
        and (name in passed or value != defaults.get(name))
        and not (name in before and before[name] == value)
    ]
    if idle:
        raise ValueError(
            f"{', '.join(idle)} would have no effect: {because} trains no model. Leave out one of the two."
        )


SCENE_OPTIONS = ("timestep", "action_bounds", "wide_starts", "mocap_actions", "motors")


def scene_options(cfg: DictConfig) -> dict[str, Any]:
    """Return a recipe's options for ``load_scene``."""
    plain = plain_config(cfg)
    return {key: plain[key] for key in SCENE_OPTIONS}


def load_system(cfg: DictConfig, system: str) -> Scene:
    """Load the scene of a recipe's system; ValueError if an actuator has no bounds."""
    scene = load_scene(system, **scene_options(cfg))
    if scene.unbounded:
        raise ValueError(
            f"{system!r} has actuators without bounds, {list(scene.unbounded)}: pass action_bounds=[-1,1], say, or one"
            f' by one "action_bounds={{{scene.unbounded[0]}: [-1, 1]}}"; the same to train, plan and learn policies.'
        )
    return scene

"""The forward model of a recipe's ``model:`` block, and the known physics of ``physics=`` that it corrects."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_gn.dynamics import (
    Activations,
    Actuators,
    BodyState,
    Canonicalizer,
    Constraints,
    Controls,
    Couplings,
    ForwardModel,
    JointAxes,
    Joints,
    MocapPoses,
    MujocoPhysics,
    PairContacts,
    Physics,
    Tendons,
    Wrenches,
    contacts_of,
    trees_can_touch,
)
from torchrl_gn.dynamics.physics import as_physics
from torchrl_gn.scenes import KinematicTree, Scene
from torchrl_gn.training import plain_config


def build_model(
    scenes: Scene | KinematicTree | Sequence[Scene], options: Mapping[str, Any], **more: Any
) -> ForwardModel:
    """Make a model with fresh weights.

    Args:
        scenes: the scene, or scenes that share the model.
        options: the block; null options keep their defaults. All but ``features`` and ``canonicalizer`` are options of
            :class:`~torchrl_gn.dynamics.ForwardModel` and its core.
        **more: further options, which replace the block's options.
    """
    settings = {name: value for name, value in {**plain_config(options), **more}.items() if value is not None}
    canonicalizer, shown = Canonicalizer(**settings.pop("canonicalizer")), settings.pop("features")
    all_scenes = scenes if isinstance(scenes, Sequence) else [scenes]
    if shown["contact_pairs"] is None:
        shown["contact_pairs"] = any(map(trees_can_touch, all_scenes))
    optional = {
        "joint_axes": JointAxes(),
        "joints": Joints(),
        "actuators": Actuators(),
        "tendons": Tendons(),
        "constraints": Constraints(),
        "couplings": Couplings(),
        "contacts": contacts_of(all_scenes),
        "contact_pairs": PairContacts(),
    }
    chosen = [
        *(feature for name, feature in optional.items() if shown.pop(name)),
        Activations(),
        MocapPoses(),
        Wrenches(),
    ]
    features = (BodyState(**shown), Controls(), *(each for each in chosen if any(map(each.suits, all_scenes))))
    return ForwardModel.for_scene(scenes, features=features, canonicalizer=canonicalizer, **settings)


def model_overrides(options: Mapping[str, Any], prefix: str = "model") -> list[str]:
    """Return a block as command-line overrides of another recipe."""
    found = []
    for name, value in plain_config(options).items():
        if isinstance(value, dict):
            found += model_overrides(value, f"{prefix}.{name}")
        else:
            found.append(f"++{prefix}.{name}={'null' if value is None else value}".replace(" ", ""))
    return found


def load_physics(source: str | None, options: Mapping[str, Any] | None, robot: Scene | KinematicTree) -> Physics | None:
    """Load the known physics that a robot's residual model corrects; None if ``source`` is None.

    Args:
        source: an MJCF file; ``"scene"``, the robot's own scene; or ``PATH.py:NAME`` or ``MODULE:NAME``, a function of
            state and action, or a class that is constructed from the robot.
        options: options of :class:`~torchrl_gn.dynamics.MujocoPhysics` or of that class.

    Raises:
        ValueError: if nothing has the name ``source``, or options are given for a function.
    """
    options = plain_config(options or {})
    if source is None:
        return None
    if source == "scene":
        if isinstance(robot, KinematicTree):
            raise ValueError("physics=scene is for simulated systems: name the robot's MJCF file, or a function.")
        return MujocoPhysics(robot, **options)
    if ":" not in source:
        return MujocoPhysics(Path(source), robot if isinstance(robot, KinematicTree) else None, **options)
    place, name = source.rsplit(":", 1)
    found: Any = getattr(_module(place), name, None)
    if found is None:
        raise ValueError(f"physics={source}: there is no function or class {name!r} in {place}.")
    if isinstance(found, type):
        return as_physics(found(robot, **options))
    if options:
        raise ValueError(f"physics={source} is a function, which takes no physics_options; make it a class.")
    return as_physics(found)


def _module(place: str) -> Any:
    if not place.endswith(".py"):
        return importlib.import_module(place)
    if not Path(place).is_file():
        raise ValueError(f"physics: there is no file {place}.")
    spec = importlib.util.spec_from_file_location(Path(place).stem, place)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module

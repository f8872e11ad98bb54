"""The forward model of a recipe's ``model:`` block."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    PairContacts,
    Tendons,
    Wrenches,
    contacts_of,
    trees_meet,
)
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
        **more: further options, which replace those of the block.
    """
    given = {name: value for name, value in {**plain_config(options), **more}.items() if value is not None}
    canonicalizer, shown = Canonicalizer(**given.pop("canonicalizer")), given.pop("features")
    all_scenes = scenes if isinstance(scenes, Sequence) else [scenes]
    if shown["contact_pairs"] is None:
        shown["contact_pairs"] = any(map(trees_meet, all_scenes))
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
    return ForwardModel.for_scene(scenes, features=features, canonicalizer=canonicalizer, **given)


def model_overrides(options: Mapping[str, Any], prefix: str = "model") -> list[str]:
    """Return a block as command-line overrides of another recipe."""
    found = []
    for name, value in plain_config(options).items():
        if isinstance(value, dict):
            found += model_overrides(value, f"{prefix}.{name}")
        else:
            found.append(f"++{prefix}.{name}={'null' if value is None else value}".replace(" ", ""))
    return found

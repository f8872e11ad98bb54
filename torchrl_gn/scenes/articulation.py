"""Robots that forward models predict: scenes of bodies, and kinematic trees of joints alone."""

from __future__ import annotations

import math
from typing import TypeAlias

from torchrl_gn.scenes.kinematic_tree import KinematicTree
from torchrl_gn.scenes.scene import Scene

Articulation: TypeAlias = Scene | KinematicTree
"""Robot that a forward model predicts: a scene of bodies, or a kinematic tree."""


def require_bodies(robot: Articulation, user: str) -> Scene:
    """Return a robot that is a scene; TypeError for one known by its joints alone. ``user`` starts the message."""
    if isinstance(robot, Scene):
        return robot
    name = getattr(robot, "name", robot)
    raise TypeError(f"{user} needs the bodies of a Scene, which the {type(robot).__name__} {name!r} does not have.")


def require_same_nodes(robot: Articulation, other: Articulation, what: str) -> None:
    """Raise ValueError unless the scene ``other`` of ``what`` has a robot's bodies and joints, by name.

    Variants of a scene do. Equal sizes alone would let ``what`` read other bodies than it learned.
    """
    for kind, names, others in (
        ("bodies", robot.node_names, other.node_names),
        ("joints", robot.joint_names, other.joint_names),
    ):
        if names != others:
            raise ValueError(f"{what} is of scene {other.name!r}, whose {kind} are not those of {robot.name!r}.")


def require_timestep(robot: Articulation, timestep: float, what: str) -> None:
    """Raise ValueError if ``timestep`` [s], the step that ``what`` was trained at, differs from the robot's."""
    if not math.isclose(timestep, robot.timestep, rel_tol=1e-6):
        remedy = "load it with timestep" if isinstance(robot, Scene) else "load its log with resample"
        raise ValueError(
            f"{what} learned with control steps of {1e3 * timestep:g} ms, scene {robot.name!r} has"
            f" {1e3 * robot.timestep:g} ms: {remedy}={timestep:g}."
        )

"""Poses and velocities of named bodies, for rewards."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.scenes.articulation import Articulation, require_bodies
from torchrl_gn.scenes.scene import Attachment, Scene

_POSITION, _ORIENTATION = BODY_STATE.slices["position"], BODY_STATE.slices["orientation"]
_LINEAR, _ANGULAR = BODY_STATE.slices["linear_velocity"], BODY_STATE.slices["angular_velocity"]


def find_body(scene: Articulation, name: str) -> Attachment:
    """Find a body's node and its fixed offset there, zero unless welded; ValueError if there is no such body."""
    scene = require_bodies(scene, "A reward")
    if name in scene.node_names:
        return Attachment(scene.node_names.index(name), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    if name in scene.attachments:
        return scene.attachments[name]
    known = ", ".join([*scene.node_names, *scene.attachments])
    raise ValueError(f"scene {scene.name!r} has no body {name!r}; it has: {known}")


class Bodies(Float64Buffers):
    r"""Differentiable poses and velocities of ``K`` named bodies in states ``[*B, N, 13]``, in the states' dtype.

    A body welded at offset :math:`(p, q)` into a node with pose and velocity :math:`(x, R, v, \omega)` has position
    :math:`x + R p`, orientation :math:`R q`, velocity :math:`v + \omega \times R p` and angular velocity
    :math:`\omega`. All are in the world frame and belong to the body's frame (MuJoCo's ``xpos`` and ``xquat``), not to
    its centre of mass.

    Raises:
        ValueError: if a name is unknown or repeated, or, in a method, if states have a wrong shape.
    """

    node: Tensor
    offset: Tensor
    rotation: Tensor

    def __init__(self, scene: Scene, names: Sequence[str]):
        super().__init__()
        if isinstance(names, str) or not names:
            raise ValueError(f"bodies must be a list of body names, got {names!r}")
        if len(set(names)) < len(names):
            raise ValueError(f"bodies must be distinct, got {list(names)}")
        bodies = [find_body(scene, name) for name in names]
        self.names, self.scene_name, self.node_names = tuple(names), scene.name, tuple(scene.node_names)
        self.state_size = scene.state_size
        offset, rotation = np.stack([body.pos for body in bodies]), np.stack([body.quat for body in bodies])
        self.constants({"node": [body.node for body in bodies], "offset": offset, "rotation": rotation})
        # Most offsets are the identity: skip them, which also avoids rounding.
        self._is_shifted, self._is_rotated = bool(np.any(offset != 0)), bool(np.any(rotation[:, 1:] != 0))

    def require_same(self, scene: Articulation) -> None:
        """Raise ValueError if a scene has other nodes."""
        if tuple(scene.node_names) != self.node_names:
            raise ValueError(
                f"the reward reads the bodies of scene {self.scene_name!r}, not those of {scene.name!r}; build it for"
                " that scene"
            )

    def position(self, state: Tensor) -> Tensor:
        """Return positions ``[*B, K, 3]``, metres."""
        return self._position(self._nodes(state))

    def orientation(self, state: Tensor) -> Tensor:
        """Return unit quaternions ``[*B, K, 4]``, w-first, of either sign."""
        return self._orientation(self._nodes(state))

    def pose(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions and orientations."""
        nodes = self._nodes(state)
        return self._position(nodes), self._orientation(nodes)

    def _position(self, nodes: Tensor) -> Tensor:
        position = nodes[..., _POSITION]
        return position + self._shift(nodes) if self._is_shifted else position

    def _orientation(self, nodes: Tensor) -> Tensor:
        orientation = nodes[..., _ORIENTATION]
        return quaternion.product(orientation, self.rotation.to(nodes.dtype)) if self._is_rotated else orientation

    def linear_velocity(self, state: Tensor) -> Tensor:
        """Return velocities ``[*B, K, 3]`` of the frames' origins, m/s."""
        nodes = self._nodes(state)
        velocity = nodes[..., _LINEAR]
        return velocity + torch.linalg.cross(nodes[..., _ANGULAR], self._shift(nodes)) if self._is_shifted else velocity

    def angular_velocity(self, state: Tensor) -> Tensor:
        """Return angular velocities ``[*B, K, 3]``, rad/s."""
        return self._nodes(state)[..., _ANGULAR]

    def _nodes(self, state: Tensor) -> Tensor:
        if state.shape[-2:] != (len(self.node_names), self.state_size):
            expected = f"[*B, {len(self.node_names)}, {self.state_size}]"
            raise ValueError(f"states of scene {self.scene_name!r} must be {expected}, got {list(state.shape)}")
        return state.index_select(-2, self.node)

    def _shift(self, nodes: Tensor) -> Tensor:
        return quaternion.rotate(nodes[..., _ORIENTATION], self.offset.to(nodes.dtype))

    def extra_repr(self) -> str:
        return f"scene={self.scene_name!r}, names={self.names}"

"""Poses and velocities of named bodies, for rewards."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.scenes.scene import Attachment, Scene

_POSITION, _ORIENTATION = BODY_STATE.slices["position"], BODY_STATE.slices["orientation"]
_LINEAR, _ANGULAR = BODY_STATE.slices["linear_velocity"], BODY_STATE.slices["angular_velocity"]


def require_bodies(scene: Scene) -> None:
    """Check that a scene has bodies.

    Raises:
        TypeError: ``scene`` is no :class:`~torchrl_gn.scenes.Scene` but a robot known by its joints alone.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"rewards read the states of a Scene's bodies, which {type(scene).__name__} has not got")


def find_body(scene: Scene, name: str) -> Attachment:
    """Node of a named body, and the body's fixed offset in the node's frame.

    Args:
        scene: the scene.
        name: name of a node, or of a body welded into one.

    Returns:
        The node and the offset; the identity for a node's own name.

    Raises:
        TypeError: ``scene`` is a robot known by its joints alone.
        ValueError: the scene has no body of this name.
    """
    require_bodies(scene)
    if name in scene.node_names:
        return Attachment(scene.node_names.index(name), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    if name in scene.attachments:
        return scene.attachments[name]
    known = ", ".join([*scene.node_names, *scene.attachments])
    raise ValueError(f"scene {scene.name!r} has no body {name!r}; it has: {known}")


class Bodies(Float64Buffers):
    r"""Read poses and velocities of named bodies from states ``[*B, N, 13]``.

    A body welded at offset :math:`(p, q)` into a node with pose and velocity :math:`(x, R, v, \omega)` has position
    :math:`x + R p`, orientation :math:`R q`, velocity :math:`v + \omega \times R p` and angular velocity
    :math:`\omega`: world frame, of the body's frame (MuJoCo's ``xpos`` and ``xquat``), not of its centre of mass.
    Differentiable in the states. Results have the states' dtype; casting the module leaves the offsets in float64.

    Args:
        scene: the scene.
        names: ``K`` names of bodies, as for :func:`find_body`.

    Raises:
        ValueError: ``names`` is no list of different names, or the scene has no such body; when reading, states
            of a wrong shape.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> scene = load_scene("jaco")
        >>> Bodies(scene, ["jaco_hand/hand"]).position(torch.zeros(5, scene.num_nodes, 13)).shape
        torch.Size([5, 1, 3])
    """

    node: Tensor
    offset: Tensor
    rotation: Tensor

    def __init__(self, scene: Scene, names: Sequence[str]):
        super().__init__()
        if isinstance(names, str) or not names:
            raise ValueError(f"bodies must be a list of body names, got {names!r}")
        if len(set(names)) < len(names):
            raise ValueError(f"bodies must be different ones, got {list(names)}")
        found = [find_body(scene, name) for name in names]
        self.names, self.scene_name, self.node_names = tuple(names), scene.name, tuple(scene.node_names)
        offset, rotation = np.stack([body.pos for body in found]), np.stack([body.quat for body in found])
        self.constants({"node": [body.node for body in found], "offset": offset, "rotation": rotation})
        # Most offsets are the identity: skip them, exactly.
        self._is_shifted, self._is_rotated = bool(np.any(offset != 0)), bool(np.any(rotation[:, 1:] != 0))

    def require_same(self, scene: Scene) -> None:
        """Check that a scene has the same nodes.

        Raises:
            ValueError: the nodes have other names.
        """
        if tuple(scene.node_names) != self.node_names:
            raise ValueError(
                f"the reward reads the bodies of scene {self.scene_name!r}, not those of {scene.name!r}; build it of"
                " that scene"
            )

    def position(self, state: Tensor) -> Tensor:
        """``[*B, K, 3]`` positions in metres of states ``[*B, N, 13]``."""
        nodes = self._nodes(state)
        position = nodes[..., _POSITION]
        return position + self._shift(nodes) if self._is_shifted else position

    def orientation(self, state: Tensor) -> Tensor:
        """``[*B, K, 4]`` unit quaternions, w-first and of either sign, of states ``[*B, N, 13]``."""
        orientation = self._nodes(state)[..., _ORIENTATION]
        return quaternion.product(orientation, self.rotation.to(state.dtype)) if self._is_rotated else orientation

    def linear_velocity(self, state: Tensor) -> Tensor:
        """``[*B, K, 3]`` velocities of the frames' origins in m/s of states ``[*B, N, 13]``."""
        nodes = self._nodes(state)
        velocity = nodes[..., _LINEAR]
        return velocity + torch.linalg.cross(nodes[..., _ANGULAR], self._shift(nodes)) if self._is_shifted else velocity

    def angular_velocity(self, state: Tensor) -> Tensor:
        """``[*B, K, 3]`` angular velocities in rad/s of states ``[*B, N, 13]``."""
        return self._nodes(state)[..., _ANGULAR]

    def _nodes(self, state: Tensor) -> Tensor:
        """States ``[*B, K, 13]`` of the bodies' nodes."""
        if state.shape[-2:] != (len(self.node_names), BODY_STATE.size):
            wanted = f"[*B, {len(self.node_names)}, {BODY_STATE.size}]"
            raise ValueError(f"states of scene {self.scene_name!r} must be {wanted}, got {list(state.shape)}")
        return state.index_select(-2, self.node)

    def _shift(self, nodes: Tensor) -> Tensor:
        """Offsets ``[*B, K, 3]`` in the world frame."""
        return quaternion.rotate(nodes[..., _ORIENTATION], self.offset.to(nodes.dtype))

    def extra_repr(self) -> str:
        return f"scene={self.scene_name!r}, names={self.names}"

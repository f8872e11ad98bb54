"""How the network sees a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchrl_gn.dynamics.features.contacts import Contacts
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import Encoding
from torchrl_gn.scenes.joint_axes import joint_axes

if TYPE_CHECKING:
    from torchrl_gn.dynamics.model import ForwardModel
    from torchrl_gn.scenes import Scene
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters


class Turn(NamedTuple):
    """A rotation of a whole scene.

    Attributes:
        rotation: ``[*B, 4]``.
        matrix: ``[*B, 3, 3]``.
    """

    rotation: Tensor
    matrix: Tensor


class CanonicalState(NamedTuple):
    """A state as the network sees it.

    Attributes:
        state: ``[*B, N, 13]`` recentred, at yaw_frame 0.
        matrices: ``[*B, N, 3, 3]`` of the orientations in it; None of a robot that is known by its joints alone.
        turn: from yaw_frame 0 to the root's yaw_frame; None where there is none.
    """

    state: Tensor
    matrices: Tensor | None
    turn: Turn | None


class Canonicalizer(Float64Buffers):
    """Dynamic features of a scene: recentred, at yaw_frame 0, with what need not be learned worked out.

    Args:
        scene: the scene.
        model: the model, whose options say what its network sees.
    """

    action_low: Tensor
    action_high: Tensor
    edge_action: Tensor
    joint_node: Tensor
    predicted: Tensor
    shifted: Tensor
    visible: Tensor

    def __init__(self, scene: Scene, model: ForwardModel) -> None:
        super().__init__()
        self.layout, self.joint_axes = model.layout, model.joint_axes
        self.encoding: Encoding = model.encoding
        self.yaw_frame = scene.yaw_frame if model.align else None
        self.contacts = Contacts(scene) if model.contacts else None
        predicted = torch.as_tensor(scene.predicted, dtype=torch.float64)
        invariant = torch.as_tensor(scene.translation_invariant, dtype=torch.float64)
        self.recenters = bool(model.recenter and invariant.any() and predicted.any())
        edge_action = torch.as_tensor(scene.edge_action).long()
        edge_action = edge_action.unsqueeze(-1) if edge_action.ndim == 1 else edge_action  # [E, C]
        values = {
            "action_low": torch.as_tensor(scene.action_low),
            "action_high": torch.as_tensor(scene.action_high),
            # A column of zeros behind the actions stands for joints without motor.
            "edge_action": torch.where(edge_action < 0, scene.num_actions, edge_action),
            "predicted": predicted,
            # [N, 3]: which positions move when the scene is shifted; the world stays at 0.
            "shifted": predicted[:, None] * invariant,
        }
        # Of a scene that turns about an axis, both others must be invariant to be hidden in every yaw_frame.
        across = invariant.bool() if self.yaw_frame is None else torch.arange(3) != self.yaw_frame.axis
        self.hides = bool(not model.positions and invariant.any() and invariant.bool()[across].all())
        if self.hides:
            visible = torch.ones(scene.num_nodes, self.layout.size)
            visible[:, self.layout.slices["position"]] -= values["shifted"]
            values["visible"] = visible
        if self.joint_axes:
            values["joint_node"] = torch.as_tensor(joint_axes(scene)[0]).long().repeat_interleave(2)
        self.constants(values)

    def recentered(self, state: Tensor) -> Tensor:
        """State ``[*B, N, 13]`` with the bodies' mean position moved to 0 along invariant axes.

        The world stays at 0, so that it does not give the absolute position away
        (paper, SM "System invariance").
        """
        if not self.recenters:
            return state
        position = self.layout.slices["position"]
        weight = (self.predicted / self.predicted.sum()).to(state.dtype)
        center = (state[..., position] * weight[:, None]).sum(-2, keepdim=True)
        moved = state[..., position] - center * self.shifted.to(state.dtype)
        return torch.cat((state[..., : position.start], moved, state[..., position.stop :]), dim=-1)

    def see(self, state: Tensor, values: PhysicalParameters) -> CanonicalState:
        """State ``[*B, N, 13]`` as the network sees it: recentred, and turned to yaw_frame 0.

        Where the dynamics do not depend on how the scene is turned
        (:attr:`~torchrl_gn.scenes.Scene.yaw_frame`), the root faces one way always and
        predicted changes are turned back, so that nothing is learned twice. The world stays;
        where parts can touch it, it is turned with the rest and so shows the yaw_frame.
        """
        state, turn = self.recentered(state), self.yaw_rotation(state, values)
        if self.yaw_frame is not None and turn is not None:
            pivot = torch.nn.functional.pad(values.pivot.to(state.dtype), (0, self.layout.size - 3)).unsqueeze(-2)
            back = quaternion.conjugate(turn.rotation)
            turned = self.layout.turn(state - pivot, back, turn.matrix.mT) + pivot
            state = torch.cat((state[..., :1, :], turned[..., 1:, :]), dim=-2) if self.yaw_frame.exact else turned
        return CanonicalState(state, self.matrices(state), turn)

    def matrices(self, state: Tensor) -> Tensor | None:
        """Rotation matrices ``[*B, N, 3, 3]`` of the bodies of a state; None if it has none."""
        where = self.layout.slices.get("orientation")
        return None if where is None else quaternion.to_matrix(state[..., where]).unflatten(-1, (3, 3))

    def yaw_rotation(self, state: Tensor, values: PhysicalParameters) -> Turn | None:
        """Rotation from yaw_frame 0 to the root's yaw_frame; None where there is none."""
        if self.yaw_frame is None:
            return None
        orientation = state[..., self.yaw_frame.node, self.layout.slices["orientation"]]
        rest = values.rest.to(state.dtype)
        turn = quaternion.product(orientation, quaternion.conjugate(rest))
        kept = torch.zeros(4, dtype=state.dtype, device=state.device)
        kept[0] = kept[1 + self.yaw_frame.axis] = 1
        rotation = quaternion.normalize(turn * kept)
        return Turn(rotation, quaternion.to_matrix(rotation).unflatten(-1, (3, 3)))

    def features(self, seen: CanonicalState, action: Tensor, values: PhysicalParameters) -> tuple[Tensor, Tensor]:
        """Dynamic node ``[*B, N, F_n]`` and edge ``[*B, E, F_e]`` features, not normalised.

        Args:
            seen: what :meth:`see` gives of the state.
            action: ``[*B, A]``; cut off at the motors' limits.
            values: numbers of the scene.
        """
        state, matrices, _ = seen
        # As motors do: what is beyond their limits has no effect, and the network never sees it.
        # (0 * action: an infinite action gives no number, as it should, and not the motor's limit.)
        action = action.clamp(self.action_low.to(action.dtype), self.action_high.to(action.dtype)) + 0 * action
        padded = torch.cat((action, action.new_zeros((*action.shape[:-1], 1))), dim=-1)
        controls = padded[..., self.edge_action]  # [*B, E, C]
        if self.joint_axes:
            assert matrices is not None
            axes = (matrices[..., self.joint_node, :, :] @ values.joint_axis.to(state.dtype).unsqueeze(-1)).squeeze(-1)
            controls = torch.cat((controls, axes, controls * axes), dim=-1)  # [*B, E, 7]
        shown = state * self.visible.to(state.dtype) if self.hides else state
        features = self.layout.encode(shown, self.encoding, matrices)
        if self.contacts is not None:
            touching = self.contacts(state, matrices, values.contact_offset, values.contact_radius)
            features = torch.cat((features, touching), dim=-1)
        return features, controls

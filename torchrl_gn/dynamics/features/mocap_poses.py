"""Target poses of mocap bodies relative to the bodies that they lead, as features of the edges between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import mujoco
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchrl_gn.dynamics.features.feature import Feature, StepInputs
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.quaternion import turned_by
from torchrl_gn.maths.state_layout import BODY_STATE, StateLayout
from torchrl_gn.scenes import Articulation, Scene
from torchrl_gn.scenes.constraints import joined_frames
from torchrl_gn.scenes.mocap import leading_mocaps
from torchrl_gn.scenes.topology import topology
from torchrl_gn.scenes.transmissions import find_transmissions

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer

_NEAR, _NEAR_ANGLE = 0.01, 0.05  # metres and rad: distances at which the fine features are clipped
_SIZE = 21


@dataclass(frozen=True)
class MocapPoses(Feature):
    """Offset of each led body from its target, set by a mocap body whose pose is an action.

    The features are on the edges of the weld or connect constraint between both bodies. Paper: no mocap bodies.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "edges"

    @staticmethod
    def suits(scene: object) -> bool:
        """Return True if a scene has poses of mocap bodies as actions."""
        return isinstance(scene, Scene) and len(scene.mocaps) > 0

    def size(self, layout: StateLayout) -> int:
        return _SIZE

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        scene = self.require_bodies(scene)
        return _Bound(scene)


class _Bound(Float64Buffers):
    pose: Tensor
    target_place: Tensor
    target_turn: Tensor
    node: Tensor
    place: Tensor
    turn: Tensor
    is_weld: Tensor
    row: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.timestep, self.edges = float(scene.timestep), scene.num_edges
        model, graph, mocaps = scene.model, topology(scene.model), scene.mocaps
        led = [each for each in leading_mocaps(model) if each[1] in mocaps.body]
        self.count = len(led)
        if not led:
            return
        equality_of_pair = find_transmissions(model, graph).equality.tolist()
        targets, ends = [], []
        for equality, mocap, _ in led:
            target, end = sorted(joined_frames(model, graph, equality), key=lambda each: each[0])
            targets.append(_in_body(model, mocap, *target[1:]))
            ends.append(end)
        rows = np.full(len(scene.pairs), len(led))
        rows[[equality_of_pair.index(equality) for equality, _, _ in led]] = np.arange(len(led))
        first = scene.num_actions - len(mocaps)
        at = [mocaps.body.tolist().index(mocap) for _, mocap, _ in led]
        kinds = model.eq_type[[equality for equality, _, _ in led]]
        self.constants(
            {
                "pose": first + 7 * np.array(at)[:, None] + np.arange(7),
                "target_place": np.array([position for position, _ in targets]),
                "target_turn": np.array([turn for _, turn in targets]),
                "node": np.array([node for node, _, _ in ends]),
                "place": np.array([position for _, position, _ in ends]),
                "turn": np.array([turn for _, _, turn in ends]),
                "is_weld": (kinds == int(mujoco.mjtEq.mjEQ_WELD))[:, None],
                "row": np.repeat(rows, 2),
            }
        )

    def forward(self, inputs: StepInputs) -> Tensor:
        """Return features ``[*B, E, 21]``, 0 on edges without a mocap body, the same in both directions.

        In the canonical frame and this order:

        - offset from the point that the constraint holds to its target (metres): now, the same clipped to 1 cm and
          scaled to 1, and a step later;
        - rotation to the target orientation (twice the quaternion's vector, rad if small; 0 for a connect): now, the
          same clipped to 0.05 rad and scaled to 1, and a step later;
        - the held point relative to the body's origin (metres).
        """
        state, matrices = inputs.canonical[:2]
        if not self.count:
            return state.new_zeros((*state.shape[:-2], self.edges, _SIZE))
        assert matrices is not None and inputs.action is not None
        at, dtype = BODY_STATE.slices, state.dtype
        pose, body = inputs.action.to(dtype)[..., self.pose], state[..., self.node, :]
        length = pose[..., 3:].square().sum(-1, keepdim=True)
        still = torch.eye(4, dtype=dtype, device=state.device)[0]
        quat = torch.where(length > 1e-18, pose[..., 3:] / torch.where(length > 1e-18, length, 1.0).sqrt(), still)
        frame = quaternion.to_matrix(quat).unflatten(-1, (3, 3))
        target = pose[..., :3] + turned_by(frame, self.target_place.to(dtype))
        arm = turned_by(matrices[..., self.node, :, :], self.place.to(dtype))
        gap = target - body[..., at["position"]] - arm
        spin = body[..., at["angular_velocity"]]
        moved = gap - self.timestep * (body[..., at["linear_velocity"]] + torch.linalg.cross(spin, arm))
        target_quat = quaternion.product(quat, self.target_turn.to(dtype).expand_as(quat))
        orientation = body[..., at["orientation"]]
        held = quaternion.product(orientation, self.turn.to(dtype).expand_as(orientation))
        relative = quaternion.product(target_quat, quaternion.conjugate(held))
        turn = torch.where(relative[..., :1] < 0, -2.0, 2.0) * relative[..., 1:]
        turn, spin = (torch.where(self.is_weld, each, 0.0) for each in (turn, spin))
        parts = [gap, (gap / _NEAR).clamp(-1, 1), moved]
        parts += [turn, (turn / _NEAR_ANGLE).clamp(-1, 1), turn - self.timestep * spin, arm]
        return pad(torch.cat(parts, dim=-1), (0, 0, 0, 1))[..., self.row, :]


def _in_body(model: mujoco.MjModel, body: int, place: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Express a frame of the world in the frame of a mocap body at its pose in the model."""
    back, moved, turned = np.empty(4), np.empty(3), np.empty(4)
    mujoco.mju_negQuat(back, model.body_quat[body])
    mujoco.mju_rotVecQuat(moved, np.asarray(place, dtype=float) - model.body_pos[body], back)
    mujoco.mju_mulQuat(turned, back, np.asarray(turn, dtype=float))
    return moved, turned

"""Violations of connect and weld constraints as features of the edges between the joined bodies."""

from __future__ import annotations

from dataclasses import dataclass, replace
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
from torchrl_gn.scenes.topology import topology
from torchrl_gn.scenes.transmissions import find_transmissions

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer

_NEAR, _NEAR_ANGLE = 0.002, 0.02  # metres and rad: violations at which the fine features are clipped
_STEP = 0.02  # seconds: a rate's least scale is such a violation in this time
_WELD = int(mujoco.mjtEq.mjEQ_WELD)


@dataclass(frozen=True)
class Constraints(Feature):
    """Violation of each connect or weld constraint, and its rate.

    A constraint's edges (:attr:`Scene.pairs`) join the two bodies that its force acts on. Paper: no such constraints.

    Not a default feature: it did not reduce errors where it was measured.
    """

    part: ClassVar[Literal["nodes", "edges"]] = "edges"

    welds: bool = False  # also violations of orientation, by welds

    @staticmethod
    def suits(scene: object) -> bool:
        """Return True if a scene has active connect or weld constraints between nodes."""
        return isinstance(scene, Scene) and bool(len(_constraints(scene)[0]))

    def resolved(self, scene: Articulation) -> Constraints:
        return replace(self, welds=_has_welds(self.require_bodies(scene)))

    def size(self, layout: StateLayout) -> int:
        return 21 if self.welds else 12

    def least_scales(self, layout: StateLayout) -> list[float]:
        # Data lie within micrometres of the constraint, a model's predictions do not.
        turn = [_NEAR_ANGLE] * 3 + [1.0] * 3 + [_NEAR_ANGLE / _STEP] * 3 if self.welds else []
        return [_NEAR] * 3 + [1.0] * 3 + [_NEAR / _STEP] * 3 + turn + [0.0] * 3

    def bind(self, scene: Articulation, layout: StateLayout, canonicalizer: BoundCanonicalizer) -> nn.Module:
        scene = self.require_bodies(scene)
        if _has_welds(scene) and not self.welds:
            raise ValueError(
                f"The model reads no welds, scene {scene.name!r} has some: build the model with ForwardModel.for_scene."
            )
        return _Bound(scene, self.welds)


def _constraints(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the edge pairs of constraints between two nodes, and these constraints' MuJoCo ids."""
    equality = find_transmissions(scene.model, topology(scene.model)).equality
    pairs = np.flatnonzero(equality >= 0)
    return pairs, equality[pairs]


def _has_welds(scene: Scene) -> bool:
    return bool((scene.model.eq_type[_constraints(scene)[1]] == _WELD).any())


class _Bound(Float64Buffers):
    nodes: Tensor
    places: Tensor
    turns: Tensor
    is_weld: Tensor

    def __init__(self, scene: Scene, welds: bool) -> None:
        super().__init__()
        (pairs, equalities), graph = _constraints(scene), topology(scene.model)
        self.welds, self.count, self.edges = welds, len(pairs), scene.num_edges
        if not self.count:
            return
        assert pairs[-1] == len(scene.pairs) - 1 and np.ptp(pairs) == len(pairs) - 1  # the last pairs
        frames = [sorted(joined_frames(scene.model, graph, one), key=lambda end: end[0]) for one in equalities.tolist()]
        self.constants(
            {
                "nodes": np.array([[node for node, _, _ in both] for both in frames]).T.copy(),
                "places": np.array([[position for _, position, _ in both] for both in frames])
                .transpose(1, 0, 2)
                .copy(),
                "turns": np.array([[quat for _, _, quat in both] for both in frames]).transpose(1, 0, 2).copy(),
                "is_weld": (scene.model.eq_type[equalities] == _WELD)[:, None],
            }
        )

    def forward(self, inputs: StepInputs) -> Tensor:
        """Return features ``[*B, E, 12]``, or ``[*B, E, 21]`` with welds; 0 on the edges of joints and actuators.

        On each edge of a constraint, in the canonical frame and this order:

        - the sender's anchor relative to the receiver's (metres), the same clipped to 2 mm and scaled to 1, and its
          rate (m/s);
        - with welds, the rotation of the sender relative to the receiver (twice the quaternion's vector, rad if small),
          the same clipped to 0.02 rad and scaled to 1, and its rate (rad/s); 0 for a connect;
        - the receiver's anchor relative to its origin (metres).
        """
        state, matrices = inputs.canonical[:2]
        assert matrices is not None
        size = 21 if self.welds else 12
        if not self.count:
            return state.new_zeros((*state.shape[:-2], self.edges, size))
        at, places = BODY_STATE.slices, self.places.to(state.dtype)
        arms = [
            turned_by(matrices[..., node, :, :], position) for node, position in zip(self.nodes, places, strict=True)
        ]
        ends = [state[..., node, :] for node in self.nodes]
        points = [end[..., at["position"]] + arm for end, arm in zip(ends, arms, strict=True)]
        spins = [end[..., at["angular_velocity"]] for end in ends]
        rates = [
            end[..., at["linear_velocity"]] + torch.linalg.cross(spin, arm)
            for end, spin, arm in zip(ends, spins, arms, strict=True)
        ]
        gap, rate = points[0] - points[1], rates[0] - rates[1]
        odd = [gap, (gap / _NEAR).clamp(-1, 1), rate]  # change sign with the edge's direction
        if self.welds:
            turn = torch.where(self.is_weld, self._turn(ends, at["orientation"]), 0.0)
            spin = torch.where(self.is_weld, spins[0] - spins[1], 0.0)
            odd += [turn, (turn / _NEAR_ANGLE).clamp(-1, 1), spin]
        both = torch.cat(odd, dim=-1)
        # Towards the second node, then back.
        pairs = torch.stack((torch.cat((both, arms[1]), dim=-1), torch.cat((-both, arms[0]), dim=-1)), dim=-2)
        return pad(pairs.flatten(-3, -2), (0, 0, self.edges - 2 * self.count, 0))

    def _turn(self, ends: list[Tensor], where: slice) -> Tensor:
        """Return twice the vector part of the quaternion from the second frame to the first, in the canonical frame."""
        first, second = (
            quaternion.product(end[..., where], turn.to(end.dtype).expand_as(end[..., where]))
            for end, turn in zip(ends, self.turns, strict=True)
        )
        relative = quaternion.product(first, quaternion.conjugate(second))
        return torch.where(relative[..., :1] < 0, -2.0, 2.0) * relative[..., 1:]

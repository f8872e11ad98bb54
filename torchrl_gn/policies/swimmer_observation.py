"""Observations of the suite's swimmers, from body states."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_gn.maths import quaternion
from torchrl_gn.scenes import Scene

_NOSE = (0.0, -0.06, 0.0)  # in the head's frame, metres


class SwimmerObservation(TensorDictModuleBase):
    """Observation of the suite's swimmers from body states: policies learned there then act in any environment here.

    Reads ``state`` ``[*B, N, 13]`` and ``target`` ``[*B, 3]`` (metres, world frame), writes float32 ``observation``
    ``[*B, O]``, arranged as :meth:`ObservationGraph.swimmer <torchrl_gn.scenes.ObservationGraph.swimmer>`: joint
    angles, vector from nose to target in the head's frame, velocities of every link in its own frame. Differentiable.

    Raises ValueError if the scene's nodes are not those of a swimmer.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        links = ["head", *(f"segment_{link}" for link in range(scene.num_nodes - 2))]
        if list(scene.node_names[1:]) != links:
            raise ValueError(f"Scene {scene.name!r} is no swimmer of the suite; its nodes are {scene.node_names}.")
        self.in_keys: list[NestedKey] = ["state", "target"]
        self.out_keys: list[NestedKey] = ["observation"]

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, target = (tensordict[key] for key in self.in_keys)
        return tensordict.set("observation", self.observe(state, target))

    def observe(self, state: Tensor, target: Tensor) -> Tensor:
        """Observation ``[*B, O]`` of states ``[*B, N, 13]`` and targets ``[*B, 3]``."""
        links = state[..., 1:, :]
        rotation = links[..., 3:7]
        before, after = rotation[..., :-1, :], rotation[..., 1:, :]
        between = quaternion.product(quaternion.conjugate(before), after)
        angles = 2 * torch.atan2(between[..., 3], between[..., 0])
        angles = torch.remainder(angles + torch.pi, 2 * torch.pi) - torch.pi
        back = quaternion.conjugate(rotation)
        nose = links[..., 0, :3] + quaternion.rotate(rotation[..., 0, :], state.new_tensor(_NOSE))
        to_target = quaternion.rotate(back[..., 0, :], target.to(state.dtype) - nose)[..., :2]
        linear, angular = (quaternion.rotate(back, part) for part in links[..., 7:].split(3, dim=-1))
        velocities = torch.cat((linear[..., :2], angular[..., 2:]), dim=-1).flatten(-2)
        return torch.cat((angles, to_target, velocities), dim=-1).float()

"""What the suite's swimmers observe, from body states."""

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
    """Observation of the suite's swimmers out of body states: policies learned there then act in any environment here.

    Reads ``state`` ``[*B, N, 13]`` and ``target`` ``[*B, 3]`` (metres, world frame), writes ``observation`` ``[*B, O]``
    in float32: angles of the joints, the way from nose to target in the head's frame, velocities of every link in its
    own frame, as :meth:`ObservationGraph.swimmer <torchrl_gn.scenes.ObservationGraph.swimmer>` arranges them. Put it
    before the policy, in a ``TensorDictSequential``.

    Differentiable in states and target.

    Args:
        scene: a swimmer of any length.

    Raises:
        ValueError: if the scene's nodes are not those of a swimmer.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        links = ["head", *(f"segment_{project}" for project in range(scene.num_nodes - 2))]
        if list(scene.node_names[1:]) != links:
            raise ValueError(f"Scene {scene.name!r} is no swimmer of the suite; its nodes are {scene.node_names}.")
        self.in_keys: list[NestedKey] = ["state", "target"]
        self.out_keys: list[NestedKey] = ["observation"]

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the observation into ``tensordict`` and return it."""
        state, target = (tensordict[key] for key in self.in_keys)
        return tensordict.set("observation", self.observe(state, target))

    def observe(self, state: Tensor, target: Tensor) -> Tensor:
        """Observation ``[*B, O]`` of states ``[*B, N, 13]`` and targets ``[*B, 3]``."""
        links = state[..., 1:, :]
        turned = links[..., 3:7]
        before, after = turned[..., :-1, :], turned[..., 1:, :]
        between = quaternion.product(quaternion.conjugate(before), after)
        angles = 2 * torch.atan2(between[..., 3], between[..., 0])
        angles = torch.remainder(angles + torch.pi, 2 * torch.pi) - torch.pi
        back = quaternion.conjugate(turned)
        nose = links[..., 0, :3] + quaternion.rotate(turned[..., 0, :], state.new_tensor(_NOSE))
        way = quaternion.rotate(back[..., 0, :], target.to(state.dtype) - nose)[..., :2]
        linear, angular = (quaternion.rotate(back, part) for part in links[..., 7:].split(3, dim=-1))
        velocities = torch.cat((linear[..., :2], angular[..., 2:]), dim=-1).flatten(-2)
        return torch.cat((angles, way, velocities), dim=-1).float()

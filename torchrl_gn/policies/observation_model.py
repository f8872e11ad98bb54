"""Forward model of flat observations, and observations from body states."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from torchrl_gn.maths import quaternion
from torchrl_gn.maths.normalizer import Normalizer, unchanged_on_error
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.policies.observation_network import ObservationNetwork, sharing_weights
from torchrl_gn.scenes import ObservationGraph, Scene

_NOSE = (0.0, -0.06, 0.0)  # position in the frame of the swimmer's head, metres


class ObservationModel(TensorDictModuleBase):
    """Forward model of a task's observations (paper, SM "SVG": the model of the agents that learn by planning).

    Reads ``observation`` ``[*B, O]`` and ``action`` ``[*B, A]``, writes ``("next", "observation")``; differentiable in
    both and in the weights. The network predicts normalised changes of node, joint and global features. Changes of a
    joint are read at the node that it moves; changes of globals are sums over nodes. All outputs are thus at nodes, as
    folding the network requires. ``options`` are those of :class:`ObservationNetwork`.
    """

    take: Tensor

    def __init__(
        self,
        graph: ObservationGraph,
        *,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        **options: Any,
    ) -> None:
        super().__init__()
        self.in_keys: list[NestedKey] = [observation_key, action_key]
        self.out_keys: list[NestedKey] = [unravel_key(("next", observation_key))]
        slots, globals_ = graph.node_entries.shape[1], len(graph.global_entries)
        self.network = ObservationNetwork(graph, slots + globals_, actions=True, **options)
        self.change_normalizer = Normalizer(slots, floor=1e-6)
        self.global_change_normalizer = Normalizer(globals_, floor=1e-6)
        self.register_buffer("take", torch.as_tensor(graph.observation_at), persistent=False)

    @property
    def graph(self) -> ObservationGraph:
        return self.network.graph

    def for_graph(self, graph: ObservationGraph) -> ObservationModel:
        """Return the model for another graph, with shared weights; see :meth:`ObservationNetwork.for_graph`."""
        model = sharing_weights(self)
        model.network = self.network.for_graph(graph)
        model.take = torch.as_tensor(graph.observation_at).to(self.take.device)
        return model

    @property
    def fitted(self) -> bool:
        """True if the normalisers have data; reading it synchronises with the device."""
        return self.network.fitted and self.change_normalizer.fitted and self.global_change_normalizer.fitted

    @property
    def change_std(self) -> Tensor:
        """Standard deviation ``[O]`` of the change of each number, 0 where it never varied."""
        return self._flat(self.change_normalizer.std, self.global_change_normalizer.std)

    def _flat(self, slots: Tensor, globals_: Tensor) -> Tensor:
        """Arrange numbers of slots and globals in the order of the observation."""
        every_node = slots.expand(self.graph.num_nodes, -1).flatten()
        return torch.cat((every_node, globals_))[self.take]

    @torch.no_grad()
    def update_normalizers(self, observation: Tensor, action: Tensor, next_observation: Tensor) -> None:
        """Add transitions ``[*B, O]``, ``[*B, A]``, ``[*B, O]``; ValueError if misshapen or not finite."""
        places = self.network.places
        if next_observation.shape != observation.shape:
            raise ValueError(
                f"Next observations must be {list(observation.shape)} as observations, got"
                f" {list(next_observation.shape)}."
            )
        change = next_observation - observation
        with unchanged_on_error(self):
            self.network.update_normalizers(observation, action)
            slots = torch.nn.functional.pad(change, (0, 1))[..., places.slots]
            self.change_normalizer.update(slots, places.mask)
            self.global_change_normalizer.update(change[..., places.globals_])

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, action = (tensordict[key] for key in self.in_keys)
        return tensordict.set(self.out_keys[0], self.step(observation, action))

    @without_autocast
    def step(self, observation: Tensor, action: Tensor) -> Tensor:
        """Predict the next observation ``[*B, O]``; ValueError if a shape does not fit the graph."""
        mean = self._flat(self.change_normalizer.mean, self.global_change_normalizer.mean)
        change = self._change(observation, action) * self.change_std.to(observation.dtype)
        return observation + change + mean.to(observation.dtype)

    @without_autocast
    def normalized_change(self, observation: Tensor, action: Tensor) -> Tensor:
        """Predict the change ``[*B, O]`` in standard deviations, 0 where the change never varied."""
        change = self._change(observation, action)
        mean = self._flat(self.change_normalizer.mean, self.global_change_normalizer.mean)
        inverse = self._flat(self.change_normalizer.inverse_std, self.global_change_normalizer.inverse_std)
        return change + (mean * inverse).to(change.dtype)

    def _change(self, observation: Tensor, action: Tensor) -> Tensor:
        """Predict the change ``[*B, O]`` in standard deviations from its mean."""
        out = self.network(observation, action).to(observation.dtype)
        slots = self.network.places.slots.shape[1]
        nodes, globals_ = out[..., :slots], out[..., slots:].sum(-2)
        return torch.cat((nodes.flatten(-2), globals_), dim=-1)[..., self.take]


class SwimmerObservation(TensorDictModuleBase):
    """Observation of the suite's swimmers from body states, for policies from the suite in other environments.

    Reads ``state`` ``[*B, N, 13]`` and ``target`` ``[*B, 3]`` (metres, world frame), writes float32 ``observation``
    ``[*B, O]``, arranged as :meth:`ObservationGraph.swimmer <torchrl_gn.scenes.ObservationGraph.swimmer>`: joint
    angles, vector from nose to target in the head's frame, velocities of every link in its own frame. Differentiable.

    ValueError if the scene's nodes are not a swimmer's.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        links = ["head", *(f"segment_{link}" for link in range(scene.num_nodes - 2))]
        if list(scene.node_names[1:]) != links:
            raise ValueError(f"Scene {scene.name!r} is not a swimmer of the suite; its nodes are {scene.node_names}.")
        self.in_keys: list[NestedKey] = ["state", "target"]
        self.out_keys: list[NestedKey] = ["observation"]

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, target = (tensordict[key] for key in self.in_keys)
        return tensordict.set("observation", self.observe(state, target))

    @without_autocast
    def observe(self, state: Tensor, target: Tensor) -> Tensor:
        """Return the observation ``[*B, O]`` of states ``[*B, N, 13]`` and targets ``[*B, 3]``."""
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

"""Graph-network policy over states, for robots with any number of bodies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.core import FoldedCore
from torchrl_gn.networks.gn_core import GNCore
from torchrl_gn.networks.graph import GraphSize
from torchrl_gn.policies.body_frame_features import BodyFrameFeatures
from torchrl_gn.policies.bounded_policy import BoundedPolicy
from torchrl_gn.policies.observation_network import sharing_weights
from torchrl_gn.policies.state_features import StateFeatures, check_hidden
from torchrl_gn.scenes import Scene
from torchrl_gn.scenes.articulation import require_timestep


class GraphStatePolicy(BoundedPolicy):
    """Graph-network policy from ``state`` ``[*B, N, 13]`` to ``action`` ``[*B, A]`` within the scene's bounds.

    Two GN blocks run over :class:`BodyFrameFeatures`; a joint's actions are outputs of the body that it moves. The same
    weights drive other scenes (:meth:`for_scene`). Several scenes can learn together, each with its own
    :class:`~torchrl_gn.objectives.SHACLoss`; their gradients add. The rest is as in
    :class:`~torchrl_gn.policies.StatePolicy`, but all bodies share the learned standard deviations of a body's actions.

    Args:
        hidden, latent: sizes as in the forward model's core.
        canonicalizer: invariances of the task, see :func:`~torchrl_gn.policies.task_invariances`. Default: none.

    Raises:
        ValueError: the scene has no actions, actions without bounds, or an action that is not at exactly one joint.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> policy = GraphStatePolicy(load_scene("swimmer3"))
        >>> longer = policy.for_scene(load_scene("swimmer6"))
        >>> longer.act(torch.zeros(5, 7, 13)).shape
        torch.Size([5, 5])
    """

    features: BodyFrameFeatures  # pyright: ignore[reportIncompatibleVariableOverride]
    slots: Tensor
    take: Tensor
    _folded: FoldedCore | None = None

    def __init__(
        self,
        scene: Scene,
        *,
        hidden: Sequence[int] = (64, 64),
        latent: int = 64,
        canonicalizer: Canonicalizer | None = None,
    ) -> None:
        nodes, slots = _places(scene)
        super().__init__(scene, count := int(slots.max(initial=-1)) + 1)
        self.hidden, self.latent = check_hidden(hidden), latent
        self.features = BodyFrameFeatures(scene, canonicalizer or Canonicalizer(recenter=False, yaw=False))
        self.network = GNCore(self.features.size, GraphSize(0, 1, 0), count, hidden=self.hidden, latent=latent)
        self._read_at(nodes, slots)

    def _read_at(self, nodes: np.ndarray, slots: np.ndarray) -> None:
        device = self.log_std.device
        for name, value in (("slots", slots), ("take", nodes * len(self.log_std) + slots)):
            self.register_buffer(name, torch.as_tensor(value, device=device), persistent=False)

    @property
    def log_stds(self) -> Tensor:
        return self.log_std[self.slots]

    def for_scene(self, scene: Scene) -> GraphStatePolicy:
        """Return the policy for another scene, with shared weights and statistics.

        ValueError if the scene has another timestep, other invariances or features, or more actions per body.
        """
        if scene is self.scene:
            return self
        nodes, slots = _places(scene)
        if slots.max(initial=-1) >= len(self.log_std):
            raise ValueError(
                f"A body of scene {scene.name!r} has {slots.max() + 1} actions, the policy has {len(self.log_std)}."
            )
        features = BodyFrameFeatures(scene, self.features.options).to(self.log_std.device)
        if features.size != self.features.size:
            raise ValueError(
                f"The policy's features have other sizes in scene {scene.name!r} than in {self.scene.name!r}: both need"
                " a yaw frame, or neither, and equally many activations."
            )
        if different := features.differs_from(self.features):
            raise ValueError(
                f"The policy was learned in scene {self.scene.name!r}, and {scene.name!r} has {different}, so that"
                " features would have another meaning."
            )
        require_timestep(scene, self.scene.timestep, "The policy")
        features.node_normalizer, features.edge_normalizer = (
            self.features.node_normalizer,
            self.features.edge_normalizer,
        )
        policy = sharing_weights(self)
        policy.features = features
        policy.bound_to(scene)
        policy._read_at(nodes, slots)
        return policy

    @without_autocast
    def unbounded(self, state: Tensor, target: Tensor | None = None) -> Tensor:
        core = self._fold() if self._folded is None else self._folded
        return core.predict(self.features(state, self.log_std.dtype)).flatten(-2)[..., self.take]

    @without_autocast
    def _fold(self) -> FoldedCore:
        return self.network.fold(self.features.incidence, self.features.static_graph(self.log_std))

    @contextmanager
    def prepared(self) -> Iterator[None]:
        self._folded = self._fold()
        try:
            yield
        finally:
            self._folded = None

    def description(self) -> dict[str, Any]:
        description = {"scene": self.scene.description(), "canonicalizer": asdict(self.features.options)}
        return {**description, "hidden": self.hidden, "latent": self.latent}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> GraphStatePolicy:
        return cls(**StateFeatures.arguments_from(description))


def _places(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return each action's row among the moving bodies, and its index among the actions of its body."""
    edges = scene.edge_action[::2]  # each joint's edge from its parent
    nodes, slots, slots_used = [], [], np.zeros(scene.num_nodes, int)
    row = np.cumsum(scene.predicted) - 1
    for action in range(scene.num_actions):
        joints = np.flatnonzero((edges == action).any(1))
        if len(joints) != 1:
            raise ValueError(
                f"A graph policy reads every action at its joint; action {action} of {scene.name!r} has {len(joints)}."
            )
        body = scene.receivers[::2][joints[0]]
        nodes.append(row[body])
        slots.append(slots_used[body])
        slots_used[body] += 1
    return np.array(nodes, int), np.array(slots, int)

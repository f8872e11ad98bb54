"""Reward of the control suite's reaching tasks, on observations."""

from __future__ import annotations

import math

from torch import Tensor, nn

from torchrl_gn.scenes import ObservationGraph


class TargetDistance(nn.Module):
    """The suite's reward for reaching a target: 1 within ``radius`` of the target, less at larger distances.

    At a distance ``d``, ``1 / (1 + (3 (d - radius) / margin)^2)``, as ``dm_control.utils.rewards.tolerance`` with a
    long tail. ``entry`` of the observation is the vector to the target. The gradient there is 0.
    """

    def __init__(
        self, graph: ObservationGraph, entry: str = "to_target", *, radius: float = 0.1, margin: float = 0.5
    ) -> None:
        super().__init__()
        if entry not in graph.observation:
            raise ValueError(f"Observations of {graph.name!r} have no {entry!r}; there are {list(graph.observation)}.")
        if not (0 < radius < math.inf and 0 < margin < math.inf):
            raise ValueError(f"radius={radius} and margin={margin} must be positive and finite.")
        names = list(graph.observation)
        start = sum(graph.observation[name] for name in names[: names.index(entry)])
        self.where, self.radius, self.margin = slice(start, start + graph.observation[entry]), radius, margin

    def forward(self, observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
        square = next_observation[..., self.where].square().sum(-1, keepdim=True)
        # Clamp before the root: its gradient stays finite at 0.
        beyond = square.clamp(min=self.radius**2).sqrt() - self.radius
        return 1 / (1 + (3 * beyond / self.margin).square())

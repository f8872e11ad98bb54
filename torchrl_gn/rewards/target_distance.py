"""Reward of the control suite's reaching tasks, on observations."""

from __future__ import annotations

import math

from torch import Tensor, nn

from torchrl_gn.scenes import ObservationGraph


class TargetDistance(nn.Module):
    """The suite's reward for reaching a target, from the observed vector to the target.

    1 within ``radius``; at larger distances ``d`` it is ``1 / (1 + (3 (d - radius) / margin)^2)``
    (``dm_control.utils.rewards.tolerance`` with a long tail). The gradient at the target is 0.

    Args:
        graph: graph of the observations.
        entry: entry of the observation that holds the vector to the target.
        radius: size of the target, metres; 0.1 for the suite's swimmers.
        margin: metres beyond the radius at which the reward is 0.1.

    Raises:
        ValueError: there is no such entry, or a length is not positive and finite.
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
        """Reward ``[*B, 1]`` of the observation ``[*B, O]`` after the step."""
        square = next_observation[..., self.where].square().sum(-1, keepdim=True)
        # Clamp before the root: its gradient stays finite at 0.
        beyond = square.clamp(min=self.radius**2).sqrt() - self.radius
        return 1 / (1 + (3 * beyond / self.margin).square())

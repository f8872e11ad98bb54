"""Errors of predicted poses in metres and radians, as in the literature on contacts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from numbers import Integral
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_gn.dynamics import AdaptedPredictor, BoundEnsemble, Predictor
from torchrl_gn.dynamics.predictor import require_bound
from torchrl_gn.evaluation.rollout import rollout_of
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes.checked_trajectories import (
    check_episodes,
    check_numbers,
    check_trajectories,
    require_trajectories,
)


class PoseErrors(NamedTuple):
    """Mean errors of each rollout over its steps; infinite if it diverged."""

    position: Tensor  # [M] distance, metres
    rotation: Tensor  # [M] angle, radians

    def to_metrics(self) -> dict[str, float]:
        """Return means and medians over the rollouts by name."""
        each = {"position": self.position, "rotation": self.rotation}
        means = {f"{name}_error": value.mean().item() for name, value in each.items()}
        return means | {f"{name}_error/median": value.median().item() for name, value in each.items()}


@torch.no_grad()
def pose_errors(
    model: Predictor | BoundEnsemble | AdaptedPredictor | Callable[[Tensor, Tensor], Tensor],
    trajectories: TensorDictBase,
    *,
    node: int | None = None,
) -> PoseErrors:
    """Return mean distances and angles between one body's predicted and true poses in rollouts from state 0.

    Args:
        model: a bound or specialised model, an ensemble, an adapted model, or known physics: a function of state and
            action.
        trajectories: ``[M]`` of ``state`` ``[M, T + 1, N, 13]``, ``action`` ``[M, T, A]`` and, if the model reads them,
            physical parameters ``[M]`` at its ``parameters_key``.
        node: the body's node, one that moves. Default for a model: the first that moves, the base of a robot.

    Raises:
        KeyError: if parameters that the model reads are missing.
        TypeError: if the model is not bound to a scene, or the trajectories are no TensorDict.
        ValueError: if trajectories are not finite, or of another control step or shape; if they are of other variants
            than the scene of a model that reads no parameters; if ``node`` is no node, or its body cannot move; if
            physics come without ``node``.
    """
    require_bound(model)
    require_trajectories(trajectories)
    state, action = trajectories.get("state"), trajectories.get("action")
    if isinstance(model, (Predictor, BoundEnsemble, AdaptedPredictor)):
        check_trajectories(trajectories, model.scene, layout=model.layout)
        nodes = np.flatnonzero(model.scene.predicted).tolist()
        node = nodes[0] if node is None else _checked_node(node, nodes)
        predicted = rollout_of(model, trajectories)[:, 1:]
    elif node is None:
        raise ValueError("Physics have no default body: pass node=.")
    else:
        check_episodes(trajectories)
        check_numbers(state, action, BODY_STATE)
        node = _checked_node(node, range(state.shape[2]))
        current, steps = state[:, 0], []
        for now in action.unbind(1):
            current = model(current, now)
            steps.append(current)
        predicted = torch.stack(steps, 1)
    predicted, truth = predicted[:, :, node, :7].double(), state[:, 1:, node, :7].double().to(predicted.device)
    position = (predicted[..., :3] - truth[..., :3]).norm(dim=-1).mean(1)
    rotation = quaternion.angle(predicted[..., 3:], truth[..., 3:]).mean(1)
    return PoseErrors(*(torch.where(error.isfinite(), error, torch.inf) for error in (position, rotation)))


def _checked_node(node: int, nodes: Sequence[int]) -> int:
    """Return the node; ValueError unless it is one of those that move."""
    if not isinstance(node, Integral) or node not in nodes:
        raise ValueError(f"node={node!r} must be a node whose body moves: {list(nodes)}.")
    return int(node)

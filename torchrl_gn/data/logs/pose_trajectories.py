"""Trajectories of a scene from a log of body poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_gn.checks import check_counts
from torchrl_gn.data.logs.logged_trajectories import chosen_episodes
from torchrl_gn.data.logs.pose_log import PoseLog
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes import Scene
from torchrl_gn.scenes.articulation import require_timestep


def pose_trajectories(
    log: PoseLog,
    scene: Scene,
    steps: int,
    *,
    stride: int | None = None,
    episodes: Sequence[int] | np.ndarray | None = None,
) -> TensorDict:
    """Cut a log into trajectories of equal length, each within an episode.

    Args:
        log: log of the scene's moving bodies, in the order of its nodes.
        scene: scene with the log's control step. Bodies that do not move stay as in its model.
        steps: steps of each trajectory.
        stride: steps between the starts of trajectories; default: ``steps``, so that none overlap.
        episodes: indices of the episodes to use; default: all.

    Returns:
        TensorDict ``[M]``, float64, of ``state`` ``[M, steps + 1, N, 13]``, ``action`` ``[M, steps, A]`` and integer
        ``episode`` ``[M]``.

    Raises:
        ValueError: if log and scene differ in bodies, actions or time step, or no episode is long enough.
    """
    stride = steps if stride is None else stride
    check_counts(steps=steps, stride=stride)
    require_timestep(scene, log.timestep, "The log")
    nodes, counts = np.flatnonzero(scene.predicted), (log.state.shape[1], log.action.shape[1])
    if scene.state_size > BODY_STATE.size or counts != (len(nodes), scene.num_actions):
        names = [scene.node_names[node] for node in nodes]
        raise ValueError(
            f"The log has {counts[0]} bodies and {counts[1]} actions; scene {scene.name!r} moves {names} by"
            f" {scene.num_actions} actions, and must have no activations, delays or joints whose angles are state."
        )
    begins = np.r_[0, np.cumsum(log.length)]
    chosen = chosen_episodes(episodes, len(log.length))
    starts = {episode: np.arange(0, log.length[episode] - steps, stride) for episode in chosen}
    which = np.concatenate([np.full(len(each), episode) for episode, each in starts.items()] or [np.zeros(0, int)])
    if not len(which):
        longest = max((int(log.length[episode]) for episode in chosen), default=0)
        raise ValueError(f"No episode has {steps} steps; the longest has {longest} rows.")
    rows = (begins[which] + np.concatenate(list(starts.values())))[:, None] + np.arange(steps + 1)
    state = np.tile(scene.reference_state, (*rows.shape, 1, 1))
    state[:, :, nodes] = log.state[rows]
    entries = {"state": state, "action": log.action[rows[:, :-1]], "episode": which}
    return TensorDict({name: torch.from_numpy(value) for name, value in entries.items()}, batch_size=[len(which)])

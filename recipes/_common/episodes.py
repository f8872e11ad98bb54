"""Episodes under a planner: records, files, summaries and videos."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.evaluation import rollout_video
from torchrl_gn.scenes import Scene
from torchrl_gn.training.tensor_files import load_tensors, write_tensors

TIME_FIRST = ("seconds", "planned")  # records [T, ...], of all episodes together or of the first alone


class Episodes:
    """Episodes under one planner, saved to a file and resumed from it.

    Args:
        path: the file.
        start: TensorDict ``[B]`` to begin with, if the file does not exist.
    """

    def __init__(self, path: Path, start: TensorDictBase) -> None:
        self.path, self.now = path, start
        self.records: dict[str, list[Tensor]] = {name: [] for name in ("state", "action", "reward", *TIME_FIRST)}
        self.records["state"].append(start["state"])
        if path.exists():
            saved = read_episodes(path, *self.records, "now.state")
            flat = {key.removeprefix("now."): value for key, value in saved.items() if key.startswith("now.")}
            batch = start.batch_size
            self.now = cast(TensorDictBase, TensorDict(flat, batch_size=batch).unflatten_keys("."))
            for name, record in self.records.items():
                values = saved[name]
                record[:] = list(values.unbind(0) if name in TIME_FIRST else values.unbind(1))

    def __len__(self) -> int:
        return len(self.records["action"])

    def __getitem__(self, name: str) -> Tensor:
        """Return a record: ``[B, T, ...]`` for states, actions and rewards, ``[T, ...]`` for seconds and planned."""
        record = self.records[name]
        if not record:
            return torch.zeros(0)
        return torch.stack(record, dim=0 if name in TIME_FIRST else 1)

    @property
    def over(self) -> Tensor:
        """True for each of the episodes ``[B]`` that ended early because its simulation became unstable."""
        return self.records["state"][-1].isnan().flatten(1).any(1)

    def record(self, now: TensorDictBase, step: Mapping[str, Tensor]) -> None:
        """Append the records of a step; ``now`` is the episodes' state after it."""
        self.now = now
        for name, value in step.items():
            self.records[name].append(value)

    def save(self) -> None:
        """Write all records atomically, if there is a step."""
        if not len(self):
            return
        now = {f"now.{key}": value for key, value in self.now.flatten_keys(".").items()}
        write_tensors(self.path, now | {name: self[name] for name in self.records})


def read_episodes(path: str | Path, *needed: str) -> dict[str, Tensor]:
    """Read the records of saved episodes by name, with states and actions at least.

    Raises:
        ValueError: if the file is missing or damaged, lacks a ``needed`` record, or has an incomplete step.
    """
    records = load_tensors(path)
    if missing := [name for name in ("state", "action", *needed) if name not in records]:
        raise ValueError(f"{path} has no {', '.join(missing)}: it is not a file of episodes of recipes/mpc.py.")
    episodes, steps = (*records["action"].shape, 0, 0)[:2]
    wanted = {"state": [episodes, steps + 1], "reward": [episodes, steps], "seconds": [steps], "planned": [steps]}
    for name, size in wanted.items():
        if name in records and list(records[name].shape[: len(size)]) not in (size, [0] if name == "planned" else size):
            raise ValueError(
                f"{path} is damaged: {name} of shape {list(records[name].shape)} beside action of"
                f" {list(records['action'].shape)}, so that a step is not whole; delete it, or name another."
            )
    if (now := records.get("now.state")) is not None:
        last = records["state"][:, -1]
        going = ~last.isnan().flatten(1).any(1)  # episodes that did not become unstable
        if now.shape != last.shape or not torch.equal(now[going], last[going]):
            raise ValueError(
                f"{path} is damaged: its last states are not those that it goes on from, so that a step is missing;"
                " delete it, or name another."
            )
    return records


def transitions(path: Path) -> list[TensorDict]:
    """Return the steps ``[M, T]`` of saved episodes in the format of TorchRL's rollouts, grouped by length.

    An unstable episode ends at its last stable state.

    Raises:
        ValueError: if no episode has a stable step.
    """
    records = read_episodes(path, "reward")
    lengths = records["state"].isfinite().flatten(2).all(-1).sum(1) - 1
    found = []
    for length in lengths[lengths > 0].unique().tolist():
        state, action, reward = (records[name][lengths == length] for name in ("state", "action", "reward"))
        after = {"state": state[:, 1 : length + 1], "reward": reward[:, :length, None]}
        steps = {"state": state[:, :length], "action": action[:, :length], "next": after}
        found.append(TensorDict(steps, [len(state), length]))
    if not found:
        raise ValueError(f"{path} has no episode with a stable step.")
    return found


def planned_state(env: SceneEnv, imagined: ModelEnv | None, now: TensorDictBase) -> Tensor:
    """Return the last state ``[N, 13]`` of the first episode's plan, by the model or, without one, by MuJoCo."""
    plans = cast(Tensor, now["plan", "actions"])
    left = plans if plans.ndim == 3 else plans[:, 0]  # the best candidate
    actions = torch.cat((now["action"].unsqueeze(1), left[:, :-1]), dim=1)
    if imagined is None:
        ahead = env.simulator.rollout(now["physics"][:1], actions[:1])
        return ahead["state"][0, -1].where(ahead["stable"][0], torch.nan)
    # As many rows as the planner has: a compiled model is compiled anew for every number of rows.
    rows = 1 if plans.ndim == 3 else plans.shape[1]
    many = cast(TensorDictBase, now.repeat_interleave(rows, 0))
    return imagined.imagine(many, actions.repeat_interleave(rows, 0))[0][0, -1].detach()


def distance_left(episodes: Episodes, target: Tensor) -> Tensor:
    """Return the final over the initial distance ``[B]`` of a swimmer to its target."""
    away = (episodes["state"][:, [0, -1], 1, :2] - target[:, None, :2]).norm(dim=-1)
    return away[:, 1] / away[:, 0]


def summarize(episodes: Episodes, target: Tensor | None, goal: float | None = None) -> dict[str, float]:
    """Summarise a planner's episodes.

    ``target`` ``[B, 3]`` adds the remaining distance to the target. ``goal``, a reward per step, adds the number of
    episodes that reach the goal, the number that hold it throughout the last tenth, and the steps until the last
    episode reaches it.
    """
    rewards, seconds = episodes["reward"], episodes["seconds"]
    last = rewards[:, -max(1, rewards.shape[1] // 10) :]
    numbers = {
        "mean_reward": rewards.nanmean().item(),
        "mean_reward_std": standard_deviation(rewards.nanmean(1)),
        "last_tenth_reward": last.nanmean().item(),
        "unstable": episodes.over.sum().item(),
        "planning_ms": 1e3 * seconds.median().item(),
        "planning_ms_first": 1e3 * seconds[0].item(),
    }
    if target is not None:
        left = distance_left(episodes, target)
        numbers |= {"distance_left": left.nanmean().item(), "distance_left_std": standard_deviation(left)}
    if goal is not None:
        reached = rewards >= goal
        numbers |= {"reached": reached.any(1).sum().item(), "held": (last >= goal).all(1).sum().item()}
        numbers["steps_to_goal"] = 1.0 + max(reached.int().argmax(1)[reached.any(1)].tolist(), default=math.nan)
    return numbers


def standard_deviation(values: Tensor) -> float:
    """Return the standard deviation of the values that are not NaN."""
    return (values - values.nanmean()).square().nanmean().sqrt().item()


def film(episodes: Episodes, scene: Scene, horizon: int, path: Path) -> None:
    """Make a video of the first episode, beside the states that were planned one horizon earlier."""
    states, planned = episodes["state"][0], episodes["planned"]
    states = states[states.isfinite().flatten(1).all(1)]  # until its simulation became unstable
    speed, prediction = min(1.0, scene.timestep / 0.01), None
    if len(episodes) == len(planned) and len(states) > horizon + 1:
        prediction = torch.cat((states[:horizon], planned))[: len(states)]
    rollout_video(scene, states, prediction, path, speed=speed, labels=("executed", "planned a horizon before"))

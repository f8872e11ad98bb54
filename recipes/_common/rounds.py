"""Rounds of an actor-critic in a run folder: the files of each round, and how a run resumes after the last one."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from tensordict import TensorDict

from _common.tensor_files import load_tensors
from torchrl_gn.actor_critic import ActorCritic, ActorCriticOptions, ActorCriticTask
from torchrl_gn.atomic import atomic_path, read_json, write_json
from torchrl_gn.policies import BoundedPolicy
from torchrl_gn.training import load_pretrained, save_checkpoint
from torchrl_gn.training.checkpoint import CHECKPOINT_FILE
from torchrl_gn.training.tensor_files import write_tensors

_PLACES = {"value": "value.safetensors", "reward": "reward.safetensors", "model": CHECKPOINT_FILE}  # in a run folder
_KINDS = {"value": "value", "reward": "reward", "model": "trained"}  # attributes of a checkpoint


class Rounds:
    """The rounds of a run; a round is finished once its last file, that of its numbers, is written.

    Args:
        run: the run folder; its first round is in ``rounds/000``.
        tasks: the tasks; several have a folder each, in the run and in every round.
        config: the run's options, which its checkpoints hold.
    """

    def __init__(self, run: Path, tasks: Sequence[ActorCriticTask], config: Mapping[str, Any]) -> None:
        self.run, self.tasks, self.config = run, list(tasks), dict(config)
        self.finished = 0
        while self._numbers(self.finished).exists():
            self.finished += 1
        policy = run / "policy.safetensors"
        others = [run / self.folder(task) / _PLACES[what] for task in self.tasks for what in task.network_names]
        self.latest = [policy, *others]  # averaged policy, and networks of the last round

    def folder(self, task: ActorCriticTask) -> str:
        """Return the name of a task's folder; empty for a single task, whose files lie directly in the run or round."""
        return task.scene.name if len(self.tasks) > 1 else ""

    def _file(self, index: int, what: str, task: ActorCriticTask | None = None) -> Path:
        """Return the file of a round's ``policy``, or of a task's ``value``, ``model``, ``reward`` or ``played``."""
        inner = "" if task is None else self.folder(task)
        return self.run / "rounds" / f"{index:03}" / inner / f"{what}.safetensors"

    def _numbers(self, index: int) -> Path:
        return self.run / "rounds" / f"{index:03}" / "numbers.json"

    def begin(self, options: ActorCriticOptions) -> ActorCritic:
        """Return the actor-critic of the tasks: new, or as the last finished round left it."""
        if not self.finished:
            return ActorCritic(self.tasks, options)
        last = self.finished - 1
        kept = load_pretrained(self._file(last, "policy"))
        networks = [{what: self._network(last, what, task) for what in task.network_names} for task in self.tasks]
        learner = ActorCritic(self.tasks, options, kept.policy, networks)
        kept.resume(learner.load_state_dict)
        return learner

    def _network(self, index: int, what: str, task: ActorCriticTask) -> Any:
        return getattr(load_pretrained(self._file(index, what, task)), _KINDS[what])

    def collect(self) -> None:
        """Give the tasks their data: trajectories of random control, and the trajectories played in finished rounds."""
        for task in self.tasks:
            task.collect()
            for index in range(self.finished):
                played = load_tensors(self._file(index, "played", task))
                task.add(TensorDict(cast(Any, played), [len(played["action"])]))

    def numbers(self) -> list[dict[str, Any]]:
        """Return the numbers of the finished rounds."""
        return [read_json(self._numbers(index)) for index in range(self.finished)]

    def policies(self, indices: Iterable[int]) -> list[BoundedPolicy]:
        """Load the policies of rounds, on the CPU."""
        return [load_pretrained(self._file(index, "policy")).policy for index in indices]

    def save(self, learner: ActorCritic, played: Sequence[TensorDict], numbers: Mapping[str, Any]) -> None:
        """Write the next round: networks, the learner's state, played trajectories, and numbers."""
        index = self.finished
        for task, trajectories in zip(self.tasks, played, strict=True):
            self._file(index, "played", task).parent.mkdir(parents=True, exist_ok=True)
            for what, network in task.networks.items():
                scene = task.scene if what == "value" else task.modelled
                save_checkpoint(self._file(index, what, task), cast(Any, network), scene=scene, config=self.config)
            write_tensors(self._file(index, "played", task), dict(trajectories.items()))
        self._save_policy(self._file(index, "policy"), learner.policy, training=learner.state_dict())
        write_json(self._numbers(index), numbers, checked=True)
        self.finished += 1

    def keep_latest(self, averaged: BoundedPolicy) -> None:
        """Write the averaged policy, and the other networks of the last round, to their places in the run folder."""
        self._save_policy(self.latest[0], averaged)
        files = [self._file(self.finished - 1, what, task) for task in self.tasks for what in task.network_names]
        for source, target in zip(files, self.latest[1:], strict=True):
            target.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(target) as temporary:
                shutil.copyfile(source, temporary)

    def _save_policy(self, path: Path, policy: BoundedPolicy, **options: Any) -> None:
        save_checkpoint(path, policy, scene=[task.scene for task in self.tasks], config=self.config, **options)

"""Files of an actor-critic's rounds in a run folder; a run resumes after its last finished round."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from tensordict import TensorDict

from torchrl_gn.actor_critic.options import ActorCriticOptions
from torchrl_gn.actor_critic.task import ActorCriticTask
from torchrl_gn.actor_critic.trainer import ActorCritic
from torchrl_gn.atomic import atomic_path, read_json, write_json
from torchrl_gn.policies import BoundedPolicy
from torchrl_gn.training import load_pretrained, save_checkpoint
from torchrl_gn.training.checkpoint import CHECKPOINT_FILE, POLICY_FILE
from torchrl_gn.training.tensor_files import load_tensors, write_tensors

_PLACES = {"value": "value.safetensors", "reward": "reward.safetensors", "model": CHECKPOINT_FILE}  # in a run folder
_KINDS = {"value": "value", "reward": "reward", "model": "trained"}  # attributes of a checkpoint


class Rounds:
    """Files of the finished rounds of a run; a run resumes after its last finished round.

    Round 0 is in ``rounds/000`` of the run folder: policy, networks and played trajectories as safetensors, and the
    numbers as JSON. The numbers are written last: a round without them is not finished, and :meth:`save` replaces its
    files. A resumed run equals an uninterrupted one if torch's generator is seeded in every round.

    Args:
        run: the run folder.
        tasks: the tasks; their networks are among ``"value"``, ``"model"`` and ``"reward"``. Several tasks have a
            folder each, in the run folder and in every round.
        config: the run's options, which its checkpoints hold.

    Attributes:
        finished: number of finished rounds.
        latest: files of :meth:`keep_latest`: the averaged policy, and the networks of the last round.

    Example:
        >>> import torch
        >>> from tempfile import TemporaryDirectory
        >>> from torchrl_gn.actor_critic import FirstTrajectories
        >>> from torchrl_gn.rewards import make_reward
        >>> from torchrl_gn.scenes import load_scene
        >>> small = {"model": {"hidden": 8, "latent": 8}, "hidden": [8], "horizon": 3, "batch_size": 8, "steps": 50}
        >>> first = FirstTrajectories(trajectories=2, length=50, steps=2)
        >>> options = ActorCriticOptions(first=first, updates=2, model_steps=2, **small)
        >>> scene = load_scene("pendulum")
        >>> task = ActorCriticTask(scene, options, make_reward("balance", scene))
        >>> folder = TemporaryDirectory()
        >>> rounds = Rounds(folder.name, [task], {"system": "pendulum"})
        >>> learner = rounds.begin(options)
        >>> rounds.collect()
        >>> for index in range(rounds.finished, 2):
        ...     seed = torch.manual_seed(index)
        ...     losses = learner.learn(index)
        ...     played = task.play(learner.playing(), seed=index)
        ...     task.add(played)
        ...     rounds.save(learner, [played], losses)
        >>> policies = rounds.policies(learner.averaged_rounds(index))
        >>> rounds.keep_latest(learner.averaged(policies))
        >>> Rounds(folder.name, [task], {"system": "pendulum"}).finished
        2
        >>> folder.cleanup()
    """

    def __init__(self, run: str | os.PathLike, tasks: Sequence[ActorCriticTask], config: Mapping[str, Any]) -> None:
        self.run, self.tasks, self.config = Path(run), list(tasks), dict(config)
        self.finished = 0
        while self._numbers(self.finished).exists():
            self.finished += 1
        policy = self.run / POLICY_FILE
        others = [self.run / self.folder(task) / _PLACES[what] for task in self.tasks for what in task.network_names]
        self.latest = [policy, *others]

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
        """Return the actor-critic of the tasks: new, or as the last finished round left it.

        Raises:
            CheckpointError: a file of the last round is damaged, or does not fit the tasks.
            ValueError: the options do not suit the tasks, or the networks do not fit together.
        """
        if not self.finished:
            return ActorCritic(self.tasks, options)
        last = self.finished - 1
        checkpoint = load_pretrained(self._file(last, "policy"))
        networks = [{what: self._network(last, what, task) for what in task.network_names} for task in self.tasks]
        learner = ActorCritic(self.tasks, options, checkpoint.policy, networks)
        checkpoint.resume(learner.load_state_dict)
        return learner

    def _network(self, index: int, what: str, task: ActorCriticTask) -> Any:
        return getattr(load_pretrained(self._file(index, what, task)), _KINDS[what])

    def collect(self) -> None:
        """Give the tasks their data: trajectories of random control, and the trajectories played in finished rounds.

        Raises:
            ValueError: a file of played trajectories is missing or damaged.
        """
        for task in self.tasks:
            task.collect()
            for index in range(self.finished):
                played = load_tensors(self._file(index, "played", task))
                task.add(TensorDict(cast(Any, played), [len(played["action"])]))

    def numbers(self) -> list[dict[str, Any]]:
        """Return the numbers of the finished rounds; ValueError if a file of numbers is damaged."""
        return [read_json(self._numbers(index)) for index in range(self.finished)]

    def policies(self, indices: Iterable[int]) -> list[BoundedPolicy]:
        """Load the policies of finished rounds, on the CPU; for :meth:`ActorCritic.averaged`."""
        return [load_pretrained(self._file(index, "policy")).policy for index in indices]

    def save(self, learner: ActorCritic, played: Sequence[TensorDict], numbers: Mapping[str, Any]) -> None:
        """Write the next round: networks, the learner's state, played trajectories, and numbers.

        Args:
            learner: the actor-critic of the tasks.
            played: trajectories played in the round, one TensorDict for each task.
            numbers: plain values to keep, such as losses and returns.

        Raises:
            ValueError: a number is NaN or infinite; the round is then not finished.
            OSError: there is no disk space.
        """
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
        """Write the averaged policy to the run folder; copy the other networks of the last round there.

        The files are ``policy.safetensors``, ``value.safetensors``, the model's ``checkpoint`` folder and, if the
        reward is learned, ``reward.safetensors``.
        """
        self._save_policy(self.latest[0], averaged)
        files = [self._file(self.finished - 1, what, task) for task in self.tasks for what in task.network_names]
        for source, target in zip(files, self.latest[1:], strict=True):
            target.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(target) as temporary:
                shutil.copyfile(source, temporary)

    def _save_policy(self, path: Path, policy: BoundedPolicy, **options: Any) -> None:
        save_checkpoint(path, policy, scene=[task.scene for task in self.tasks], config=self.config, **options)

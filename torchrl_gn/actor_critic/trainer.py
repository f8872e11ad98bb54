"""Trainer of the short-horizon actor-critic: one policy, one or several tasks, round by round."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn

from torchrl_gn.actor_critic.optimizer import ActorCriticOptimizer
from torchrl_gn.actor_critic.options import ActorCriticOptions
from torchrl_gn.actor_critic.task import ActorCriticTask
from torchrl_gn.policies import BoundedPolicy, GraphStatePolicy, StatePolicy


class ActorCritic:
    """Train a policy in learned models of its tasks (:class:`~torchrl_gn.objectives.SHACLoss`), round by round.

    In a round :meth:`learn` trains each task's model and, if learned, its reward on all trajectories, and then the
    policy and the values in these models. The caller plays the policy :meth:`playing` with exploration and adds the
    trajectories. Weights and imagined noise come from torch's global generator: seed it by ``torch.manual_seed``.

    Args:
        tasks: one task; or several with a policy of kind ``"graph"``, which learns on all of them at once.
        policy: policy to continue with. Default: a new one, as ``options`` say.
        networks: networks of each task to continue with, see :attr:`ActorCriticTask.networks`. Default: new ones.

    Raises:
        ValueError: the kind of policy does not suit the tasks, or the networks do not fit together.

    Example:
        >>> from torchrl_gn.actor_critic import FirstTrajectories, SuiteActorCriticTask
        >>> small = {"model": {"hidden": 8, "latent": 8}, "hidden": [8], "horizon": 3, "batch_size": 8, "steps": 50}
        >>> small |= {"updates": 2, "model_steps": 2, "reward_steps": 2}
        >>> first = FirstTrajectories(trajectories=2, length=50, steps=2)
        >>> options = ActorCriticOptions(first=first, **small)
        >>> task = SuiteActorCriticTask("suite:cheetah/run", options)
        >>> learner = ActorCritic([task], options)
        >>> task.collect()
        >>> for index in range(2):
        ...     losses = learner.learn(index)
        ...     played = task.play(learner.playing(), seed=index)
        ...     task.add(played)
        >>> sorted(losses), len(task.data)
        (['entropy', 'imagined_reward', 'loss_value'], 3)
    """

    policy: BoundedPolicy

    def __init__(
        self,
        tasks: Sequence[ActorCriticTask],
        options: ActorCriticOptions,
        policy: BoundedPolicy | None = None,
        networks: Sequence[Mapping[str, nn.Module]] | None = None,
    ) -> None:
        if not tasks:
            raise ValueError("tasks= must have at least one.")
        self.tasks, self.options = list(tasks), options
        self.policy = self._new_policy() if policy is None else policy
        self.policy.to(self.tasks[0].device)
        for task, task_networks in zip(self.tasks, networks or [None] * len(self.tasks), strict=True):
            task.begin(self.policy.for_scene(task.scene), task_networks)
        rates = {"policy_lr": options.policy_lr, "value_lr": options.value_lr, "alpha_lr": options.alpha_lr}
        losses = [task.loss for task in self.tasks]
        self.optimizer = ActorCriticOptimizer(losses, value_steps=options.value_steps, **rates)

    def _new_policy(self) -> BoundedPolicy:
        first, options = self.tasks[0], self.options
        if options.policy == "graph":
            if any(task.targeted for task in self.tasks):
                raise ValueError("Episodes of this task have a target, which policy=graph does not read: use mlp.")
            return GraphStatePolicy(first.scene, canonicalizer=first.invariances, **options.graph)
        if len(self.tasks) > 1:
            raise ValueError(f"policy={options.policy} must be graph to learn on several systems.")
        arguments = {"hidden": options.hidden, "canonicalizer": first.invariances, "target": first.targeted}
        return StatePolicy(first.scene, **arguments)

    def learn(self, index: int) -> dict[str, float]:
        """Train the models, then policy and values in the models.

        Args:
            index: number of the round, from 0.

        Returns:
            Means over tasks and the last quarter of the updates: ``imagined_reward`` of a control step, ``loss_value``
            in variances of the value, and ``entropy`` of the actions, scaled to [-1, 1].

        Raises:
            RuntimeError: a task has no trajectories.
            FloatingPointError: a loss or a gradient is not finite; that step changes nothing.
        """
        for task in self.tasks:
            task.learn_model(index)
        batches = [task.starts() for task in self.tasks]
        sizes = {"updates": self.options.updates, "batch_size": self.options.batch_size // self.options.members}
        return self.optimizer.learn(batches, **sizes, desc=f"policy, round {index}")

    def playing(self) -> BoundedPolicy:
        """Return a copy of the policy on the CPU, where MuJoCo runs."""
        return copy.deepcopy(self.policy).cpu()

    def averaged_rounds(self, index: int) -> range:
        """Return the earlier rounds to average with round ``index``: an eighth of all, at most ``average - 1``."""
        return range(index + 1 - min(self.options.average, 1 + index // 8), index)

    def averaged(self, before: Sequence[BoundedPolicy]) -> BoundedPolicy:
        """Return a copy of the policy, with weights averaged over this round and earlier ones.

        The average is steadier than the policy of one round.

        Args:
            before: policies of the rounds that :meth:`averaged_rounds` names, on the CPU.
        """
        policy = self.playing()
        with torch.no_grad():
            for mean, *weights in zip(
                policy.parameters(), *(policy_before.parameters() for policy_before in before), strict=True
            ):
                mean.copy_(torch.stack([mean, *weights]).mean(0))
        return policy

    def state_dict(self) -> dict[str, Any]:
        """Return the state to resume from, without the networks."""
        return self.optimizer.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a :meth:`state_dict`; ValueError if it belongs to other networks or is malformed."""
        self.optimizer.load_state_dict(state)

"""Task of the control suite for an actor-critic: dm_control plays it; its reward is known or learned."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_gn.actor_critic.options import ActorCriticOptions
from torchrl_gn.actor_critic.task import EVALUATION_SEED, ActorCriticTask
from torchrl_gn.actor_critic.trajectories import play, unbroken, windows
from torchrl_gn.data import spline_controls
from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.envs import SuiteTaskEnv
from torchrl_gn.policies import BoundedPolicy, StateReward
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import has_target, hidden_by_task, load_scene, suite_name
from torchrl_gn.training import fit_reward

LEARNED = "learned"


class SuiteActorCriticTask(ActorCriticTask):
    """A task of the control suite; dm_control's reward evaluates the policy.

    A control step of policy and value is ``action_repeat`` frames of the suite. Model and reward predict one frame
    with ``per_frame``, else one control step: longer steps make contacts harder to predict.

    Args:
        system: the task's name, such as ``"suite:cheetah/run"``.
        reward: ``"learned"`` learns it from observed rewards; None takes the task's own differentiable reward; or terms
            for :func:`~torchrl_gn.rewards.make_reward`.

    Raises:
        ValueError: there is no such task, its reward is not known, or episodes are longer than the task's.
        ImportError: dm_control is missing.

    Example:
        >>> task = SuiteActorCriticTask("suite:cheetah/run", ActorCriticOptions(per_frame=True))
        >>> task.scene.timestep, task.modelled.timestep, task.network_names
        (0.02, 0.01, ('value', 'model', 'reward'))
    """

    def __init__(
        self,
        system: str,
        options: ActorCriticOptions,
        *,
        reward: str | Sequence[Mapping[str, Any]] | None = LEARNED,
    ) -> None:
        if suite_name(system) is None:
            raise ValueError(f"system={system!r} is not a task of the suite: give 'suite:cheetah/run', say.")
        frame = load_scene(system)
        scene = load_scene(system, timestep=options.action_repeat * frame.timestep)
        modelled, name = frame if options.per_frame else scene, scene.origin["suite"]
        recenter, yaw = hidden_by_task(*name.split("/"))
        hidden = Canonicalizer(recenter=recenter, yaw=yaw, full_rotation=False)
        self.learns_reward, self.frames_per_step = reward == LEARNED, options.action_repeat
        if self.learns_reward:
            self.network_names = (*self.network_names, "reward")
            arguments = {"hidden": options.hidden, "canonicalizer": hidden, "target": has_target(name)}
            reward_module = StateReward(modelled, **arguments)
        else:
            reward_module = make_reward(reward, modelled)
        super().__init__(scene, options, reward_module, modelled=modelled, invariances=hidden)
        lengths = {"steps": options.steps, "first.length": options.first.length}
        for option, steps in {**lengths, "evaluate.steps": options.evaluate.steps}.items():
            if steps is not None and steps > (longest := self._evaluation_env.steps):
                raise ValueError(f"{option}={steps}: an episode of suite:{name} has {longest} control steps.")

    @cached_property
    def _exploration_env(self) -> SuiteTaskEnv:
        return SuiteTaskEnv(self.scene, num_envs=self.options.episodes, frames=self.options.per_frame, seed=0)

    @cached_property
    def _evaluation_env(self) -> SuiteTaskEnv:
        return SuiteTaskEnv(self.scene, num_envs=self.options.evaluate.episodes, seed=EVALUATION_SEED)

    def begin(self, policy: BoundedPolicy, networks: Mapping[str, nn.Module] | None = None) -> None:
        if self.learns_reward:
            if networks is not None and "reward" in networks:
                self.reward = cast(StateReward, networks["reward"])
            cast(StateReward, self.reward).to(self.device)
        super().begin(policy, networks)

    @property
    def networks(self) -> dict[str, nn.Module]:
        learned = {"reward": cast(StateReward, self.reward)} if self.learns_reward else {}
        return {**super().networks, **learned}

    def play_at_random(self) -> TensorDict:
        first, episodes = self.options.first, []
        env = SuiteTaskEnv(self.scene, frames=self.options.per_frame, seed=self.options.seed)
        controls = spline_controls(self.scene, first.trajectories, first.length, self.options.seed)
        for sequence in torch.from_numpy(controls).float():
            episodes.append(play(env, _replay(sequence), episodes=1, steps=first.length))
        return self._windows(cast(TensorDict, torch.cat(episodes)))

    def play(self, policy: BoundedPolicy, seed: int) -> TensorDict:
        self._exploration_env.set_seed(seed)
        sizes = {"episodes": self.options.episodes, "steps": self.options.steps}
        return self._windows(play(self._exploration_env, self.explorer(policy, seed), **sizes))

    def evaluate(self, policy: Callable[[TensorDictBase], TensorDictBase]) -> TensorDict:
        self._evaluation_env.set_seed(EVALUATION_SEED)
        evaluate = self.options.evaluate
        sizes = {"episodes": evaluate.episodes, "steps": evaluate.steps or self._evaluation_env.steps}
        played = play(self._evaluation_env, self._driver(policy), **sizes)
        played["next", "reward"] = cast(Tensor, played["next", "reward"]) / self.frames_per_step
        return played

    def _windows(self, played: TensorDict) -> TensorDict:
        """Cut episodes into trajectories with the model's steps."""
        played = unbroken(played)
        if self.options.per_frame:
            state, reward = (played["next", name].flatten(1, 2) for name in ("frames", "frame_rewards"))
        else:
            state, reward = played["next", "state"], played["next", "reward"]
        state = torch.cat((played["state"][:, :1], state), 1)
        action = played["action"].repeat_interleave(self.model_steps, 1)
        target = played["target"][:, 0] if self.targeted else None
        return windows(state, action, reward, target)

    def learn_reward(self, data: TensorDict, index: int) -> None:
        if self.learns_reward:
            steps = self.options.reward_steps * (3 if index == 0 else 1)
            fit_reward(cast(StateReward, self.reward), data, steps=steps, seed=self.options.seed + index)


def _replay(actions: Tensor) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return a policy that replays ``actions`` ``[T, A]``."""
    remaining = iter(actions.unsqueeze(1))
    return lambda tensordict: tensordict.set("action", next(remaining))

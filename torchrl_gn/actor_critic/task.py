"""A task of a short-horizon actor-critic: a scene with its reward, and what learns of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_gn.actor_critic.options import ActorCriticOptions
from torchrl_gn.actor_critic.target_squares import TargetSquares
from torchrl_gn.actor_critic.trajectories import WINDOW, exploring, play, unbroken, windows
from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import (
    BoundEnsemble,
    BoundPredictor,
    Canonicalizer,
    Ensemble,
    ForwardModel,
    SpecializedPredictor,
    SplitEnsemble,
    specialize,
)
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.envs.starts import StartStates
from torchrl_gn.objectives import SHACLoss
from torchrl_gn.planners import BoundedPolicy, StateValue, task_invariances
from torchrl_gn.rewards import Reward
from torchrl_gn.scenes import Scene
from torchrl_gn.training import Workers, fit

JUDGED_STEPS = 500  # control steps of an episode
JUDGED_SEED = 10_000
_SCALED_BY = 10_000  # states to imagine from, by whose rewards the value is scaled


class ActorCriticTask:
    """A scene with its reward, and the model and value that learn for it, with their trajectories on one device.

    :class:`ActorCritic` calls :meth:`begin`, and in every round :meth:`learn_model` and :meth:`starts`. The caller
    plays: :meth:`collect` once, then :meth:`play` and :meth:`add` after each round. Subclass it to play elsewhere (a
    robot): override :meth:`play_at_random`, :meth:`play` and :meth:`judged`; or to learn more: :meth:`learn_reward`.

    Trajectories are ``[K]``: ``state`` ``[K, 51, N, 13]``, ``action`` ``[K, 50, A]`` of the model's steps, ``reward``
    ``[K, 50, 1]``, what they were paid, and, where they have one, ``target`` ``[K, 3]`` of the episode, metres.

    Args:
        scene: with the control step of the policy.
        reward: of a step of the model, differentiable.
        judge: reward of the judged episodes. Default: the same.
        squares: where the targets of a reward lie that goes to the origin. Default: the scene's own starts.
        judged_starts: of the judged episodes, as of :class:`~torchrl_gn.envs.SceneEnv`. Default: those of ``squares``.
        modelled: the scene with the control step of the model, of which an action is as many as fill it. Default: its.
        invariances: of the task. Default: those of scene and reward.

    Raises:
        ValueError: the reward has a target that the policy cannot know, or there is no such device.

    Example:
        >>> from torchrl_gn.actor_critic import FirstTrajectories
        >>> from torchrl_gn.rewards import make_reward
        >>> from torchrl_gn.scenes import load_scene
        >>> scene = load_scene("pendulum")
        >>> options = ActorCriticOptions(first=FirstTrajectories(trajectories=4, length=100))
        >>> task = ActorCriticTask(scene, options, make_reward("balance", scene))
        >>> task.collect()
        >>> task.newest["state"].shape
        torch.Size([8, 51, 2, 13])
    """

    value: StateValue
    trained: ForwardModel | Ensemble
    model: BoundPredictor | BoundEnsemble
    loss: SHACLoss

    network_names: tuple[str, ...] = ("value", "model")
    """What learns for the task beside the policy, by name."""

    def __init__(
        self,
        scene: Scene,
        options: ActorCriticOptions,
        reward: Reward,
        *,
        judge: Reward | None = None,
        squares: TargetSquares | None = None,
        judged_starts: StartStates | None = None,
        modelled: Scene | None = None,
        invariances: Canonicalizer | None = None,
    ) -> None:
        self.targeted = reward.target_shape is not None
        if self.targeted and "suite" not in scene.origin:
            raise ValueError(f"A policy of states does not know the target of {reward}.")
        self.scene, self.options, self.reward, self.judge = scene, options, reward, judge or reward
        self.modelled = modelled or scene
        self.model_steps = round(scene.timestep / self.modelled.timestep)  # under an action
        self.device = Workers().device(options.device)
        self.squares = squares
        own_starts = None if squares is None else squares.start_states
        self.judged_starts = own_starts if judged_starts is None else judged_starts
        self.invariances = invariances or task_invariances(scene, reward)
        self.data: list[TensorDict] = []

    def begin(self, policy: BoundedPolicy, networks: Mapping[str, nn.Module] | None = None) -> None:
        """Make the networks and the loss of a policy, bound to the scene.

        Args:
            networks: to go on with, by :attr:`network_names`. Default: new ones, from torch's generator.

        Raises:
            ValueError: one of the networks is missing.
        """
        options = self.options
        if networks is None:
            model = self._new_model()
            given = {"discount": options.discount, "hidden": options.hidden, "target": self.targeted}
            self.value = StateValue(self.scene, combine="mean", canonicalizer=self.invariances, **given)
        else:
            if missing := set(self.network_names) - set(networks):
                raise ValueError(f"networks= lacks {sorted(missing)}: give all of {list(self.network_names)}, or none.")
            model, self.value = networks["model"], cast(StateValue, networks["value"])
        self.trained = cast("ForwardModel | Ensemble", model).to(self.device)
        self.model = self.trained.bind(self.modelled)
        imagined = ModelEnv(self.model, self.reward)  # until the model has learned: learn_model() takes a snapshot
        given = {"steps": options.horizon, "lmbda": options.lmbda, "pessimism": options.pessimism}
        given |= {"action_repeat": self.model_steps, "policy_lmbda": options.policy_lmbda, "outlier": options.outlier}
        self.loss = SHACLoss(policy, self.value, imagined, **given).to(self.device)

    def _new_model(self) -> ForwardModel | Ensemble:
        """A model with fresh weights, or an ensemble."""
        members, options = self.options.members, self.options.model
        if members == 1:
            return ForwardModel.for_scene(self.modelled, **options)
        return Ensemble.for_scene(self.modelled, count=members, **options)

    @property
    def networks(self) -> dict[str, nn.Module]:
        """The networks by :attr:`network_names`, once begun."""
        return {"value": self.value, "model": self.trained}

    @property
    def members(self) -> list[BoundPredictor]:
        """The model, or the members of the ensemble."""
        return cast(Any, self.model.members) if isinstance(self.model, BoundEnsemble) else [self.model]

    def collect(self) -> None:
        """Play at random, and begin the trajectories with these."""
        self.data = []
        self.add(self.play_at_random())

    def add(self, played: TensorDict) -> None:
        """Keep trajectories that were played."""
        self.data.append(played.to(self.device))

    @property
    def newest(self) -> TensorDict:
        """The last trajectories. A round whose episodes all became unstable left none."""
        return next(played for played in reversed(self.data) if len(played))

    def play_at_random(self) -> TensorDict:
        """Trajectories of random control."""
        first = self.options.first
        found = collect_trajectories(self.scene, first.trajectories, steps=first.length, seed=self.options.seed)
        state, action = cast(Tensor, found["state"]), cast(Tensor, found["action"])
        with torch.no_grad():
            return windows(state, action, self.reward(state[:, :-1], action, state[:, 1:]))

    def play(self, policy: BoundedPolicy, seed: int) -> TensorDict:
        """Trajectories of a round's episodes with exploration, without those that became unstable.

        Args:
            policy: on the processor, of this scene or one that drives it (:meth:`BoundedPolicy.for_scene`).
            seed: of the starts. Noise is drawn by torch's generator.
        """
        starts = None if self.squares is None else self.squares.start_states
        env = SceneEnv(self.scene, self.reward, seed=seed, start_states=starts)
        sizes = {"episodes": self.options.episodes, "steps": self.options.steps}
        explorer = exploring(policy.for_scene(self.scene), **sizes, color=self.options.noise_color)
        played = unbroken(play(env, explorer, **sizes))
        state = torch.cat((played["state"], played["next", "state"][:, -1:]), 1)
        return windows(state, cast(Tensor, played["action"]), cast(Tensor, played["next", "reward"]))

    def judged(self, policy: BoundedPolicy) -> TensorDict:
        """Episodes ``[M, T]`` without exploration, from the same starts every round; rewards of a frame."""
        env = SceneEnv(self.scene, self.judge, seed=JUDGED_SEED, start_states=self.judged_starts)
        sizes = {"episodes": self.options.evaluate.episodes, "steps": self.options.evaluate.steps or JUDGED_STEPS}
        return play(env, policy.for_scene(self.scene), **sizes)

    def learn_model(self, index: int) -> None:
        """Train the model, and what else is learned of the scene, on all data; tell normalisers of the newest.

        Args:
            index: of the round; the first, 0, trains for ``first.steps``.

        Raises:
            RuntimeError: there are no trajectories.
        """
        if not any(map(len, self.data)):
            raise RuntimeError(f"There are no trajectories of {self.scene.name!r} to learn from: call collect() first.")
        options, first = self.options, index == 0
        steps, lr = (options.first.steps, None) if first else (options.model_steps, options.model_lr)
        data = cast(TensorDict, torch.cat(cast(Any, self.data)))
        # All samples count alike, as when the results were measured.
        for number, member in enumerate(self.members):
            seed = options.seed + index + 1_000_000 * number
            fit(member, data, steps=steps, lr=lr, seed=seed, size_floor=None)
        self.learn_reward(data, index)
        self._take_snapshot()
        seen = self.newest["state"].flatten(0, 1)
        target = self.newest["target"].repeat_interleave(WINDOW + 1, 0) if self.targeted else None
        seen = seen if self.squares is None else self.squares.move(seen)
        self.loss.fit_normalizers(seen, self.model_steps * cast(Tensor, self.starts()(_SCALED_BY)["reward"]), target)

    def learn_reward(self, data: TensorDict, index: int) -> None:
        """Nothing: the reward is known. Override it to learn from all trajectories ``[K]`` in round ``index``."""

    def _take_snapshot(self) -> None:
        """Imagine with the model as it is now."""
        env = self.loss.env
        before = env.world_model.members if isinstance(env.world_model, SplitEnsemble) else [env.world_model]
        if isinstance(before[0], SpecializedPredictor):
            for snapshot, member in zip(cast(Any, before), self.members, strict=True):
                snapshot.refresh(member)
        else:
            model = specialize(self.model)
            env.world_model = cast(Any, model.split() if isinstance(model, BoundEnsemble) else model)

    def starts(self) -> Callable[[int], TensorDict]:
        """What draws states ``[size]`` to imagine from, half of the newest trajectories, half of all.

        With the ``reward`` of the step that was played there.
        """
        states, newest = _steps(cast(TensorDict, torch.cat(cast(Any, self.data)))), _steps(self.newest)

        def draw(size: int) -> TensorDict:
            found = [_any(states, size - size // 2), _any(newest, size // 2)]
            if self.squares is not None:
                found[0]["state"] = self.squares.move(cast(Tensor, found[0]["state"]))
            return cast(TensorDict, torch.cat(cast(Any, found)))

        return draw


def _steps(data: TensorDict) -> TensorDict:
    """States ``[K T]`` before the steps of trajectories ``[K]``, their rewards, and their targets."""
    entries = {"state": cast(Tensor, data["state"])[:, :-1].flatten(0, 1), "reward": data["reward"].flatten(0, 1)}
    if "target" in data.keys():
        entries["target"] = cast(Tensor, data["target"]).repeat_interleave(WINDOW, 0)
    return TensorDict(entries, [len(entries["state"])])


def _any(states: TensorDict, count: int) -> TensorDict:
    """States at random."""
    return states[torch.randint(len(states), (count,), device=states["state"].device)]

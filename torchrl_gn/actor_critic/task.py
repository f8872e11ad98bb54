"""Task of the short-horizon actor-critic: a scene, its reward, its trajectories and its networks."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn

from torchrl_gn.actor_critic.novelty import HELD, following, novelty
from torchrl_gn.actor_critic.options import ActorCriticOptions
from torchrl_gn.actor_critic.target_squares import TargetSquares
from torchrl_gn.actor_critic.trajectories import WINDOW, exploring, play, unbroken, windows, with_others
from torchrl_gn.checks import checked_seed
from torchrl_gn.data import collect_trajectories, spline_controls
from torchrl_gn.dynamics import (
    BoundEnsemble,
    BoundPredictor,
    Canonicalizer,
    Ensemble,
    ForwardModel,
    Predictor,
    SpecializedPredictor,
    SplitEnsemble,
    specialize,
)
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.envs.specs import RewardFunction, require_reward
from torchrl_gn.envs.starts import StartStates
from torchrl_gn.objectives import SHACLoss
from torchrl_gn.planners import SamplingPlanner
from torchrl_gn.policies import BoundedPolicy, StateValue, task_invariances
from torchrl_gn.rewards import FreezeGoal, Reward
from torchrl_gn.scenes import Scene
from torchrl_gn.scenes.contact_pairs import bodies_can_touch
from torchrl_gn.training import Workers, fit

EVALUATION_STEPS = 500  # control steps of an evaluation episode
EVALUATION_SEED = 10_000
_SEQUENCES, _AHEAD = 64, 50  # random controls among which novel ones are chosen, and their control steps
_PLAN, _PLAN_WITHOUT_CONTACTS = 5, 20  # control steps of a plan
_KNOWN = 512  # states of the data from which novel ones are far
_SCALED_BY = 10_000  # start states of imagination, whose rewards scale the value


class ActorCriticTask:
    """A scene and its reward, with their model, value and trajectories on one device.

    :class:`ActorCritic` calls :meth:`begin` once, and :meth:`learn_model` and :meth:`starts` in every round. The caller
    plays the episodes: :meth:`collect` once, then :meth:`play` and :meth:`add` in every round. Subclass the task to
    play elsewhere, such as on a robot (override :meth:`play_at_random`, :meth:`play` and :meth:`evaluate`), or to learn
    more (:meth:`learn_reward`).

    Trajectories are ``[K]``, in steps of the model: ``state`` ``[K, 51, N, 13]``, ``action`` ``[K, 50, A]``, the
    observed ``reward`` ``[K, 50, 1]`` and, in tasks with a target, the episode's ``target`` ``[K, 3]``, metres.

    Args:
        scene: scene with the control step of the policy.
        reward: differentiable reward of a model step: a :class:`~torchrl_gn.rewards.Reward`, or any function
            ``(state, action, next_state, task) -> [*B, 1]``.
        evaluation_reward: reward of the evaluation episodes. Default: ``reward``.
        squares: random targets, for a reward whose target is the origin. Default: the scene's own starts.
        evaluation_starts: start states of the evaluation episodes, see :class:`~torchrl_gn.envs.SceneEnv`. Default:
            those of ``squares``.
        modelled: scene with the model's control step; the policy's control step is a multiple of it. Default:
            ``scene``.
        invariances: invariances of the task. Default: those of scene and reward.

    Raises:
        TypeError: a reward is not such a function.
        ValueError: the reward has a target that the policy cannot read, or there is no such device.

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
    """Names of the task's networks, without the policy."""

    frames_per_step: int = 1
    """Frames of a control step, as published results of the control suite count them."""

    def __init__(
        self,
        scene: Scene,
        options: ActorCriticOptions,
        reward: RewardFunction,
        *,
        evaluation_reward: RewardFunction | None = None,
        squares: TargetSquares | None = None,
        evaluation_starts: StartStates | None = None,
        modelled: Scene | None = None,
        invariances: Canonicalizer | None = None,
    ) -> None:
        for each in (reward, evaluation_reward):
            require_reward(each)
        self.targeted = getattr(reward, "target_shape", None) is not None
        if self.targeted and "suite" not in scene.origin:
            raise ValueError(f"A policy of states does not read the target of {reward}.")
        self.scene, self.options, self.reward = scene, options, reward
        self.evaluation_reward = evaluation_reward or reward
        self.modelled = modelled or scene
        self.model_steps = round(scene.timestep / self.modelled.timestep)  # model steps of an action
        self.device = Workers().device(options.device)
        self.squares = squares
        own_starts = None if squares is None else squares.start_states
        self.evaluation_starts = own_starts if evaluation_starts is None else evaluation_starts
        self.invariances = invariances or task_invariances(scene, reward)
        self.data: list[TensorDict] = []

    def begin(self, policy: BoundedPolicy, networks: Mapping[str, nn.Module] | None = None) -> None:
        """Make the networks, and the loss of ``policy``.

        Args:
            policy: a policy for the scene.
            networks: networks to continue with, by :attr:`network_names`. Default: new ones, from torch's generator.

        Raises:
            ValueError: one of the networks is missing.
        """
        options = self.options
        if networks is None:
            model = self._new_model()
            arguments = {"discount": options.discount, "hidden": options.hidden, "target": self.targeted}
            self.value = StateValue(self.scene, combine="mean", canonicalizer=self.invariances, **arguments)
        else:
            if missing := set(self.network_names) - set(networks):
                raise ValueError(f"networks= lacks {sorted(missing)}: give all of {list(self.network_names)}, or none.")
            model, self.value = networks["model"], cast(StateValue, networks["value"])
        self.trained = cast("ForwardModel | Ensemble", model).to(self.device)
        self.model = self.trained.bind(self.modelled)
        # learn_model() replaces the model by a snapshot.
        imagined = ModelEnv(self.model, self.reward, action_repeat=self.model_steps)
        arguments = {"steps": options.horizon, "lmbda": options.lmbda, "pessimism": options.pessimism}
        arguments |= {"policy_lmbda": options.policy_lmbda, "outlier": options.outlier}
        self.loss = SHACLoss(policy, self.value, imagined, **arguments).to(self.device)

    def _new_model(self) -> ForwardModel | Ensemble:
        """Return a model, or an ensemble, with fresh weights."""
        members, options = self.options.members, self.options.model
        if members == 1:
            return ForwardModel.for_scene(self.modelled, **options)
        return Ensemble.for_scene(self.modelled, count=members, **options)

    @property
    def networks(self) -> dict[str, nn.Module]:
        """The networks by :attr:`network_names`, after :meth:`begin`."""
        return {"value": self.value, "model": self.trained}

    @property
    def members(self) -> list[BoundPredictor]:
        """The model, or the members of the ensemble."""
        return cast(Any, self.model.members) if isinstance(self.model, BoundEnsemble) else [self.model]

    def collect(self) -> None:
        """Play random control; its trajectories replace all others."""
        self.data = []
        self.add(self.play_at_random())

    def add(self, played: TensorDict) -> None:
        """Add played trajectories."""
        self.data.append(played.to(self.device))

    def _all_data(self) -> TensorDict:
        """Return all trajectories in one batch."""
        return cast(TensorDict, torch.cat(cast(Any, self.data)))

    @property
    def newest(self) -> TensorDict:
        """The latest trajectories that are not empty. A round is empty if all its episodes became unstable."""
        return next(played for played in reversed(self.data) if len(played))

    def play_at_random(self) -> TensorDict:
        """Play random control and return its trajectories."""
        first = self.options.first
        count, steps = first.trajectories, first.length
        # Split 0, as training data of data sets.
        found = collect_trajectories(self.scene, count, steps, self.options.seed, split=0)
        state, action = cast(Tensor, found["state"]), cast(Tensor, found["action"])
        with torch.no_grad():
            return windows(state, action, self.reward(state[:, :-1], action, state[:, 1:], None))

    def play(self, policy: BoundedPolicy, seed: int) -> TensorDict:
        """Play a round's episodes with exploration; return their trajectories, without unstable episodes.

        Args:
            policy: policy on the CPU, for this scene or able to drive it (:meth:`BoundedPolicy.for_scene`).
            seed: seed of the start states. Exploration noise comes from torch's generator.
        """
        starts = None if self.squares is None else self.squares.start_states
        env = SceneEnv(self.scene, self.reward, seed=seed, start_states=starts)
        sizes = {"episodes": self.options.episodes, "steps": self.options.steps}
        played = unbroken(play(env, self.explorer(policy, seed), **sizes))
        state = torch.cat((played["state"], played["next", "state"][:, -1:]), 1)
        return windows(state, cast(Tensor, played["action"]), cast(Tensor, played["next", "reward"]))

    def explorer(self, policy: BoundedPolicy, seed: int) -> Callable[[TensorDictBase], TensorDictBase]:
        """Return a policy for one round of :func:`play`: ``policy`` with exploration noise.

        The first episode of each of the first ``novelty_rounds`` rounds follows random controls instead. Among some
        random sequences, it follows the one that leads the model farthest from all data. Noise in a policy's actions
        seldom finds a reward that takes many coordinated steps, such as a swing-up's. A :meth:`planner` acts in the
        last ``planned_episodes`` episodes.

        Args:
            seed: seed of the random controls.
        """
        options, others = self.options, []
        sizes = {"episodes": options.episodes, "steps": options.steps}
        learned = hasattr(self, "value") and self.value.features.fitted
        if learned and len(self.data) <= options.novelty_rounds:  # the first data are of random control
            states = cast(Tensor, self._all_data()["state"]).flatten(0, 1)
            controls = partial(self._novel_controls, states, np.random.default_rng(checked_seed(seed)))
            others.append((slice(1), following(controls)))
        if learned and options.planned_episodes:
            others.append((slice(options.episodes - options.planned_episodes, None), self.planner(policy)))
        return with_others(exploring(policy.for_scene(self.scene), **sizes, color=options.noise_color), others)

    def _novel_controls(self, states: Tensor, rng: np.random.Generator, state: Tensor) -> Tensor:
        """Return controls ``[HELD, A]`` on the CPU that lead from ``state`` ``[1, N, 13]`` far from ``states``."""
        controls = torch.from_numpy(spline_controls(self.scene, _SEQUENCES, _AHEAD, rng)).float()
        dtype = next(self.value.members.parameters()).dtype

        def features(states: Tensor) -> Tensor:
            origin = states.new_zeros(*states.shape[:-2], 3) if self.targeted else None  # one target for all states
            return self.value.features(states, dtype, origin)

        known = features(states[torch.randint(len(states), (_KNOWN,)).to(self.device)])
        inputs = state.to(self.device), controls.to(self.device)
        distance = novelty(self._snapshots()[0], features, *inputs, known, self.model_steps)
        return controls[int(distance.argmax()), :HELD]

    def evaluate(self, policy: Callable[[TensorDictBase], TensorDictBase]) -> TensorDict:
        """Play evaluation episodes ``[M, T]``: no exploration, the same starts every round, one reward per frame.

        Args:
            policy: writes ``action`` ``[M, A]``: a policy on the CPU, for this scene or able to drive it, or a
                :meth:`planner`.
        """
        env = SceneEnv(self.scene, self.evaluation_reward, seed=EVALUATION_SEED, start_states=self.evaluation_starts)
        sizes = {"episodes": self.options.evaluate.episodes, "steps": self.options.evaluate.steps or EVALUATION_STEPS}
        return play(env, self._driver(policy), **sizes)

    def _driver(self, policy: Callable[[TensorDictBase], TensorDictBase]) -> Callable[[TensorDictBase], TensorDictBase]:
        """Return the policy for this scene, or the planner itself."""
        return policy.for_scene(self.scene) if isinstance(policy, BoundedPolicy) else policy

    def planner(self, policy: BoundedPolicy, *, horizon: int | None = None, **options: Any) -> TensorDictModuleBase:
        """Return a planner in the current model, with the policy's proposals and the value of a plan's last state.

        Short plans at every control step improve on the policy (TD-MPC2, Hansen et al. 2024), but cost time.

        Args:
            policy: policy for this scene or able to drive it; copied to the device of the task.
            horizon: control steps of a plan. Default: 5, or 20 if no bodies can touch: without contacts predictions
                stay right for longer, and long plans correct a value that is wrong in states the policy never visits.
            options: options of :class:`~torchrl_gn.planners.SamplingPlanner`.
        """
        if horizon is None:
            horizon = _PLAN if bodies_can_touch(self.scene) else _PLAN_WITHOUT_CONTACTS
        imagined = ModelEnv(
            specialize(self.model), self.reward, terminal=copy.deepcopy(self.value), action_repeat=self.model_steps
        )
        proposal = copy.deepcopy(policy.for_scene(self.scene)).to(self.device)
        arguments = {"pessimism": self.options.pessimism, "proposal": proposal, **options}
        planner = SamplingPlanner(imagined, horizon, **arguments)
        return TensorDictSequential([FreezeGoal(cast(Reward, self.reward)), planner]) if self.targeted else planner

    def learn_model(self, index: int) -> None:
        """Train the model and a learned reward on all data, and update the normalisers with the newest.

        Args:
            index: the round, from 0. Round 0 trains for ``first.steps``.

        Raises:
            RuntimeError: there are no trajectories.
        """
        if not any(map(len, self.data)):
            raise RuntimeError(f"There are no trajectories of {self.scene.name!r} to learn from: call collect() first.")
        options, first = self.options, index == 0
        steps, lr = (options.first.steps, None) if first else (options.model_steps, options.model_lr)
        data = self._all_data()
        # No size floor: all samples weigh the same, as in the published results.
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
        """Train the reward on all trajectories ``[K]`` in round ``index``; a known reward needs no training."""

    def _take_snapshot(self) -> None:
        """Snapshot the model: imagination uses its current weights."""
        before = self._snapshots()
        if isinstance(before[0], SpecializedPredictor):
            for snapshot, member in zip(cast(Any, before), self.members, strict=True):
                snapshot.refresh(member)
        else:
            model = specialize(self.model)
            self.loss.env.world_model = cast(Any, model.split() if isinstance(model, BoundEnsemble) else model)

    def _snapshots(self) -> list[Predictor]:
        """Return the model that imagination uses, or its members."""
        model = self.loss.env.world_model
        return cast(Any, list(model.members) if isinstance(model, SplitEnsemble) else [model])

    def starts(self) -> Callable[[int], TensorDict]:
        """Return a sampler of imagination's start states ``[size]``, half from the newest trajectories, half from all.

        It draws ``state``, the ``reward`` observed there and, in tasks with a target, ``target``.
        """
        states, newest = _steps(self._all_data()), _steps(self.newest)

        def draw(size: int) -> TensorDict:
            found = [_draw(states, size - size // 2), _draw(newest, size // 2)]
            if self.squares is not None:
                found[0]["state"] = self.squares.move(cast(Tensor, found[0]["state"]))
            return cast(TensorDict, torch.cat(cast(Any, found)))

        return draw


def _steps(data: TensorDict) -> TensorDict:
    """Flatten trajectories ``[K]`` to start states ``[K T]`` with rewards and targets."""
    entries = {"state": cast(Tensor, data["state"])[:, :-1].flatten(0, 1), "reward": data["reward"].flatten(0, 1)}
    if "target" in data.keys():
        entries["target"] = cast(Tensor, data["target"]).repeat_interleave(WINDOW, 0)
    return TensorDict(entries, [len(entries["state"])])


def _draw(states: TensorDict, count: int) -> TensorDict:
    """Draw ``count`` states at random."""
    return states[torch.randint(len(states), (count,), device=states["state"].device)]

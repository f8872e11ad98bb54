"""Environments of DeepMind Control Suite tasks with flat observations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import (
    CatTensors,
    DMControlWrapper,
    DoubleToFloat,
    EnvBase,
    FlattenObservation,
    SerialEnv,
    TransformedEnv,
)

from torchrl_gn.checks import check_count
from torchrl_gn.data.controls import known_seed
from torchrl_gn.scenes import ObservationGraph
from torchrl_gn.scenes.suite_tasks import load_suite_task, suite_modules


def suite_env(
    domain: str,
    task: str,
    *,
    num_envs: int = 1,
    timestep: float | None = None,
    steps: int | None = 1000,
    keys: Sequence[str] | None = None,
    seed: int | None = None,
) -> EnvBase:
    """Make an environment of a suite task with one flat entry ``observation`` ``[num_envs, O]`` float32.

    Args:
        task: for example ``"swimmer6"``; swimmers may have any number of links from 3.
        num_envs: number of environments, stepped in turn in this process.
        timestep: control step, seconds, a multiple of the physics step. Default: the suite's.
        steps: control steps of an episode; None: the suite's time limit.
        keys: the suite's entries to concatenate, in order. Default: all.
        seed: seed of the episodes. Default: drawn from torch's global generator.

    Example:
        >>> suite_env("swimmer", "swimmer6", num_envs=2, timestep=0.02).reset()["observation"].shape
        torch.Size([2, 25])
    """
    check_count("num_envs", num_envs, 1)
    if steps is not None:
        check_count("steps", steps, 1)
    seeds = np.random.SeedSequence(known_seed(seed)).generate_state(num_envs).tolist()
    make = partial(_make, domain, task, timestep, steps)
    order = tuple(load_suite_task(domain, task, 0).observation_spec()) if keys is None else tuple(keys)
    env = TransformedEnv(SerialEnv(num_envs, [partial(make, seed=each) for each in seeds]), DoubleToFloat())
    for key in order:
        axes = env.observation_spec[key].ndim - 1  # without the batch of environments
        if axes > 1:
            env.append_transform(FlattenObservation(-axes, -1, in_keys=[key]))
    env.append_transform(CatTensors(in_keys=list(order), out_key="observation", sort=False))
    return env


def observation_env(graph: ObservationGraph, domain: str, task: str, **options) -> EnvBase:
    """Make the environment of the task that an observation graph describes, with the options of :func:`suite_env`.

    ValueError if the task's observation or actions differ from the graph's, or the action bounds are not -1 and 1.
    """
    loaded = load_suite_task(domain, task, 0)
    low, high = loaded.action_spec().minimum, loaded.action_spec().maximum
    if (low != -1).any() or (high != 1).any():
        raise ValueError(f"Task {domain} {task} has actions of {low.min():g} to {high.max():g}; policies give -1 to 1.")
    observation = {name: int(np.prod(entry.shape)) for name, entry in loaded.observation_spec().items()}
    actions = int(np.prod(loaded.action_spec().shape))
    if observation != dict(graph.observation) or actions != graph.num_actions:
        task_sizes = f"Task {domain} {task} has observations {observation} and {actions} actions"
        raise ValueError(
            f"{task_sizes}, graph {graph.name!r} arranges {dict(graph.observation)} and {graph.num_actions}."
        )
    return suite_env(domain, task, keys=list(graph.observation), **options)


class _SuiteEnv(DMControlWrapper):
    """Suite task that can save and resume its running episode.

    It saves the random state before the episode's start, and the actions since. Resuming replays the episode instead of
    setting a state, because every task keeps targets and counters in its own attributes.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env, device=torch.device("cpu"))
        self._random = env.task.random.get_state()
        self._actions: list[Tensor] = []
        self._resumed: dict[str, Any] | None = None

    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        resumed, self._resumed = self._resumed, None
        if resumed is not None:
            self._env.task.random.set_state(("MT19937", resumed["random"].numpy().astype(np.uint32), *resumed["drawn"]))
        self._random, self._actions = self._env.task.random.get_state(), []
        start = super()._reset(tensordict, **options)
        for action in () if resumed is None else resumed["actions"]:
            start = self._step(TensorDict({self.action_key: action})).select(*start.keys())
        return start

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._actions.append(tensordict[self.action_key].clone())
        return super()._step(tensordict)

    def get_extra_state(self) -> dict[str, Any]:
        """Return the running episode, which the next reset after :meth:`set_extra_state` replays."""
        _, random, *drawn = self._random
        actions = torch.stack(self._actions) if self._actions else torch.empty(0, *self.action_spec.shape)
        return {"random": torch.from_numpy(random.astype(np.int64)), "drawn": drawn, "actions": actions.double()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Set the episode that the next reset replays; ValueError if it is not one of this task."""
        random, drawn, actions = state.get("random"), state.get("drawn"), state.get("actions")
        if not (_is_random(random, drawn) and self._are_actions(actions)):
            raise ValueError("a running episode is not one of this task")
        self._resumed = state

    def _are_actions(self, actions: Any) -> bool:
        like = isinstance(actions, Tensor) and actions.dtype == torch.float64
        like = like and actions.shape[1:] == self.action_spec.shape and bool(actions.isfinite().all())
        return like and len(actions) < self._env._step_limit


def _is_random(numbers: Any, drawn: Any) -> bool:
    """Return True for values as from ``numpy.random.RandomState.get_state``; numpy itself hardly checks them."""
    like = isinstance(numbers, Tensor) and numbers.dtype == torch.int64 and numbers.shape == (624,)
    like = like and bool(((numbers >= 0) & (numbers < 2**32)).all())
    like = like and isinstance(drawn, list) and [type(each) for each in drawn] == [int, int, float]
    return like and 0 <= drawn[0] <= 624 and drawn[1] in (0, 1) and math.isfinite(drawn[2])


def _make(domain: str, task: str, timestep: float | None, steps: int | None, *, seed: int) -> _SuiteEnv:
    loaded = load_suite_task(domain, task, seed)
    step = loaded.control_timestep() if timestep is None else timestep
    physics_step = loaded.physics.timestep()
    if not 0 < step < np.inf or abs(step / physics_step - round(step / physics_step)) > 1e-6:
        raise ValueError(f"timestep={timestep} must be a positive multiple of the physics step, {physics_step} s.")
    # Half a step less, so that rounding errors cannot add a step.
    limit = loaded._step_limit * loaded.control_timestep() if steps is None else (steps - 0.5) * step
    *_, control = suite_modules()
    env = control.Environment(loaded.physics, loaded.task, time_limit=limit, control_timestep=step)
    return _SuiteEnv(env)

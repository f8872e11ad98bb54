"""A short-horizon actor-critic round by round: the networks' optimiser, and what the policy plays."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from torchrl_gn.data import sample_start_states
from torchrl_gn.envs import SceneEnv, SuiteTaskEnv, observation_env
from torchrl_gn.envs.starts import for_learning
from torchrl_gn.objectives import SHACLoss
from torchrl_gn.scenes import ObservationGraph, Scene
from torchrl_gn.training.nested_state import require_like
from torchrl_gn.training.optimizers import clip_gradients, load_optimizer
from torchrl_gn.training.recorded_update import UpdateGraph, clip_on_device

WINDOW = 50  # control steps of a trajectory that the model learns from
_BETAS = (0.7, 0.95)  # SHAC's: gradients change fast with the policy
_MAX_NORM = 1.0
_KEPT = {"reward": "imagined_reward", "loss_value": "loss_value", "entropy": "entropy"}


class TargetSquares:
    """Targets anywhere in a square around the start, one of several sizes. The target is the origin: the scene moves.

    ValueError if the scene cannot: it needs a root that slides along x and y, in physics that are the same everywhere.

    Args:
        half_sides: of the squares, metres, equally likely.
    """

    def __init__(self, scene: Scene, half_sides: Sequence[float]) -> None:
        model, self.scene = scene.model, scene
        self.half_sides = np.array([float(each) for each in half_sides])
        self._sizes = torch.from_numpy(self.half_sides)  # where states are
        if not (self.half_sides > 0).all():
            raise ValueError(f"target_squares={list(half_sides)} must be positive half sides, metres.")
        slides = [
            np.flatnonzero((model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE) & (np.abs(model.jnt_axis) == axis).all(1))
            for axis in np.eye(3)[:2]
        ]
        if not (scene.translation_invariant[:2].all() and all(len(found) for found in slides)):
            raise ValueError(f"target_squares= needs a scene that slides freely along x and y, not {scene.name!r}.")
        self.where = [1 + model.jnt_qposadr[found[0]] for found in slides]  # in a MuJoCo state, after the time

    def start_states(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Full MuJoCo states ``[n, S]``."""
        states = sample_start_states(self.scene, n, rng)
        size = rng.choice(self.half_sides, (n, 1))
        states[:, self.where] = rng.uniform(-size, size, (n, 2))
        return states

    def suite_states(self, n: int, seed: int) -> np.ndarray:
        """Full MuJoCo states ``[n, S]`` of the suite's own starts and targets, as recipes/svg.py judges by.

        ValueError if the scene is no swimmer of the suite.
        """
        scene, links = self.scene, self.scene.num_nodes - 1
        if scene.name != f"swimmer{links}":
            raise ValueError(f"evaluate.suite_seed= is for the suite's swimmers, not {scene.name!r}.")
        env = observation_env(ObservationGraph.swimmer(links), "swimmer", scene.name, num_envs=n)
        env.set_seed(seed)
        env.reset()
        states = np.zeros((n, scene.physics_size))
        for state, each in zip(states, cast(Any, env).base_env._envs, strict=True):
            physics = each._env.physics
            state[1 : 1 + scene.model.nq] = physics.data.qpos
            state[self.where] -= physics.named.model.geom_pos["target", ["x", "y"]]
        return states

    def move(self, state: Tensor) -> Tensor:
        """States ``[B, N, 13]`` with the first body somewhere else in a square around the target."""
        device, count = state.device, len(state)
        self._sizes = self._sizes.to(device)
        sizes = self._sizes[torch.randint(len(self._sizes), (count, 1, 1), device=device)]
        place = sizes * (2 * torch.rand(count, 1, 2, dtype=torch.float64, device=device) - 1)
        moved = state.clone()
        moved[:, 1:, :2] += place.to(state) - state[:, 1:2, :2]
        return moved


class ActorCriticOptimizer:
    """Updates policy, values and entropies' weights by Adam, each kind with its own rate and clipped gradients.

    On an NVIDIA GPU the third update is recorded as a CUDA graph, which all after it replay.

    Args:
        losses: of every task, whose policies share their weights.
    """

    def __init__(self, losses: Sequence[SHACLoss], *, policy_lr: float, value_lr: float, alpha_lr: float) -> None:
        self.losses = list(losses)
        self.policy = list(self.losses[0].policy.parameters())
        self.values = [list(loss.value.parameters()) for loss in self.losses]
        self.alphas = [loss.log_alpha for loss in self.losses]
        groups = (
            (self.policy, policy_lr),
            ([each for of in self.values for each in of], value_lr),
            (self.alphas, alpha_lr),
        )
        self.optimizer = torch.optim.Adam([{"params": of, "lr": lr} for of, lr in groups], betas=_BETAS, fused=True)
        self.clipped = [self.policy, *self.values, *([alpha] for alpha in self.alphas)]
        self._by_torch, self._graph = 2 if self.alphas[0].is_cuda else math.inf, None  # updates before the recording
        self._states: list[TensorDict] = []

    def learn(
        self, starts: Sequence[Callable[[int], TensorDict]], *, updates: int, batch_size: int, desc: str
    ) -> dict[str, float]:
        """Update from the states ``[batch_size]`` that every task's ``starts`` draws; means of the last quarter.

        They have ``state`` ``[batch_size, N, 13]`` and, where episodes have one, ``target`` ``[batch_size, 3]``.
        """
        kept: dict[str, list[Tensor]] = {name: [] for name in _KEPT}
        with tqdm(total=updates, desc=desc, unit=" updates", leave=False) as bar:
            for update in range(updates):
                found = self._update([partial(draw, batch_size) for draw in starts], f"update {update}")
                if update >= 3 * updates // 4:
                    for name, values in kept.items():
                        values += [of[name] for of in found]
                bar.update()
        return {_KEPT[name]: float(torch.stack(values).mean()) for name, values in kept.items()}

    def _update(self, draws: Sequence[Callable[[], TensorDict]], when: str) -> list[dict[str, Tensor]]:
        """Update from the states that are drawn for every loss; numbers of each. FloatingPointError changes nothing."""
        if self._graph is None and self._by_torch < 1:
            self._record([draw() for draw in draws])
        if self._graph is None:
            self._by_torch -= 1
            self.optimizer.zero_grad()
            found = [self._backward(loss, draw()) for loss, draw in zip(self.losses, draws, strict=True)]
            for group in self.clipped:
                clip_gradients(group, _MAX_NORM, when)
            self.optimizer.step()
            return found
        for static, draw in zip(self._states, draws, strict=True):
            static.copy_(draw())
        numbers = self._graph()
        norms, rest = numbers[: len(self.clipped)], iter(torch.tensor(numbers[len(self.clipped) :]))
        if not all(map(math.isfinite, norms)):
            self._graph.undo()
            raise FloatingPointError(f"The gradient is not finite at {when}; lower the learning rate.")
        return [{name: next(rest) for name in _KEPT} for _ in self.losses]

    def _backward(self, loss: SHACLoss, starts: TensorDict) -> dict[str, Tensor]:
        """Add the gradient of a loss from states ``[B]``."""
        out = loss(starts)
        (out["loss_actor"] / len(self.losses) + out["loss_value"] + out["loss_alpha"]).backward()
        return {name: out[name].detach() for name in _KEPT}

    def _record(self, states: list[TensorDict]) -> None:
        """Record the update of as many states."""
        self._states = states
        gc.collect()  # what earlier updates left of their gradients belongs to another stream
        self._set_capturable(True)
        self.optimizer.zero_grad()
        self._graph = UpdateGraph.or_none(
            self._on_device, [each for of in self.clipped for each in of], [self.optimizer]
        )
        if self._graph is None:
            self._by_torch = math.inf
            self._set_capturable(False)

    def _set_capturable(self, value: bool) -> None:
        for group in self.optimizer.param_groups:
            group["capturable"] = value

    def _on_device(self) -> Tensor:
        """The update without waiting for the device: norms of the gradients that are clipped, and numbers of losses."""
        found = [self._backward(loss, state) for loss, state in zip(self.losses, self._states, strict=True)]
        norms = [clip_on_device(group, _MAX_NORM) for group in self.clipped]
        self.optimizer.step()
        return torch.stack([*norms, *(value.double() for of in found for value in of.values())])

    def state_dict(self) -> dict[str, Any]:
        return {"adam": self.optimizer.state_dict(), "log_alphas": [alpha.detach() for alpha in self.alphas]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        require_like(self.state_dict()["log_alphas"], state["log_alphas"], "training.log_alphas")
        load_optimizer(self.optimizer, state["adam"])
        with torch.no_grad():
            for alpha, kept in zip(self.alphas, state["log_alphas"], strict=True):
                alpha.copy_(kept)


def play(
    env: SceneEnv | SuiteTaskEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    episodes: int,
    steps: int,
    explore: bool,
) -> TensorDict:
    """Episodes ``[M, T]`` in MuJoCo, from new starts."""
    kind = ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC
    with torch.no_grad(), set_exploration_type(kind):
        env = cast(SceneEnv, for_learning(env))
        start = env.reset(TensorDict(batch_size=[episodes]))
        return cast(
            TensorDict, env.rollout(steps, policy, tensordict=start, auto_reset=False, break_when_any_done=False)
        )


def windows(state: Tensor, action: Tensor, reward: Tensor | None = None, target: Tensor | None = None) -> TensorDict:
    """Cut trajectories into those of :data:`WINDOW` steps.

    Args:
        state: ``[K, T + 1, N, 13]``.
        action: ``[K, T, A]``.
        reward: ``[K, T, 1]`` that was paid, if it is to be learned.
        target: ``[K, 3]`` of the episodes, if they have one.
    """
    first = range(0, action.shape[1] - WINDOW + 1, WINDOW)
    parts = {
        "state": torch.cat([state[:, at : at + WINDOW + 1] for at in first]),
        "action": torch.cat([action[:, at : at + WINDOW].float() for at in first]),
    }
    if reward is not None:
        parts["reward"] = torch.cat([reward[:, at : at + WINDOW] for at in first])
    if target is not None:
        parts["target"] = target.repeat(len(first), 1)
    return TensorDict(parts, [len(parts["action"])])


def played_windows(played: TensorDict) -> TensorDict:
    """Trajectories of :func:`play`, without the episodes whose simulation became unstable."""
    played = unbroken(played)
    return windows(torch.cat((played["state"], played["next", "state"][:, -1:]), 1), played["action"])


def unbroken(played: TensorDict) -> TensorDict:
    """Episodes whose simulation did not become unstable."""
    return played[~cast(Tensor, played["next", "terminated"]).flatten(1).any(1)]

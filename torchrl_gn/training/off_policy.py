"""Off-policy training: experience collection, updates from a replay buffer, evaluation."""

from __future__ import annotations

import copy
import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import HardUpdate, LossModule

from torchrl_gn.cache import keep_inductor_private
from torchrl_gn.checks import check_count, check_counts, checked_seed
from torchrl_gn.dynamics.executors.compiled import check_compiling
from torchrl_gn.envs.episode_ends import alive_of
from torchrl_gn.finite import require_finite
from torchrl_gn.interrupts import held, let_in_at_once
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.policies import Agent
from torchrl_gn.training.experience import (
    buffer_state,
    device_of,
    episode_state,
    load_buffer_state,
    load_episode_state,
    make_collector,
)
from torchrl_gn.training.gradients import with_gradients
from torchrl_gn.training.nested_state import require_amounts, require_like
from torchrl_gn.training.optimizers import clip_gradients, load_optimizer, require_own_weights

_STORED = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
)


@dataclass
class LearningCurve:
    """Mean returns, and the frames, updates and seconds before each."""

    frames: list[float] = field(default_factory=list)
    updates: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class LearningProgress:
    """State of the training after a batch of experience; frames, updates and seconds sum over resumed runs."""

    frames: int
    updates: int
    seconds: float  # without evaluation
    losses: dict[str, float]  # means over the batch's updates
    evaluation: float | None = None  # mean return of evaluation episodes


class OffPolicyTrainer:
    """Trainer of a policy from a replay buffer (paper: SM "Reinforcement learning agents"); iterate over :meth:`run`.

    Args:
        agent: the networks; every new transition updates their normalisers once.
        losses: first a loss with target networks (``DDPGLoss``, :class:`~torchrl_gn.objectives.SVGLoss`), then others.
        env: environments ``[num_envs]`` to collect in; or functions that make some, each for a collector on a Ray
            cluster (enter :class:`~torchrl_gn.training.RayCluster` first).
        evaluate: returns the mean return of the current policy.
        frames_per_batch: environment steps between updates; a multiple of ``num_envs``.
        updates_per_frame: gradient steps per environment step.
        random_frames: initial environment steps of random actions, without updates.
        evaluate_frames: environment steps between evaluations.
        target_interval: updates between copies to the target networks (paper: 1000).
        max_norm: norm that the joint gradient is clipped to.
        compile: compile losses and gradients, which takes minutes at the second update and makes later ones faster.
            None: compile if torch and a C++ compiler can.
        seed: seed of the replay buffer; also of the environments of a resumed run if they cannot resume their episodes.

    On the CPU, a resumed run gives the numbers of an uninterrupted one if ``env`` is from
    :func:`~torchrl_gn.envs.suite_env`.
    """

    def __init__(
        self,
        agent: Agent,
        losses: Sequence[LossModule],
        env: EnvBase | Sequence[Callable[[], EnvBase]],
        exploration_policy: TensorDictModuleBase,
        evaluate: Callable[[], float],
        optimizer: torch.optim.Optimizer,
        *,
        frames: int,
        batch_size: int = 256,
        frames_per_batch: int = 200,
        updates_per_frame: float = 0.1,
        random_frames: int = 5000,
        evaluate_frames: int = 10_000,
        capacity: int = 1_000_000,
        target_interval: int = 1000,
        max_norm: float = 10.0,
        compile: bool | None = False,
        seed: int = 0,
    ) -> None:
        check_count("frames_per_batch", frames_per_batch, 0)
        if isinstance(env, EnvBase) and (frames_per_batch % env.batch_size.numel() or frames_per_batch < 1):
            raise ValueError(
                f"frames_per_batch={frames_per_batch} must be a multiple of {env.batch_size.numel()} environments."
            )
        check_counts(frames=frames, batch_size=batch_size, capacity=capacity)
        check_counts(evaluate_frames=evaluate_frames, target_interval=target_interval)
        check_count("random_frames", random_frames, 0)
        for name, value in {"updates_per_frame": updates_per_frame, "max_norm": max_norm}.items():
            if not 0 < value < math.inf:
                raise ValueError(f"{name}={value} must be positive and finite.")
        self.agent, self.losses, self.env = agent, list(losses), env
        self.exploration_policy, self.evaluate, self.optimizer = exploration_policy, evaluate, optimizer
        self.total, self.per_batch, self.random_frames = frames, frames_per_batch, random_frames
        self.updates_per_frame, self.evaluate_frames, self.max_norm = updates_per_frame, evaluate_frames, max_norm
        self.capacity = min(capacity, frames + frames_per_batch)  # the last batch may exceed frames
        # TorchRL's interval counts the updates between two copies.
        self.target = HardUpdate(losses[0], value_network_update_interval=target_interval - 1)
        self.generator = torch.Generator().manual_seed(checked_seed(seed))
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(self.capacity, device=torch.device("cpu")),
            batch_size=batch_size,
            generator=self.generator,
        )
        self.frames, self.updates, self.seconds, self.owed = 0, 0, 0.0, 0.0
        self.curve = LearningCurve()
        self.seed = seed
        self._recent: dict[str, list[float]] = {}  # losses of the batch's updates
        self._episodes: dict[str, Any] = {}  # after the last whole batch
        self._draws = self._drawn()  # after the last whole step: an interrupt may come within the next one
        self._weights = [p for group in optimizer.param_groups for p in group["params"]]
        require_own_weights("optimizer", self._weights, *self.losses)
        if compile is not False:
            try:
                check_compiling(self._weights[0].device)
            except (RuntimeError, FileNotFoundError):
                if compile:
                    raise
                compile = False
        self._loss = self._total_loss if compile is False else self._first_loss

    def run(self) -> Iterator[LearningProgress]:
        """Train until all frames are spent, yielding after every batch; raises the errors of :meth:`update`.

        Ctrl-C and SIGTERM act at once during collection and evaluation, and otherwise wait until a change is complete.
        """
        self._draws = self._drawn()
        if not self.curve.frames:
            self._evaluate()
        if self.owed >= 1 or self._evaluation_is_due:  # interrupted between a batch and its updates
            yield self._learn(time.perf_counter())
        if self.frames >= self.total:
            return
        collector = make_collector(
            self.env,
            self.exploration_policy,
            # If episodes cannot resume, new ones need another seed: the same would repeat the first ones.
            seed=self.seed + self.frames if self.frames and not self._episodes else None,
            frames_per_batch=self.per_batch,
            total_frames=self.total - self.frames,
            init_random_frames=max(0, self.random_frames - self.frames),
        )
        torch.set_rng_state(self._draws["global"])  # undo the draws of its trial steps
        threads = torch.get_num_threads()
        try:
            start, batches = time.perf_counter(), iter(collector)
            while (batch := _next(batches)) is not None:
                # TorchRL closes a SerialEnv with the last batch, which resets the number of threads.
                torch.set_num_threads(threads)
                self.remember(batch)
                yield self._learn(start)
                start = time.perf_counter()
                if not isinstance(self.env, EnvBase):
                    collector.update_policy_weights_(self.exploration_policy)
        finally:
            # The caller owns the environment; collectors on a cluster must end their processes.
            collector.shutdown(**({"close_env": False} if isinstance(self.env, EnvBase) else {}))

    def _learn(self, start: float) -> LearningProgress:
        """Run the pending updates, and evaluate if due; ``start`` is the time at which collection began."""
        while self.owed >= 1:
            with held():
                for name, value in self.update().items():
                    self._recent.setdefault(name, []).append(value)
                self.owed -= 1
        self.seconds += time.perf_counter() - start
        evaluation = self._evaluate() if self._evaluation_is_due else None
        means = {name: sum(values) / len(values) for name, values in self._recent.items()}
        self._recent = {}
        return LearningProgress(self.frames, self.updates, self.seconds, means, evaluation)

    @property
    def _evaluation_is_due(self) -> bool:
        last = self.curve.frames[-1]
        passed = self.frames // self.evaluate_frames > last // self.evaluate_frames
        return passed or self.frames >= self.total and self.frames > last

    def remember(self, batch: TensorDictBase) -> None:
        """Add transitions ``[*B]`` to the replay buffer and the agent's normalisers; ValueError if not finite."""
        steps = cast(TensorDict, batch.select(*_STORED)).reshape(-1)
        require_finite(steps, "Experience")
        moved = steps.to(self._weights[0].device)
        with held():
            self.agent.update_normalizers(moved["observation"], moved["action"], moved["next", "observation"])
            self.buffer.extend(steps.to("cpu"))  # the buffer's device
            self.frames += len(steps)
            if self.frames > self.random_frames:
                self.owed += self.updates_per_frame * len(steps)
            self._episodes = episode_state(self.env) if isinstance(self.env, EnvBase) else {}
            self._draws = self._drawn()

    def _drawn(self) -> dict[str, torch.Tensor]:
        return {"buffer": self.generator.get_state(), "global": torch.get_rng_state()}

    @without_autocast
    @with_gradients
    def update(self) -> dict[str, float]:
        """Take one gradient step on transitions from the replay buffer; return the losses by name.

        Raises:
            FloatingPointError: a loss or a gradient is not finite; nothing changes.
        """
        with let_in_at_once():  # the first may be compiled for minutes
            total, losses = self._loss(self.buffer.sample().to(self._weights[0].device))
        values = {name: float(value) for name, value in losses.items()}
        if not math.isfinite(sum(values.values())):
            raise FloatingPointError(f"Losses are {values} at update {self.updates}; lower the learning rate.")
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        clip_gradients(self._weights, self.max_norm, f"update {self.updates}")
        with held():
            self.optimizer.step()
            self.target.step()
            self.updates += 1
            self._draws = self._drawn()
        return values

    def _first_loss(self, batch: TensorDictBase) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Compute the first losses eagerly, and compile them for later updates."""
        # TorchRL's losses create modules at their first call, which would make torch compile twice. The warning is
        # about an option that tensordict reads and torch has deprecated.
        warnings.filterwarnings("ignore", "torch._dynamo.config.inline_inbuilt_nn_modules", FutureWarning)
        keep_inductor_private()
        self._loss, draws = torch.compile(self._total_loss, fullgraph=True, dynamic=False), torch.get_rng_state()
        first = self._total_loss(batch)
        if not self.updates:
            return first
        torch.set_rng_state(draws)
        return self._loss(batch)  # after resuming, as in an uninterrupted run

    def _total_loss(self, batch: TensorDictBase) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Return the sum of all losses, and each by name, detached."""
        losses: dict[str, torch.Tensor] = {}
        for loss in self.losses:
            out = loss(batch)
            names = [name for name in map(str, loss.out_keys) if name.startswith("loss_")]
            losses |= {name: cast(torch.Tensor, out[name]) for name in names}
        return torch.stack(list(losses.values())).sum(), {name: value.detach() for name, value in losses.items()}

    def _evaluate(self) -> float:
        with let_in_at_once():
            value = self.evaluate()
        with held():
            for name in ("frames", "updates", "seconds"):
                getattr(self.curve, name).append(getattr(self, name))
            self.curve.returns.append(value)
            self._draws = self._drawn()
        return value

    def state_dict(self) -> dict[str, Any]:
        """Return the state to resume from, without the agent."""
        return {
            "losses": [dict(loss.state_dict()) for loss in self.losses],
            "optimizer": self.optimizer.state_dict(),
            "target_counter": self.target.counter,
            "buffer": buffer_state(self.buffer),
            "generators": self._draws,
            "episodes": self._episodes,
            "recent": self._recent,
            "curve": vars(self.curve),
            "progress": {name: getattr(self, name) for name in ("frames", "updates", "seconds", "owed")},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a :meth:`state_dict`.

        Raises:
            ValueError: the state has more frames than this training, belongs to other networks or options, or is
                forged. Losses, optimiser and replay buffer are then as before.
        """
        current = self.state_dict()
        curve = {name: [] for name in current["curve"]}
        # Optimiser and buffer are checked as they are loaded.
        require_like({**current, "optimizer": {}, "buffer": {}, "curve": curve, "episodes": {}, "recent": {}}, state)
        require_like(dict.fromkeys(state["recent"], []), state["recent"], "training.recent")
        require_amounts(state["progress"])
        if len({len(state["curve"][name]) for name in curve}) > 1:
            raise ValueError("training.curve has lists of several lengths")
        frames = state["progress"]["frames"]
        if frames >= self.total + self.per_batch:
            raise ValueError(f"The checkpoint has {frames} frames already; pass frames={frames} or more to resume.")
        before = copy.deepcopy({name: current[name] for name in ("losses", "optimizer")})
        try:
            self._load_weights(state)
            if state["episodes"] and isinstance(self.env, EnvBase):
                load_episode_state(self.env, state["episodes"])
            load_buffer_state(self.buffer, state["buffer"], self.capacity, self.agent.graph)  # checks, then extends
        except BaseException:
            self._load_weights(before)
            raise
        if state["episodes"] and isinstance(self.env, EnvBase):
            self._episodes = state["episodes"]
        self.target.counter = state["target_counter"]
        self.generator.set_state(state["generators"]["buffer"])
        torch.set_rng_state(state["generators"]["global"])
        self.curve = LearningCurve(**{name: list(state["curve"][name]) for name in curve})
        self._recent = {name: list(values) for name, values in state["recent"].items()}
        for name in current["progress"]:
            setattr(self, name, state["progress"][name])

    def _load_weights(self, state: dict[str, Any]) -> None:
        for loss, saved in zip(self.losses, state["losses"], strict=True):
            loss.load_state_dict(saved)
        load_optimizer(self.optimizer, state["optimizer"])


def _next(batches: Iterator[TensorDictBase]) -> TensorDictBase | None:
    with let_in_at_once():
        return next(batches, None)


@torch.no_grad()
def mean_return(env: EnvBase, policy: TensorDictModuleBase, steps: int, *, seed: int = 0) -> float:
    """Return the mean return of the first episodes of an environment's batch ``[*B]``, without exploration.

    Args:
        env: environment of any batch, or of none, which plays a single episode.
        policy: the policy, which acts without exploration.
        steps: most control steps of an episode.
        seed: seed of the environment; compare policies with the same seed.
    """
    check_count("steps", steps, 1)
    env.set_seed(seed)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        options = {"break_when_any_done": False, "break_when_all_done": True}
        rollout = env.rollout(steps, policy, auto_cast_to_device=device_of(policy) not in (None, env.device), **options)
    reward, done = rollout["next", "reward"], rollout["next", "done"]
    # Environments reset themselves when done: count the first episode only.
    return float(torch.where(alive_of(done)[..., :-1, :], reward, 0.0).sum(-2).mean())

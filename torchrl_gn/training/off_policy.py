"""Learning a policy from its own experience, kept in a replay buffer."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import HardUpdate, LossModule

from torchrl_gn.dynamics.executors.compiled import check_compiler, check_torch
from torchrl_gn.finite import require_finite
from torchrl_gn.policies import Agent

_KEPT = ("observation", "action", ("next", "observation"), ("next", "reward"), ("next", "done"), ("next", "terminated"))


@dataclass(frozen=True)
class LearningProgress:
    """Where learning stands, yielded after every batch of experience.

    Attributes:
        frames: environment steps made, over all environments and resumed runs.
        updates: gradient steps made.
        seconds: spent, over all resumed runs; evaluation apart.
        losses: means since the last progress.
        evaluation: mean return of evaluation episodes, if there were any after this batch.
    """

    frames: int
    updates: int
    seconds: float
    losses: dict[str, float]
    evaluation: float | None = None


@dataclass
class LearningCurve:
    """Returns of evaluation episodes, and the frames, updates and seconds that came before each."""

    frames: list[float] = field(default_factory=list)
    updates: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)


class OffPolicyTrainer:
    """Collect experience, update from a replay buffer, evaluate; again and again.

    (Paper, SM "Reinforcement learning agents".) Iterate over :meth:`run`. The losses' own rules about gradients hold;
    one optimiser updates all of their weights, and target networks are copied after every ``target_interval`` updates.

    Args:
        agent: the networks, whose statistics take every new transition once.
        losses: a loss with target networks first (``DDPGLoss``, :class:`~torchrl_gn.objectives.SVGLoss`), others after.
        env: environments to learn in, ``[num_envs]``; or functions that make some, each for a collector of its own on a
            Ray cluster (join one first: :class:`~torchrl_gn.training.RayCluster`), which has the last update's policy.
        explore: policy to collect with.
        evaluate: mean return of the policy as it is now.
        optimizer: of all weights that the losses train.
        frames: environment steps in all.
        batch_size: transitions of an update.
        frames_per_batch: environment steps between updates; a multiple of ``num_envs``.
        updates_per_frame: gradient steps for every environment step.
        random_frames: environment steps of random actions first, without updates.
        evaluate_frames: environment steps between evaluations.
        capacity: transitions that the replay buffer holds.
        target_interval: updates between copies of the target networks (paper: 1000).
        max_norm: norm that the gradient of all weights together is clipped to.
        compile: compile the losses and their gradients with ``torch.compile`` from the second update on, which takes
            some minutes: 1.6 to 1.9 times as many updates a second then.
        seed: of the replay buffer, and of the environments of a run that goes on: else the same episodes would begin it
            again.

    Raises:
        ValueError: if a number of frames does not fit the environments, or a number is not positive.
        FileNotFoundError: with ``compile``, without a C++ compiler on a CPU.
        RuntimeError: with ``compile``, if torch is too old.
    """

    def __init__(
        self,
        agent: Agent,
        losses: Sequence[LossModule],
        env: EnvBase | Sequence[Callable[[], EnvBase]],
        explore: TensorDictModuleBase,
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
        compile: bool = False,
        seed: int = 0,
    ) -> None:
        if isinstance(env, EnvBase) and (frames_per_batch % env.batch_size.numel() or frames_per_batch < 1):
            raise ValueError(
                f"frames_per_batch={frames_per_batch} must be a multiple of {env.batch_size.numel()} environments."
            )
        for name, value in (
            ("frames", frames),
            ("batch_size", batch_size),
            ("updates_per_frame", updates_per_frame),
            ("evaluate_frames", evaluate_frames),
            ("capacity", capacity),
            ("target_interval", target_interval),
            ("max_norm", max_norm),
        ):
            if not 0 < value < math.inf:
                raise ValueError(f"{name}={value} must be positive and finite.")
        self.agent, self.losses, self.env, self.explore = agent, list(losses), env, explore
        self.evaluate, self.optimizer = evaluate, optimizer
        self.total, self.per_batch, self.random_frames = frames, frames_per_batch, random_frames
        self.updates_per_frame, self.evaluate_frames, self.max_norm = updates_per_frame, evaluate_frames, max_norm
        self.capacity = min(capacity, frames + frames_per_batch)  # the last batch may go beyond
        # TorchRL's interval are the updates in between.
        self.target = HardUpdate(losses[0], value_network_update_interval=target_interval - 1)
        self.generator = torch.Generator().manual_seed(seed)
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(self.capacity, device=torch.device("cpu")),
            batch_size=batch_size,
            generator=self.generator,
        )
        self.frames, self.updates, self.seconds, self.owed = 0, 0, 0.0, 0.0
        self.curve = LearningCurve()
        self.seed = seed
        self._weights = [p for group in optimizer.param_groups for p in group["params"]]
        if compile:
            check_torch()
        if compile and self._weights[0].device.type == "cpu":
            check_compiler()
        self._loss = self._first_loss if compile else self._every_loss

    def run(self) -> Iterator[LearningProgress]:
        """Learn until all frames are spent.

        Raises:
            FloatingPointError: if a loss or a gradient is not finite, before any weight is touched by it.
        """
        if not self.curve.frames:
            self._evaluate()
        if self.owed >= 1 or self._due:  # an interrupt came between a batch and what belongs to it
            yield self._learn(time.perf_counter())
        if self.frames >= self.total:
            return
        collector, threads = self._collector(), torch.get_num_threads()
        try:
            start = time.perf_counter()
            for batch in collector:
                # With the last batch TorchRL closes the environments, after which a SerialEnv leaves torch all threads:
                # on a busy machine the last updates took minutes.
                torch.set_num_threads(threads)
                self.remember(batch)
                yield self._learn(start)
                start = time.perf_counter()
                if not isinstance(self.env, EnvBase):
                    collector.update_policy_weights_(self.explore)
        finally:
            # Left to itself it would close an environment that is the caller's, and leave processes of a cluster.
            collector.shutdown(**({"close_env": False} if isinstance(self.env, EnvBase) else {}))

    def _learn(self, start: float) -> LearningProgress:
        """The updates that are owed, and an evaluation where one is due; time counts from ``start``."""
        losses: dict[str, list[float]] = {}
        while self.owed >= 1:
            for name, value in self.update().items():
                losses.setdefault(name, []).append(value)
            self.owed -= 1
        self.seconds += time.perf_counter() - start
        evaluation = self._evaluate() if self._due else None
        means = {name: sum(values) / len(values) for name, values in losses.items()}
        return LearningProgress(self.frames, self.updates, self.seconds, means, evaluation)

    @property
    def _due(self) -> bool:
        """Whether the policy is to be evaluated: now and then, and at the end."""
        last = self.curve.frames[-1]
        passed = self.frames // self.evaluate_frames > last // self.evaluate_frames
        return passed or self.frames >= self.total and self.frames > last

    def _collector(self) -> BaseCollector:
        common: dict[str, Any] = {
            "frames_per_batch": self.per_batch,
            "total_frames": self.total - self.frames,
            "init_random_frames": max(0, self.random_frames - self.frames),
            "exploration_type": ExplorationType.RANDOM,
        }
        options: dict[str, Any] = {"track_traj_ids": False, "auto_register_policy_transforms": False}
        if isinstance(self.env, EnvBase):
            if self.frames:
                self.env.set_seed(self.seed + self.frames)
            return Collector(self.env, self.explore, **common, **options)
        makers = list(self.env)
        if self.frames:
            makers = [partial(_seeded, make, self.seed + self.frames + index) for index, make in enumerate(makers)]
        resources = {"num_cpus": 1, "num_gpus": 0}
        collector = Collector(
            makers,
            self.explore,
            backend="ray",
            sync=True,
            backend_options={"collector_kwargs": options, "remote_configs": resources},
            **common,
        )
        collector.update_policy_weights_(self.explore)
        return collector

    def remember(self, batch: TensorDictBase) -> None:
        """Take new transitions ``[*B]`` into the replay buffer and the agent's statistics.

        Raises:
            ValueError: if a number is not finite.
        """
        steps = cast(TensorDict, batch.select(*_KEPT)).reshape(-1).to(self._weights[0].device)
        require_finite(steps, "Experience")
        self.agent.update_normalizers(steps["observation"], steps["action"], steps["next", "observation"])
        self.buffer.extend(steps)
        self.frames += len(steps)
        if self.frames > self.random_frames:
            self.owed += self.updates_per_frame * len(steps)

    def update(self) -> dict[str, float]:
        """One gradient step on transitions from the replay buffer; the losses of it.

        Raises:
            FloatingPointError: if a loss or a gradient is not finite; no weight is changed.
        """
        total, each = self._loss(self.buffer.sample().to(self._weights[0].device))
        values = {name: float(value) for name, value in each.items()}
        if not math.isfinite(sum(values.values())):
            raise FloatingPointError(f"Losses are {values} at update {self.updates}; lower the learning rate.")
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        norm = float(torch.nn.utils.clip_grad_norm_(self._weights, self.max_norm))
        if not math.isfinite(norm):
            raise FloatingPointError(f"The gradient is not finite at update {self.updates}; lower the learning rate.")
        self.optimizer.step()
        self.target.step()
        self.updates += 1
        return values

    def _first_loss(self, batch: TensorDictBase) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """As :meth:`_every_loss`, which is compiled from now on.

        TorchRL's losses make some of their parts at their first call; compiled before, all would be compiled again.
        """
        # Asked for by tensordict, to which it matters no more.
        warnings.filterwarnings("ignore", "torch._dynamo.config.inline_inbuilt_nn_modules", FutureWarning)
        self._loss = torch.compile(self._every_loss, fullgraph=True, dynamic=False)
        return self._every_loss(batch)

    def _every_loss(self, batch: TensorDictBase) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Sum of all losses, to be differentiated, and each by name."""
        each: dict[str, torch.Tensor] = {}
        for loss in self.losses:
            out = loss(batch)
            names = [name for name in map(str, loss.out_keys) if name.startswith("loss_")]
            each |= {name: cast(torch.Tensor, out[name]) for name in names}
        return torch.stack(list(each.values())).sum(), {name: value.detach() for name, value in each.items()}

    def _evaluate(self) -> float:
        value = self.evaluate()
        for record, now in (
            (self.curve.frames, self.frames),
            (self.curve.updates, self.updates),
            (self.curve.seconds, self.seconds),
            (self.curve.returns, value),
        ):
            record.append(now)
        return value

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to go on later, the agent apart; episodes that were going on begin anew."""
        filled = self.buffer.storage[: len(self.buffer)] if len(self.buffer) else TensorDict()
        oldest = int(self.buffer.writer.state_dict()["_cursor"]) % max(1, len(self.buffer))
        return {
            "losses": [dict(loss.state_dict()) for loss in self.losses],
            "optimizer": self.optimizer.state_dict(),
            "target_counter": self.target.counter,
            "buffer": {".".join(key): value.roll(-oldest, 0) for key, value in _leaves(filled)},
            "generators": {"buffer": self.generator.get_state(), "global": torch.get_rng_state()},
            "curve": vars(self.curve),
            "progress": {name: getattr(self, name) for name in ("frames", "updates", "seconds", "owed")},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what :meth:`state_dict` gave.

        Raises:
            ValueError: if it has more frames than there are to be in all; nothing is changed.
        """
        frames = state["progress"]["frames"]
        if frames >= self.total + self.per_batch:
            raise ValueError(f"{frames} frames were learned from before; give frames={frames} or more to go on.")
        for loss, saved in zip(self.losses, state["losses"], strict=True):
            loss.load_state_dict(saved)
        self.optimizer.load_state_dict(state["optimizer"])
        self.target.counter = state["target_counter"]
        if state["buffer"]:
            flat = TensorDict(state["buffer"])
            flat.auto_batch_size_(1)
            self.buffer.extend(flat.unflatten_keys(".")[-self.capacity :])
        self.generator.set_state(state["generators"]["buffer"])
        torch.set_rng_state(state["generators"]["global"])
        self.curve = LearningCurve(**{name: list(values) for name, values in state["curve"].items()})
        for name, value in state["progress"].items():
            setattr(self, name, value)


def _seeded(make: Callable[[], EnvBase], seed: int) -> EnvBase:
    env = make()
    env.set_seed(seed)
    return env


def _leaves(tensordict: TensorDictBase) -> Iterator[tuple[tuple[str, ...], torch.Tensor]]:
    for key, value in tensordict.items(include_nested=True, leaves_only=True):
        yield ((key,) if isinstance(key, str) else key), cast(torch.Tensor, value)


@torch.no_grad()
def mean_return(env: EnvBase, policy: TensorDictModuleBase, steps: int, *, seed: int = 0) -> float:
    """Mean return of one episode in each environment ``[num_envs]``, without exploration.

    Args:
        env: environments whose episodes take ``steps`` steps, or less if they end by themselves.
        policy: the policy.
        steps: control steps of an episode.
        seed: of the episodes; the same ones every time, so that policies compare.
    """
    env.set_seed(seed)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = env.rollout(steps, policy, break_when_any_done=False, break_when_all_done=True)
    reward, done = rollout["next", "reward"], rollout["next", "done"]
    # Steps after an episode's end are another's.
    going = torch.cat((torch.ones_like(done[:, :1]), (~done[:, :-1]).cumprod(1).bool()), dim=1)
    return float((reward * going).sum(1).mean())

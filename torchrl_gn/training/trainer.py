"""Training loop of a forward model, resumable at any step."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass

import torch
from torch import nn
from torchrl.data import ReplayBuffer

from torchrl_gn.checks import check_count
from torchrl_gn.dynamics.executors.native.preparation import around_preparation
from torchrl_gn.interrupts import held, let_in_at_once
from torchrl_gn.maths import fast_matmul
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.objectives import ForwardModelLoss, IdentificationLoss, SeveralScenesLoss
from torchrl_gn.processor import threads_for_native
from torchrl_gn.training.budget import Budget
from torchrl_gn.training.gradients import with_gradients
from torchrl_gn.training.nested_state import require_amounts, require_like
from torchrl_gn.training.optimizers import ScheduledOptimizer, require_own_weights
from torchrl_gn.training.recorded_update import RecordedUpdates
from torchrl_gn.training.workers import Workers

_WINDOW_BATCHES = 10  # most batches of windows drawn for an update while rollouts diverge


@dataclass(frozen=True)
class Progress:
    """State of the training after a step."""

    step: int
    seconds: float  # over all resumed runs
    fraction: float  # of the budget spent
    loss: float
    validation: float | None = None  # error, if measured after this step


class Trainer:
    """Trainer of a forward model from a replay buffer; iterate over :meth:`run`.

    With several ``workers``, each process trains on its shard of every batch, and gradients are averaged. Clock,
    validation and checkpoint are those of rank 0. The result equals that of one process up to rounding and input noise.
    Preparing steps for C++, once per process, does not count towards the budget.

    Args:
        loss: the loss, which holds the model to train.
        buffer: replay buffer of transitions, or of windows for recurrent models and identification.
        optimizer: from ``make_optimizer``, or any of ``torch.optim`` (no schedule, no clipping).
        budget: limits on steps and minutes.
        unroll: replay buffer of windows of several steps, for the last part of the work.
        unroll_fraction: share of the work that trains on these windows.
        unroll_cost: cost of an update on windows, in updates on transitions.
        validate: function that returns the validation error. :meth:`restore_best` loads the weights with the lowest
            error (paper: error of 20-step rollouts).
        validations: number of validations, at equal shares of the budget.
        patience: validations without a new best before training stops. Default: never stop early.
        workers: processes that train together. Default: this one alone.

    Raises:
        ValueError: an option is out of range, or the optimiser has no weight of the loss's model.
    """

    def __init__(
        self,
        loss: ForwardModelLoss | SeveralScenesLoss | IdentificationLoss,
        buffer: ReplayBuffer,
        optimizer: ScheduledOptimizer | torch.optim.Optimizer,
        budget: Budget,
        *,
        unroll: ReplayBuffer | None = None,
        unroll_fraction: float = 0.0,
        unroll_cost: float = 1.0,
        validate: Callable[[], float] | None = None,
        validations: int = 20,
        patience: int | None = None,
        workers: Workers | None = None,
    ) -> None:
        if not 0 <= unroll_fraction <= 1:
            raise ValueError(f"unroll_fraction={unroll_fraction} must be a share, 0 to 1.")
        if not 0 < unroll_cost < math.inf:
            raise ValueError(f"unroll_cost={unroll_cost} must be positive and finite.")
        check_count("validations", validations, 1)
        if patience is not None:
            check_count("patience", patience, 1)
        self.loss, self.buffer, self.budget = loss, buffer, budget
        self.optimizer = ScheduledOptimizer.of(optimizer)
        self.unroll, self.unroll_fraction, self.unroll_cost = unroll, unroll_fraction, unroll_cost
        self.validate, self.validations, self.patience = validate, validations, patience
        self.workers = workers or Workers()
        self.model = loss.trained
        self.device = next(self.model.parameters()).device
        require_own_weights("optimizer", self.optimizer.parameters, self.model)
        self.step, self.seconds, self._paused = 0, 0.0, 0.0
        self.best, self.since_best, self.validated = math.inf, 0, 0
        self.best_weights: dict[str, torch.Tensor] = {}
        self._recorded: RecordedUpdates | None = None
        # Seconds by part of a step.
        self.spent = {"sampling": 0.0, "model": 0.0, "optimizer": 0.0, "validation": 0.0, "caller": 0.0}

    @property
    def fraction(self) -> float:
        """Share of the budget spent, 0 to 1."""
        windows = 0.0 if self.unroll is None else self.unroll_fraction
        return self.budget.fraction(self.step, self.seconds, windows=windows, window_cost=self.unroll_cost)

    @property
    def cut_short(self) -> bool:
        """True if the budget's minutes ran out before its steps."""
        return self.budget.is_cut_short(self.step, self.seconds)

    def run(self) -> Iterator[Progress]:
        """Train until the budget is spent, yielding after every step.

        Ctrl-C and SIGTERM wait until a step and its validation are complete, so :meth:`state_dict` resumes exactly.

        Raises:
            FloatingPointError: the loss or the gradient is not finite; nothing changes at that step. With windows,
                whose rollouts may diverge, only if ten batches in a row are not finite.
        """
        module, fraction = self.workers.wrap(self.loss), self.workers.agree(lambda: self.fraction)
        with let_in_at_once():  # preparation may take minutes
            native = getattr(self.loss, "reason", "no forward model") is None
        if self._recorded is None and self.workers.size == 1:
            self._recorded = RecordedUpdates.of(self.loss, self.optimizer, self.device)
        while fraction < 1 and (self.patience is None or self.since_best < self.patience):
            with held(), around_preparation(self._pause):
                with fast_matmul(), threads_for_native() if native else nullcontext():
                    loss = self._update(module, fraction)
                fraction = self.workers.agree(lambda: self.fraction)
                validation = self._validation(fraction)
            start = self._now()
            yield Progress(self.step, self.seconds, fraction, loss, validation)
            self._lap("caller", start)

    def _update(self, module: nn.Module, fraction: float) -> float:
        if self.unroll is None or fraction < 1 - self.unroll_fraction - 1e-9:  # tolerates rounding
            return self._update_on(self.buffer, module, fraction)
        for _ in range(_WINDOW_BATCHES - 1):
            with suppress(FloatingPointError):
                return self._update_on(self.unroll, module, fraction)
        return self._update_on(self.unroll, module, fraction)

    @without_autocast
    @with_gradients
    def _update_on(self, buffer: ReplayBuffer, module: nn.Module, fraction: float) -> float:
        """Draw a batch, update on it and return the loss; FloatingPointError, and no change, if it is not finite."""
        clock = self._now()
        batch = buffer.sample().to(self.device)
        clock = self._lap("sampling", clock)
        if self._recorded is not None and (value := self._recorded(batch, self.step, fraction)) is not None:
            self._lap("model", clock)
            self.step += 1
            return value
        loss = module(batch)["loss_forward_model"]
        self.optimizer.zero_grad()
        loss.backward()
        # Averaged over processes, so that all raise if one does; read last, as reading waits for the device.
        mean = self.workers.mean(loss.item())
        if not math.isfinite(mean):
            raise FloatingPointError(f"The loss is {mean} at step {self.step}; lower the learning rate.")
        clock = self._lap("model", clock)
        self.optimizer.step(self.step, fraction)
        self._lap("optimizer", clock)
        self.step += 1
        return mean

    @without_autocast
    def _validation(self, fraction: float) -> float | None:
        due = math.floor(fraction * self.validations)
        if self.validate is None or due <= self.validated:
            return None
        start = self._now()
        with fast_matmul():
            error = self.workers.agree(self.validate)
        self.validated = due
        self.since_best += 1
        if error < self.best:
            self.best, self.since_best = error, 0
            self.best_weights = {name: value.clone() for name, value in self.model.state_dict().items()}
        self._lap("validation", start)
        return error

    @contextmanager
    def _pause(self) -> Iterator[None]:
        """Stop the training's clock."""
        start = self.budget.now()
        yield
        self._paused += self.budget.now() - start

    def _now(self) -> float:
        return self.budget.now() - self._paused

    def _lap(self, part: str, since: float) -> float:
        now = self._now()
        self.spent[part] += now - since
        self.seconds += now - since
        return now

    def outside_share(self) -> float:
        """Return the share of a step's time outside model and optimiser: sampling and the caller."""
        step = sum(seconds for part, seconds in self.spent.items() if part != "validation")
        return (self.spent["sampling"] + self.spent["caller"]) / step if step else 0.0

    def restore_best(self) -> None:
        """Load the weights of the best validation, if any, into the model."""
        if self.best_weights:
            self.model.load_state_dict(self.best_weights)

    def state_dict(self) -> dict:
        """Return the state to resume exactly from, without the weights."""
        buffers = {"main": self.buffer, "unroll": self.unroll}
        return {
            "optimizer": self.optimizer.state_dict(),
            "loss": self.loss.training_state(),
            "samplers": {name: buffer.sampler.state_dict() for name, buffer in buffers.items() if buffer is not None},
            "best_weights": self.best_weights,
            "progress": {
                **{name: getattr(self, name) for name in ("step", "seconds")},
                "best": self.best if math.isfinite(self.best) else None,
                **{name: getattr(self, name) for name in ("since_best", "validated", "spent")},
            },
        }

    def load_state_dict(self, state: dict) -> None:
        """Resume from a :meth:`state_dict`.

        ValueError, and no change, if it belongs to other networks or options, or is forged.
        """
        before = copy.deepcopy(self.state_dict())
        try:
            self._load(state)
        except BaseException:
            self._load(before)  # optimiser, loss or samplers may have loaded a part of the refused state
            raise

    def _load(self, state: dict) -> None:
        current = self.state_dict()
        if "unroll" not in state["samplers"]:  # the saved run had no windows
            current["samplers"].pop("unroll", None)
        # Optimiser and loss check what they load.
        current |= {
            "optimizer": {},
            "loss": {},
            "best_weights": self.model.state_dict() if state["best_weights"] else {},
        }
        current["progress"]["best"] = None if state["progress"]["best"] is None else 0.0
        require_like(current, state)
        require_amounts(state["progress"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.loss.load_training_state(state["loss"])
        for module in () if self.workers.first else self.loss.modules():  # the state is that of rank 0
            if isinstance(generator := getattr(module, "generator", None), torch.Generator):
                # Reseed the other ranks from the loaded state, so that every resumed run gets new seeds.
                seeds = torch.randint(2**62, (self.workers.size,), generator=generator)
                generator.manual_seed(int(seeds[self.workers.rank]))
        self.buffer.sampler.load_state_dict(state["samplers"]["main"])
        if self.unroll is not None and "unroll" in state["samplers"]:
            self.unroll.sampler.load_state_dict(state["samplers"]["unroll"])
        self.best_weights = dict(state["best_weights"])
        progress = state["progress"]
        self.step, self.seconds, self.spent = progress["step"], progress["seconds"], dict(progress["spent"])
        self.best = math.inf if progress["best"] is None else progress["best"]
        self.since_best = progress["since_best"]
        # With a larger budget, a smaller share is spent and fewer validations count as done.
        self.validated = min(progress["validated"], math.floor(self.fraction * self.validations))

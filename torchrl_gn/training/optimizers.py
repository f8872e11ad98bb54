"""Optimisers with learning-rate schedules, and presets of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, cast, get_args

import torch
from torch import nn
from torchrl.objectives import LossModule

from torchrl_gn.checks import refuse_closure
from torchrl_gn.training.muon import Muon
from torchrl_gn.training.nested_state import require_amounts, require_like

Preset = Literal["muon", "adam", "paper"]

_STATE_NAMES: dict[type, tuple[str, ...]] = {torch.optim.Adam: ("exp_avg", "exp_avg_sq"), Muon: ("momentum_buffer",)}


class ScheduledOptimizer:
    """Optimisers that step together, with clipped gradients and scheduled learning rates.

    Args:
        optimizers: the optimisers, at their peak learning rates; none whose steps need a closure, such as LBFGS.
        schedule: factor on the learning rates from ``(step, fraction of the budget spent)``; None: no change.
        max_norm: positive norm that the joint gradient is clipped to; infinite: no clipping.
    """

    def __init__(
        self,
        optimizers: list[torch.optim.Optimizer],
        schedule: Callable[[int, float], float] | None,
        *,
        max_norm: float = 1.0,
    ) -> None:
        if not max_norm > 0:
            raise ValueError(f"max_norm={max_norm} must be positive.")
        for each in optimizers:
            refuse_closure(each)
        self.optimizers, self.schedule, self.max_norm = optimizers, schedule, max_norm
        # Numbers, because a rate that is a tensor is scheduled in place.
        self._peak_rates = [[float(group["lr"]) for group in optimizer.param_groups] for optimizer in optimizers]
        self._parameters = [p for o in optimizers for group in o.param_groups for p in group["params"]]

    @classmethod
    def of(cls, optimizer: ScheduledOptimizer | torch.optim.Optimizer) -> ScheduledOptimizer:
        """Wrap an optimiser of ``torch.optim`` without schedule or clipping."""
        if isinstance(optimizer, cls):
            return optimizer
        if not isinstance(optimizer, torch.optim.Optimizer):
            raise TypeError(
                f"optimizer must be of make_optimizer(...) or a torch.optim.Optimizer, not {type(optimizer).__name__}."
            )
        return cls([optimizer], None, max_norm=math.inf)

    def zero_grad(self) -> None:
        for optimizer in self.optimizers:
            optimizer.zero_grad(set_to_none=True)

    def step(self, step: int, fraction: float) -> float:
        """Clip the gradients, set the learning rates, update the parameters; return the norm before clipping.

        Args:
            step: number of updates done before.
            fraction: share of the budget spent, 0 to 1.

        Raises:
            FloatingPointError: the gradient is not finite; nothing changes.
        """
        norm = clip_gradients(self._parameters, self.max_norm, f"step {step}")
        self.set_rates(step, fraction)
        for optimizer in self.optimizers:
            optimizer.step()
        return norm

    def set_rates(self, step: int, fraction: float) -> None:
        """Set the learning rates of the schedule; tensors are set in place."""
        if self.schedule is None:
            return
        factor = self.schedule(step, fraction)
        for optimizer, rates in zip(self.optimizers, self._peak_rates, strict=True):
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                if isinstance(group["lr"], torch.Tensor):
                    group["lr"].fill_(rate * factor)
                else:
                    group["lr"] = rate * factor

    @property
    def parameters(self) -> list[torch.Tensor]:
        """All trained parameters."""
        return self._parameters

    def make_recordable(self) -> bool:
        """Keep learning rates and step counts on the GPU, so that a CUDA graph can hold an update.

        Return False, and change nothing, if some optimiser cannot.
        """
        if not all(isinstance(each, (Muon, torch.optim.Adam)) for each in self.optimizers):
            return False
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = torch.as_tensor(group["lr"], dtype=torch.float32, device=group["params"][0].device)
                if isinstance(optimizer, torch.optim.Adam):
                    group["capturable"] = True
        return True

    def state_dict(self) -> dict:
        state = {str(index): optimizer.state_dict() for index, optimizer in enumerate(self.optimizers)}
        for each in state.values():  # as numbers, which load on any device
            for group in each["param_groups"]:
                group["lr"] = float(group["lr"])
                if "capturable" in group:
                    group["capturable"] = False
        return state

    def load_state_dict(self, state: dict) -> None:
        for index, optimizer in enumerate(self.optimizers):
            load_optimizer(optimizer, state[str(index)])


def load_optimizer(optimizer: torch.optim.Optimizer, state: Mapping[str, Any]) -> None:
    """Load the ``state_dict()`` of an equal optimiser; ValueError if its parameters differ or it is forged.

    Rates and other numbers are restored, but not options such as ``fused`` for how updates are computed.
    """
    groups = []
    for group, saved in zip(optimizer.state_dict()["param_groups"], state["param_groups"], strict=True):
        numbers = {name: value for name, value in group.items() if name in saved and _is_numeric(value)}
        require_like(numbers, saved, "training.optimizer.param_groups")
        groups.append({**group, **{name: saved[name] for name in numbers}})
    optimizer.load_state_dict({"state": state["state"], "param_groups": groups})
    state_names = next((names for kind, names in _STATE_NAMES.items() if isinstance(optimizer, kind)), ())
    for parameter, entries in optimizer.state.items():
        # Kernels do not check shapes: a fused one would write beyond the end of moments that are too small.
        like: dict[str, Any] = {name: torch.empty_like(parameter, device="meta") for name in state_names}
        if isinstance(optimizer, torch.optim.Adam):
            like["step"] = torch.zeros(())
        require_like(like, entries, "training.optimizer.state")
        require_amounts({name: entries[name] for name in like if name == "step"}, "training.optimizer.state")


def _is_numeric(option: Any) -> bool:
    each = option if isinstance(option, (list, tuple)) else [option]
    return all(type(number) in (int, float) for number in each)


def clip_gradients(parameters: Iterable[torch.Tensor], max_norm: float, when: str) -> float:
    """Clip the joint gradient; return its norm before. FloatingPointError, naming ``when``, if it is not finite."""
    parameters = list(parameters)
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    norm = nn.utils.get_total_norm(gradients)
    if not math.isfinite(size := float(norm)):  # the one wait for a device
        # Squares of finite gradients overflow float32 from 1.8e19 on.
        norm = nn.utils.get_total_norm([gradient.double() for gradient in gradients])
        size = float(norm)
    if not math.isfinite(size):
        raise FloatingPointError(f"The gradient is not finite at {when}; lower the learning rate.")
    nn.utils.clip_grads_with_norm_(parameters, max_norm, norm)
    return size


def trained_weights(module: nn.Module) -> list[nn.Parameter]:
    """Return the weights that require a gradient; ValueError if there are none."""
    weights = [weight for weight in module.parameters() if weight.requires_grad]
    if not weights:
        raise ValueError(f"{type(module).__name__} has no weight that requires a gradient: there is nothing to train.")
    return weights


def require_own_weights(optimizer: str, parameters: Iterable[torch.Tensor], *modules: nn.Module) -> None:
    """Raise ValueError, naming ``optimizer``, if ``parameters`` include no weight of the modules: none would change."""
    own = {id(weight) for module in modules for weight in module.parameters()}
    if own.isdisjoint(map(id, parameters)):
        raise ValueError(
            f"{optimizer} has no weight of the {type(modules[0]).__name__} that is trained, so nothing would change:"
            " make it of the weights of this very network, not of a copy or of an earlier one."
        )


def make_optimizer(module: nn.Module, preset: Preset = "muon", *, lr: float | None = None) -> ScheduledOptimizer:
    """Make a preset optimiser for a module's parameters.

    Args:
        preset: ``"muon"`` (Muon 1e-2 on matrices, Adam 1e-3 on the rest, cosine to 0), ``"adam"`` (1e-3, cosine to 0)
            or ``"paper"`` (Adam 1e-4, times 0.975 every 50,000 steps: SM "Training details").
        lr: peak learning rate (of Muon's matrices), instead of the preset's.
    """
    if preset not in get_args(Preset):
        raise ValueError(f"Optimiser preset {preset!r} is not known; use one of {list(get_args(Preset))}.")
    if lr is not None and not 0 < lr < math.inf:
        raise ValueError(f"lr={lr} must be positive and finite.")
    parameters = [parameter for parameter in trained_weights(module) if parameter.numel()]
    if preset != "muon":
        # Paper: the rate is printed as 1^{-4}.
        rate, schedule = (1e-4, _paper_decay) if preset == "paper" else (1e-3, _cosine)
        return ScheduledOptimizer([torch.optim.Adam(parameters, lr=lr or rate, fused=True)], schedule)
    matrices = [parameter for parameter in parameters if parameter.ndim == 2]
    others = [parameter for parameter in parameters if parameter.ndim != 2]
    optimizers: list[torch.optim.Optimizer] = [Muon(matrices, lr=lr or 1e-2)] if matrices else []
    optimizers += [torch.optim.Adam(others, lr=1e-3, fused=True)] if others else []
    return ScheduledOptimizer(optimizers, _cosine)


def make_agent_optimizer(
    losses: Sequence[LossModule], *, policy_lr: float, value_lr: float, model_lr: float | None = None
) -> torch.optim.Optimizer:
    """Make one Adam for an agent's networks.

    Args:
        losses: the loss of policy and value; further losses train model and reward.
        policy_lr: learning rate of the policy.
        value_lr: learning rate of the value.
        model_lr: learning rate of the networks of further losses.

    Raises:
        ValueError: if a learning rate that is needed is missing, or not positive and finite.
    """
    first = cast(Any, losses[0])
    groups = [(first.actor_network_params, policy_lr, "policy_lr"), (first.value_network_params, value_lr, "value_lr")]
    groups += [(loss, model_lr, "model_lr") for loss in losses[1:]]
    for _, rate, name in groups:
        if rate is None or not 0 < rate < math.inf:
            raise ValueError(f"{name}={rate} must be positive and finite.")
    return torch.optim.Adam(
        [{"params": list(module.parameters()), "lr": rate} for module, rate, _ in groups], fused=True
    )


def _paper_decay(step: int, fraction: float) -> float:
    return 0.975 ** (step // 50_000)


def _cosine(step: int, fraction: float) -> float:
    return 0.5 * (1 + math.cos(math.pi * min(max(fraction, 0.0), 1.0)))

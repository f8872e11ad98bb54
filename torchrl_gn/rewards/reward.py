"""Base class of task rewards, their weighted sums, and the module that freezes their goal for a plan."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from types import MappingProxyType
from typing import cast

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn

from torchrl_gn.finite import require_finite
from torchrl_gn.maths.precision import without_autocast


class Reward(nn.Module):
    """Reward of one control step for one scene, differentiable in all tensors; constants are buffers.

    When planning starts, :meth:`task_of` computes the ``task`` from the episode's ``target``, and :meth:`forward` reads
    the task at every step of the plan (:class:`~torchrl_gn.rewards.FreezeGoal`). Rewards can be added and scaled, as in
    ``forward + 0.1 * upright``. Environments and sums also accept any callable with the signature of :meth:`forward`.
    Subclasses raise ValueError for bodies that the scene does not have.
    """

    target_shape: tuple[int, ...] | None = None  # shape of a target without batch; None if the reward takes none
    shown: Mapping[str, object] = MappingProxyType({})  # arguments in its repr

    @without_autocast
    def __call__(self, *args, **kwargs):
        return super().__call__(*args, **kwargs)

    @abstractmethod
    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        """Return the reward ``[*B, 1]`` of a step, in the dtype of ``next_state``.

        Args:
            state: ``[*B, N, 13]`` before the step (position 3, w-first quaternion 4, velocity 3, angular velocity 3).
            action: ``[*B, A]`` controls during the step.
            next_state: ``[*B, N, 13]`` after the step.
            task: goal of the plan, if the reward needs one; its batch broadcasts against ``*B``. ValueError if it does
                not fit.
        """

    def along(self, states: Tensor, actions: Tensor, task: Tensor | None = None) -> Tensor:
        """Return the rewards ``[*B, H, 1]`` of steps along states ``[*B, H + 1, N, 13]``, as :meth:`forward` does.

        Override it where two steps share the work on the state between them.

        Args:
            actions: ``[*B, H, A]``.
            task: ``[*B, H or 1, ...]``.
        """
        return self(states[..., :-1, :, :], actions, states[..., 1:, :, :], task)

    def task_of(self, state: Tensor, target: Tensor) -> Tensor:
        """Return the task of a plan from ``state`` ``[*B, N, 13]``; here the target ``[*B, *target_shape]`` itself.

        Waits for a GPU to check the target. ValueError if the reward takes no target, or it is misshapen or not finite.
        """
        name = type(self).__name__
        if self.target_shape is None:
            raise ValueError(f"{name} needs no target: leave out FreezeGoal and the entry 'target'")
        expected = (*state.shape[:-2], *self.target_shape)
        if target.shape != expected:
            raise ValueError(
                f"the target of {name} must be {list(expected)} for states {list(state.shape)},"
                f" got {list(target.shape)}"
            )
        require_finite(target, f"the target of {name}")
        return target

    def require_task(self, task: Tensor | None, next_state: Tensor) -> Tensor:
        """Return ``task`` in the dtype of ``next_state``, for :meth:`forward`; ValueError if missing or misshapen."""
        name, shape, batch = type(self).__name__, self.target_shape or (), next_state.shape[:-2]
        if task is None:
            raise ValueError(
                f"{name} needs a task: give the episode's TensorDict an entry 'target' {list(shape)} and put"
                " FreezeGoal(reward) before the planner, or pass task=reward.task_of(state, target)"
            )
        split = task.ndim - len(shape)
        lead = task.shape[: max(split, 0)]
        sizes = batch[len(batch) - len(lead) :] if 0 <= split <= len(batch) else None
        fits = sizes is not None and all(own in (1, size) for own, size in zip(lead, sizes, strict=True))
        if not fits or task.shape[split:] != shape:
            raise ValueError(f"the task of {name} must be {[*batch, *shape]}, got {list(task.shape)}")
        return task.to(next_state.dtype)

    def __add__(self, other: Reward | Callable[..., Tensor]) -> Reward:
        """Add two rewards, at most one of which needs a target."""
        return self._sum((1.0, self), (1.0, other))

    def __radd__(self, other: Callable[..., Tensor]) -> Reward:
        return self._sum((1.0, other), (1.0, self))

    def __sub__(self, other: Reward | Callable[..., Tensor]) -> Reward:
        return self._sum((1.0, self), (-1.0, other))

    def __mul__(self, factor: float) -> Reward:
        """Multiply the reward by a number."""
        return self._sum((float(factor), self)) if isinstance(factor, Real) else NotImplemented

    __rmul__ = __mul__

    def __neg__(self) -> Reward:
        return self._sum((-1.0, self))

    @staticmethod
    def _sum(*terms: tuple[float, Reward | Callable[..., Tensor]]) -> Reward:
        if any(isinstance(term, type) or not callable(term) for _, term in terms):
            return NotImplemented
        return WeightedSum([(weight, term if isinstance(term, Reward) else _Function(term)) for weight, term in terms])

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={value!r}" for name, value in self.shown.items())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.extra_repr()})"


class _Function(Reward):
    """A callable wrapped as a reward, for sums."""

    def __init__(self, function: Callable[..., Tensor]):
        super().__init__()
        self.function = function

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return self.function(state, action, next_state, task)

    def __repr__(self) -> str:
        return getattr(self.function, "__name__", repr(self.function))


class WeightedSum(Reward):
    """Weighted sum of rewards, the type of ``forward + 0.1 * upright``.

    At most one of them may need a target; ValueError otherwise.
    """

    def __init__(self, terms: Sequence[tuple[float, Reward]]):
        super().__init__()
        flat = [(weight * inner, one) for weight, term in terms for inner, one in terms_of(term)]
        needing = [one for _, one in flat if one.target_shape is not None]
        if not flat or len(needing) > 1:
            raise ValueError(f"At most one reward of a sum may need a target, got {needing or 'none'}.")
        self.weights = tuple(float(weight) for weight, _ in flat)
        self.rewards = nn.ModuleList(one for _, one in flat)
        self.target_shape = needing[0].target_shape if needing else None

    @property
    def terms(self) -> list[tuple[float, Reward]]:
        return list(zip(self.weights, self.rewards, strict=True))  # pyright: ignore[reportReturnType]

    def task_of(self, state: Tensor, target: Tensor) -> Tensor:
        for _, reward in self.terms:
            if reward.target_shape is not None:
                return reward.task_of(state, target)
        return super().task_of(state, target)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        parts = (
            weight * reward(state, action, next_state, None if reward.target_shape is None else task)
            for weight, reward in self.terms
        )
        total = next(parts)
        for part in parts:
            total = total + part
        return total

    def extra_repr(self) -> str:
        return " + ".join(f"{weight:g} * {reward!r}" for weight, reward in self.terms)


def terms_of(reward: Reward) -> list[tuple[float, Reward]]:
    """Return a reward as weighted terms."""
    return reward.terms if isinstance(reward, WeightedSum) else [(1.0, reward)]


class FreezeGoal(TensorDictModuleBase):
    """Module that writes ``task = reward.task_of(state, target)``, which the reward reads at every step of a plan.

    Before a planner, ``TensorDictSequential(FreezeGoal(reward), planner)``, it gives every plan a new task. To keep one
    task for an episode, apply it to the episode's first TensorDict. It reads ``state`` ``[*B, N, 13]`` and ``target``
    ``[*B, *reward.target_shape]``, and detaches nothing. KeyError if one is missing; see :meth:`Reward.task_of` for
    ValueError.
    """

    def __init__(self, reward: Reward):
        super().__init__()
        if not isinstance(reward, Reward):
            raise TypeError(f"FreezeGoal takes a Reward, which defines its task, got {type(reward).__name__}")
        if reward.target_shape is None:
            raise ValueError(f"{reward} needs no target: leave FreezeGoal out")
        self.reward = reward
        self.in_keys = ["state", "target"]
        self.out_keys = ["task"]

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, target = tensordict.get("state", None), tensordict.get("target", None)
        if state is None:
            raise KeyError(f"FreezeGoal({self.reward}) needs an entry 'state'; an environment's reset() writes it")
        if target is None:
            shape = [*tensordict.shape, *(self.reward.target_shape or ())]
            raise KeyError(
                f"FreezeGoal({self.reward}) needs an entry 'target' {shape} in the episode's first TensorDict"
            )
        return tensordict.set("task", self.reward.task_of(cast(Tensor, state), cast(Tensor, target)))

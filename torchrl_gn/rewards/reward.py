"""Base class of task rewards."""

from __future__ import annotations

from abc import abstractmethod

from torch import Tensor, nn

from torchrl_gn.finite import require_finite


class Reward(nn.Module):
    """Reward of one control step, a differentiable function of tensors.

    A subclass is built for one scene and looks up its bodies there. Constants (target orientations, say) are buffers,
    so that ``reward.to(device)`` moves them. Environments accept any callable with the signature of :meth:`forward`.

    Goals that vary between episodes are the entry ``target`` of an episode's TensorDict. When planning starts,
    :meth:`task_of` turns the target and the current state into the ``task`` that :meth:`forward` reads at every step of
    the plan; :class:`~torchrl_gn.rewards.FreezeGoal` does this before a planner.

    Gradients flow to ``state``, ``action``, ``next_state``, ``task`` and ``target``; nothing is detached.

    Attributes:
        target_shape: shape of a target without batch; None if the reward needs none.
    """

    target_shape: tuple[int, ...] | None = None

    @abstractmethod
    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        """Reward for taking ``action`` in ``state`` and arriving in ``next_state``.

        Args:
            state: ``[*B, N, 13]`` states before the step (position 3, w-first quaternion 4,
                linear velocity 3, angular velocity 3; SI, world frame).
            action: ``[*B, A]`` controls during the step.
            next_state: ``[*B, N, 13]`` states after the step.
            task: goal of the episode, such as a direction, if the reward needs one; broadcasts against ``*B``.

        Returns:
            ``[*B, 1]`` rewards in the dtype of ``next_state``.

        Raises:
            ValueError: the reward needs a ``task`` and gets none, or one of a wrong shape.
        """

    def task_of(self, state: Tensor, target: Tensor) -> Tensor:
        """Task of a plan that starts in ``state``; the target itself, unless a subclass overrides this.

        Synchronises with a GPU to check the target.

        Args:
            state: ``[*B, N, 13]`` states that planning starts from.
            target: ``[*B, *target_shape]``.

        Returns:
            The ``task`` that :meth:`forward` reads.

        Raises:
            ValueError: the reward needs no target, or the target has a wrong shape, is not finite or out of reach.
        """
        name = type(self).__name__
        if self.target_shape is None:
            raise ValueError(f"{name} needs no target: leave out FreezeGoal and the entry 'target'")
        wanted = (*state.shape[:-2], *self.target_shape)
        if target.shape != wanted:
            raise ValueError(
                f"the target of {name} must be {list(wanted)} for states {list(state.shape)}, got {list(target.shape)}"
            )
        require_finite(target, f"the target of {name}")
        return target

    def require_task(self, task: Tensor | None, next_state: Tensor) -> Tensor:
        """Checked task, for a subclass's :meth:`forward`.

        Args:
            task: ``[*B, *target_shape]``, or broadcastable to it.
            next_state: ``[*B, N, 13]``.

        Returns:
            ``task`` in the dtype of ``next_state``.

        Raises:
            ValueError: there is no task, or its shape does not fit.
        """
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

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.extra_repr()})"

"""What a task reward is."""

from __future__ import annotations

from abc import abstractmethod

from torch import Tensor, nn


class Reward(nn.Module):
    """Reward of one control step, a differentiable function of tensors.

    A subclass is bound to one scene when it is built: it looks up its bodies
    there and refuses a scene that has not got them. What is fixed (target
    orientations, say) is a buffer, so that ``reward.to(device)`` moves it.
    Environments accept any callable with the signature of :meth:`forward`.

    Gradients flow to ``state``, ``action``, ``next_state`` and ``task``; nothing is
    detached, and whoever wants gradients keeps autograd on.
    """

    @abstractmethod
    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        """Reward for taking ``action`` in ``state`` and arriving in ``next_state``.

        Args:
            state: ``[*B, N, 13]`` states before the step (position 3, w-first quaternion 4,
                linear velocity 3, angular velocity 3; SI, world frame).
            action: ``[*B, A]`` controls during the step.
            next_state: ``[*B, N, 13]`` states after the step.
            task: what varies between episodes (a target position, say), where the
                task has such a thing.

        Returns:
            ``[*B, 1]`` rewards in the dtype of ``next_state``.
        """

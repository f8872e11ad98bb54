"""Freeze an episode's goal when planning starts."""

from __future__ import annotations

from typing import cast

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor

from torchrl_gn.rewards.reward import Reward


class FreezeGoal(TensorDictModuleBase):
    """Write the ``task`` that a reward reads at every step of a plan: ``reward.task_of(state, target)``.

    Put it before any planner: ``TensorDictSequential(FreezeGoal(reward), planner)``. Every plan then gets a new task;
    for :class:`Reach` the direction from the body's current position (paper, SM "Planning configuration": "at the first
    planning timestep"). To keep one task for a whole episode, apply the module to the episode's first TensorDict and
    leave it out of the policy.

    Reads ``state`` ``[*B, N, 13]`` and ``target`` ``[*B, *reward.target_shape]``, writes ``task``. Differentiable where
    ``reward.task_of`` is; nothing is detached.

    Args:
        reward: reward that needs a target.

    Raises:
        TypeError: ``reward`` is no :class:`Reward`.
        ValueError: the reward has no target; when called, the target has a wrong shape, is not finite or out of reach.
        KeyError: when called, no ``state`` or ``target``.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_gn.rewards import make_reward
        >>> from torchrl_gn.scenes import load_scene
        >>> scene = load_scene("swimmer6")
        >>> freeze = FreezeGoal(make_reward("reach", scene))
        >>> state, target = torch.zeros(4, scene.num_nodes, 13), torch.ones(4, 3)
        >>> freeze(TensorDict({"state": state, "target": target}, batch_size=[4]))["task"].shape
        torch.Size([4, 3])
    """

    def __init__(self, reward: Reward):
        super().__init__()
        if not isinstance(reward, Reward):
            raise TypeError(f"FreezeGoal takes a Reward, which says what its task is, got {type(reward).__name__}")
        if reward.target_shape is None:
            raise ValueError(f"{reward} needs no target: leave FreezeGoal out")
        self.reward = reward
        self.in_keys = ["state", "target"]
        self.out_keys = ["task"]

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``task`` into the TensorDict and return it."""
        state, target = tensordict.get("state", None), tensordict.get("target", None)
        if state is None:
            raise KeyError(f"FreezeGoal({self.reward}) needs an entry 'state'; an environment's reset() writes it")
        if target is None:
            shape = [*tensordict.shape, *(self.reward.target_shape or ())]
            raise KeyError(
                f"FreezeGoal({self.reward}) needs an entry 'target' {shape} in the episode's first TensorDict"
            )
        return tensordict.set("task", self.reward.task_of(cast(Tensor, state), cast(Tensor, target)))

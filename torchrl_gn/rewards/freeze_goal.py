"""Freeze an episode's goal when planning starts."""

from __future__ import annotations

from typing import cast

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor

from torchrl_gn.rewards.reward import Reward


class FreezeGoal(TensorDictModuleBase):
    """Write ``task = reward.task_of(state, target)``, which a reward reads at every step of a plan.

    Before a planner, ``TensorDictSequential(FreezeGoal(reward), planner)``, every plan gets a new task. To keep one for
    an episode, apply it to the episode's first TensorDict. Reads ``state`` ``[*B, N, 13]`` and ``target``
    ``[*B, *reward.target_shape]`` (KeyError if missing, ValueError as of ``task_of``). Nothing is detached.
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
        state, target = tensordict.get("state", None), tensordict.get("target", None)
        if state is None:
            raise KeyError(f"FreezeGoal({self.reward}) needs an entry 'state'; an environment's reset() writes it")
        if target is None:
            shape = [*tensordict.shape, *(self.reward.target_shape or ())]
            raise KeyError(
                f"FreezeGoal({self.reward}) needs an entry 'target' {shape} in the episode's first TensorDict"
            )
        return tensordict.set("task", self.reward.task_of(cast(Tensor, state), cast(Tensor, target)))

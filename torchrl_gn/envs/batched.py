"""A fixed number of environments, for collectors."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import BatchSizeTransform, EnvBase, TransformedEnv


class _Starts:
    """Reset every sample of a batch to its own start state."""

    def __init__(self, env: EnvBase, batch_size: torch.Size) -> None:
        self.env, self.batch_size = env, batch_size

    def __call__(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if tensordict_reset.shape == self.batch_size:
            return tensordict_reset
        return self.env.reset(TensorDict(batch_size=self.batch_size))


def batched(env: EnvBase, *batch_size: int) -> TransformedEnv:
    """Fix the batch size of an environment that takes any batch; every sample gets its own start states.

    TorchRL's ``BatchSizeTransform`` alone repeats one start state over the batch at the first reset.

    Args:
        env: a :class:`~torchrl_gn.envs.SceneEnv` or :class:`~torchrl_gn.envs.ModelEnv`.
        *batch_size: number of environments.

    Returns:
        The environment with this batch size; append further transforms to it.

    Raises:
        ValueError: if a number is below 1.

    Example:
        >>> from torchrl_gn.envs import SceneEnv
        >>> from torchrl_gn.scenes import load_scene
        >>> batched(SceneEnv(load_scene("pendulum"), seed=0), 4).rollout(5)["state"].shape
        torch.Size([4, 5, 2, 13])
    """
    size = torch.Size(batch_size)
    if not size or min(size) < 1:
        raise ValueError(f"batch_size must be numbers of at least 1, got {list(size)}")
    return TransformedEnv(env, BatchSizeTransform(batch_size=size, reset_func=_Starts(env, size)))

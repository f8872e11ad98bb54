"""A fixed number of environments, as collectors want them."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import BatchSizeTransform, EnvBase, TransformedEnv


class _Starts:
    """Gives every sample of a batch a start of its own; the transform alone repeats one."""

    def __init__(self, env: EnvBase, batch_size: torch.Size) -> None:
        self.env, self.batch_size = env, batch_size

    def __call__(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if tensordict_reset.shape == self.batch_size:
            return tensordict_reset
        return self.env.reset(TensorDict(batch_size=self.batch_size))


def batched(env: EnvBase, *batch_size: int) -> TransformedEnv:
    """A fixed number of environments out of one that takes any batch, each with its own starts.

    TorchRL's ``BatchSizeTransform`` alone gives the whole batch one start, repeated, at its first reset.

    Args:
        env: a :class:`~torchrl_gn.envs.SceneEnv` or :class:`~torchrl_gn.envs.ModelEnv`.
        *batch_size: how many.

    Returns:
        The environment with this batch size, to which further transforms can be appended.

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

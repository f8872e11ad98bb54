"""Keep bodies upright."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.maths import quaternion
from torchrl_gn.rewards.bodies import Bodies
from torchrl_gn.rewards.reward import Reward
from torchrl_gn.scenes.scene import Scene


class Balance(Reward):
    """Negative angle between bodies and their balanced orientation, radians: ``-sum_i angle(q_i', target_i)``.

    Paper, SM "Planning configuration", Pendulum Balance. The gradient is finite everywhere and zero at both ends.

    Args:
        target: ``[4]`` or ``[len(bodies), 4]``, w-first, world frame, any non-zero norm; default: the identity, upright
            for the suite's poles, acrobot and walker (upside down: ``[0, 0, 1, 0]``).
    """

    target: Tensor

    def __init__(self, scene: Scene, bodies: Sequence[str], *, target: np.ndarray | Tensor | None = None):
        super().__init__()
        self.bodies = Bodies(scene, bodies)
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        wanted = identity if target is None else torch.as_tensor(target, dtype=torch.float64)
        if wanted.shape not in {(4,), (len(bodies), 4)}:
            raise ValueError(f"target must be [4] or [{len(bodies)}, 4], got {list(wanted.shape)}")
        norm = wanted.norm(dim=-1, keepdim=True)
        if not bool((norm > 0).all() and wanted.isfinite().all()):
            raise ValueError(f"target must hold finite quaternions of non-zero norm, got {wanted.tolist()}")
        # `forward` casts the float64 buffer to the states' dtype.
        self.register_buffer("target", (wanted / norm).expand(len(bodies), 4).clone())

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        angle = quaternion.angle(self.bodies.orientation(next_state), self.target.to(next_state.dtype))
        return -angle.sum(-1, keepdim=True)

    def extra_repr(self) -> str:
        return f"scene={self.bodies.scene_name!r}, bodies={self.bodies.names}"

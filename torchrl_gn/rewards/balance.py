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
    r"""Negative angle between bodies and their balanced orientation.

    .. math:: r = -\sum_i \angle(q_i', \hat q_i)

    with :math:`q_i'` the orientation of body :math:`i` after the step and :math:`\hat q_i` the balanced one: 0 when
    every body is balanced, :math:`-\pi` for each body upside down (paper, SM "Planning configuration", Pendulum
    Balance). The gradient is finite everywhere and exactly zero at both ends.

    Args:
        scene: scene whose states are judged.
        bodies: names of the bodies, summed over.
        target: ``[4]`` or ``[len(bodies), 4]`` balanced orientation, w-first, world frame, of any non-zero norm.
            Default: the identity, upright for the suite's poles, acrobot and walker. Upside down for these is
            ``[0, 0, 1, 0]``, half a rotation about y.

    Raises:
        ValueError: the scene has no such body, ``bodies`` is no list of different names, or ``target`` has a wrong
            shape or a quaternion that is not finite or of norm zero.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> import torch
        >>> reward = Balance(load_scene("pendulum"), ["pole"])
        >>> state = torch.zeros(2, 13, dtype=torch.float64)
        >>> state[:, 3] = 1  # no rotation: the pole stands
        >>> reward(state, torch.zeros(1), state).item() == 0
        True
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
        """Reward ``[*B, 1]``, radians; see :class:`Reward`. Only ``next_state`` is read."""
        angle = quaternion.angle(self.bodies.orientation(next_state), self.target.to(next_state.dtype))
        return -angle.sum(-1, keepdim=True)

    def extra_repr(self) -> str:
        return f"scene={self.bodies.scene_name!r}, bodies={self.bodies.names}"

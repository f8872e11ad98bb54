"""Controls that act late, and the past ones that states hold until then."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes.scene import Scene


class DelayStep(NamedTuple):
    """Controls in a control step, not clipped."""

    first: Tensor  # [*B, A] that act at its start
    later: Tensor  # [*B, A] that act at its end
    change: Tensor  # [*B, N, K] of the past controls in the state


class DelayedControls(Float64Buffers):
    """Which controls of a scene act in a control step: those of earlier ones, from states, and of this one.

    An actuator that acts ``lag`` physics steps late goes on for ``switch`` of them with the control of ``ceil(lag /
    substeps)`` control steps ago, then with the next.
    """

    node: Tensor
    channel: Tensor
    place: Tensor
    source: Tensor
    first: Tensor
    later: Tensor
    share: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        held, count, steps = scene.delays, scene.num_actions, scene.substeps
        oldest = -(-held.lag // steps)
        self.switch = np.where(oldest > 0, held.lag - (oldest - 1) * steps, steps)  # [A]
        past = list(zip(held.actuator.tolist(), held.age.tolist(), strict=True))
        # Controls by actuator and age: the present ones, and the past ones behind them.
        where = {key: index for index, key in enumerate([*((each, 0) for each in range(count)), *past])}
        on_time = count - len(oldest)  # numbers of mocap poses
        acting = list(enumerate([*oldest.tolist(), *[0] * on_time]))
        self.constants(
            {
                "node": held.node,
                "channel": BODY_STATE.size + scene.activations.size + held.slot,
                "place": held.places(scene.num_nodes),
                "source": np.array([where[actuator, age - 1] for actuator, age in past]),
                "first": np.array([where[each] for each in acting]),
                "later": np.array([where[actuator, max(age - 1, 0)] for actuator, age in acting]),
                "share": np.append(self.switch / steps, np.ones(on_time)),
            }
        )

    def forward(self, state: Tensor, action: Tensor) -> DelayStep:
        """What states ``[*B, N, C]`` and actions ``[*B, A]`` let act."""
        past = state[..., self.node, self.channel]
        given = torch.cat((action, past.to(action.dtype)), dim=-1)
        change = pad(given[..., self.source].to(past.dtype) - past, (0, 1))[..., self.place]
        return DelayStep(given[..., self.first], given[..., self.later], change)

    def mean(self, first: Tensor, later: Tensor) -> Tensor:
        """Mean controls ``[*B, A]`` of the control step."""
        return later + (first - later) * self.share.to(first.dtype)

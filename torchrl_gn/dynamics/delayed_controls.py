"""Delayed controls: the state holds past controls until they act."""

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
    """Controls that act in a control step, not clipped."""

    first: Tensor  # [*B, A] controls at the start of the step
    later: Tensor  # [*B, A] controls at the end of the step
    change: Tensor  # [*B, N, K] change of the past controls in the state


class DelayedControls(Float64Buffers):
    """Selection of the controls that act in a control step: past ones, which the state holds, and present ones.

    An actuator that acts ``lag`` physics steps late first applies the control of ``ceil(lag / substeps)`` control steps
    ago, for ``switch`` physics steps, and then the next newer one.
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
        # Index of each control by actuator and age: the present ones, then the past ones.
        where = {key: index for index, key in enumerate([*((each, 0) for each in range(count)), *past])}
        on_time = count - len(oldest)  # actions that are mocap poses, without delay
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
        """Select the controls that act, from states ``[*B, N, C]`` and actions ``[*B, A]``."""
        past = state[..., self.node, self.channel]
        controls = torch.cat((action, past.to(action.dtype)), dim=-1)
        change = pad(controls[..., self.source].to(past.dtype) - past, (0, 1))[..., self.place]
        return DelayStep(controls[..., self.first], controls[..., self.later], change)

    def mean(self, first: Tensor, later: Tensor) -> Tensor:
        """Return the mean controls ``[*B, A]`` over the control step."""
        return later + (first - later) * self.share.to(first.dtype)

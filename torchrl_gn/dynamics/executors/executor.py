"""What runs a step program."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.networks.graph import Graph


class Executor(Protocol):
    """Runs one program; made from it, ``EXECUTORS[name](program)``."""

    program: StepProgram  # the step
    fixed_batch: bool  # whether another batch size costs a compilation

    def update(self, program: StepProgram) -> None:
        """Take another program of the same scene."""
        ...

    def step(self, state: Tensor, action: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        """Next state ``[*B, N, 13]`` and hidden state of a state and an action ``[*B, A]``."""
        ...

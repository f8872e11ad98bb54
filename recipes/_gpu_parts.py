"""The parts of a step on a GPU: kernels before and after the network, and the network."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_gn.dynamics.executors.cuda import CudaExecutor
from torchrl_gn.dynamics.executors.cuda.executor import predict
from torchrl_gn.dynamics.executors.cuda.state_kernels import NetworkInputs, StepResult
from torchrl_gn.dynamics.program import StepProgram


class StepParts:
    """The parts of a step on a GPU and their gradients, for one batch."""

    def __init__(self, executor: CudaExecutor, program: StepProgram, state: Tensor, action: Tensor) -> None:
        self.kernels, self.shapes, self.program = executor._kernels, executor._inputs, program
        self.state, self.action, self.numbers = state, action, executor.parameters.numbers(program)
        self.nodes, self.edges = (each.requires_grad_() for each in self.inputs())
        self.output = self.network(self.nodes, self.edges).detach().requires_grad_()

    def inputs(self, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        state = self.state if state is None else state
        return NetworkInputs.apply(self.kernels, self.shapes, self.program.dtype, state, self.action, self.numbers)

    def result(self) -> Tensor:
        return StepResult.apply(self.kernels, self.state, self.action, self.numbers, self.output)

    def network(self, nodes: Tensor, edges: Tensor) -> Tensor:
        return predict(self.program.core, self.program.edge_index, nodes, edges)

    def inputs_gradient(self) -> None:
        state = self.state.detach().requires_grad_()
        found = self.inputs(state)
        torch.autograd.grad(found, state, [torch.ones_like(each) for each in found])

    def result_gradient(self) -> None:
        found = self.result()
        torch.autograd.grad(found, self.output, torch.ones_like(found))

    @torch.no_grad()
    def forward(self, network: Callable[[Tensor, Tensor], Tensor]) -> None:
        network(self.nodes, self.edges)

    def network_gradient(self, network: Callable[[Tensor, Tensor], Tensor]) -> None:
        found = network(self.nodes, self.edges)
        torch.autograd.grad(found, (self.nodes, self.edges), torch.ones_like(found))

"""Steps of specialised predictors as torch operators, which ``torch.compile`` and ``torch.export`` take as they are."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchrl_gn.dynamics.predictor import Predictor
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.networks.graph import Graph

if TYPE_CHECKING:
    from torchrl_gn.dynamics.specialized import SpecializedPredictor


class OperatorExecutor:
    """Runs a predictor's steps and rollouts as operators, so that a compiler does not look inside.

    That is, into the check whether the weights changed, and C++.
    """

    def __init__(self, predictor: SpecializedPredictor) -> None:
        self.predictor = predictor

    @property
    def program(self) -> StepProgram:
        """The step as the compiler can see it."""
        with torch.no_grad():
            return Predictor.program(self.predictor)

    def step(self, state: Tensor, action: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        return torch.ops.torchrl_gn.rollout(state, action, self.predictor.number, False), None

    def rollout(self, state: Tensor, actions: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        return torch.ops.torchrl_gn.rollout(state, actions, self.predictor.number, True), None


_PREDICTORS: weakref.WeakValueDictionary[int, SpecializedPredictor] = weakref.WeakValueDictionary()


def register(predictor: SpecializedPredictor) -> int:
    """Number by which operators find a predictor."""
    number = id(predictor)
    _PREDICTORS[number] = predictor
    return number


def _predictor(number: int) -> SpecializedPredictor:
    if (predictor := _PREDICTORS.get(number)) is None:
        raise RuntimeError("A compiled function calls a specialised model that is gone: keep it while you call.")
    return predictor


@torch.library.custom_op("torchrl_gn::rollout", mutates_args=())
def rollout(state: Tensor, actions: Tensor, predictor: int, many: bool) -> Tensor:
    """The next state; with ``many`` actions ``[*B, T, A]``, states ``[*B, T + 1, N, C]``."""
    executor = _predictor(predictor).executor()
    out, _ = executor.rollout(state, actions) if many else executor.step(state, actions)
    return out.clone() if out is state else out


@rollout.register_fake
def _(state: Tensor, actions: Tensor, predictor: int, many: bool) -> Tensor:
    if not many:
        return torch.empty_like(state, memory_format=torch.contiguous_format)
    return state.new_empty((*state.shape[:-2], actions.shape[-2] + 1, *state.shape[-2:]))


@torch.library.custom_op("torchrl_gn::rollout_adjoint", mutates_args=())
def rollout_adjoint(
    gradient: Tensor, state: Tensor, actions: Tensor, predictor: int, many: bool
) -> tuple[Tensor, Tensor]:
    """Gradients in state and actions."""
    leaves = [each.detach().requires_grad_() for each in (state, actions)]
    executor = _predictor(predictor).executor()
    with torch.enable_grad():
        out, _ = executor.rollout(leaves[0], leaves[1]) if many else executor.step(leaves[0], leaves[1])
    found = torch.autograd.grad(out, leaves, gradient, allow_unused=True)
    of_state, of_actions = (
        torch.zeros_like(leaf) if each is None else each for leaf, each in zip(leaves, found, strict=True)
    )
    return of_state, of_actions


@rollout_adjoint.register_fake
def _(gradient: Tensor, state: Tensor, actions: Tensor, predictor: int, many: bool) -> tuple[Tensor, Tensor]:
    return torch.empty_like(state), torch.empty_like(actions)


def _keep(ctx, inputs: tuple, output: Tensor) -> None:
    state, actions, ctx.predictor, ctx.many = inputs
    ctx.save_for_backward(state, actions)


def _pull(ctx, gradient: Tensor):
    return *torch.ops.torchrl_gn.rollout_adjoint(gradient, *ctx.saved_tensors, ctx.predictor, ctx.many), None, None


rollout.register_autograd(_pull, setup_context=_keep)

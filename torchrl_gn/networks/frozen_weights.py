"""Context managers that swap a module's weights, or exclude them from gradients."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn


@contextmanager
def with_weights(module: nn.Module, weights: TensorDictBase) -> Iterator[None]:
    """Swap a module's weights and buffers for others."""
    # The context manager of a TensorDict does not restore the module's weights after an error.
    swapped = weights.to_module(module, preserve_module_state=False)
    swapped.__enter__()
    try:
        yield
    finally:
        swapped.__exit__(None, None, None)


@contextmanager
def frozen(module: nn.Module) -> Iterator[None]:
    """Exclude a module's weights from gradients: none are computed or accumulated for them."""
    if torch.compiler.is_compiling():  # compiled code cannot change requires_grad
        with with_weights(module, cast(TensorDictBase, TensorDict.from_module(module)).detach()):
            yield
        return
    trained = [weight for weight in module.parameters() if weight.requires_grad]
    try:
        for weight in trained:
            weight.requires_grad_(False)
        yield
    finally:
        for weight in trained:
            weight.requires_grad_(True)

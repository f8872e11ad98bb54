"""A module's weights, exchanged or cut from gradients for a while."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn


@contextmanager
def with_weights(module: nn.Module, weights: TensorDictBase) -> Iterator[None]:
    """Exchange a module's weights and buffers for others."""
    # A TensorDict's own exit leaves the weights in the module if there was an error.
    swapped = weights.to_module(module, preserve_module_state=False)
    swapped.__enter__()
    try:
        yield
    finally:
        swapped.__exit__(None, None, None)


@contextmanager
def frozen(module: nn.Module) -> Iterator[None]:
    """Cut a module's weights from gradients: none are computed for them, and they get none."""
    if torch.compiler.is_compiling():  # where what requires gradients cannot be changed
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

"""Checks that a network has exactly the layers of a fold: linear layers with one activation between them.

Cores are folded at every training step, so the checks are fast: they build the name of a change only if they find one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import nn
from torch.nn.modules import module as modules
from torch_geometric.nn.aggr import SumAggregation
from torchrl.modules import MLP

from torchrl_gn.networks.gn_block import GNBlock
from torchrl_gn.networks.linear import ACTIVATIONS

_METHODS = {"forward", "edge_updater", "edge_update", "propagate", "message", "aggregate", "update"}  # of GNBlock
_CALLED = ("propagate", "message", "aggregate", "message_and_aggregate", "edge_update")  # these have hooks in PyG
_BLOCK_HOOKS = tuple(f"_{name}_forward{when}_hooks" for name in _CALLED for when in ("_pre", ""))


def change_of_core(core: nn.Module, kind: type[nn.Module]) -> str | None:
    """Describe how a core differs from its class ``kind``, apart from submodules; None if it does not."""
    if modules._has_any_global_hook():
        return "there are hooks on all modules"
    if type(core).forward is not kind.forward or "forward" in core.__dict__:
        return "it has its own forward()"
    return "it has a hook" if hooked(core) else None


def change_of_block(block: nn.Module, parts: Sequence[str], activation: str) -> str | None:
    """Describe how a GN block differs from sum message passing with MLPs ``parts``; None if it does not."""
    if type(block) is not GNBlock:
        return f" is {_class_name(block)}"
    attributes, inside = block.__dict__, block._modules
    if hooked(block) or any([attributes[hooks] for hooks in _BLOCK_HOOKS]):
        return " has a hook"
    if not _METHODS.isdisjoint(attributes):
        return " has its own method"
    if attributes["flow"] != "source_to_target" or attributes["_explain"] or attributes["_decomposed_layers"] > 1:
        return " passes messages in another way"
    sums = inside["aggr_module"]
    if type(sums) is not SumAggregation or hooked(sums) or "forward" in sums.__dict__:
        return ".aggr_module is changed"
    for part in parts:
        if (change := change_of_mlp(inside.get(part), activation)) is not None:
            return f".{part}{change}"
    return None


def is_plain(layer: nn.Module) -> bool:
    """Return True for a linear layer whose output is its own weight and bias: no adapter, hook or parametrisation."""
    return type(layer) is nn.Linear and not hooked(layer) and type(layer._parameters.get("weight")) is nn.Parameter


def change_of_mlp(mlp: nn.Module | None, activation: str) -> str | None:
    """Describe how an MLP differs from linear layers with biases and the activation; None if it does not."""
    kind, usual = type(mlp), ACTIVATIONS[activation]
    if mlp is None or (kind is not MLP and kind is not nn.Sequential):
        return f" is {_class_name(mlp)}"
    if hooked(mlp):
        return " has a hook"
    layers: list[Any] = list(mlp._modules.values())
    if len(layers) < 3 or len(layers) % 2 == 0:
        return f" has {len(layers)} layers"
    expected = [nn.Linear, usual] * (len(layers) // 2) + [nn.Linear]
    if list(map(type, layers)) != expected:
        index = next(index for index, layer in enumerate(layers) if type(layer) is not expected[index])
        return f"[{index}] is {_class_name(layers[index])}"
    if True in (hooks := [hooked(layer) for layer in layers]):
        return f"[{hooks.index(True)}] has a hook"
    for layer in layers[::2]:
        weights = layer._parameters
        if type(weights.get("weight")) is nn.Parameter and type(weights.get("bias")) is nn.Parameter:
            continue
        # A loss or torch.func may have swapped the parameters for plain tensors.
        if layer.bias is None:
            return f"[{layers.index(layer)}] has no bias"
        if hasattr(type(layer.weight), "__tensor_flatten__"):
            return f"[{layers.index(layer)}] has {_class_name(layer.weight)} as weight"
    if activation == "gelu" and any(layer.approximate != "none" for layer in layers[1::2]):
        return " has another GELU"
    return None


def hooked(module: nn.Module) -> bool:
    """Return True if a module has hooks, or replaces the ``forward`` of its class."""
    attributes = module.__dict__
    if (
        attributes["_forward_hooks"]
        or attributes["_forward_pre_hooks"]
        or attributes["_backward_hooks"]
        or attributes["_backward_pre_hooks"]
    ):
        return True
    return "forward" in attributes


def _class_name(thing: object) -> str:
    """Name the class of a thing: ``a Dropout``, ``an Adapter``; ``None`` for None."""
    name = type(thing).__name__
    return "None" if thing is None else f"a{'n' if name[0] in 'AEIOU' else ''} {name}"

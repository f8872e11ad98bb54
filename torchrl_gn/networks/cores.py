"""The cores by name, for the ``core=`` of forward models and for their checkpoints."""

from __future__ import annotations

import inspect
from collections.abc import Collection

from torchrl_gn.networks.core import Core
from torchrl_gn.networks.gn_core import GNCore
from torchrl_gn.networks.mlp_core import MLPCore
from torchrl_gn.networks.recurrent_core import RecurrentCore

CORES: dict[str, type[Core]] = {"gn": GNCore, "mlp": MLPCore, "recurrent": RecurrentCore}
"""Add a core of your own here, before a model or a checkpoint names it."""


def core_class(name: str) -> type[Core]:
    """Return the core of a name; ValueError if it is not in :data:`CORES`."""
    if name not in CORES:
        raise ValueError(f"core={name!r} is not known; use one of {list(CORES)}, or add yours to CORES.")
    return CORES[name]


def require_options(core: type[Core], options: Collection[str]) -> None:
    """Raise TypeError, naming the options of a core's class, if it does not take one of ``options``."""
    _, _, _, *parameters = inspect.signature(core).parameters.values()  # dynamic, static, out_nodes
    if any(each.kind is each.VAR_KEYWORD for each in parameters):
        return  # for a core within
    taken = [each.name for each in parameters if each.name != "counts"]
    if unknown := sorted(set(options) - set(taken)):
        raise TypeError(
            f"Neither ForwardModel nor its core {core.__name__} has options {unknown}; the core has {taken}."
        )

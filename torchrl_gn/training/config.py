"""A configuration as plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


def plain_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration, as Hydra gives it or otherwise, in dictionaries, lists and plain values, references resolved."""
    return {str(name): _plain(value) for name, value in config.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return plain_config(value)
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(each) for each in value]
    return value

"""Options of a recipe as plain values."""

from __future__ import annotations

from typing import Any

from torchrl_gn.training import plain_config


def as_list(value: Any) -> list[Any]:
    """Return an option as a list: a single value (``only=default``) as a list of one, null as an empty one."""
    if value is None:
        return []
    plain = plain_config({"value": value})["value"]
    return plain if isinstance(plain, list) else [plain]

"""Options of a recipe as plain values."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from torchrl_gn.training import plain_config


def as_list(value: Any) -> list[Any]:
    """Return an option as a list: a single value (``only=default``) as a list of one, null as an empty one."""
    if value is None:
        return []
    plain = plain_config({"value": value})["value"]
    return plain if isinstance(plain, list) else [plain]


def scene_options(cfg: DictConfig) -> dict[str, Any]:
    """Options of ``load_scene`` that a recipe has."""
    plain = plain_config(cfg)
    return {key: plain[key] for key in ("timestep", "action_bounds", "wide_starts")}

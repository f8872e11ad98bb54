"""Small MJCF models that the tests share, one per file; the first line of each gives its purpose."""

from __future__ import annotations

from pathlib import Path

from torchrl_gn.scenes import Scene, load_scene


def mjcf(name: str, /, *edits: tuple[str, str]) -> str:
    """Text of a model after edits ``(old, new)``; raises ValueError for an edit that finds nothing."""
    text = _file(name).read_text()
    for old, new in edits:
        if old not in text:
            raise ValueError(f"{name}.xml does not contain {old!r}")
        text = text.replace(old, new)
    return text


def load(name: str, /, *edits: tuple[str, str], **options) -> Scene:
    """Scene of an edited model, or of a system by its name; the options are those of ``load_scene``."""
    return load_scene(mjcf(name, *edits) if _file(name).exists() else name, **options)


def _file(name: str) -> Path:
    return Path(__file__).with_name(f"{name}.xml")

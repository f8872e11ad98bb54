"""Errors and warnings of scenes."""

from __future__ import annotations


class SceneError(ValueError):
    """A model cannot be read as a scene."""


class UnsupportedSceneError(SceneError):
    """The graph cannot represent an element of a valid MuJoCo model."""


class SceneChangedWarning(UserWarning):
    """A scene rebuilt from its description has other physics than the original."""

"""Errors of the scenes part."""

from __future__ import annotations


class SceneError(ValueError):
    """A model cannot be read as a scene; the message names the element and what to do."""


class UnsupportedSceneError(SceneError):
    """The model is valid MuJoCo but holds something that the graph cannot represent."""


class SceneChangedWarning(UserWarning):
    """A scene rebuilt from its description has other physics than when it was described."""

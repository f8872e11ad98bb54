"""Libraries whose scenes have other static features of nodes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from torchrl_gn.scenes import static_features


def change_columns(monkeypatch: pytest.MonkeyPatch, *, gain: bool) -> None:
    """Let the features of a node come the other way round; with ``gain``, behind another one, 1, 2, ..."""
    columns: Callable = static_features._node_columns

    def changed(model, graph) -> list:
        more = [("charm", np.arange(len(graph.body)) + 1.0)] if gain else []
        return [*more, *reversed(columns(model, graph))]

    monkeypatch.setattr(static_features, "_node_columns", changed)

"""Sizes of networks that take milliseconds."""

from __future__ import annotations

SMALL = {"latent": 6, "edge_hidden": (8,), "node_hidden": (8,), "global_hidden": (8,)}
"""Sizes of a ``ForwardModel`` with a graph-network core."""

"""Errors of simulation and data sets."""

from __future__ import annotations


class UnstableSimulationError(RuntimeError):
    """Too many simulations of a scene become unstable."""


class DatasetError(RuntimeError):
    """A data set on disk is damaged, incomplete, of a newer format or of another scene."""

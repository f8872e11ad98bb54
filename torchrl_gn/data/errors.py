"""Errors of simulation and data sets."""

from __future__ import annotations


class UnstableSimulationError(RuntimeError):
    """Too many simulations of a scene left the range that MuJoCo can integrate."""


class DatasetError(RuntimeError):
    """A data set on disk is damaged, incomplete, newer than this library or of another scene."""

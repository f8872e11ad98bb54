"""Random variants of the paper's systems (paper, SM "Description of the simulated environments")."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import mujoco
import numpy as np

from torchrl_gn.scenes.build import build_scene, shrink_textures
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.systems import SYSTEMS, ParameterRange, System, find_system


def parameter_ranges(system: str) -> dict[str, ParameterRange]:
    """Return the parameters of a system's random variants and their ranges (the SM's table); ValueError without any."""
    return dict(_system_with_variants(system).ranges)


def has_variants(scene: Scene) -> bool:
    """Return True if a scene is a standard system that has variants."""
    system = find_system(scene.origin.get("system", ""))
    return system is not None and system.vary is not None and "parameters" not in scene.origin


def sample_parameters(system: str, count: int, rng: int | np.random.Generator) -> np.ndarray:
    """Draw independent uniform parameters ``[count, P]``, float64, columns in the order of :func:`parameter_ranges`.

    Args:
        system: name of the system.
        count: number of rows. The first rows of a seed are the same for every count.
        rng: generator or seed.

    Raises:
        ValueError: if ``count`` is negative.
    """
    ranges = parameter_ranges(system).values()
    if count < 0:
        raise ValueError(f"count must not be negative, got {count}")
    low, high = np.array([(one.low, one.high) for one in ranges]).T
    return np.random.default_rng(rng).uniform(low, high, (count, len(ranges)))


def sample_variants(
    system: str, count: int, rng: int | np.random.Generator, *, timestep: float | None = None
) -> list[Scene]:
    """Build random variants of a system with :func:`sample_parameters` and :func:`make_variants`."""
    return make_variants(system, sample_parameters(system, count, rng), timestep=timestep)


def make_variants(
    system: str, parameters: np.ndarray, *, timestep: float | None = None, name: str | None = None
) -> list[Scene]:
    """Build variants from parameters ``[count, P]``, also beyond their ranges; ValueError if they do not fit."""
    ranges = parameter_ranges(system)
    parameters = np.asarray(parameters, dtype=np.float64)
    if parameters.ndim != 2 or parameters.shape[1] != len(ranges):
        raise ValueError(f"parameters of {system!r} must be [count, {len(ranges)}], got {list(parameters.shape)}")
    rows = (dict(zip(ranges, row, strict=True)) for row in parameters.tolist())
    return list(_build(_system_with_variants(system), rows, timestep=timestep, name=name))


def make_variant(
    system: object, parameters: Mapping[str, float], *, timestep: float | None = None, name: str | None = None
) -> Scene:
    """Build one variant; parameters not given keep the standard system's values. ValueError if one is unknown."""
    system_info = _system_with_variants(system)
    standard = {key: one.standard for key, one in system_info.ranges.items()}
    if unknown := [key for key in parameters if key not in standard]:
        raise ValueError(f"{system_info.name!r} has no parameters {unknown}; use some of {list(standard)}.")
    values = {**standard, **{key: float(value) for key, value in parameters.items()}}
    return next(_build(system_info, iter([values]), timestep=timestep, name=name))


def _build(
    system: System, rows: Iterator[Mapping[str, float]], *, timestep: float | None, name: str | None
) -> Iterator[Scene]:
    assert system.vary is not None
    standard = system.build()
    standard.compiler.usethread = False  # threads take longer to start than the model to compile
    shrink_textures(standard, 16)  # thousands of variants each keep their own textures
    for values in rows:
        for key, value in values.items():
            if not math.isfinite(value) or (value <= 0 and not system.ranges[key].is_angle):
                expected = "a finite angle" if system.ranges[key].is_angle else "a finite factor above 0"
                raise ValueError(f"{key} of {system.name!r} must be {expected}, got {value}.")
        spec: mujoco.MjSpec = standard.copy()
        system.vary(spec, values)
        yield build_system(system, spec, name, timestep, parameters=dict(values))


def build_system(system: System, spec: mujoco.MjSpec, name: str | None, timestep: float | None, **origin) -> Scene:
    """Build a scene from a system's model; name and control step default to the system's."""
    name, timestep = name or system.name, system.timestep if timestep is None else timestep
    origin = {"system": system.name, **origin}
    return build_scene(spec, name=name, timestep=timestep, settle_steps=system.settle_steps, origin=origin)


def _system_with_variants(source: object) -> System:
    system = find_system(source) if isinstance(source, str) else None
    if system is None or system.vary is None:
        varying = [known for known in SYSTEMS if (found := find_system(known)) and found.vary]
        names = ["swimmerN" if known == "swimmer6" else known for known in varying]
        what = repr(source) if isinstance(source, str) and "<" not in source else "An MJCF model"
        raise ValueError(f"{what} has no parameters to vary; these systems have: {', '.join(names)}.")
    return system

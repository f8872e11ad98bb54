"""Cheetah: the planar half-cheetah of the suite. 10 ms, one suite physics step.

The suite lets it fall for 200 physics steps after a reset, before an episode starts.
"""

from __future__ import annotations

import mujoco

from torchrl_gn.scenes.systems.system import System, suite_model


def _build() -> mujoco.MjSpec:
    """The suite's model with its total mass written as a density.

    ``settotalmass`` would rescale every variant of the model to the same mass, and is
    deprecated: the density that it amounts to takes its place.
    """
    spec = suite_model("cheetah")
    total = spec.compiler.settotalmass
    spec.compiler.settotalmass = -1.0
    scale = total / spec.compile().body_mass.sum()
    for geom in spec.geoms:
        geom.density *= scale
    return spec


SYSTEM = System("cheetah", _build, timestep=0.01, settle_steps=200)

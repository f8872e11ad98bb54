"""Start states of simulations: the suite's reset distributions for its systems, start poses for other models."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_gn.checks import check_count
from torchrl_gn.data.simulate import Simulator, UnstableSimulationError, steadier_physics
from torchrl_gn.data.start_poses import StartPoses
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.suite_tasks import SuiteStarts

_ATTEMPTS = 10


def sample_start_states(scene: Scene, n: int, rng: int | np.random.Generator) -> np.ndarray:
    """Draw full MuJoCo states ``[n, S]``, float64 (``mjSTATE_FULLPHYSICS``).

    Models from MJCF use :class:`~torchrl_gn.data.StartPoses`. Tasks of the suite (``"suite:cheetah/run"``) use
    dm_control's own resets, one after another. The paper's systems follow the suite's reset distributions:

    - Cartpole: slider uniform in [-0.1, 0.1] m, hinges in [-0.034, 0.034] rad, velocities with standard deviation 0.01.
    - Cheetah: limited joints uniform within their limits.
    - Others: limited joints uniform within their limits, unlimited hinges in [-pi, pi]; the rest as in ``qpos0``, at
      rest.
    - JACO, not in the suite: like others, but redrawn while bodies overlap (4 %), as they would spin at over 100 rad/s.

    Then ``scene.settle_steps`` physics steps without control are simulated, and the old time is restored. Unstable
    states are redrawn.

    Args:
        rng: generator or seed.

    Raises:
        UnstableSimulationError: states are unstable ten times in a row.
    """
    check_count("n", n, 0)
    return draw_start_states(Simulator(scene), np.zeros(n, dtype=np.int64), rng)[0]


def draw_start_states(
    simulator: Simulator, variant: np.ndarray, rng: int | np.random.Generator
) -> tuple[np.ndarray, int]:
    """Draw start states ``[n, S]`` of scenes ``variant`` ``[n]``, and count the unstable ones that were redrawn."""
    rng, n, scene = np.random.default_rng(rng), len(variant), simulator.scene
    states = _draw_apart(simulator, variant, rng)
    if n == 0 or scene.settle_steps == 0:
        return states, 0
    pending, rejected = np.arange(n), 0
    for _ in range(_ATTEMPTS):
        states[pending], stable = simulator.settle(states[pending], scene.settle_steps, variant[pending])
        pending = pending[~stable]
        if not len(pending):
            return states, rejected
        rejected += len(pending)
        states[pending] = _draw_apart(simulator, variant[pending], rng)
    raise UnstableSimulationError(
        f"{len(pending)} of {n} start states of {scene.name!r} became unstable within {scene.settle_steps} physics "
        f"steps, {_ATTEMPTS} times in a row. Use {steadier_physics(scene.model)}, or softer contacts."
    )


def _draw_apart(simulator: Simulator, variant: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    states, scenes = _draw_each(simulator, variant, rng), simulator.scenes
    if simulator.scene.origin.get("system") != "jaco":
        return states
    pending, data = np.arange(len(variant)), mujoco.MjData(simulator.scene.model)
    while len(pending):
        pending = pending[[_overlaps(scenes[variant[row]].model, data, states[row]) for row in pending]]
        states[pending] = _draw_each(simulator, variant[pending], rng)
    return states


def _draw_each(simulator: Simulator, variant: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if "system" not in simulator.scene.origin:
        states = np.empty((len(variant), simulator.scene.physics_size))
        for which in np.unique(variant):
            rows = variant == which
            if which not in simulator.start_poses:
                simulator.start_poses[which] = _source(simulator.scenes[which])
            states[rows] = simulator.start_poses[which].draw(int(rows.sum()), rng)
        return states
    if len(simulator.scenes) == 1:
        return _draw(simulator.scene, len(variant), rng)
    rows = [_draw(simulator.scenes[which], 1, rng) for which in variant]
    return np.concatenate(rows) if rows else np.empty((0, simulator.scene.physics_size))


def _overlaps(model: mujoco.MjModel, data: mujoco.MjData, state: np.ndarray) -> bool:
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_fwdPosition(model, data)
    return bool((data.contact.dist < 0).any())


def _source(scene: Scene) -> StartPoses | SuiteStarts:
    suite = scene.origin.get("suite")
    return StartPoses(scene) if suite is None else SuiteStarts(*suite.split("/"))


def _draw(scene: Scene, n: int, rng: np.random.Generator) -> np.ndarray:
    model, states = scene.model, np.tile(scene.rest_physics, (n, 1))
    qpos = states[:, 1 : 1 + model.nq]  # after the time; both are views
    qvel = states[:, 1 + model.nq : 1 + model.nq + model.nv]
    if scene.origin.get("system") == "cartpole":
        qpos[:, 0] = rng.uniform(-0.1, 0.1, n)
        qpos[:, 1:] = rng.uniform(-0.034, 0.034, (n, model.nq - 1))
        qvel[:] = 0.01 * rng.standard_normal((n, model.nv))
    else:
        _randomize_joints(model, qpos, rng, unlimited=scene.origin.get("system") != "cheetah")
    return states


def _randomize_joints(model: mujoco.MjModel, qpos: np.ndarray, rng: np.random.Generator, *, unlimited: bool) -> None:
    """Randomise hinges and slides in place, like the suite's ``randomize_limited_and_rotational_joints``."""
    kind, n = mujoco.mjtJoint, len(qpos)
    for joint in range(model.njnt):
        first = model.jnt_qposadr[joint]
        if model.jnt_limited[joint]:
            qpos[:, first] = rng.uniform(model.jnt_range[joint, 0], model.jnt_range[joint, 1], n)
        elif unlimited and model.jnt_type[joint] == kind.mjJNT_HINGE:
            qpos[:, first] = rng.uniform(-np.pi, np.pi, n)

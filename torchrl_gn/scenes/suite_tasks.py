"""Tasks of the DeepMind Control Suite: dm_control's environments, and the models that they simulate."""

from __future__ import annotations

import importlib
import logging
import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from torchrl_gn.scenes.systems.system import INSTALL_SUITE

_NAME = re.compile(r"suite:(\w+)/(\w+)")
# Tasks whose models are drawn at random, or come with meshes or terrains that a scene does not hold.
_NO_SCENES = re.compile(r"(dog|lqr|manipulator|stacker)/\w+|quadruped/(escape|fetch)")
_TARGET = re.compile(r"reacher/\w+|finger/turn_\w+|fish/swim|swimmer/\w+")  # tasks whose episodes have a target
# Arrays of a model that tasks change at the start of an episode without an effect on bodies: targets and visuals.
_TARGETS = {"site_pos", "site_size", "geom_pos", "geom_size"}
_LOOKS = {"site_rgba", "geom_rgba", "light_pos", "geom_rbound", "geom_aabb", "bvh_aabb"}


def suite_name(source: Any) -> tuple[str, str] | None:
    """Return domain and task of ``"suite:cheetah/run"``; None for anything else."""
    match = _NAME.fullmatch(source) if isinstance(source, str) else None
    return None if match is None else (match[1], match[2])


@cache
def suite_modules() -> tuple[Any, Any, Any]:
    """Import dm_control's ``suite``, its ``swimmer`` and ``rl.control``, without a display.

    ImportError if dm_control is missing.
    """
    before = os.environ.get("MUJOCO_GL")
    os.environ.setdefault("MUJOCO_GL", "off")  # look for no display
    try:
        from dm_control import suite
        from dm_control.rl import control
        from dm_control.suite import swimmer
    except ImportError as error:
        raise ImportError(f"Tasks of the suite need dm_control: {INSTALL_SUITE}.") from error
    finally:
        if before is None:
            del os.environ["MUJOCO_GL"]
    return suite, swimmer, control


def load_suite_task(domain: str, task: str, seed: int) -> Any:
    """Load dm_control's environment of a suite task, without a display; swimmers may have any number of links.

    Raises ValueError for an unknown task, ImportError without dm_control.
    """
    suite, swimmer, _ = suite_modules()
    links = task.removeprefix("swimmer")
    if domain == "swimmer" and links.isdigit() and (domain, task) not in suite.ALL_TASKS:
        return swimmer.swimmer(int(links), random=seed)
    if (domain, task) not in suite.ALL_TASKS:
        known = sorted(name for owner, name in suite.ALL_TASKS if owner == domain) or sorted(suite.TASKS_BY_DOMAIN)
        raise ValueError(f"The suite has no task {domain} {task}; there are {', '.join(known)}.")
    with _without_advice():
        return suite.load(domain, task, {"random": seed})


@contextmanager
def _without_advice() -> Iterator[None]:
    """Keep dm_control from logging MuJoCo's deprecation warnings."""
    logger = logging.getLogger("absl")

    def keep(record: logging.LogRecord) -> bool:
        return "is deprecated" not in record.getMessage()

    logger.addFilter(keep)
    try:
        yield
    finally:
        logger.removeFilter(keep)


@contextmanager
def suite_model_file(domain: str, task: str) -> Iterator[tuple[Path, float]]:
    """Yield a task's MJCF file and its control step in seconds.

    The context writes the file and the assets that it reads to a temporary folder, and removes them at its end.

    Raises:
        ValueError: if the task is unknown, its model is not a file, or its episodes differ in their physics.
    """
    if _NO_SCENES.fullmatch(f"{domain}/{task}"):
        raise ValueError(
            f"There is no scene of the suite's {domain}/{task}: its model is drawn at random, or needs meshes or a"
            " terrain that a scene does not hold. suite_env(domain, task) plays it, for policies of observations."
        )
    env = load_suite_task(domain, task, 0)
    text, assets = _mjcf(env, domain, task)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"{domain}.xml")
        for name, content in {**assets, path.name: text}.items():
            file = Path(folder, name)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content.encode() if isinstance(content, str) else content)
        yield path, env.control_timestep()


def _mjcf(env: Any, domain: str, task: str) -> tuple[bytes | str, Mapping[str, bytes | str]]:
    """Return the text of a task's model, and the files that it reads."""
    module = importlib.import_module(f"dm_control.suite.{domain}")
    if domain == "quadruped":  # walk and run differ only in the size of the drawn floor
        text, assets = module.make_model(), module.common.ASSETS
    elif domain == "cartpole":
        text, assets = module.get_model_and_assets(num_poles=env.physics.model.nbody - 2)
    elif domain == "swimmer":
        text, assets = module.get_model_and_assets(env.physics.model.nbody - 1)
    else:
        text, assets = module.get_model_and_assets()
    return _with_damping(text, _damping_in_episodes(env, f"{domain}/{task}")), assets


def _damping_in_episodes(env: Any, name: str) -> dict[str, float]:
    """Return the joint dampings that a task changes from its file's; ValueError if it changes other physics."""
    model = env.physics.model.ptr
    arrays = {key for key in dir(model) if isinstance(getattr(model, key, None), np.ndarray)} - _TARGETS - _LOOKS
    at_first = {key: np.array(getattr(model, key)) for key in arrays}
    env.reset()
    before, changed = at_first["dof_damping"], _changed(model, at_first)
    later = {key: np.array(getattr(model, key)) for key in arrays}
    env.reset()
    if not changed <= {"dof_damping"} or _changed(model, later):
        raise ValueError(f"Episodes of the suite's {name} differ in their physics ({', '.join(sorted(changed))}).")
    joints = model.dof_jntid[np.flatnonzero(model.dof_damping != before)]
    return {model.joint(joint).name: float(model.joint(joint).damping[0]) for joint in joints}


def _changed(model: mujoco.MjModel, arrays: Mapping[str, np.ndarray]) -> set[str]:
    return {key for key, before in arrays.items() if not np.array_equal(getattr(model, key), before)}


def _with_damping(text: bytes | str, damping: Mapping[str, float]) -> bytes | str:
    if not damping:
        return text
    root = ElementTree.fromstring(text)
    for joint in root.iter("joint"):
        if joint.get("name") in damping:
            joint.set("damping", repr(damping[joint.attrib["name"]]))
    return ElementTree.tostring(root)


def full_physics(env: Any) -> np.ndarray:
    """Return the full MuJoCo state ``[S]`` (``mjSTATE_FULLPHYSICS``) of dm_control's environment."""
    model, data, kind = env.physics.model.ptr, env.physics.data.ptr, mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    return state


def hidden_by_task(domain: str, task: str) -> tuple[bool, bool]:
    """Return whether the task's observation hides the body's position, and whether it hides the body's yaw.

    A quantity is hidden if the observation stays the same when the quantity changes at the roots that move freely. Both
    are False without such roots. A policy for the task needs no hidden quantity, whatever the reward is.
    """
    env = load_suite_task(domain, task, 0)
    env.reset()
    model, data = env.physics.model.ptr, env.physics.data.ptr
    roots = [joint for joint in range(model.njnt) if model.body_parentid[model.jnt_bodyid[joint]] == 0]
    before = env.task.get_observation(env.physics)
    start, places, turns = np.concatenate((data.qpos, data.qvel)), [], []
    for joint in roots:
        at, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        kind, level = model.jnt_type[joint], abs(model.jnt_axis[joint][2]) < 1e-9
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            places += [at, at + 1]
            turns.append((at + 3, model.nq + dof))
        elif kind == mujoco.mjtJoint.mjJNT_SLIDE and level and not model.jnt_limited[joint]:
            places.append(at)

    def stays(moved: np.ndarray) -> bool:
        with env.physics.reset_context():
            data.qpos[:], data.qvel[:] = np.split(moved, [model.nq])
        after = env.task.get_observation(env.physics)
        return all(np.allclose(before[name], after[name], atol=1e-6) for name in before)

    shifted, turned = start.copy(), start.copy()
    shifted[places] += 0.3
    half = np.array([np.cos(0.4), 0.0, 0.0, np.sin(0.4)])
    for orientation, velocity in turns:
        mujoco.mju_mulQuat(turned[orientation : orientation + 4], half, start[orientation : orientation + 4])
        mujoco.mju_rotVecQuat(turned[velocity : velocity + 3], start[velocity : velocity + 3], half)
    return bool(places) and stays(shifted), bool(turns) and stays(turned)


def has_target(task: str) -> bool:
    """Return True if every episode of a task, such as ``"reacher/easy"``, has a target of its own."""
    return _TARGET.fullmatch(task) is not None


def episode_target(env: Any) -> np.ndarray:
    """Return the target's position ``[3]``, metres, world frame, in the running episode of a task with a target."""
    model, data = env.physics.model.ptr, env.physics.data.ptr
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "target")
    position = data.geom("target").xpos if site < 0 else data.site("target").xpos
    return np.array(position)


class SuiteStarts:
    """Start states of a task as dm_control draws them."""

    def __init__(self, domain: str, task: str) -> None:
        self.env = load_suite_task(domain, task, 0)

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw full MuJoCo states ``[n, S]``."""
        states = np.empty((n, len(full_physics(self.env))))
        self.env.task.random.seed(int(rng.integers(2**32)))
        for row in states:
            self.env.reset()
            row[:] = full_physics(self.env)
        return states

"""Collision-free start poses of users' models, around a keyframe or the model's own pose."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np

from torchrl_gn.data.clearance import clearance, find_bases
from torchrl_gn.scenes.actuator_kinds import activated_servos, actuator_kind, holding_controls
from torchrl_gn.scenes.collisions import colliding_geoms
from torchrl_gn.scenes.joint_ranges import bounded_joints, drawn_ranges
from torchrl_gn.scenes.keyframes import reference_keyframe
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.topology import named, weld_roots

_NEAR = 0.3  # largest narrow perturbation, as a share of a wide one
_TILT = 0.5  # rad, largest tilt of a robot's base
_DEPTH = 1e-3  # m, tolerated overlap of two geoms beyond that in the reference pose
_REDRAWS, _SHRINKS, _SHRINK = 8, 16, 0.7  # attempts at full size, then at sizes that shrink to 0.3 %
_EQUALITY_STEPS, _EQUALITY_ERROR = 50, 1e-4
_DAMPING, _MOST_DAMPING = 1e-6, 1e6  # Levenberg-Marquardt damping: smallest; where the search ends
_BEYOND = 0.05  # tolerated violation of a joint's limits, as a share of its range
_SEARCH = 100  # random poses tried if the reference pose penetrates
_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS


class StartPoseWarning(UserWarning):
    """The reference pose of a model penetrates something."""


class StartPoses:
    """Sampler of collision-free states at rest of one model.

    The reference pose is the keyframe ``home``, else ``stand``, else the first, else ``qpos0``. A joint beyond its
    limits moves to the nearest limit, or to the middle of its range if it is far beyond. Half of the draws
    (``Scene.wide_starts``) perturb the reference pose widely: joints are uniform within their limits, unlimited hinges
    and balls take every direction. The other draws perturb it by up to 30 % of these ranges. Hinges with a range of
    over eight turns stay within half a turn of the reference; slides with a range of over 20 extents of the model,
    within one extent.

    - Free bodies turn about the vertical and shift by up to their size; robots' bases also tilt by up to 0.5 rad.
      Without gravity, or where they can touch nothing fixed, free bodies keep their position and take any orientation.
    - Bodies that move up and down freely keep their clearance to planes below, or touch the planes if they penetrate
      them in the reference pose.
    - Levenberg-Marquardt steps from each draw satisfy the equality constraints and the limits of tendons.
    - Draws whose geoms penetrate over 1 mm deeper than in the reference pose are drawn again, and at last shrunk
      towards the reference pose.
    """

    def __init__(self, scene: Scene):
        self.scene, self.model = scene, scene.model
        self._data = mujoco.MjData(self.model)
        limited = (self.model.jnt_limited != 0) & (self.model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE))
        self._limited = (self.model.jnt_qposadr[limited], *self.model.jnt_range[limited].T)
        self._bounded = bounded_joints(self.model)[limited]
        balls = (self.model.jnt_limited != 0) & (self.model.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL))
        self._balls = self.model.jnt_qposadr[balls][:, None] + np.arange(4), self.model.jnt_range[balls, 1]
        self._load_reference()
        self._touching = colliding_geoms(self.model)
        self._bases = find_bases(self.model, self._touching)
        self._equality_error = _EQUALITY_ERROR
        self._equality_error = max(_EQUALITY_ERROR, self._hold_equalities())
        self._clearance = [max(clearance(self.model, self._data, base), 0.0) for base in self._bases]
        self._lift()
        self._reference = self._data.qpos.copy()
        self._ranges = drawn_ranges(self.model, self._reference)
        self._allowed: dict[tuple[int, int], float] = {}
        if depths := self._depths():
            self._avoid(depths)
        self._integrates = self.model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
        self._servos = activated_servos(self.model)
        late = np.flatnonzero(scene.delays.lag).tolist()
        self._late = [actuator for actuator in late if actuator_kind(self.model, actuator) == "position"]
        self._rest = np.empty(scene.physics_size)
        mujoco.mj_getState(self.model, self._data, self._rest, _PHYSICS)

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw states ``[n, S]``, float64."""
        states = np.tile(self._rest, (n, 1))
        wide = rng.random(n) < self.scene.wide_starts
        spread = np.where(wide, 1.0, _NEAR * rng.random(n))
        pending = np.arange(n)
        for attempt in range(_REDRAWS + _SHRINKS):
            if not len(pending):
                break
            size = _SHRINK ** max(0, attempt - _REDRAWS)
            changes = size * self._perturbations(spread[pending], rng)
            collided = []
            for row, change in zip(pending, changes, strict=True):
                if self._perturb(change):
                    states[row, 1 : 1 + self.model.nq] = self._data.qpos
                    self._hold(states[row])
                else:
                    collided.append(row)
            pending = np.array(collided, dtype=np.int64)
        return states  # draws that still collide keep the reference pose

    def _hold(self, state: np.ndarray) -> None:
        """Set the activations and past controls of position servos so that they hold the pose."""
        model, data, scene = self.model, self._data, self.scene
        servos = self._servos
        if not len(servos) + len(self._late):
            return
        for stage in ("kinematics", "comPos", "tendon", "transmission"):
            getattr(mujoco, f"mj_{stage}")(model, data)
        for actuator in self._late:
            target = holding_controls(model, actuator, data.actuator_length[actuator])
            inside = np.clip(target, scene.action_low[actuator], scene.action_high[actuator])
            scene.delays.hold(model, state, actuator, float(inside))
        held = holding_controls(model, servos, data.actuator_length[servos])
        for limited, bounds in (
            (model.actuator_actlimited[servos], model.actuator_actrange[servos]),
            (model.actuator_ctrllimited[servos] & ~self._integrates[servos], model.actuator_ctrlrange[servos]),
        ):
            held = np.where(limited, np.clip(held, *bounds.T), held)
        state[1 + model.nq + model.nv + model.actuator_actadr[servos]] = held

    def _load_reference(self) -> None:
        model, data = self.model, self._data
        if (key := reference_keyframe(model)) is not None:
            mujoco.mj_resetDataKeyframe(model, data, key)
        data.time, data.qvel[:] = 0.0, 0.0
        mujoco.mj_normalizeQuat(model, data.qpos)
        there, low, high = self._limited
        inside = np.clip(data.qpos[there], low, high)
        far = (np.abs(inside - data.qpos[there]) > _BEYOND * (high - low)) & self._bounded
        data.qpos[there] = np.where(far, (low + high) / 2, inside)
        self._limit_balls()

    def _limit_balls(self) -> None:
        """Turn balls beyond their limits back to the limits."""
        data, (there, most) = self._data, self._balls
        beyond = _angles(data.qpos[there]) > most
        if beyond.any():
            axes, half = data.qpos[there[beyond]], most[beyond, None] / 2
            axes = np.where(axes[:, :1] < 0, -1, 1) * axes
            data.qpos[there[beyond]] = np.concatenate((np.cos(half), np.sin(half) * _unit(axes[:, 1:])), axis=1)

    def _avoid(self, depths: dict[tuple[int, int], float]) -> None:
        """Replace a penetrating reference pose by the best of random poses, tolerate its overlaps, and warn."""
        (first, second), depth = max(depths.items(), key=lambda item: item[1])
        best, pose = depths, self._reference
        for change in self._perturbations(np.ones(_SEARCH), np.random.default_rng(0)):
            free = self._perturb(change)
            left = {} if free else self._depths()
            if sum(left.values()) < sum(best.values()):
                best, pose = left, self._data.qpos.copy()
            if free:
                break
        self._allowed, self._reference = best, pose
        self._data.qpos[:] = pose
        mujoco.mj_kinematics(self.model, self._data)
        instead = "may overlap too" if best is depths else "are around a random pose that has less overlap"
        warnings.warn(
            f"The reference pose of scene {self.scene.name!r} has {_geom(self.model, first)} {1e3 * depth:.3g} mm deep"
            f" in {_geom(self.model, second)}. Start states {instead}; give the model a keyframe 'home' without"
            " overlaps, or exclude contacts that mean nothing.",
            StartPoseWarning,
            stacklevel=2,
        )

    def _perturbations(self, spread: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw changes ``[n, nv]`` of the reference pose, as velocities for ``mj_integratePos`` over one second."""
        model, kind, n = self.model, mujoco.mjtJoint, len(spread)
        changes = np.zeros((n, model.nv))
        for joint in range(model.njnt):
            first, dof, (low, high) = model.jnt_qposadr[joint], model.jnt_dofadr[joint], self._ranges[joint]
            match model.jnt_type[joint], bool(model.jnt_limited[joint]):
                case ((kind.mjJNT_HINGE | kind.mjJNT_SLIDE), True):
                    here = self._reference[first]
                    changes[:, dof] = spread * (rng.uniform(low, high, n) - here)
                case kind.mjJNT_HINGE, False:
                    changes[:, dof] = spread * rng.uniform(-np.pi, np.pi, n)
                case kind.mjJNT_BALL, limited:
                    here = self._reference[first : first + 4]
                    turned = _ball(rng, n, high if limited else None)
                    changes[:, dof : dof + 3] = spread[:, None] * _rotation_between(here, turned)
                case kind.mjJNT_FREE, _:
                    changes[:, dof : dof + 6] = self._free_body(joint, spread[:, None], rng)
        return changes

    def _free_body(self, joint: int, spread: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw shifts in world axes and rotations in body axes, ``[n, 6]``, of a free joint."""
        model, n = self.model, len(spread)
        body, first = model.jnt_bodyid[joint], model.jnt_qposadr[joint]
        change, vertical = np.zeros((n, 6)), np.zeros((n, 3))
        here = self._reference[first + 3 : first + 7]
        carried = model.body_rootid[model.geom_bodyid] == model.body_rootid[body]
        fixed = weld_roots(model)[model.geom_bodyid] == 0
        falls = model.opt.gravity.any() and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        if not (falls and self._touching[np.ix_(carried, fixed)].any()):
            change[:, 3:] = spread * _rotation_between(here, _ball(rng, n, None))
            return change
        geoms = np.flatnonzero(model.geom_bodyid == body)
        size = model.geom_rbound[geoms].max(initial=0.0)
        change[:, :2] = spread * size * rng.uniform(-1.0, 1.0, (n, 2))
        vertical[:, 2] = rng.uniform(-np.pi, np.pi, n)
        if (model.body_rootid[model.jnt_bodyid] == model.body_rootid[body]).sum() > 1:  # it carries other joints
            vertical[:, :2] = spread * _TILT * rng.uniform(-1.0, 1.0, (n, 2))
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, here)
        change[:, 3:] = vertical @ rotation.reshape(3, 3)  # in the body's axes
        return change

    def _perturb(self, change: np.ndarray) -> bool:
        """Move to the perturbed reference pose; return True if it may be a start."""
        model, data = self.model, self._data
        data.qpos[:] = self._reference
        mujoco.mj_integratePos(model, data.qpos, change, 1.0)
        self._limit_balls()
        if self._hold_equalities() > self._equality_error:
            return False
        there, low, high = self._limited  # equality constraints may have moved joints beyond
        if (np.abs(np.clip(data.qpos[there], low, high) - data.qpos[there]) > _BEYOND * (high - low)).any():
            return False
        turned, most = self._balls
        if (_angles(data.qpos[turned]) > (1 + _BEYOND) * most).any():
            return False
        self._lift()
        return not self._depths()

    def _lift(self) -> None:
        """Move bases up or down to their clearance, and update the kinematics."""
        for base, least_clearance in zip(self._bases, self._clearance, strict=True):
            now = clearance(self.model, self._data, base)
            if np.isfinite(now):
                self._data.qpos[base.height] += (least_clearance - now) / base.up
        mujoco.mj_kinematics(self.model, self._data)

    def _hold_equalities(self) -> float:
        """Step onto the equality constraints within all limits, update the kinematics; return the remaining error.

        No Levenberg-Marquardt step increases the error, so unreachable constraints do not wind joints up.
        """
        model, data = self.model, self._data
        if not data.eq_active.any() and not model.tendon_limited.any():
            mujoco.mj_kinematics(model, data)
            return 0.0
        there, low, high = self._limited
        error, jacobian = self._equalities()
        damping, best = _DAMPING, data.qpos.copy()
        for _ in range(_EQUALITY_STEPS):
            if np.abs(error).max(initial=0.0) <= self._equality_error or damping > _MOST_DAMPING:
                break
            square = jacobian @ jacobian.T
            floor = damping * max(np.trace(square) / len(square), _EQUALITY_ERROR)
            step = jacobian.T @ np.linalg.lstsq(square + floor * np.eye(len(square)), error, rcond=None)[0]
            mujoco.mj_integratePos(model, data.qpos, -step, 1.0)
            data.qpos[there] = np.clip(data.qpos[there], np.minimum(low, best[there]), np.maximum(high, best[there]))
            tried, its_jacobian = self._equalities()
            if tried @ tried < error @ error:
                error, jacobian, best, damping = tried, its_jacobian, data.qpos.copy(), max(damping / 10, _DAMPING)
            else:
                data.qpos[:] = best
                damping *= 10
        mujoco.mj_kinematics(model, data)
        return float(np.abs(error).max(initial=0.0))

    def _equalities(self) -> tuple[np.ndarray, np.ndarray]:
        """Return errors ``[R]`` of equality constraints and violated tendon limits, and their Jacobian ``[R, nv]``."""
        model, data, kind = self.model, self._data, mujoco.mjtConstraint
        mujoco.mj_fwdPosition(model, data)
        kinds = data.efc_type[: data.nefc]
        rows = kinds == kind.mjCNSTR_EQUALITY
        rows |= (kinds == kind.mjCNSTR_LIMIT_TENDON) & (data.efc_pos[: data.nefc] < 0)
        return data.efc_pos[: data.nefc][rows], _constraint_jacobian(model, data)[rows]

    def _depths(self) -> dict[tuple[int, int], float]:
        """Return the depth of each pair of geoms that overlap by 1 mm more than allowed; needs current kinematics."""
        model, data = self.model, self._data
        mujoco.mj_comPos(model, data)
        if model.nflex:
            mujoco.mj_flex(model, data)
        mujoco.mj_collision(model, data)
        deep = data.contact.dist < -_DEPTH
        if not deep.any():
            return {}
        depths: dict[tuple[int, int], float] = {}
        for pair, distance in zip(map(tuple, data.contact.geom[deep].tolist()), data.contact.dist[deep], strict=True):
            if -distance > self._allowed.get(pair, 0.0) + _DEPTH:
                depths[pair] = max(depths.get(pair, 0.0), -float(distance))
        return depths


def _constraint_jacobian(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the dense Jacobian ``[nefc, nv]`` of all constraints."""
    if not mujoco.mj_isSparse(model):
        return data.efc_J.ravel()[: data.nefc * model.nv].reshape(data.nefc, model.nv)  # the buffer may be longer
    dense = np.zeros((data.nefc, model.nv))
    for row in range(data.nefc):
        first, count = data.efc_J_rowadr[row], data.efc_J_rownnz[row]
        dense[row, data.efc_J_colind[first : first + count]] = data.efc_J[first : first + count]
    return dense


def _ball(rng: np.random.Generator, n: int, limit: float | None) -> np.ndarray:
    """Draw random orientations ``[n, 4]``: uniform, or turned by a uniform angle below the limit [rad]."""
    if limit is None:
        return _unit(rng.standard_normal((n, 4)))
    axis, half = _unit(rng.standard_normal((n, 3))), 0.5 * rng.uniform(0.0, limit, (n, 1))
    return np.concatenate([np.cos(half), np.sin(half) * axis], axis=1)


def _rotation_between(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Return rotation vectors ``[n, 3]`` in the body's axes from an orientation ``[4]`` to others ``[n, 4]``."""
    vectors = np.empty((len(there), 3))
    for row, orientation in enumerate(there):
        mujoco.mju_subQuat(vectors[row], orientation, here)
    return vectors


def _angles(quaternions: np.ndarray) -> np.ndarray:
    """Return the angles ``[n]`` of rotations ``[n, 4]``, from 0 to pi."""
    return 2 * np.arctan2(np.linalg.norm(quaternions[:, 1:], axis=1), np.abs(quaternions[:, 0]))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _geom(model: mujoco.MjModel, geom: int) -> str:
    if geom < 0:
        return "a flex"
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
    body = named(model, mujoco.mjtObj.mjOBJ_BODY, int(model.geom_bodyid[geom]))
    return f"geom {name!r}" if name else f"a geom of body {body!r}"

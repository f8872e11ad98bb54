"""Controls that hold a pose or accelerate joints: position servo targets, and motor controls by inverse dynamics."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_gn.data.simulate import Simulator
from torchrl_gn.scenes.actuator_kinds import actuator_kind, holding_controls, switched_off

_STAGES = ("kinematics", "comPos", "tendon", "transmission", "comVel", "passive")
_UNBALANCED = 1e-3  # largest force left over, as a share of the largest force to balance
_TURNING = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


class MotorLaws:
    """Inverse dynamics of a model's fixed-gain motors that are not switched off.

    Attributes:
        motors: indices of these motors.
        mask: ``[A]`` bool, True for these motors.
    """

    def __init__(self, model: mujoco.MjModel):
        kinds = np.array([actuator_kind(model, actuator) for actuator in range(model.nu)])
        fixed = model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)
        self.mask = (kinds == "motor") & fixed & (model.actuator_gainprm[:, 0] != 0)
        self.mask &= (model.actuator_actnum == 0) & (model.actuator_plugin < 0)  # no state between control and force
        self.mask &= ~switched_off(model)
        self.motors = np.flatnonzero(self.mask)
        self.model, self._data = model, mujoco.MjData(model)
        self._dofs = _driven_dofs(model, self.motors)

    def controls(
        self, model: mujoco.MjModel, state: np.ndarray, dofs: np.ndarray, acceleration: np.ndarray
    ) -> np.ndarray:
        """Return unclipped controls ``[motors]`` that accelerate ``dofs`` in a state ``[S]``, ignoring contacts.

        NaN if the motors cannot do so without moving other joints of the same robots.
        """
        data, moments = self._update(model, state)
        data.qacc[:] = 0.0
        data.qacc[dofs] = acceleration
        needed = _inverse_dynamics(model, data) - data.qfrc_passive
        # Passive forces lack the gravity compensation that counts as an actuator's force.
        needed -= np.where(model.jnt_actgravcomp[model.dof_jntid], data.qfrc_gravcomp, 0.0)
        force = self._forces(model, moments, needed)
        gain, bias = model.actuator_gainprm[self.motors, 0], model.actuator_biasprm[self.motors]
        affine = model.actuator_biastype[self.motors] == int(mujoco.mjtBias.mjBIAS_AFFINE)
        velocity = bias[:, 2] * (moments @ data.qvel)
        return (force - affine * (bias[:, 0] + bias[:, 1] * data.actuator_length[self.motors] + velocity)) / gain

    def _forces(self, model: mujoco.MjModel, moments: np.ndarray, needed: np.ndarray) -> np.ndarray:
        """Solve for the motor forces ``[motors]`` that give the ``needed`` joint forces ``[nv]``; NaN if none do."""
        if self._dofs is not None:
            return needed[self._dofs] / moments[np.arange(len(self.motors)), self._dofs]
        trees = _same_trees(model, (moments != 0).any(0))
        force = np.linalg.lstsq(moments[:, trees].T, needed[trees], rcond=None)[0]
        left = np.abs(needed[trees] - moments[:, trees].T @ force).max(initial=0.0)
        balanced = left <= _UNBALANCED * np.abs(needed[trees]).max(initial=0.0)
        return force if balanced else np.full(len(self.motors), np.nan)

    def driven_joints(self, state: np.ndarray) -> np.ndarray | None:
        """Return all joints of the motors' robots if these are hinges and slides, and fully actuated; else None."""
        model = self.model
        _, moments = self._update(model, state)
        trees = _same_trees(model, (moments != 0).any(0))
        joints = np.unique(model.dof_jntid[trees])
        whole = np.linalg.matrix_rank(moments[:, trees]) == np.count_nonzero(trees)
        return joints if len(joints) and whole and np.isin(model.jnt_type[joints], _TURNING).all() else None

    def _update(self, model: mujoco.MjModel, state: np.ndarray) -> tuple[mujoco.MjData, np.ndarray]:
        """Compute positions and velocities of a state, and the motors' moments ``[motors, nv]``."""
        data = self._data
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        for stage in _STAGES:
            getattr(mujoco, f"mj_{stage}")(model, data)
        if self._dofs is None:
            return data, actuator_moments(model, data)[self.motors]
        moments = np.zeros((len(self.motors), model.nv))
        moments[np.arange(len(self.motors)), self._dofs] = model.actuator_gear[self.motors, 0]
        return data, moments


def _inverse_dynamics(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the joint forces ``[nv]`` that inertia and gravity need for ``data.qacc``."""
    needed = np.empty(model.nv)
    # Newer versions of MuJoCo have armatures of tendons and actuators.
    if any(np.any(getattr(model, f"{part}_armature", 0.0)) for part in ("tendon", "actuator")):
        mujoco.mj_makeM(model, data)
        mujoco.mj_fwdVelocity(model, data)  # tendons' armatures add to the bias, too
        mujoco.mj_mulM(model, data, needed, data.qacc)
        return needed + data.qfrc_bias
    mujoco.mj_rne(model, data, 1, needed)
    return needed + model.dof_armature * data.qacc


def _same_trees(model: mujoco.MjModel, dofs: np.ndarray) -> np.ndarray:
    """Detect the degrees of freedom, ``[nv]`` bool, of the robots that ``dofs`` belong to."""
    return np.isin(model.dof_treeid, model.dof_treeid[dofs])


def _driven_dofs(model: mujoco.MjModel, motors: np.ndarray) -> np.ndarray | None:
    """Return each motor's degree of freedom ``[motors]`` if each joint of their robots has one motor; else None.

    Most arms have such motors. Their forces need no least squares, which would take most of the time.
    """
    joints = model.actuator_trnid[motors, 0]
    at_joints = np.isin(model.actuator_trntype[motors], (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    if not at_joints.all() or not np.isin(model.jnt_type[joints], _TURNING).all():
        return None
    dofs = model.jnt_dofadr[joints]
    trees = _same_trees(model, dofs)
    one_each = len(np.unique(dofs)) == len(dofs) == np.count_nonzero(trees)
    return dofs if one_each and (model.actuator_gear[motors, 0] != 0).all() else None


def pose_holding_controls(
    simulator: Simulator, physics: np.ndarray, variant: np.ndarray, otherwise: np.ndarray
) -> np.ndarray:
    """Return unclipped controls ``[n, A]`` that hold states ``[n, S]`` at rest.

    Position servos get targets at which they exert no force. Fixed-gain motors balance gravity and springs if they can
    do so alone, as in arms. All other actuators get ``otherwise`` ``[A]``.
    """
    scene, controls = simulator.scene, np.tile(otherwise, (len(physics), 1))
    kinds = np.array([actuator_kind(scene.model, actuator) for actuator in range(scene.model.nu)])
    servos, laws = np.flatnonzero(kinds == "position"), MotorLaws(scene.model)
    none, still = np.empty(0, dtype=np.int64), 1 + scene.model.nq + np.arange(scene.model.nv)
    data = mujoco.MjData(scene.model)
    for row, state in enumerate(physics):
        model = simulator.scenes[variant[row]].model
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        for stage in _STAGES[:4]:
            getattr(mujoco, f"mj_{stage}")(model, data)
        controls[row, servos] = holding_controls(model, servos, data.actuator_length[servos])
        if len(laws.motors):
            resting = state.copy()
            resting[still] = 0.0
            motor_controls = laws.controls(model, resting, none, np.empty(0))
            controls[row, laws.motors] = np.where(np.isnan(motor_controls), otherwise[laws.motors], motor_controls)
    return controls


def actuator_moments(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the actuators' moments ``[A, nv]`` in ``data``, whose transmissions are up to date."""
    moments = np.zeros((model.nu, model.nv))
    for actuator in range(model.nu):
        first, count = data.moment_rowadr[actuator], data.moment_rownnz[actuator]
        here = slice(first, first + count)
        moments[actuator, data.moment_colind.ravel()[here]] = data.actuator_moment.ravel()[here]
    return moments

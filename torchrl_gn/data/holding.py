"""Controls that hold a pose or accelerate joints: targets of position servos, and motors by inverse dynamics."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_gn.data.simulate import Simulator
from torchrl_gn.scenes.actuator_kinds import actuator_kind, holding_controls

_STAGES = ("kinematics", "comPos", "tendon", "transmission", "comVel", "passive")
_UNBALANCED = 1e-3  # largest force left, as a share of those to balance
_TURNING = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


class MotorLaws:
    """Controls of a model's motors of fixed gain for accelerations of its joints.

    Attributes:
        motors: their numbers; ``mask`` ``[A]`` says which actions they are.
    """

    def __init__(self, model: mujoco.MjModel):
        kinds = np.array([actuator_kind(model, actuator) for actuator in range(model.nu)])
        fixed = model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)
        self.mask = (kinds == "motor") & fixed & (model.actuator_gainprm[:, 0] != 0)
        self.mask &= (model.actuator_actnum == 0) & (model.actuator_plugin < 0)  # whose force is the control's
        self.motors = np.flatnonzero(self.mask)
        self.model, self._data = model, mujoco.MjData(model)
        self._dofs = _driven_dofs(model, self.motors)

    def controls(
        self, model: mujoco.MjModel, state: np.ndarray, dofs: np.ndarray, acceleration: np.ndarray
    ) -> np.ndarray:
        """Controls ``[motors]``, not clipped, for ``acceleration`` of ``dofs`` in a state ``[S]``, without contacts.

        NaN if other joints of the same robots would move as well.
        """
        data, moments = self._update(model, state)
        data.qacc[:] = 0.0
        data.qacc[dofs] = acceleration
        needed = np.empty(model.nv)
        mujoco.mj_rne(model, data, 1, needed)
        needed += model.dof_armature * data.qacc - data.qfrc_passive
        force = self._forces(model, moments, needed)
        gain, bias = model.actuator_gainprm[self.motors, 0], model.actuator_biasprm[self.motors]
        affine = model.actuator_biastype[self.motors] == int(mujoco.mjtBias.mjBIAS_AFFINE)
        velocity = bias[:, 2] * (moments @ data.qvel)
        return (force - affine * (bias[:, 0] + bias[:, 1] * data.actuator_length[self.motors] + velocity)) / gain

    def _forces(self, model: mujoco.MjModel, moments: np.ndarray, needed: np.ndarray) -> np.ndarray:
        """Forces ``[motors]`` that give ``needed`` ``[nv]`` of their robots; NaN if none do."""
        if self._dofs is not None:
            return needed[self._dofs] / moments[np.arange(len(self.motors)), self._dofs]
        trees = _same_trees(model, (moments != 0).any(0))
        force = np.linalg.lstsq(moments[:, trees].T, needed[trees], rcond=None)[0]
        left = np.abs(needed[trees] - moments[:, trees].T @ force).max(initial=0.0)
        balanced = left <= _UNBALANCED * np.abs(needed[trees]).max(initial=0.0)
        return force if balanced else np.full(len(self.motors), np.nan)

    def driven_joints(self, state: np.ndarray) -> np.ndarray | None:
        """Joints that the motors drive, if these are hinges and slides, and all of their robots'; else None."""
        model = self.model
        _, moments = self._update(model, state)
        trees = _same_trees(model, (moments != 0).any(0))
        joints = np.unique(model.dof_jntid[trees])
        whole = np.linalg.matrix_rank(moments[:, trees]) == np.count_nonzero(trees)
        return joints if len(joints) and whole and np.isin(model.jnt_type[joints], _TURNING).all() else None

    def _update(self, model: mujoco.MjModel, state: np.ndarray) -> tuple[mujoco.MjData, np.ndarray]:
        """The state's positions and velocities, and moments ``[motors, nv]``."""
        data = self._data
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        for stage in _STAGES:
            getattr(mujoco, f"mj_{stage}")(model, data)
        if self._dofs is None:
            return data, actuator_moments(model, data)[self.motors]
        moments = np.zeros((len(self.motors), model.nv))
        moments[np.arange(len(self.motors)), self._dofs] = model.actuator_gear[self.motors, 0]
        return data, moments


def _same_trees(model: mujoco.MjModel, dofs: np.ndarray) -> np.ndarray:
    """Whether each degree of freedom, ``[nv]`` bool, is of the same robot as one of ``dofs``."""
    return np.isin(model.dof_treeid, model.dof_treeid[dofs])


def _driven_dofs(model: mujoco.MjModel, motors: np.ndarray) -> np.ndarray | None:
    """Degrees of freedom ``[motors]`` if each is that of one motor's joint, and all of their robots'; else None.

    Most arms are such, and then forces need no least squares, which would take most of the time.
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
    """Controls ``[n, A]``, not clipped, that hold states ``[n, S]`` at rest.

    Position servos exert no force there. Motors of fixed gain balance gravity and springs where they can alone, as
    those of arms do; all else has ``otherwise`` ``[A]``.
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
            found = laws.controls(model, resting, none, np.empty(0))
            controls[row, laws.motors] = np.where(np.isnan(found), otherwise[laws.motors], found)
    return controls


def actuator_moments(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Moments ``[A, nv]`` of the actuators at the pose of ``data``, whose transmissions are known."""
    moments = np.zeros((model.nu, model.nv))
    for actuator in range(model.nu):
        first, count = data.moment_rowadr[actuator], data.moment_rownnz[actuator]
        here = slice(first, first + count)
        moments[actuator, data.moment_colind.ravel()[here]] = data.actuator_moment.ravel()[here]
    return moments

"""Features of tendons, and of actuators through them, slider-cranks and sites, against MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.dynamics import Actuators, ForwardModel, Tendons, specialize
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.dynamics.tendon_states import TendonStates
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes.force_elements import known_slots
from torchrl_gn.scenes.tendons import acting_tendons, tendon_joints, tendon_laws, tendon_scales

from .. import zoo
from ..sizes import SMALL
from .test_force_elements import bind, check_gradients, inputs_of, poses

_KINDS = mujoco.mjtJoint


def along(model: mujoco.MjModel, data: mujoco.MjData, tendon: int, joint: int, step: float = 1e-6) -> np.ndarray:
    """Derivatives of a tendon's length along the degrees of freedom of a joint."""
    other, lengths = mujoco.MjData(model), []
    count = {_KINDS.mjJNT_FREE: 6, _KINDS.mjJNT_BALL: 3}.get(_KINDS(model.jnt_type[joint]), 1)
    for dof in range(count):
        for sign in (1, -1):
            change = np.zeros(model.nv)
            change[model.jnt_dofadr[joint] + dof] = sign * step
            other.qpos[:] = data.qpos
            mujoco.mj_integratePos(model, other.qpos, change, 1.0)
            for stage in ("kinematics", "comPos", "tendon"):
                getattr(mujoco, f"mj_{stage}")(model, other)
            lengths.append(sign * other.ten_length[tendon])
    return np.array(lengths).reshape(count, 2).sum(1) / (2 * step)


@pytest.mark.parametrize("name", ["lines", "tendon_arm", "gripper"])
def test_lengths_rates_and_moments_are_mujocos(name):
    scene = zoo.load(name)
    model, tendons = scene.model, list(range(scene.model.ntendon))
    slots = [(tendon, joint) for tendon in tendons for joint in tendon_joints(scene, tendon)]
    states, coordinates, wrapped = TendonStates(scene, tendons, slots), JointCoordinates(scene), 0
    for index, (data, state) in enumerate(poses(scene, 40)):
        matrices = quaternion.to_matrix(state[:, BODY_STATE.slices["orientation"]]).unflatten(-1, (3, 3))
        found = states(state, matrices, coordinates.joints(state, matrices))
        np.testing.assert_allclose(found.length, data.ten_length, atol=1e-9)
        np.testing.assert_allclose(found.velocity, data.ten_velocity, atol=1e-8)
        wrapped += int(data.ten_wrapnum.sum())
        if index % 10:
            continue
        for slot, (tendon, joint) in enumerate(slots):
            expected, kind = along(model, data, tendon, joint), _KINDS(model.jnt_type[joint])
            body = matrices[scene.receivers[2 * joint]].numpy()
            force, torque = found.vector[slot].numpy().reshape(2, 3)
            moment = {_KINDS.mjJNT_BALL: torque @ body, _KINDS.mjJNT_FREE: np.append(force, torque @ body)}
            np.testing.assert_allclose(moment.get(kind, found.moment[slot].numpy()), expected.squeeze(), atol=1e-6)
            assert kind in moment or not found.vector[slot].any()
    sites = sum(int(kind) == int(mujoco.mjtWrap.mjWRAP_SITE) for kind in model.wrap_type)
    assert name == "gripper" or wrapped > 40 * sites + 20  # many poses in which something wraps


# MuJoCo 3.3 turns a site against its refsite otherwise.
_OLD = mujoco.__version__.split(".")[:2] == ["3", "3"]


@pytest.mark.parametrize("name", ["lines", "tendon_arm", "machine"])
def test_forces_of_lines_are_mujocos(name):
    """An actuator's force times its moments, as ``qfrc_actuator`` has it."""
    scene = zoo.load(name)
    model, slots = scene.model, scene.edge_action.shape[1]
    feature, known = bind(Actuators(), scene), known_slots(scene)
    assert set(scene.edge_action[::2][known]) == set(range(scene.num_actions)) - {
        index for index, actuator in enumerate(scene.actuator_names) if actuator in ("aim", "stick", "swing")
    }
    for data, state in poses(scene, 20):
        features = feature(inputs_of(scene, state, data.ctrl)).unflatten(-1, (slots, 4))[::2, :, 0].numpy()
        moments = np.zeros((model.nu, model.nv))
        mujoco.mju_sparse2dense(
            moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )
        for (pair, slot), actuator in np.ndenumerate(scene.edge_action[::2]):
            if scene.actuator_names[actuator] == "reach" and _OLD:
                continue
            expected = data.actuator_force[actuator]
            if pair < model.njnt and model.jnt_type[pair] in (int(_KINDS.mjJNT_HINGE), int(_KINDS.mjJNT_SLIDE)):
                expected = expected * moments[actuator, model.jnt_dofadr[pair]]
            elif scene.actuator_names[actuator] in ("pull", "servo"):
                expected = -2 * expected if scene.actuator_names[actuator] == "pull" else 1.5 * expected
            np.testing.assert_allclose(features[pair, slot], expected * known[pair, slot], atol=1e-8)


@pytest.mark.parametrize("name", ["lines", "everything"])
def test_tendons_springs_and_limits_are_mujocos(name):
    scene = zoo.load(name, *([('range="0 2"', 'range="0.3 0.5"')] if name == "everything" else []))
    model, feature, found = scene.model, bind(Tendons(), scene), 0
    size, tendons = 16 if name == "lines" else 10, acting_tendons(scene)[0]
    at = {joint: [each for each in tendons if joint in tendon_joints(scene, each)] for joint in range(model.njnt)}
    laws, near = tendon_laws(model), tendon_scales(model)
    for data, state in poses(scene, 20):
        features = feature(inputs_of(scene, state, data.ctrl)).unflatten(-1, (-1, size))
        torch.testing.assert_close(features[::2], features[1::2])
        active = data.efc_id[data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON)].tolist()
        for joint, some in at.items():
            for slot, tendon in enumerate(some):
                own, length = features[2 * joint, slot].numpy(), data.ten_length[tendon]
                assert own[1] == pytest.approx(data.ten_velocity[tendon])
                if np.abs(laws[tendon, 0]) < 1e9:
                    assert ((own[2:4] >= 0).all()) == (tendon not in active)
                    expected = np.clip((length - laws[tendon, 0]) / near[tendon], -1, 1)
                    assert own[2] == pytest.approx(expected, abs=1e-9)
                    found += tendon in active
            if model.jnt_type[joint] in (int(_KINDS.mjJNT_HINGE), int(_KINDS.mjJNT_SLIDE)):
                dof, stiff = model.jnt_dofadr[joint], model.jnt_stiffness.reshape(model.njnt, -1)[joint, 0]
                rest = model.qpos_spring[model.jnt_qposadr[joint]] - data.qpos[model.jnt_qposadr[joint]]
                damping = model.dof_damping.reshape(model.nv, -1)[dof, 0] * data.qvel[dof]
                expected = data.qfrc_spring[dof] + data.qfrc_damper[dof] - stiff * rest + damping
                assert float(features[2 * joint, :, 6].sum()) == pytest.approx(expected, abs=1e-8)
    assert found


def test_tendons_a_step_on():
    scene = zoo.load("lines", ('damping="0.5"', ""))
    feature, compared = bind(Tendons(), scene), 0
    near = torch.from_numpy(tendon_scales(scene.model))[1]
    for data, state in poses(scene, 25, speed=0.1):
        now = feature(inputs_of(scene, state, data.ctrl))[2].unflatten(
            -1, (-1, 16)
        )  # round, over and pulley at a hinge
        moved = scene.timestep * now[:, 1]
        for low, sign in ((2, 1), (3, -1)):
            free = now[1, [low, low + 2]].abs() < 1
            if bool(free.all()):
                torch.testing.assert_close(now[1, low + 2] - now[1, low], sign * moved[1] / near)
                compared += 1
        if data.ten_length[0] > 0.52:
            torch.testing.assert_close(now[0, 7] - now[0, 6], -20 * moved[0] * now[0, 9])
            compared += 1
    assert compared > 10


def test_tendons_whose_length_does_not_follow_are_printed():
    inside = ('<geom geom="rod" sidesite="under"/>', '<geom geom="rod" sidesite="rod"/>')
    site = ('<site name="rim"', '<site name="rod" pos="0 0.1 0.1"/><site name="rim"')
    scene = zoo.load("lines", inside, site)
    assert "tendons without features of their own: pulley" in str(scene)
    assert "actuators without features of their forces: pull" in str(scene)
    assert "tendons that pull at joints: round (rail, swing, tilt, spin, wrist), over" in str(scene)
    assert not bind(Tendons(), scene)(inputs_of(scene, next(poses(scene, 1))[1], np.zeros(6))).isnan().any()


def test_scenes_that_tendons_suit():
    for name, expected in {"lines": True, "everything": True, "gripper": False, "cheetah": False}.items():
        scene = zoo.load(name)
        kinds = [type(each) for each in ForwardModel.for_scene(scene, **SMALL).features]
        assert Tendons.suits(scene) == expected == (Tendons in kinds)
    with pytest.raises(ValueError, match="1 tendons at each edge, of no balls or free joints, scene 'lines' has more"):
        Tendons().bind(zoo.load("lines"), BODY_STATE, None)  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_gradients_are_right_and_finite_at_rest():
    scene = zoo.load("lines")
    kinds = [bind(Tendons(), scene), bind(Actuators(), scene)]
    weights = torch.linspace(-1, 1, 400, dtype=torch.float64)
    check_gradients(scene, kinds, np.full(6, 0.3), weights, count=8, tolerance=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lines", "tendon_arm"])
def test_the_native_step_runs_tendons(fit, random_states, random_actions, name):
    scene = zoo.load(name)
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scene, **SMALL), scene)
    state, action = random_states(scene, 2, 3), random_actions(scene, 2, 3)
    predictor = specialize(model.bind(scene), executor="native")
    assert predictor.reason is None
    expected = model.bind(scene, reference=True).step(state, action)[0]
    torch.testing.assert_close(predictor.step(state, action)[0], expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "edit", "what"),
    [
        (
            "lines",
            ('name="rim" pos="0.2 0.1 -0.1"', 'name="rim" pos="0.2 0.1 -0.2"'),
            "tendons, slider-cranks or sites",
        ),
        ("lines", ('springlength="0.3 0.5"', 'springlength="0.3 0.6"'), "tendons, slider-cranks or sites"),
        ("lines", ('cranklength="0.6"', 'cranklength="0.7"'), "tendons, slider-cranks or sites"),
        ("constraints", ('anchor="0.1 0 0.02"', 'anchor="0.1 0 0.03"'), "equality constraints"),
        ("constraints", ('polycoef="0.1 0.8', 'polycoef="0.1 0.7'), "equality constraints"),
    ],
)
def test_variants_with_other_tendons_or_constraints_are_refused(name, edit, what):
    """Features read these numbers of the bound scene, so a variant's would be silently wrong."""
    bound = ForwardModel.for_scene(scene := zoo.load(name), **SMALL).bind(scene, parameters_key="parameters")
    with pytest.raises(ValueError, match=f"is not a variant of '{name}': {what} differ"):
        bound.parameters_of(zoo.load(name, edit))
    bound.parameters_of(zoo.load(name))


def test_adhesion_at_a_pair_of_its_own_has_no_force_here():
    """The pair of a body without joint to the world comes after the joints' pairs."""
    scene = zoo.load("machine", ('<adhesion name="stick" body="pad"', '<adhesion name="stick" body="rod"'))
    pair = int(np.flatnonzero((scene.edge_action[::2] == scene.actuator_names.index("stick")).any(1))[0])
    assert pair >= scene.model.njnt and not known_slots(scene)[pair].any()
    assert "actuators without features of their forces: aim, stick, swing" in str(scene)

"""Features of equality constraints against MuJoCo's rows of them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.dynamics import BodyState, Constraints, Controls, Couplings, ForwardModel, specialize
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes import Scene, load_scene

from .. import zoo
from ..sizes import SMALL
from .test_force_elements import bind, check_gradients, inputs_of, poses


def rows(scene: Scene, data: mujoco.MjData, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Violations ``[R]``, their rates, and the Jacobian ``[R, nv]`` of a constraint."""
    of = (data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)) & (data.efc_id == scene.model.equality(name).id)
    dense = np.zeros((data.nefc, scene.model.nv))
    if mujoco.mj_isSparse(scene.model):
        mujoco.mju_sparse2dense(dense, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    else:
        dense = data.efc_J.reshape(data.nefc, scene.model.nv)
    return data.efc_pos[of], data.efc_vel[of], dense[of]


def frame_of(scene: Scene, data: mujoco.MjData, name: str) -> np.ndarray:
    """Orientation ``[3, 3]`` of a weld's second end, in whose frame MuJoCo has its rotation."""
    model, one = scene.model, scene.model.equality(name).id
    kind = "xmat" if model.eq_objtype[one] == int(mujoco.mjtObj.mjOBJ_BODY) else "site_xmat"
    return getattr(data, kind)[model.eq_obj2id[one]].reshape(3, 3)


def test_violations_of_connects_and_welds_are_mujocos():
    scene = zoo.load("constraints")
    feature, graph = bind(Constraints(), scene), dict(enumerate(scene.pairs))
    names = {pair.name: index for index, pair in graph.items() if pair.element == "constraint"}
    assert list(names) == ["tie", "hook", "glue", "mate"]
    for data, state in poses(scene, 20):
        features = feature(inputs_of(scene, state, data.ctrl)).numpy()
        assert not features[: 2 * scene.model.njnt].any() and features.shape == (scene.num_edges, 21)
        for name, pair in names.items():
            there, back = features[2 * pair], features[2 * pair + 1]
            np.testing.assert_array_equal(there[:18], -back[:18])
            violation, rate, _ = rows(scene, data, name)
            # Which of a pair's nodes is the constraint's first end.
            model, one = scene.model, scene.model.equality(name).id
            end = int(model.eq_obj1id[one])
            body = end if model.eq_objtype[one] == int(mujoco.mjtObj.mjOBJ_BODY) else int(model.site_bodyid[end])
            sign = 1 if scene.body[graph[pair].first] == model.body_weldid[body] else -1
            np.testing.assert_allclose(sign * there[:3], violation[:3], atol=1e-8)
            np.testing.assert_allclose(sign * there[6:9], rate[:3], atol=1e-8)
            np.testing.assert_allclose(there[3:6], np.clip(there[:3] / 0.002, -1, 1), atol=1e-12)
            points = [
                data.xpos[scene.body[node]] + arm[18:]
                for node, arm in ((graph[pair].second, there), (graph[pair].first, back))
            ]
            np.testing.assert_allclose(points[1] - points[0], there[:3], atol=1e-8)
            if len(violation) == 3:
                assert not there[9:18].any()
                continue
            frame, scale = frame_of(scene, data, name), model.eq_data[one, 10]
            turned = sign * there[9:12] @ frame
            either = np.abs(np.stack((turned, -turned)) - 2 * violation[3:] / scale).max(
                1
            )  # a quaternion has two signs
            assert either.min() < 1e-8
            np.testing.assert_allclose(there[12:15], np.clip(there[9:12] / 0.02, -1, 1), atol=1e-12)
            spins = [data.sensordata.reshape(-1, 13)[node, 10:] for node in (graph[pair].first, graph[pair].second)]
            np.testing.assert_allclose(there[15:18], spins[0] - spins[1], atol=1e-8)


def test_a_welds_rotation_is_its_small_angle_and_rate():
    """Against finite differences: near zero the rotation changes as its rate says."""
    scene = zoo.load("constraints")
    feature, pair = bind(Constraints(), scene), [pair.name for pair in scene.pairs].index("glue")
    model, data, step = scene.model, mujoco.MjData(scene.model), 1e-5
    data.qvel[:] = np.random.default_rng(1).normal(size=model.nv)
    found = []
    for _ in range(2):
        mujoco.mj_forward(model, data)
        state = torch.from_numpy(data.sensordata.reshape(scene.num_nodes, 13).copy())
        found.append(feature(inputs_of(scene, state, data.ctrl))[2 * pair].numpy())
        mujoco.mj_integratePos(model, data.qpos, data.qvel, step)
    assert np.abs(found[0][9:12]).max() < 1e-6  # the weld keeps the poses of the model
    np.testing.assert_allclose((found[1][9:12] - found[0][9:12]) / step, found[0][15:18], atol=1e-3)
    np.testing.assert_allclose((found[1][:3] - found[0][:3]) / step, found[0][6:9], atol=1e-3)


@pytest.mark.parametrize("winds", [False, True])
def test_violations_of_joints_and_tendons_are_mujocos(winds):
    """One joint has no limits and may make any number of turns."""
    edits = ('name="b" axis="0 0.2 1" ref="-3"', 'name="b" axis="0 0.2 1" limited="false"')
    scene = zoo.load("constraints", *[edits] * winds)
    assert len(scene.unwrapped.joint) == winds
    model, feature = scene.model, bind(Couplings(), scene)
    at = {"a": ["follow", "ropes", "fixed"], "b": ["follow", "ropes"], "c": ["ropes"], "d": ["held", "ropes", "fixed"]}
    near = {"follow": 0.02, "held": 0.02}
    for data, state in poses(scene, 20):
        features = feature(inputs_of(scene, state, data.ctrl)).unflatten(-1, (3, 5))
        torch.testing.assert_close(features[::2], features[1::2])
        for joint, names in at.items():
            own = features[2 * scene.joint_names.index(joint)].numpy()
            for slot, name in enumerate(names):
                violation, rate, jacobian = rows(scene, data, name)
                dof = model.jnt_dofadr[scene.joint_names.index(joint)]
                np.testing.assert_allclose(own[slot, [0, 3, 4]], [violation[0], rate[0], jacobian[0, dof]], atol=1e-8)
                if name in near:
                    soon = violation[0] + scene.timestep * rate[0]
                    expected = np.clip(np.array([violation[0], soon]) / near[name], -1, 1)
                    np.testing.assert_allclose(own[slot, 1:3], expected, atol=1e-8)
            assert not own[len(names) :].any()
    assert not features[2 * scene.joint_names.index("box")].any()


def test_what_does_not_follow_is_printed_and_left_out():
    text = str(zoo.load("constraints"))
    assert "joints coupled by constraints: follow (a, b), held (d), ropes (a, b, c, d), fixed (a, d)" in text
    assert "without features" not in text
    off = zoo.load("constraints", ('density="1"/>', 'density="1"><flag equality="disable"/></option>'))
    assert "coupled" not in str(off) and not Constraints.suits(off) and not Couplings.suits(off)


def test_scenes_that_constraints_suit():
    suits = {
        "constraints": (True, True),
        "machine": (True, False),
        "cheetah": (False, False),
        "gripper": (False, False),
    }
    for name, expected in suits.items():
        scene = zoo.load(name)
        kinds = [type(each) for each in ForwardModel.for_scene(scene, **SMALL).features]
        assert (Constraints.suits(scene), Couplings.suits(scene)) == expected
        assert Constraints not in kinds and Couplings not in kinds  # by default: rollouts with them diverged
    scene = zoo.load("constraints")
    with pytest.raises(ValueError, match="reads no welds, scene 'constraints' has some"):
        Constraints().bind(scene, BODY_STATE, None)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="reads 1 couplings at each edge, scene 'constraints' has 3"):
        Couplings().bind(scene, BODY_STATE, None)  # pyright: ignore[reportArgumentType]


def test_orientations_of_either_sign_give_the_same(random_states):
    scene = zoo.load("constraints")
    state, at = random_states(scene, 3), BODY_STATE.slices["orientation"]
    turned = torch.cat((state[..., : at.start], -state[..., at], state[..., at.stop :]), dim=-1)
    turned[:, 1] = state[:, 1]  # some of them alone
    for feature in (bind(Constraints(), scene), bind(Couplings(), scene)):
        found = [feature(inputs_of(scene, each, torch.zeros(3, 1))) for each in (state, turned)]
        torch.testing.assert_close(*found)


def test_gradients_are_right_and_finite_where_all_holds():
    scene = zoo.load("constraints")
    kinds = [bind(Constraints(), scene), bind(Couplings(), scene)]
    weights = torch.linspace(-1, 1, 40, dtype=torch.float64)
    check_gradients(scene, kinds, np.zeros(1), weights, count=3, tolerance=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["constraints", "machine"])
def test_the_native_step_runs_constraints(fit, random_states, random_actions, name):
    scene = zoo.load(name, **({"action_bounds": (-1, 1)} if name == "machine" else {}))
    torch.manual_seed(0)
    more = tuple(each for each in (Constraints(), Couplings()) if each.suits(scene))
    features = (*ForwardModel.for_scene(scene, **SMALL).features, *more)
    model = fit(ForwardModel.for_scene(scene, features=features, **SMALL), scene)
    state, action = random_states(scene, 2, 3), random_actions(scene, 2, 3)
    predictor = specialize(model.bind(scene), executor="native")
    assert predictor.reason is None
    expected = model.bind(scene, reference=True).step(state, action)[0]
    torch.testing.assert_close(predictor.step(state, action)[0], expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["constraints", "mirrored_gripper"])
def test_violations_as_small_as_in_data_are_not_magnified(fit, name):
    scene = zoo.load(name)
    features = [feature.resolved(scene) for feature in (Constraints(), Couplings())]
    for feature in features:
        least = feature.least_scales(BODY_STATE)
        assert len(least) == feature.size(BODY_STATE) and max(least) == 1
    model = fit(ForwardModel.for_scene(scene, features=[BodyState(), Controls(), *features], **SMALL), scene)
    least = torch.tensor(sum((feature.least_scales(BODY_STATE) for feature in features), []), dtype=torch.float64)
    std = model.edge_normalizer.std[-len(least) :]
    varies = std > 0
    assert varies.any() and (std >= least)[varies].all() and (std == least)[varies].any()


def test_couplings_of_tendons_that_move_no_joint_have_no_features():
    text = """<mujoco><worldbody><site name="a"/><site name="b" pos="1 0 0"/>
      <body><joint axis="0 1 0"/><geom size=".1" pos=".3 0 0"/></body></worldbody>
      <tendon><spatial name="fixed"><site site="a"/><site site="b"/></spatial></tendon>
      <equality><tendon tendon1="fixed"/></equality></mujoco>"""
    scene = load_scene(text)
    feature = bind(Couplings(), scene)
    state = torch.from_numpy(scene.reference_state)
    assert not feature(inputs_of(scene, state, np.zeros(0))).any()

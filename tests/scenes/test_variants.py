"""Random variants match the paper's table, checked on the compiled models."""

from __future__ import annotations

import json
import warnings

import mujoco
import numpy as np
import pytest
from scipy import stats

from torchrl_gn.scenes import (
    SYSTEMS,
    PhysicalParameters,
    SceneError,
    load_scene,
    make_variants,
    parameter_ranges,
    sample_parameters,
    sample_variants,
    scene_from_description,
)
from torchrl_gn.scenes.physical_parameters import topology

from .. import zoo

LIMBS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
LINKS = ("head", *(f"segment_{i}" for i in range(5)))
FINGERS = (1, 2, 3)
# The SM's table, system by system.
TABLE = {
    "pendulum": {"length": (0.2, 1), "mass": (0.5, 3)},
    "cartpole": {"cart_mass": (0.2, 2), "pole_length": (0.3, 1), "pole_thickness": (0.4, 2.2)},
    "swimmer6": {**{f"length_{link}": (0.3, 2) for link in LINKS}, "thickness": (0.5, 5)},
    "cheetah": {
        **{f"angle_{limb}": (-0.1, 0.1) for limb in LIMBS},
        **{f"length_{body}": (0.5, 2) for body in ("torso", *LIMBS)},
        "thickness": (0.5, 2),
    },
    "jaco": {
        **{f"mass_{body}": (0.5, 1.5) for body in [*(f"b_{i}" for i in range(1, 6)), "hand"]},
        **{f"mass_finger_{i}": (0.5, 1.5) for i in FINGERS},
        **{f"gear_joint_{i}": (0.5, 1.5) for i in range(1, 7)},
        **{f"gear_finger_{i}": (0.5, 1.5) for i in FINGERS},
    },
}
INERTIA = {f"inertia[{i}]" for i in range(3)}
# Which static features may depend on the parameters, and do.
VARYING = {
    "pendulum": ({"mass", *INERTIA, "ipos[2]"}, {"actuator_acc0"}, set()),
    "cartpole": ({"mass", *INERTIA, "ipos[2]"}, {"actuator_acc0"}, set()),
    "swimmer6": (
        {"mass", *INERTIA, "pos[1]"},
        {"jnt_pos[1]", "actuator_acc0"},
        {"parent_anchor", "child_anchor", "joint_pose", "joint"},
    ),
    "cheetah": (
        {"mass", *INERTIA, "pos[0]", "pos[2]", "quat[0]", "quat[2]", "ipos[0]", "ipos[2]"}
        | {f"iquat[{i}]" for i in range(4)},
        {"actuator_acc0"},
        {"parent_anchor", "contact_offset", "contact_radius", "contact_point", "joint_pose"},
    ),
    "jaco": ({"mass", *INERTIA}, {"actuator_gear[0]", "actuator_acc0"}, {"actuator"}),
}
COUNT = 12


@pytest.fixture(scope="module")
def variants():
    """Some variants of every system, made once."""
    return {name: sample_variants(name, COUNT, 0) for name in TABLE}


def volumes(model: mujoco.MjModel) -> np.ndarray:
    """Volume of every geom from its compiled size, cubic metres."""
    kind, found = mujoco.mjtGeom, np.full(model.ngeom, np.nan)
    for geom, (a, b, c) in enumerate(model.geom_size):
        match model.geom_type[geom]:
            case kind.mjGEOM_CAPSULE:
                found[geom] = np.pi * a**2 * 2 * b + 4 / 3 * np.pi * a**3
            case kind.mjGEOM_BOX:
                found[geom] = 8 * a * b * c
    return found


def lowest(model: mujoco.MjModel) -> float:
    """Height of the lowest point of the capsules at the reference."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ends = []
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE):
        axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
        ends += [(data.geom_xpos[geom] + sign * axis)[2] - model.geom_size[geom, 0] for sign in (1, -1)]
    return min(ends)


def arrays(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    found = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    return {name: value for name, value in found.items() if isinstance(value, np.ndarray)}


@pytest.mark.parametrize("system", TABLE)
def test_ranges_are_those_of_the_table_and_reached(system):
    ranges = parameter_ranges(system)
    assert {name: (one.low, one.high) for name, one in ranges.items()} == TABLE[system]
    drawn = sample_parameters(system, 2000, 0)
    for column, one in zip(drawn.T, ranges.values(), strict=True):
        assert one.low <= column.min() and column.max() <= one.high
        assert stats.kstest((column - one.low) / (one.high - one.low), "uniform").pvalue > 1e-4
    correlated = np.corrcoef(drawn.T) - np.eye(len(ranges))
    assert np.abs(correlated).max() < 0.1  # every length, mass and gear on its own
    assert np.array_equal(sample_parameters(system, 20, 0), drawn[:20])
    assert not np.isin(sample_parameters(system, 20, 1), drawn).any()


@pytest.mark.parametrize("system", TABLE)
def test_the_standard_is_among_them(system):
    standard, variant = load_scene(system), load_scene(system, parameters={})
    ours, theirs = (
        {name: value for name, value in arrays(scene.model).items() if not name.startswith(("tex_", "text_"))}
        for scene in (variant, standard)
    )
    assert all(np.array_equal(ours[name], theirs[name], equal_nan=True) for name in ours)
    assert variant.origin["parameters"] == {name: one.standard for name, one in parameter_ranges(system).items()}
    assert variant.fingerprint() == standard.fingerprint()


@pytest.mark.parametrize("system", TABLE)
def test_variants_are_one_graph_and_all_differ(variants, system):
    expected = topology(load_scene(system))
    assert all(topology(scene) == expected for scene in variants[system])
    assert len({scene.fingerprint() for scene in variants[system]}) == COUNT


@pytest.mark.parametrize("system", TABLE)
def test_static_features_differ_where_they_should_and_only_there(variants, system):
    static = load_scene(system).static
    values = [PhysicalParameters.of(scene) for scene in variants[system]]
    differs = {
        name: np.ptp(np.stack([getattr(one, name) for one in values]), axis=0) > 1e-12
        for name in PhysicalParameters._fields
    }
    columns = {
        part: {
            name
            for name, any_row in zip(names, differs.pop(part).reshape(-1, len(names)).any(0), strict=True)
            if any_row
        }
        for part, names in (
            ("nodes", static.node_names),
            ("edges", static.edge_names),
            ("globals_", static.global_names),
        )
    }
    nodes, edges, others = VARYING[system]
    assert (columns["nodes"], columns["edges"], columns["globals_"]) == (nodes, edges, set())
    assert {name for name, where in differs.items() if where.any()} == others


def test_pendulum(variants):
    for scene in variants["pendulum"]:
        length, mass = scene.origin["parameters"].values()
        model = scene.model
        np.testing.assert_allclose(model.body("pole").mass, mass, rtol=1e-12)
        np.testing.assert_allclose(model.body("pole").ipos, [0, 0, 0.5 * length], atol=1e-12)
        np.testing.assert_allclose(model.body("pole").inertia, 0.4 * mass * 0.05**2, rtol=1e-9)
        np.testing.assert_allclose(model.geom("pole").size[:2], [0.02, 0.25 * length], rtol=1e-12)


def test_cartpole(variants):
    standard = load_scene("cartpole").model
    density = 0.1 / volumes(standard)[standard.geom("pole_1").id]
    for scene in variants["cartpole"]:
        cart, length, thickness = scene.origin["parameters"].values()
        model = scene.model
        np.testing.assert_allclose(model.body("cart").mass, cart, rtol=1e-12)
        assert np.array_equal(model.geom("cart").size, standard.geom("cart").size)
        np.testing.assert_allclose(model.geom("pole_1").size[:2], [0.045 * thickness, 0.5 * length], rtol=1e-12)
        np.testing.assert_allclose(model.body("pole_1").mass, density * volumes(model)[model.geom("pole_1").id])
        np.testing.assert_allclose(model.body("pole_1").ipos, [0, 0, 0.5 * length], atol=1e-12)


def test_swimmer(variants):
    density = 0.01 / (8 * 0.001 * 0.05 * 0.01)
    for scene in variants["swimmer6"]:
        *lengths, thickness = scene.origin["parameters"].values()
        model, half = scene.model, 0.05 * np.array(lengths)
        box = model.geom_size[[model.geom(name).id for name in ("inertial", *(f"inertial_{i}" for i in range(5)))]]
        np.testing.assert_allclose(box[:, 1], half, rtol=1e-12)
        np.testing.assert_allclose(box[:, [0, 2]], [[0.001 * thickness, 0.01 * thickness]] * 6, rtol=1e-12)
        np.testing.assert_allclose(model.body_mass[1:], 8 * density * box.prod(1), rtol=1e-12)
        extent = np.stack([box[:, 1] ** 2 + box[:, 2] ** 2, box[:, 0] ** 2 + box[:, 2] ** 2, (box[:, :2] ** 2).sum(1)])
        np.testing.assert_allclose(model.body_inertia[1:], (model.body_mass[1:] * extent / 3).T, rtol=1e-9)
        # Joints sit at the ends of both links.
        np.testing.assert_allclose(scene.joint_anchors.parent_anchor[2:], np.eye(3)[[1]] * half[:-1, None], atol=1e-15)
        np.testing.assert_allclose(scene.joint_anchors.child_anchor[2:], np.eye(3)[[1]] * -half[1:, None], atol=1e-15)


def test_cheetah(variants):
    standard = load_scene("cheetah")
    clearance, moving = lowest(standard.model), np.arange(1, standard.model.ngeom)
    density = standard.model.body_mass.sum() / volumes(standard.model)[moving].sum()
    for scene in variants["cheetah"]:
        model, parameters = scene.model, scene.origin["parameters"]
        mass = np.bincount(model.geom_bodyid[moving], density * volumes(model)[moving])
        np.testing.assert_allclose(model.body_mass, mass, rtol=1e-9)
        names = ("torso", *LIMBS)
        lengths = np.array([parameters[f"length_{name}"] for name in names])
        size = standard.model.geom_size[moving] * [parameters["thickness"], 1, 1]
        size[:, 1] *= lengths[model.geom_bodyid[moving] - 1]
        np.testing.assert_allclose(model.geom_size[moving], size, rtol=1e-12)
        # The points that can touch the ground keep their order.
        offset, expected = (PhysicalParameters.of(one).contact_offset[1:].numpy() for one in (scene, standard))
        np.testing.assert_allclose(offset, expected * lengths[:, None, None], atol=1e-12)
        for node in range(2, scene.num_nodes):
            expected = standard.joint_anchors.parent_anchor[node] * lengths[scene.parent[node] - 1]
            np.testing.assert_allclose(scene.joint_anchors.parent_anchor[node], expected, atol=1e-12)
            half = 0.5 * parameters[f"angle_{scene.node_names[node]}"]
            np.testing.assert_allclose(model.body_quat[node], [np.cos(half), 0, np.sin(half), 0], atol=1e-15)
        assert lowest(model) == pytest.approx(clearance, abs=1e-9)


def test_jaco(variants):
    standard = load_scene("jaco")
    column = standard.static.node_names.index("mass")
    inertia = [standard.static.node_names.index(name) for name in sorted(INERTIA)]
    for scene in variants["jaco"]:
        factors = np.array(list(scene.origin["parameters"].values()))
        mass = standard.static.nodes[1:, column] * factors[:9]
        np.testing.assert_allclose(scene.static.nodes[1:, column], mass, rtol=1e-9)
        expected = standard.static.nodes[1:, inertia] * factors[:9, None]
        np.testing.assert_allclose(scene.static.nodes[1:, inertia], expected, rtol=1e-6)
        np.testing.assert_allclose(scene.model.actuator_gear[:, 0], factors[9:], rtol=1e-12)


@pytest.mark.parametrize("system", TABLE)
def test_a_variant_is_rebuilt_bit_for_bit_from_its_description(variants, system):
    scene = variants[system][3]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = scene_from_description(json.loads(json.dumps(scene.description())))
    assert again.origin == scene.origin and again.name == system
    ours, theirs = arrays(scene.model), arrays(again.model)
    assert all(np.array_equal(ours[name], theirs[name], equal_nan=True) for name in ours)
    for name, value in PhysicalParameters.of(scene)._asdict().items():
        assert np.array_equal(value, getattr(PhysicalParameters.of(again), name))


def test_any_number_of_links_and_values_beyond_the_ranges():
    assert sample_variants("swimmer4", 1, 0)[0].num_nodes == 5
    long = load_scene("pendulum", parameters={"length": 3}, timestep=0.04, name="long")
    assert (long.name, long.substeps) == ("long", 2)
    assert long.model.body("pole").ipos[2] == pytest.approx(1.5)
    again = scene_from_description(long.description())
    assert (again.name, again.substeps, again.origin) == ("long", 2, long.origin)


def test_what_has_no_parameters_is_refused_and_named():
    for system in ("acrobot", "walker2d"):
        for attempt in (
            lambda name=system: sample_variants(name, 1, 0),
            lambda name=system: load_scene(name, parameters={}),
        ):
            with pytest.raises(ValueError, match=f"'{system}' has no.*: pendulum, cartpole, swimmerN, cheetah, jaco"):
                attempt()
    assert {name for name in SYSTEMS if name in TABLE} == set(SYSTEMS) - {"acrobot", "walker2d"}
    text = zoo.mjcf("pole")
    for source in (text, "robot.xml", mujoco.MjSpec.from_string(text)):
        with pytest.raises(ValueError, match="has no parameters to vary; these systems have: pendulum"):
            load_scene(source, parameters={"length": 1})
    with pytest.raises(
        ValueError, match=r"'pendulum' has no parameters \['lenght'\]; use some of \['length', 'mass'\]"
    ):
        load_scene("pendulum", parameters={"lenght": 1})
    for bad in (0, -1, np.nan, np.inf):
        with pytest.raises(ValueError, match="mass of 'pendulum' must be a finite factor above 0"):
            load_scene("pendulum", parameters={"mass": bad})
    with pytest.raises(ValueError, match="angle_bfoot of 'cheetah' must be a finite angle, got nan"):
        load_scene("cheetah", parameters={"angle_bfoot": np.nan})
    with pytest.raises(ValueError, match=r"must be \[count, 2\], got \[3\]"):
        make_variants("pendulum", np.ones(3))
    with pytest.raises(ValueError, match="count must not be negative"):
        sample_variants("pendulum", -1, 0)
    with pytest.raises(SceneError, match=r"timestep=0\.03"):
        sample_variants("pendulum", 1, 0, timestep=0.03)

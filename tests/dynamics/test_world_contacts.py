"""Features of contacts with the world against MuJoCo's distances and contacts."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.dynamics import Canonicalizer, Contacts, ForwardModel, WorldContacts, contacts_of, specialize
from torchrl_gn.dynamics.features import StepInputs
from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.scenes import PhysicalParameters, Scene, load_scene

from .. import zoo
from ..sizes import SMALL

WORLD = """<geom name="floor" type="plane" size="9 9 1" pos="0 0 -.3" euler="0 5 0"/>
  <geom name="step" type="box" size=".3 .4 .2" pos=".2 .1 0" euler="10 20 30"/>
  <geom name="ball" size=".3" pos="-.5 0 0"/><geom type="capsule" size=".1 .4" pos="0 -.7 .1" euler="70 20 0"/>"""
SLOPE = '<geom name="floor" type="plane" size="9 9 1" pos="0 0 .2" euler="20 5 0"/>'
CUBE = '<geom name="body" type="box" size=".1 .2 .3" pos=".1 0 .05" euler="10 0 20"/>'
BODIES = {
    "sphere": '<geom name="body" size=".05" pos=".1 0 0"/>',
    "capsule": '<geom name="body" type="capsule" size=".05 .2" pos=".1 0 0" euler="40 0 0"/>',
    "box": CUBE,
    "cylinder": '<geom name="body" type="cylinder" size=".15 .05" pos=".1 0 0" euler="40 0 0"/>',
    "ellipsoid": '<geom name="body" type="ellipsoid" size=".15 .05 .1" pos=".1 0 0" euler="40 0 0"/>',
}


def scene(body: str, world: str = WORLD, options: str = "") -> Scene:
    free = f'<body name="free" pos="0 0 2"><freejoint/>{body}</body>'
    return load_scene(f"<mujoco>{options}<worldbody>{world}{free}</worldbody></mujoco>")


def seen(scene: Scene, state, parameters=None, *, yaw: bool = False):
    """Features ``[*B, N, 8, 11]``."""
    parameters = PhysicalParameters.of(scene) if parameters is None else parameters
    canonical = Canonicalizer(recenter=yaw, yaw=yaw).bind(scene, BODY_STATE)
    inputs = StepInputs(canonical(state, parameters), torch.empty(0), parameters)
    return WorldContacts().bind(scene, BODY_STATE, canonical)(inputs).unflatten(-1, (8, 11))


def states(scene: Scene, count: int):
    """MuJoCo's data and states of a free body in random poses."""
    data, rng = mujoco.MjData(scene.model), np.random.default_rng(0)
    for _ in range(count):
        data.qpos[:3], data.qpos[3:] = rng.uniform([-1, -1, -0.2], [1, 1, 1]), rng.normal(size=4)
        data.qvel[:] = rng.normal(size=6)
        mujoco.mj_forward(scene.model, data)
        yield data, observed(scene, data)


def observed(scene: Scene, data) -> torch.Tensor:
    return torch.from_numpy(data.sensordata.reshape(scene.num_nodes, 13).copy())


@pytest.mark.parametrize(
    ("kind", "world"),
    [("sphere", WORLD), ("capsule", WORLD), *((kind, SLOPE) for kind in ("box", "cylinder", "ellipsoid", "capsule"))],
)
def test_gaps_and_normals_are_mujocos(kind, world):
    given, compared = scene(BODIES[kind], world), 0
    model, ends = given.model, np.zeros(6)
    body = model.geom("body").id
    for data, state in states(given, 60):
        others = [geom for geom in range(model.ngeom) if geom != body]
        gaps = [mujoco.mj_geomDistance(model, data, geom, body, 10, None) for geom in others]
        nearest = int(np.argmin(gaps))
        if not 1e-4 < gaps[nearest] < 0.49:
            continue
        features = seen(given, state)[1]
        point = int(features[:, 0].argmax())
        assert 0.5 - features[point, 0] == pytest.approx(gaps[nearest], abs=1e-6)
        assert features[point, 1] == pytest.approx(1 - min(gaps[nearest] / 0.02, 1), abs=1e-4)
        if (share := features[point, 7:10].norm()) > 0.01:
            mujoco.mj_geomDistance(model, data, others[nearest], body, 10, ends)
            normal = (ends[3:] - ends[:3]) / gaps[nearest]
            np.testing.assert_allclose(features[point, 7:10] / share, normal, atol=1e-4)
            compared += 1
    assert compared > 5


MOVES = pytest.mark.skipif(
    not hasattr(mujoco.MjModel, "geom_surfacevel"), reason="MuJoCo before 3.11 moves no surfaces"
)


@pytest.mark.parametrize(
    ("world", "own"),
    [
        ("", ""),
        pytest.param('surfacevel="1 -.5 .2 .3 .4 2"', "", marks=MOVES),
        pytest.param("", 'surfacevel=".4 .1 -1 2 1 .5"', marks=MOVES),
        pytest.param('surfacevel="1 -.5 .2 .3 .4 2"', 'surfacevel=".4 .1 -1 2 1 .5"', marks=MOVES),
    ],
)
@pytest.mark.parametrize("surface", ["plane", "box"])
def test_velocities_are_those_of_mujocos_contacts(surface, world, own):
    """Velocities are relative to the touched surface, as those in MuJoCo's friction."""
    size = "9 9 1" if surface == "plane" else "2 2 1"
    at = f'<geom name="floor" type="{surface}" size="{size}" pos=".3 .1 .2" euler="20 5 10" {world}/>'
    given = scene(
        f'<geom name="body" size=".1" pos=".1 0 .2" euler="10 50 20" {own}/>', at, '<option cone="elliptic"/>'
    )
    model, rng = given.model, np.random.default_rng(0)
    for data, _ in states(given, 10):
        on = np.array([*rng.uniform(-1, 1, 2), 0.1 - 1e-7 + (surface == "box")])
        data.qpos[:3] += data.geom_xpos[0] + data.geom_xmat[0].reshape(3, 3) @ on - data.geom_xpos[1]
        mujoco.mj_forward(model, data)
        assert data.ncon == 1 and abs(data.contact.dist[0]) < 1e-6
        point = seen(given, observed(given, data))[1, 0].numpy()
        frame = data.contact.frame[0].reshape(3, 3) * (1 if data.contact.geom[0, 0] == 0 else -1)
        away, *along = data.efc_vel[:3]  # of the contact's second geom
        np.testing.assert_allclose(point[3], away, atol=1e-5)
        np.testing.assert_allclose(point[4:7], frame[1:].T @ along, atol=1e-5)
        soon = (1e-7 - given.timestep * point[3]) / 0.02
        assert point[2] == pytest.approx(1 + np.clip(soon, -1, 1), abs=1e-4)
        assert point[10] == 1  # friction


def test_the_nearest_surface_is_shown_and_far_ones_are_not():
    given = scene(BODIES["sphere"])
    state = torch.zeros(3, 2, 13, dtype=torch.float64)
    state[..., 3] = 1
    state[:, 1, :3] = torch.tensor([[-0.6, 0.0, 0.36], [5.0, 0, 3], [-0.6, 0, 0.5]])
    features = seen(given, state)
    assert (features[:, 0] == 0).all() and (features[:, :, 1:] == 0).all() and (features[1] == 0).all()
    torch.testing.assert_close(features[0, 1, 0, 7:10], torch.tensor([0.0, 0, 1], dtype=torch.float64))  # of the ball
    assert features[2, 1, 0, 0] == pytest.approx(0.35) and (features[2, 1, 0, 1:] == 0).all()
    # Falling, it arrives within the step.
    state[2, 1, 9] = -0.15 / given.timestep
    assert features[2, 1, 0, 2] == 0 and seen(given, state)[2, 1, 0, 2] == pytest.approx(1)


def test_capsules_lie_on_edges_of_boxes():
    """A capsule across a step touches it between its ends."""
    given = scene('<geom type="capsule" size=".05 .5" euler="0 90 0"/>', '<geom type="box" size=".1 1 .2"/>')
    state = torch.zeros(2, 13, dtype=torch.float64)
    state[:, 3], state[1, 2] = 1, 0.26
    assert (0.5 - seen(given, state)[1, :, 0]).min() == pytest.approx(0.01)


def test_hulls_are_those_of_mujoco():
    corners = " ".join(f"{x} {y} {z}" for x in (-0.3, 0.3) for y in (-0.4, 0.4) for z in (-0.2, 0.2))
    asset = f'<asset><mesh name="block" vertex="{corners}"/></asset>'
    mesh = scene(BODIES["sphere"], '<geom type="mesh" mesh="block" euler="10 20 30"/>', asset)
    exact = 0
    for data, state in states(mesh, 60):
        gap = mujoco.mj_geomDistance(mesh.model, data, 0, 1, 10, None)
        found = 0.5 - float(seen(mesh, state)[1, 0, 0])
        if 0 < gap < 0.4:
            assert found < gap + 1e-6  # less beside edges
            exact += found > gap - 1e-6
    assert exact > 3


@pytest.mark.parametrize("name", ["crawler", "everything", "odd"])
def test_they_turn_and_shift_with_a_scene_as_far_as_this_is_invariant(name, random_states):
    """Numbers in the canonical frame are those in the world, vectors rotated with the bodies."""
    given = zoo.load(name)
    state = random_states(given, 10, seed=3)
    parameters = PhysicalParameters.of(given)
    canonical = Canonicalizer().bind(given, BODY_STATE)(state, parameters)
    found, true = seen(given, state, yaw=True), seen(given, state)
    scalars = [0, 1, 2, 3, 10]
    torch.testing.assert_close(found[..., scalars], true[..., scalars])
    for first in (4, 7):
        vectors = true[..., first : first + 3]
        if canonical.rotation is not None:
            vectors = (canonical.rotation.matrix.mT[:, None, None] @ vectors.unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(found[..., first : first + 3], vectors)
    moved = state.clone()
    moved[:, 1:, :3] += 3 * torch.as_tensor(given.translation_invariant)
    torch.testing.assert_close(seen(given, moved), true)
    assert true.any()


@pytest.mark.parametrize("name", ["everything", "odd", "pusher", "plane"])
def test_surfaces_that_bound_a_scene_break_its_invariance(name):
    """Beside boxes and hills the place counts, which the network then sees."""
    given = zoo.load(name)
    kinds = {surface.kind for surface in given.world_contacts.surfaces}
    assert kinds
    if kinds != {"plane"}:
        assert not given.translation_invariant.any() or name == "pusher"
        assert given.yaw_frame is None or not given.yaw_frame.exact


def test_they_are_shown_of_scenes_whose_contacts_one_plane_does_not_have():
    suits = {"cheetah": False, "walker2d": False, "jaco": False, "swimmer6": False, "plane": True, "everything": True}
    for name, expected in suits.items():
        given = zoo.load(name)
        assert WorldContacts.suits(given) == expected, name
        assert contacts_of([given]) == (WorldContacts() if expected else Contacts())
        kinds = {type(each) for each in ForwardModel.for_scene(given, **SMALL).features}
        assert (WorldContacts in kinds) == expected and (Contacts in kinds) != expected


@pytest.mark.parametrize("kind", BODIES)
def test_gradients_are_right(kind):
    given = scene(BODIES[kind], WORLD + '<geom type="cylinder" size=".2 .3" pos=".8 .8 0" euler="40 10 0"/>')
    weights = torch.linspace(-1, 1, 11, dtype=torch.float64)
    for _, state in states(given, 5):
        change = torch.randn(2, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

        def along(step, state=state, change=change):
            return (seen(given, BODY_STATE.apply(state, step * change)) * weights).sum()

        zero = torch.zeros((), dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(along, zero, atol=1e-4, rtol=1e-4)


def test_samples_bring_points_and_surfaces_of_their_own():
    large, small = (
        scene(CUBE, WORLD),
        scene(CUBE.replace(".1 .2 .3", ".1 .1 .2"), WORLD.replace(".3 .4 .2", ".3 .4 .3")),
    )
    state = torch.stack([each for _, each in states(large, 10)])
    there = PhysicalParameters.of(small)
    torch.testing.assert_close(seen(large, state, there), seen(small, state), rtol=0, atol=1e-12)
    assert not torch.equal(seen(large, state), seen(small, state))


HILLS = '<asset><hfield name="h" nrow="3" ncol="3" size="2 2 .3 .1" elevation="0 1 0 1 0 1 0 0 1"/></asset>'


FLAT = HILLS.replace("0 1 0 1 0 1 0 0 1", "0 0 0 0 0 0 0 0 0")


@pytest.mark.parametrize("kind", ["sphere", "capsule", "box", "cylinder", "hills", "flat"])
def test_native_steps_are_those_of_torch(fit, kind, random_states):
    """All surfaces have a scalar form, also height fields, whose cells depend on the state."""
    hills, field = kind == "hills", kind in ("hills", "flat")
    world = (
        WORLD
        + '<geom type="cylinder" size=".2 .3" pos=".8 .8 0"/><geom type="ellipsoid" size=".2 .3 .1" pos="-1 1 0"/>'
    )
    world = world + '<geom type="hfield" hfield="h"/>' * field
    given = scene(BODIES["sphere" if field else kind], world, (HILLS if hills else FLAT) * field)
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(given, **SMALL), given).bind(given)
    predictor = specialize(model, executor="native")
    assert predictor.reason is None
    state = random_states(given, 2, 3)
    state[..., 1, 2] = 0.3
    action = state.new_zeros(2, 3, 0)
    expected = model.step(state, action)[0]
    torch.testing.assert_close(predictor.step(state, action)[0], expected, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_native_steps_read_each_samples_own_points_and_surfaces(fit, random_states):
    given = scene(CUBE, WORLD)
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(given, **SMALL), given).bind(given, parameters_key="parameters")
    parameters = model.own_parameters().expand(4).clone()
    scale = torch.linspace(0.8, 1.2, 4, dtype=torch.float64)
    for name in ("contact_point", "contact_pair"):
        parameters[name] *= scale.view(-1, *[1] * (parameters[name].ndim - 1))
    parameters["surface"][..., 12:16] *= scale.view(-1, 1, 1)
    state = random_states(given, 4)
    state[:, 1, :3] = torch.tensor([0.2, 0.1, 0.45])
    action = state.new_zeros(4, 0)
    expected = model.step(state, action, parameters)[0]
    predictor = specialize(model, executor="native")
    torch.testing.assert_close(predictor.step(state, action, parameters)[0], expected, rtol=0, atol=1e-6)
    own = model.step(state, action, model.own_parameters().expand(4))[0]
    assert (expected - own)[[0, 3]].abs().max() > 1e-4


def test_either_sign_of_an_orientation_gives_the_same(random_states):
    given = zoo.load("plane")
    state = random_states(given, 4)
    turned = torch.cat((state[..., :3], -state[..., 3:7], state[..., 7:]), dim=-1)
    assert quaternion.angle(turned[..., 3:7], state[..., 3:7]).max() < 1e-12
    torch.testing.assert_close(seen(given, turned), seen(given, state))


PUCK = """<mujoco><option><flag filterparent="disable"/></option><worldbody><body name="table" pos="0 0 .4">
  <geom name="top" type="box" size=".5 .5 .05"/><body name="puck" pos="0 0 .1"><joint type="slide" axis="1 0 0"/>
  <joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/><geom name="puck" size=".03"/>
  <body name="knob" pos="0 0 .03"><joint axis="0 1 0"/><geom name="knob" size=".02" pos="0 .1 0"/></body></body></body>
  </worldbody></mujoco>"""


def test_a_puck_touches_the_table_that_carries_it():
    given = load_scene(PUCK)
    assert "  touch top (box): puck, knob" in str(given)
    model, data = given.model, mujoco.MjData(given.model)
    top, ends = model.geom("top").id, np.zeros(6)
    for height in (-0.02, 0.0, 0.1):
        data.qpos[:3] = 0.1, 0.2, height
        mujoco.mj_forward(model, data)
        features = seen(given, observed(given, data))
        for node, name in ((1, "puck"), (2, "knob")):
            gap = mujoco.mj_geomDistance(model, data, top, model.geom(name).id, 10, ends)
            assert 0.5 - features[node, 0, 0] == pytest.approx(gap, abs=1e-9)


def test_a_robot_does_not_touch_its_own_base():
    arm = PUCK.replace('<joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>', "")
    assert not load_scene(arm).world_contacts.surfaces


@pytest.mark.parametrize("margin", [0.001, 0.05])
def test_forces_that_set_in_far_above_the_plane_are_shown_where_they_do(margin):
    """Features of one plane are clipped 2 cm from its surface."""
    given = load_scene(
        f"""<mujoco><worldbody><geom type="plane" size="3 3 1"/>
        <body pos="0 0 1"><freejoint/><geom size=".1" margin="{margin}"/></body></worldbody></mujoco>"""
    )
    assert WorldContacts.suits(given) == (margin > 0.01)
    data = mujoco.MjData(given.model)
    data.qpos[2] = 0.1 + margin + 0.01
    mujoco.mj_forward(given.model, data)
    assert 0.5 - seen(given, observed(given, data))[1, 0, 0] == pytest.approx(0.01)
    data.qpos[2] -= 0.011
    mujoco.mj_forward(given.model, data)
    assert data.efc_pos[0] - data.efc_margin[0] == pytest.approx(-0.001)
    assert seen(given, observed(given, data))[1, 0, 1] == pytest.approx(1 + 0.001 / 0.02)


@pytest.mark.parametrize("corners", [8, 20])
def test_meshes_with_more_corners_than_points_are_named(corners):
    turns = 2 * np.pi * np.arange(corners) / corners
    ring = np.stack((0.1 * np.cos(turns), 0.1 * np.sin(turns), 0.05 * (-1.0) ** np.arange(corners)), axis=1)
    vertices = " ".join(f"{value:.6f}" for value in ring.ravel())
    given = load_scene(
        f"""<mujoco><asset><mesh name="m" vertex="{vertices}"/></asset><worldbody><geom type="plane" size="3 3 1"/>
        <body name="gem" pos="0 0 1"><freejoint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
    )
    named = "more than 8 contact points, of which some are shown: gem" in str(given)
    assert named == (corners > 8) and len(given.world_contacts.geom) == 8

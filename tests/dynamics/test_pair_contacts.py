"""Features of bodies that can touch: distances against MuJoCo's, velocities, edges, and every executor alike."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import (
    BodyState,
    Contacts,
    Controls,
    ForwardModel,
    JointAxes,
    PairContacts,
    specialize,
    trees_can_touch,
)
from torchrl_gn.dynamics.bound import static_graph, update_dynamic_normalizers, update_parameter_normalizers
from torchrl_gn.dynamics.executors import NativeExecutor, eager
from torchrl_gn.dynamics.features import graph_edges
from torchrl_gn.dynamics.features.pair_contacts import BoundPairContacts
from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.scenes import load_scene, sample_variants
from torchrl_gn.scenes.contact_pairs import _configurations
from torchrl_gn.training import load_pretrained, save_checkpoint

from .. import zoo
from ..compiling import compiles

FEATURES = (BodyState(), Controls(), JointAxes(), Contacts(), PairContacts())
BOUNDS = {torch.float64: 1e-10, torch.float32: 1e-5}
TWO_FAR = """<mujoco><worldbody>
    <body name="one"><joint type="hinge" axis="0 1 0"/><geom size=".1"/></body>
    <body name="two" pos="5 0 0"><joint type="hinge" axis="0 1 0"/><geom size=".1"/></body>
</worldbody></mujoco>"""
GEOMS = {
    "sphere": 'type="sphere" size=".05"',
    "capsule": 'type="capsule" size=".03 .1"',
    "box": 'type="box" size=".05 .08 .03"',
    "ellipsoid": 'type="ellipsoid" size=".03 .04 .1"',
    "cylinder": 'type="cylinder" size=".03 .1"',
    "mesh": 'type="mesh" mesh="block"',
}
load = functools.cache(lambda: zoo.load("pusher", timestep=0.02))


def two_bodies(first: str, second: str):
    bodies = "".join(
        f'<body pos="0 0 {height}"><freejoint/><geom {GEOMS[kind]} pos=".01 .02 -.03" euler="20 30 40"/></body>'
        for height, kind in enumerate((first, second))
    )
    corners = " ".join(f"{x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.05, 0.05) for z in (-0.02, 0.02))
    mesh = f'<asset><mesh name="block" vertex="{corners}"/></asset>'
    return load_scene(f"<mujoco>{mesh}<worldbody>{bodies}</worldbody></mujoco>")


@pytest.fixture(scope="module")
def sampled():
    """States of random trajectories in which the finger pushes the box, and actions."""
    data = collect_trajectories(load(), 20, 100)
    return data["state"], data["action"]


@pytest.fixture
def fitted(sampled):
    """A small model with these statistics."""

    def make(dtype=torch.float64, features=FEATURES, **options) -> ForwardModel:
        torch.manual_seed(0)
        model = ForwardModel.for_scene(load(), features=features, **({"hidden": 16} | options)).to(dtype)
        bound, (state, action) = model.bind(load()), sampled
        update_parameter_normalizers(bound)
        flat = (each.flatten(0, 1) for each in (state[:, :-1], action, state[:, 1:]))
        update_dynamic_normalizers(bound, *flat)
        return model.requires_grad_(False)

    return make


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second", "mean", "largest"),
    [
        ("sphere", "sphere", 1e-9, 1e-9),
        ("sphere", "capsule", 1e-9, 1e-9),
        ("sphere", "box", 1e-9, 1e-9),
        ("capsule", "capsule", 1e-9, 1e-9),
        ("capsule", "box", 1e-5, 3e-3),  # an end in place of the nearest point less than 5 mm away
        ("box", "box", 4e-3, 4e-2),  # edges that cross are not seen
        ("sphere", "ellipsoid", 1e-2, 2e-2),
        ("sphere", "cylinder", 1e-2, 2e-2),
        ("sphere", "mesh", 1e-6, 1e-5),  # MuJoCo's distance of meshes is iterative
    ],
)
def test_distances_are_those_of_mujoco(first, second, mean, largest):
    scene = two_bodies(first, second)
    model, data = scene.model, mujoco.MjData(scene.model)
    bound, errors = BoundPairContacts(scene, 2), []
    for _ in _configurations(model, data):
        ends = np.zeros(6)
        distance = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, ends)
        if 1e-3 < distance < 0.1:
            position, frame = torch.tensor(data.xpos[scene.body]), torch.tensor(data.xmat[scene.body]).view(-1, 3, 3)
            found = bound.nearest(position, frame)[0, 0].numpy()
            errors.append(abs(found[0] - distance))
            if largest <= 1e-9:
                normal = (ends[3:] - ends[:3]) / distance
                np.testing.assert_allclose(found[1:4], normal, atol=1e-5)
                np.testing.assert_allclose(found[4:], (ends[:3] + ends[3:]) / 2, atol=1e-5)
    assert len(errors) > 50 and np.mean(errors) < mean and np.max(errors) < largest


def edge_features(scene, state, action):
    """Features of the added edges, ``[*B, 2 P, K, 13]``."""
    program = ForwardModel.for_scene(scene, features=FEATURES, latent=4, hidden=4).bind(scene).program()
    edges = eager.features(program, program.canonicalizer(state, program.parameters), action)[1]
    assert (edges[:, : scene.num_edges, -26:] == 0).all() and (edges[:, scene.num_edges :, :-26] == 0).all()
    return edges[:, scene.num_edges :, -26:].unflatten(-1, (2, 13))


def test_added_edges_are_the_last_and_marked():
    scene = load()
    model = ForwardModel.for_scene(scene, features=FEATURES, latent=4, hidden=4)
    bound = model.bind(scene)
    update_parameter_normalizers(bound)
    index = bound.incidence.edge_index
    assert index.shape[1] == scene.num_edges + 2 * len(scene.contact_pairs.nodes)
    np.testing.assert_array_equal(index[:, : scene.num_edges], [scene.senders, scene.receivers])
    added = index[:, scene.num_edges :].T
    np.testing.assert_array_equal(added[::2], scene.contact_pairs.nodes)
    np.testing.assert_array_equal(added[1::2], scene.contact_pairs.nodes[:, ::-1])
    static = static_graph(bound, bound.scene_parameters).edges
    assert static[:, -1].tolist() == [0.0] * scene.num_edges + [1.0] * len(added)
    assert (static[scene.num_edges :, :-1] == 0).all() and (static[: scene.num_edges, :-1] != 0).any()


def test_what_the_features_are(sampled):
    scene, (states, actions) = load(), sampled
    state, action = states[:, :-1].flatten(0, 1), actions.flatten(0, 1)
    found = edge_features(scene, state, action)
    forth, back = found[:, ::2], found[:, 1::2]
    for part, sign in ((slice(0, 4), 1), (slice(4, 10), -1)):
        torch.testing.assert_close(back[..., part], sign * forth[..., part])
    near = forth[..., 0] > 0.08  # within 2 cm
    names = [tuple(scene.node_names[node] for node in nodes) for nodes in scene.contact_pairs.nodes]
    assert near[:, names.index(("world", "box")), 0].float().mean() > 0.95
    assert near[:, names.index(("link", "box"))].any(-1).sum() > 50
    # Where bodies are near: closing speeds and velocities against differences along the bodies' motion.
    step = 1e-6
    change = step * torch.cat((state[..., 7:], torch.zeros_like(state[..., 7:])), dim=-1)
    later = edge_features(scene, BODY_STATE.apply(state, change), action)
    rate = -(later[:, ::2, :, 0] - forth[..., 0]) / step
    assert ((rate - forth[..., 3]).abs()[near] < 1e-3).float().mean() > 0.99  # but where the nearest place changes
    distance = 0.1 - forth[..., 0]
    soon = distance + scene.timestep * forth[..., 3]
    for column, value in ((1, distance), (2, soon)):
        torch.testing.assert_close(forth[..., column][near], (1 - (value / 0.02).clamp(-1, 1))[near])
    normal = forth[..., 7:10][near]
    torch.testing.assert_close(normal.norm(dim=-1), torch.ones(len(normal), dtype=torch.float64))
    assert (forth[..., 4:7][near] * normal).sum(-1).abs().max() < 1e-9  # along the surface
    box, table = forth[:, names.index(("world", "box"))], torch.tensor([0.0, 0, 1], dtype=torch.float64)
    on_it = near[:, names.index(("world", "box"))]
    assert (box[..., 7:10][on_it] @ table > 0.99).float().mean() > 0.95  # the table pushes the box up


def test_far_bodies_have_no_features(sampled):
    state, action = (each[:, 0].clone() for each in sampled)
    state[:, 3, :3] += torch.tensor([0.0, 0.0, 3.0])
    found = edge_features(load(), state, action)
    box = load().contact_pairs.nodes[:, 1] == 3
    assert (found[:, np.repeat(box, 2)] == 0).all() and (found != 0).any()


def test_a_turned_scene_has_turned_features(sampled):
    """Distances and speeds stay, vectors turn along."""
    state, action = (each[:, 50] for each in sampled)
    scene = load()
    turn = quaternion.normalize(torch.tensor([1.0, 0.3, -0.5, 0.2], dtype=torch.float64)).expand(len(state), 4)
    seen = edge_features(scene, state, action)
    turned = edge_features(scene, BODY_STATE.rotate(state, turn), action)
    torch.testing.assert_close(turned[..., :4], seen[..., :4], rtol=0, atol=1e-7)
    for start in (4, 7, 10):
        vector = seen[..., start : start + 3]
        expected = quaternion.rotate(turn[:, None, None].expand(*vector.shape[:-1], 4), vector)
        torch.testing.assert_close(turned[..., start : start + 3], expected, rtol=0, atol=1e-7)


def vjp(predictor, state, actions):
    leaves = [each.detach().clone().requires_grad_() for each in (state, actions)]
    states = predictor.rollout(*leaves)[0]
    weights = torch.randn(states[0].shape, generator=torch.Generator().manual_seed(7), dtype=states.dtype)
    gradients = torch.autograd.grad((states * weights).sum(), leaves)
    return [(states[..., 1:, :, :] - states[..., :1, :, :]).detach(), *gradients]


def compare(fitted, sampled, executor, dtype, **options):
    model = fitted(dtype, **options)
    reference, fast = model.bind(load(), reference=True), specialize(model.bind(load()), executor=executor)
    states, actions = sampled
    state, actions = states[:, 40], actions[:, 40:43]
    expected, found = vjp(reference, state, actions), vjp(fast, state, actions)
    varies = torch.ones(4, 13, dtype=torch.bool)
    varies[0] = False
    varies[1, 2:7] = varies[1, 9:] = varies[2, 2] = varies[2, 9:12] = False
    varies[2:, 4:6] = varies[3, 10:12] = False
    for got, wanted in zip(found, expected, strict=True):
        if got.shape[1:] == varies.shape:
            got, wanted = got * varies, wanted * varies
        assert (got - wanted).norm() <= BOUNDS[dtype] * wanted.norm()
    return fast


@pytest.mark.parametrize("dtype", BOUNDS)
@pytest.mark.parametrize("executor", ["eager", "native"])
@pytest.mark.parametrize("core", ["gn", "mlp"])
def test_every_executor_is_the_reference(fitted, sampled, executor, dtype, core):
    fast = compare(fitted, sampled, executor, dtype, core=core, hidden=(16, 12))
    if executor == "native":
        assert isinstance(fast.executor, NativeExecutor) and fast.reason is None


@compiles
@pytest.mark.slow
def test_compiled_is_the_reference(fitted, sampled):
    compare(fitted, sampled, "compiled", torch.float32)


def test_a_model_comes_back_from_its_checkpoint(fitted, sampled, tmp_path):
    model = fitted(torch.float32, features=(*FEATURES[:-1], PairContacts(places=3)))
    save_checkpoint(tmp_path / "model.safetensors", model, scene=load())
    loaded = load_pretrained(tmp_path / "model.safetensors").model
    assert loaded.features[-1] == PairContacts(places=3)
    state, action = sampled[0][:, 9], sampled[1][:, 9]
    expected, found = (each.bind(load()).step(state, action)[0] for each in (model, loaded))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_scenes_with_other_pairs_share_weights(fitted, random_states, random_actions):
    model = fitted()
    for scene in (two_bodies("box", "capsule"), load_scene("pendulum"), zoo.load("plane")):
        assert graph_edges(scene, model.features).shape[1] == scene.num_edges + 2 * len(scene.contact_pairs.nodes)
        with pytest.warns(UserWarning, match="never saw"):
            bound = model.bind(scene)
        state = random_states(scene, 3)
        assert bound.step(state, random_actions(scene, 3))[0].isfinite().all()


def test_it_refuses_what_it_has_no_geoms_of():
    pendulum = load_scene("pendulum")
    model = ForwardModel.for_scene(pendulum, features=FEATURES, latent=4, hidden=4)
    with pytest.raises(ValueError, match="may be another variant"):
        model.bind(pendulum, parameters_key="parameters")
    model.bind(sample_variants("pendulum", 1, rng=0)[0])
    with pytest.raises(ValueError, match="places=0"):
        PairContacts(places=0)


def test_without_the_feature_a_model_is_as_before(fitted):
    model = fitted(features=FEATURES[:-1])
    assert not model.marks_edges
    bound = model.bind(load())
    assert bound.incidence.num_edges == load().num_edges
    assert model.core.first.edge_mlp[0].in_features == sum(
        (
            2 * (model.dynamic_size.nodes + len(model.parameter_names.nodes)),
            model.dynamic_size.edges + len(model.parameter_names.edges),
            len(model.parameter_names.globals_),
        )
    )


@pytest.mark.parametrize(
    ("scene", "touch"),
    [
        (lambda: load_scene("suite:finger/spin"), True),  # finger and spinner
        (lambda: zoo.load("pusher"), True),
        (lambda: load_scene("cheetah"), False),  # legs of one tree touch
        (lambda: load_scene("pendulum"), False),
        (lambda: load_scene(TWO_FAR), False),  # two trees out of reach
    ],
)
def test_trees_that_can_meet_have_contact_edges_by_default(scene, touch):
    scene = scene()
    model = ForwardModel.for_scene(scene, latent=4, hidden=4)
    assert trees_can_touch(scene) == touch == (PairContacts() in model.features)

"""A specialised predictor is its predictor: outputs and gradients."""

from __future__ import annotations

import warnings

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_gn.dynamics import (
    BodyState,
    Canonicalizer,
    Contacts,
    Controls,
    ForwardModel,
    JointAxes,
    UnseenParameterWarning,
    specialize,
)
from torchrl_gn.envs import ModelEnv
from torchrl_gn.evaluation import rollout
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import load_scene

from .. import zoo


def vjp(model, state, action):
    """Predicted changes and next states, and gradients of random functions of both in state and action."""
    found = []
    for predict in (model.delta, lambda *given: model.step(*given)[0]):
        leaves = [value.detach().clone().requires_grad_() for value in (state, action)]
        out = predict(*leaves)
        generator = torch.Generator().manual_seed(7)
        cotangent = torch.randn(out.shape, generator=generator, dtype=torch.float64)
        gradients = torch.autograd.grad((out * cotangent).sum(), leaves, allow_unused=True)
        zeros = [torch.zeros_like(leaf) if g is None else g for leaf, g in zip(leaves, gradients, strict=True)]
        found += [out.detach(), *zeros]
    return found


def compare(model: ForwardModel, scene, state, action, tolerance: float) -> None:
    reference = model.bind(scene, reference=True)
    plain = vjp(reference, state, action)
    model.requires_grad_(False)
    varies = (state[: len(state) // 2] != reference.reference_state).any(0)
    for index, (expected, got) in enumerate(zip(plain, vjp(specialize(model.bind(scene)), state, action), strict=True)):
        assert got.dtype == expected.dtype and got.shape == expected.shape
        if index == 4:  # native gradients in channels that cannot move are those of copying them
            expected, got = expected * varies, got * varies
        assert (got - expected).norm() <= tolerance * expected.norm()


def both_kinds(moved, random_states, bound, count: int = 4) -> torch.Tensor:
    """States about the reference pose, and others."""
    return torch.cat((moved(bound, count), random_states(bound.scene, count, seed=3)))


@pytest.mark.slow
@pytest.mark.parametrize("activation", ["relu", "silu", "gelu", "tanh"])
@pytest.mark.parametrize("name", ["swimmer3", "jaco"])
def test_every_activation_is_predicted_as_by_the_reference(
    make_model, moved, random_states, random_actions, name, activation
):
    scene = zoo.load(name)
    model = make_model(scene, activation=activation)
    state, action = both_kinds(moved, random_states, model.bind(scene), 8), random_actions(scene, 16, seed=3)
    compare(model.double(), scene, state, action, 1e-10)


@st.composite
def trees(draw) -> str:
    """MJCF of a random tree of bodies with random joints and motors."""
    joints = (
        '<freejoint name="j{0}"/>',
        '<joint name="j{0}" type="ball"/>',
        '<joint name="j{0}" axis="0 1 0"/>',
        '<joint name="j{0}" type="slide" axis="1 0 1"/>',
        '<joint name="j{0}" axis="0 0 1"/><joint axis="1 0 0"/>',
        "",
    )
    count = draw(st.integers(1, 6))
    children: dict[int, list[int]] = {index: [] for index in range(-1, count)}
    for index in range(count):
        children[draw(st.integers(-1, index - 1))].append(index)
    motors = []

    def body(index: int, root: bool) -> str:
        kind = draw(st.integers(0 if root else 1, 5 if index else 4))
        if kind in (2, 3, 4) and draw(st.booleans()):
            motors.append(f'<motor joint="j{index}" ctrlrange="-1 1"/>')
        inner = "".join(body(child, False) for child in children[index])
        size = draw(st.floats(0.05, 0.3))
        return f'<body pos=".3 0 .1">{joints[kind].format(index)}<geom size="{size}"/>{inner}</body>'

    bodies = "".join(body(index, True) for index in children[-1])
    return f"<mujoco><worldbody>{bodies}</worldbody><actuator>{''.join(motors)}</actuator></mujoco>"


@pytest.mark.slow
@settings(
    max_examples=20,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    xml=trees(),
    depth=st.integers(1, 3),
    latent=st.integers(1, 6),
    encoding=st.sampled_from(["matrix", "quaternion"]),
    parameters=st.sampled_from(["scene", "none"]),
    flags=st.tuples(*[st.booleans()] * 5),
    pool=st.sampled_from(["sum", "mean"]),
)
def test_random_scenes_are_predicted_as_by_the_reference(
    fit, moved, random_states, random_actions, xml, depth, latent, encoding, parameters, flags, pool
):
    scene = load_scene(xml)
    torch.manual_seed(0)
    integrate, axes, recenter, yaw, positions = flags
    body = BodyState(encoding=encoding, positions=positions)
    hidden = {"edge_hidden": [7] * depth, "node_hidden": [6] * depth, "global_hidden": [5] * depth}
    model = ForwardModel.for_scene(
        scene,
        features=(body, Controls(), *([JointAxes()] if axes else []), Contacts()),
        canonicalizer=Canonicalizer(recenter=recenter, yaw=yaw),
        parameters=parameters,
        integrate=integrate,
        latent=latent,
        pool=pool,
        **hidden,
    )
    fit(model, scene)
    state, action = both_kinds(moved, random_states, model.bind(scene), 2), random_actions(scene, 4, seed=3)
    compare(model.double(), scene, state, action, 1e-10)


@pytest.mark.parametrize("batch", [(), (3,), (0,), (2, 1, 2)])
def test_any_batch(scenes, make_model, random_states, random_actions, batch):
    scene = scenes["swimmer6"]
    bound = make_model(scene).double().bind(scene)
    state, action = random_states(scene, *batch), random_actions(scene, *batch)
    torch.testing.assert_close(
        specialize(bound).step(state, action)[0], bound.step(state, action)[0], rtol=0, atol=1e-12
    )


def test_a_model_that_has_seen_nothing(scenes, make_model, random_states, random_actions):
    """No input varies without statistics: the model predicts only the change that the rates explain."""
    scene = scenes["swimmer6"]
    bound = make_model(scene, fitted=False).bind(scene)
    state, action = random_states(scene, 3), random_actions(scene, 3)
    found, expected = (module.step(state, action)[0] for module in (specialize(bound), bound))
    torch.testing.assert_close(found, expected, rtol=1e-15, atol=1e-15)


def test_far_from_the_origin_nothing_is_lost(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    bound = make_model(scene).bind(scene)
    state, action = random_states(scene, 5), random_actions(scene, 5)
    far = state.clone()
    far[:, 1:, :2] += 1e6
    quick = specialize(bound)
    near = quick.delta(state, action)
    assert (quick.delta(far, action) - near).norm() < 1e-6 * near.norm()


@pytest.mark.filterwarnings("ignore::torchrl_gn.processor.SlowDtypeWarning")
def test_bfloat16_is_close_and_keeps_the_states_dtype(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    bound = make_model(scene, latent=64).bind(scene)
    state, action = random_states(scene, 50, seed=3), random_actions(scene, 50)
    quick = specialize(bound, dtype=torch.bfloat16)
    delta, expected = quick.delta(state, action), bound.delta(state, action).detach()
    assert delta.dtype == torch.float64
    assert 1e-6 < (delta - expected).norm() / expected.norm() < 2e-2
    assert "bfloat16" in str(quick)


@pytest.mark.slow
def test_it_stands_in_for_the_bound_model(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    bound = make_model(scene).double().bind(scene)
    quick = specialize(bound)
    state, actions = random_states(scene, 4, scale=0.1), random_actions(scene, 4, 6)
    torch.testing.assert_close(rollout(quick, state, actions), rollout(bound, state, actions).detach())
    executed = []
    for model in (quick, bound):
        torch.manual_seed(0)
        executed.append(ModelEnv(model, seed=0).rollout(5).detach())
    torch.testing.assert_close(executed[0], executed[1])
    tensordict = TensorDict({"state": state, "action": actions[:, 0]}, [4])
    assert torch.equal(ModelEnv(quick).step(tensordict)["next", "state"], quick.step(state, actions[:, 0])[0])


@pytest.mark.slow
def test_a_loss_refuses_to_train_a_snapshot(scenes, make_model):
    scene = scenes["swimmer6"]
    with pytest.raises(TypeError, match="no gradient to the weights.*bound model"):
        ForwardModelLoss(specialize(make_model(scene).bind(scene)))


@pytest.mark.slow
def test_the_table_names_what_was_skipped(scenes, make_model):
    scene = scenes["swimmer6"]
    sizes = {"edge_hidden": (128, 128), "node_hidden": (128, 128), "global_hidden": (128, 128)}
    quick = specialize(make_model(scene, latent=64, **sizes).bind(scene))
    skipped = quick.skipped()
    assert skipped["nodes predicted"] == (7, 6)
    assert skipped["components predicted"] == (24, 12)
    assert skipped["edges of the second block"] == (16, 13)  # three lead to the world
    plain, here = skipped["kFLOP"]
    # By hand: layers of h by their inputs, the last one of 12 (6 relative), and products with incidence matrices.
    nodes, edges, kept, moving, h = 7, 16, 13, 6, 128
    n, e = skipped["node features"][1], skipped["edge features"][1]
    layers = edges * (2 * n + e + h) + nodes * (h + n + h) + 3 * h + (2 * nodes + 2) * h
    layers += kept * (h + 2 * n + e + h) + moving * (h + n + h + h + 12)
    incidence = edges * 2 * nodes * n
    incidence += h * ((nodes + 1) * edges + kept * (2 * nodes + 1) + moving * kept + moving)
    assert here == pytest.approx(2e-3 * (layers * h + incidence))
    assert all(what in str(quick) for what in skipped)


@pytest.mark.slow
def test_no_second_warning(scenes, make_model):
    model = make_model(scenes["swimmer6"])
    other = load_scene("swimmer6", timestep=0.01)
    with pytest.warns(UnseenParameterWarning):
        bound = model.bind(other)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        specialize(bound)

"""A specialised model is the plain model: outputs and gradients, and never a stale one."""

from __future__ import annotations

import copy
import inspect
import warnings

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_gn.dynamics import ForwardModel, UnseenParameterWarning, specialize
from torchrl_gn.dynamics.executors.compiled import CompiledStep, check_compiler
from torchrl_gn.envs import ModelEnv
from torchrl_gn.evaluation import rollout
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import SYSTEMS, ParameterNames, load_scene


def pull(model, state, action):
    """Predicted changes, and gradients of a random function of the next state."""
    leaves = [value.detach().clone().requires_grad_() for value in (state, action)]
    delta = model.delta(*leaves)
    generator = torch.Generator().manual_seed(7)
    cotangent = torch.randn(delta.shape, generator=generator, dtype=torch.float64)
    gradients = torch.autograd.grad((delta * cotangent).sum(), leaves, allow_unused=True)
    return [
        delta.detach(),
        *(torch.zeros_like(leaf) if g is None else g for leaf, g in zip(leaves, gradients, strict=True)),
    ]


def compare(model: ForwardModel, scene, state, action, tolerance: float) -> None:
    plain = pull(model.bind(scene, reference=True), state, action)
    model.requires_grad_(False)
    for expected, got in zip(plain, pull(specialize(model.bind(scene)), state, action), strict=True):
        assert got.dtype == expected.dtype and got.shape == expected.shape
        assert (got - expected).norm() <= tolerance * expected.norm()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", [*SYSTEMS, "swimmer3", "joints", "falling"])
def test_every_scene_is_predicted_as_by_the_plain_model(scenes, make_model, random_states, random_actions, name, dtype):
    scene = scenes[name] if name in scenes else load_scene(name)
    model = make_model(scene, latent=16, edge_hidden=(32, 32), node_hidden=(32, 32), global_hidden=(32, 32))
    state, action = random_states(scene, 16, seed=3), random_actions(scene, 16, seed=3)
    compare(model.to(dtype), scene, state, action, 1e-10 if dtype == torch.float64 else 1e-5)


@pytest.mark.parametrize("options", [{"activation": name} for name in ("silu", "gelu", "tanh")] + [{"core": "mlp"}])
@pytest.mark.parametrize("name", ["swimmer3", "jaco"])
def test_other_cores_are_predicted_as_by_the_plain_model(
    scenes, make_model, random_states, random_actions, name, options
):
    scene = scenes[name] if name in scenes else load_scene(name)
    items = (scene.num_nodes, scene.num_edges)
    model = make_model(scene, items=items, mlp_hidden=(16, 12), **options)
    state, action = random_states(scene, 16, seed=3), random_actions(scene, 16, seed=3)
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


@settings(
    max_examples=25,
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
def test_random_scenes_are_predicted_as_by_the_plain_model(
    fit, random_states, random_actions, xml, depth, latent, encoding, parameters, flags, pool
):
    scene = load_scene(xml)
    torch.manual_seed(0)
    options = dict(zip(("integrate", "joint_axes", "recenter", "align", "positions"), flags, strict=True))
    options["pool"] = pool
    hidden = {"edge_hidden": [7] * depth, "node_hidden": [6] * depth, "global_hidden": [5] * depth}
    model = ForwardModel(
        ParameterNames.of(scene), parameters=parameters, encoding=encoding, latent=latent, **options, **hidden
    )
    fit(model, scene)
    state, action = random_states(scene, 4, seed=3), random_actions(scene, 4, seed=3)
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
    """Without statistics no input varies and nothing is predicted to change but what the rates explain."""
    scene = scenes["swimmer6"]
    bound = make_model(scene, fitted=False).bind(scene)
    state, action = random_states(scene, 3), random_actions(scene, 3)
    torch.testing.assert_close(
        specialize(bound).step(state, action)[0], bound.step(state, action)[0], rtol=1e-15, atol=1e-15
    )


def test_far_from_the_origin_nothing_is_lost(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    bound = make_model(scene).bind(scene)
    state, action = random_states(scene, 5), random_actions(scene, 5)
    far = state.clone()
    far[:, 1:, :2] += 1e6
    quick = specialize(bound)
    near = quick.delta(state, action)
    assert (quick.delta(far, action) - near).norm() < 1e-6 * near.norm()


def change_in_place(model: ForwardModel) -> None:
    with torch.no_grad():
        next(model.parameters()).mul_(1.5)


def load_others(model: ForwardModel) -> None:
    state = {name: value * 1.5 if "core" in name else value for name, value in model.state_dict().items()}
    model.load_state_dict(state)


def assign_others(model: ForwardModel) -> None:
    state = {name: value * 1.5 if "core" in name else value for name, value in model.state_dict().items()}
    model.load_state_dict(state, assign=True)


def step_optimizer(model: ForwardModel) -> None:
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    torch.optim.Adam(model.parameters(), lr=0.1).step()


def more_statistics(model: ForwardModel) -> None:
    model.residual_normalizer.update(5 * torch.randn(50, 12, dtype=torch.float64))


def cast_and_back(model: ForwardModel) -> None:
    model.half().double()


CHANGES = [change_in_place, load_others, assign_others, step_optimizer, more_statistics, cast_and_back]


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_model_is_never_predicted_with_its_old_weights(
    scenes, make_model, random_states, random_actions, change
):
    scene = scenes["swimmer6"]
    model = make_model(scene).double()
    bound = model.bind(scene)
    quick = specialize(bound)
    state, action = random_states(scene, 3), random_actions(scene, 3)
    before = quick.step(state, action)[0]
    change(model)
    after = quick.step(state, action)[0]
    assert (after - before).abs().max() > 1e-7
    torch.testing.assert_close(after, bound.step(state, action)[0].detach(), rtol=0, atol=1e-12)


def test_an_unchanged_model_is_folded_once(scenes, make_model, random_states, random_actions, folds):
    scene = scenes["swimmer6"]
    quick = specialize(make_model(scene).bind(scene))
    state, action = random_states(scene, 3), random_actions(scene, 3)
    first = quick.step(state, action)[0]
    assert torch.equal(quick.step(state, action)[0], first) and len(folds) == 1
    twin = copy.deepcopy(quick)
    change_in_place(twin.model)
    assert not torch.equal(twin.step(state, action)[0], first)
    assert torch.equal(quick.step(state, action)[0], first) and len(folds) == 2


def test_inference_mode_leaves_nothing_behind(scenes, make_model, random_states, random_actions):
    """Folded inside, differentiated and folded again outside; and values made inside are never taken for the same."""
    scene = scenes["swimmer6"]
    model = make_model(scene).double()
    bound = model.bind(scene, parameters_key="parameters")
    quick = specialize(bound)
    state, action = random_states(scene, 3), random_actions(scene, 3)
    with torch.inference_mode():
        parameters = bound.parameters_of(scene).clone()
        quick.step(state, action, parameters)
        parameters["nodes"].mul_(1.5)
        torch.testing.assert_close(quick.step(state, action, parameters)[0], bound.step(state, action, parameters)[0])
    for change in (lambda model: None, change_in_place):
        change(model)
        found, expected = (pull(module, state, action) for module in (quick, bound))
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


def test_bfloat16_is_close_and_keeps_the_states_dtype(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    bound = make_model(scene, latent=64).bind(scene)
    state, action = random_states(scene, 50, seed=3), random_actions(scene, 50)
    quick = specialize(bound, dtype=torch.bfloat16)
    delta, expected = quick.delta(state, action), bound.delta(state, action).detach()
    assert delta.dtype == torch.float64
    assert 1e-6 < (delta - expected).norm() / expected.norm() < 2e-2
    assert "bfloat16" in str(quick)


def test_it_stands_in_for_the_bound_model(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    bound = make_model(scene).double().bind(scene)
    quick = specialize(bound)
    state, actions = random_states(scene, 4, scale=0.1), random_actions(scene, 4, 6)
    torch.testing.assert_close(rollout(quick, state, actions), rollout(bound, state, actions).detach())
    played = []
    for model in (quick, bound):
        torch.manual_seed(0)
        played.append(ModelEnv(model, seed=0).rollout(5).detach())
    torch.testing.assert_close(played[0], played[1])
    tensordict = TensorDict({"state": state, "action": actions[:, 0]}, [4])
    assert torch.equal(ModelEnv(quick).step(tensordict)["next", "state"], quick.step(state, actions[:, 0])[0])


def test_a_loss_refuses_to_train_a_snapshot(scenes, make_model):
    scene = scenes["swimmer6"]
    with pytest.raises(TypeError, match="no gradient to the weights.*bound model"):
        ForwardModelLoss(specialize(make_model(scene).bind(scene)))


def test_the_table_names_what_was_skipped(scenes, make_model):
    scene = scenes["swimmer6"]
    sizes = {"edge_hidden": (128, 128), "node_hidden": (128, 128), "global_hidden": (128, 128)}
    quick = specialize(make_model(scene, latent=64, **sizes).bind(scene))
    skipped = quick.skipped()
    assert skipped["nodes predicted"] == (7, 6)
    assert skipped["channels predicted"] == (12, 6)
    assert skipped["edges of the second block"] == (16, 13)  # three lead to the world
    plain, here = skipped["kFLOP"]
    # By hand: layers of h by their inputs, the last one of 6, and products with incidence matrices.
    nodes, edges, kept, moving, h = 7, 16, 13, 6, 128
    n, e = skipped["node features"][1], skipped["edge features"][1]
    layers = edges * (2 * n + e + h) + nodes * (h + n + h) + 3 * h + (2 * nodes + 2) * h
    layers += kept * (h + 2 * n + e + h) + moving * (h + n + h + h + 6)
    incidence = edges * 2 * nodes * n
    incidence += h * ((nodes + 1) * edges + kept * (2 * nodes + 1) + moving * kept + moving)
    assert here == pytest.approx(2e-3 * (layers * h + incidence))
    assert all(what in str(quick) for what in skipped)


def test_no_second_warning(scenes, make_model):
    model = make_model(scenes["swimmer6"])
    other = load_scene("swimmer6", timestep=0.01)
    with pytest.warns(UnseenParameterWarning):
        bound = model.bind(other)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        specialize(bound)


NEW = "isolate_recompiles" in inspect.signature(torch.compile).parameters
isolated = pytest.mark.skipif(not NEW, reason="torch is too old to compile")


@isolated
def test_a_compiled_step_is_dropped_where_other_channels_vary(scenes, make_model):
    """As many as before, so that all tensors have the same shapes: but their places are in a compiled step's code."""
    scene = scenes["swimmer6"]
    model = make_model(scene)
    quick, normalizer = specialize(model.bind(scene)), model.residual_normalizer
    spread = normalizer.m2.clone()

    def without(channel: int, factor: float = 1.0) -> None:
        m2 = factor * spread.index_fill(0, torch.tensor(channel), 0.0)
        normalizer.load_state_dict({"count": normalizer.count, "mean": normalizer.mean, "m2": m2})
        quick.fold()

    without(0)
    quick._compiled = compiled = CompiledStep(quick.step, lambda: 0)
    without(0, factor=2.0)
    assert quick._compiled is compiled
    without(1, factor=2.0)
    assert quick._compiled is None


def has_compiler() -> bool:
    try:
        check_compiler()
    except FileNotFoundError:
        return False
    return True


@pytest.mark.slow
@isolated
@pytest.mark.skipif(not has_compiler(), reason="no C++ compiler")
def test_compiled_rollouts_and_their_gradients(scenes, make_model, random_states, random_actions):
    scene = scenes["pendulum"]
    model = make_model(scene)
    bound, quick = model.bind(scene), specialize(model.bind(scene), compile=True)
    model.requires_grad_(False)
    state, actions = random_states(scene, 2, scale=0.1), random_actions(scene, 2, 3)

    def pull(model):
        leaves = [value.clone().requires_grad_() for value in (state, actions)]
        states = model.rollout(*leaves)[0]
        return [states.detach(), *torch.autograd.grad(states[:, -1].square().sum(), leaves)]

    for expected, got in zip(pull(bound), pull(quick), strict=True):
        assert got.dtype == expected.dtype
        assert (got - expected).norm() <= 1e-5 * expected.norm()
    # Compiling takes a minute: other strides, or a gradient that is wanted, must not need it again.
    strided = state.mT.contiguous().mT
    with torch.compiler.set_stance("fail_on_recompile"):
        torch.testing.assert_close(quick.step(strided, actions[:, 0])[0], bound.step(state, actions[:, 0])[0])
        quick.step(strided.requires_grad_(), actions[:, 1])[0].sum().backward()
    # Other weights of the same shapes are used without compiling again, and not by a gradient of the old ones.
    compiled = quick._compiled
    leaf = state.clone().requires_grad_()
    old = quick.step(leaf, actions[:, 0])[0]
    change_in_place(model)
    torch.testing.assert_close(quick.step(state, actions[:, 0])[0], bound.step(state, actions[:, 0])[0])
    assert quick._compiled is compiled
    with pytest.raises(RuntimeError, match="weights changed between a prediction and its gradient"):
        old.sum().backward()


@pytest.mark.skipif(NEW, reason="this torch is new enough")
def test_compiling_with_an_old_torch_is_refused(scenes, make_model):
    with pytest.raises(RuntimeError, match="compile=True needs torch 2.13 or newer"):
        specialize(make_model(scenes["swimmer6"]).bind(scenes["swimmer6"]), compile=True)


@isolated
def test_compiling_without_a_compiler_is_refused(scenes, make_model):
    from torch._inductor import config, cpp_builder

    getattr(cpp_builder.get_cpp_compiler, "cache_clear", lambda: None)()
    missing = pytest.raises(FileNotFoundError, match="compile=True needs a C\\+\\+ compiler: install g\\+\\+")
    with config.patch({"cpp.cxx": ("no-such-compiler",)}), missing:
        specialize(make_model(scenes["swimmer6"]).bind(scenes["swimmer6"]), compile=True)

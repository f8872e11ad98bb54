"""Samples with physical parameters of their own: variants of a scene, and inferred graphs."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.envs import ModelEnv
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import ParameterNames, Scene, load_scene
from torchrl_gn.scenes.physical_parameters import PhysicalParameters
from torchrl_gn.scenes.scaled import with_factors

from .. import zoo

SIZES = {"latent": 6, "hidden": (8,), "node_hidden": (8, 8)}


def arm(length: float = 0.3, size: float = 0.05, turned: float = 0.0) -> Scene:
    """A variant of the arm."""
    return zoo.load(
        "arm",
        ('pos=".1 .2 1.3" euler="180 0 0"', f'pos=".1 .2 {1 + length}" euler="180 0 {turned}"'),
        ('pos=".3 0 0"', f'pos="{length} 0 0"'),
        ('size=".05 .2"', f'size="{size} .2"'),
    )


@pytest.fixture(scope="module")
def variants():
    return [arm(), arm(0.5, 0.07, 30), arm(0.2, 0.04, -70)]


@pytest.fixture(scope="module")
def samples(variants):
    """Trajectories of every variant, [3, 2, ...]."""
    return torch.stack([collect_trajectories(scene, 2, 4, seed) for seed, scene in enumerate(variants)])


@pytest.fixture
def model(variants, samples):
    torch.manual_seed(0)
    model = ForwardModel.for_scene(variants[0], **SIZES).double()
    bound = model.bind(variants[0], parameters_key="parameters")
    parameters = torch.stack([bound.parameters_of(scene) for scene in variants])
    for index in range(3):
        loss = ForwardModelLoss(bound)
        one = samples[index].clone().set("parameters", parameters[index].expand(2))
        loss.fit_normalizers(trajectory_buffer(one, batch_size=64, seed=0).sample())
    return model


def inputs(samples, bound, variants):
    """One state and action of every variant, and its physical parameters."""
    parameters = torch.stack([bound.parameters_of(scene) for scene in variants])
    return samples["state"][:, 0, 0], samples["action"][:, 0, 0], parameters


@pytest.mark.slow
@pytest.mark.parametrize("way", ["plain", "folded", "specialised"])
def test_every_sample_is_predicted_as_its_own_scene(variants, samples, model, way):
    bound = model.bind(variants[0], parameters_key="parameters", reference=way == "plain")
    assert bound.in_keys == ["state", "action", "parameters"]
    state, action, parameters = inputs(samples, bound, variants)
    model.requires_grad_(False)
    module = specialize(bound) if way == "specialised" else bound
    state.requires_grad_()
    action.requires_grad_()
    ours = module.step(state, action, parameters)[0]
    theirs = torch.stack(
        [model.bind(s, reference=True).step(*x)[0] for s, *x in zip(variants, state, action, strict=True)]
    )
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-10)
    assert (ours - bound.step(state, action, parameters[0])[0]).abs().max() > 1e-4
    weight = torch.randn(ours.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gradients = [torch.autograd.grad((out * weight).sum(), (state, action)) for out in (ours, theirs)]
    # A specialised model may take channels that cannot move for constants.
    moves = ((samples["state"] - samples["state"][:, :1, :1]).abs() > 1e-9).flatten(0, 2).any(0)
    varies = moves if way == "specialised" else torch.ones_like(moves)
    for (got, expected), kept in zip(zip(*gradients, strict=True), (varies, torch.ones_like(action[0])), strict=True):
        assert ((got - expected) * kept).norm() <= 1e-10 * expected.norm()
    written = module(TensorDict({"state": state, "action": action, "parameters": parameters}, [3]))["next", "state"]
    assert torch.equal(written, ours)


@pytest.mark.slow
@pytest.mark.parametrize("special", [False, True])
@pytest.mark.parametrize("core", ["gn", "mlp"])
def test_rollouts_of_variants(variants, samples, model, special, core):
    if core == "mlp":
        mlp = ForwardModel.for_scene(variants[0], core="mlp", hidden=(8, 8)).double()
        mlp.load_state_dict({**mlp.state_dict(), **{k: v for k, v in model.state_dict().items() if "core" not in k}})
        model = mlp
    bound = model.requires_grad_(False).bind(variants[0], parameters_key="parameters")
    module = specialize(bound) if special else bound
    state, _, parameters = inputs(samples, bound, variants)
    actions = samples["action"][:, 0]
    states = module.rollout(state, actions, parameters)[0]
    for index, scene in enumerate(variants):
        expected = model.bind(scene).rollout(state[index], actions[index])[0]
        torch.testing.assert_close(states[index], expected, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_values_that_change_are_never_taken_for_the_same(variants, samples, model):
    bound = model.requires_grad_(False).bind(variants[0], parameters_key="parameters")
    quick = specialize(bound)
    state, action, parameters = inputs(samples, bound, variants)
    quick.step(state, action, parameters)
    parameters["child_anchor"].mul_(1.01)  # in place
    changed = quick.step(state, action, parameters)[0]
    torch.testing.assert_close(changed, bound.step(state, action, parameters)[0])
    parameters["nodes"] = parameters["nodes"] * 1.5  # another tensor
    torch.testing.assert_close(quick.step(state, action, parameters)[0], bound.step(state, action, parameters)[0])
    turned = parameters[[1, 2, 0]]
    torch.testing.assert_close(quick.step(state, action, turned)[0], bound.step(state, action, turned)[0])
    torch.testing.assert_close(quick.step(state, action)[0], bound.step(state, action)[0])  # back to the scene's own


@pytest.mark.slow
def test_a_model_of_one_scene_refuses_samples_of_another(variants, samples, model):
    bound = model.requires_grad_(False).bind(variants[0])
    state, action = samples["state"][0, :, 0], samples["action"][0, :, 0]
    for module in (bound, specialize(bound)):
        sample = TensorDict(
            {"state": state, "action": action, "parameters": bound.parameters_of(variants[0]).expand(2)}, [2]
        )
        assert ("next", "state") in module(sample).keys(True)
        sample["parameters"] = bound.parameters_of(variants[1]).expand(2)
        with pytest.raises(ValueError, match="other parameters 'nodes' than scene 'arm'.*parameters_key='parameters'"):
            module(sample)
    sample.set(("next", "state"), state)
    with pytest.raises(ValueError, match="other parameters 'nodes'"):
        ForwardModelLoss(bound)(sample)


@pytest.mark.parametrize("source", ["none", "scene"])
def test_a_model_of_fewer_parameters_compares_all_that_samples_bring(variants, samples, source):
    names = ParameterNames(nodes=("mass",)) if source == "scene" else ParameterNames.of(variants[0])
    model = ForwardModel(names, parameters=source, **SIZES).double()
    bound = model.bind(variants[0])
    sample = TensorDict({"state": samples["state"][0, :, 0], "action": samples["action"][0, :, 0]}, [2])
    sample["parameters"] = PhysicalParameters.of(variants[0]).tensordict().expand(2)
    assert ("next", "state") in bound(sample).keys(True)
    sample["parameters", "edges"] = sample["parameters", "edges"] + 1.0
    with pytest.raises(ValueError, match="other parameters 'edges' than scene 'arm'"):
        bound(sample)


def test_what_is_no_variant_is_refused(variants, model):
    bound = model.bind(variants[0], parameters_key="parameters")
    with pytest.raises(ValueError, match="not a variant of 'arm': movable components, joint anchors differ"):
        bound.parameters_of(zoo.load("arm", ('name="elbow"', 'name="elbow" type="slide"')))
    with pytest.raises(ValueError, match="'swimmer3' is not a variant of 'arm': number of nodes, edges"):
        bound.parameters_of(load_scene("swimmer3"))


def test_variants_with_another_ground_are_refused():
    """Features read the plane of the bound scene: distances of a moved one would be silently wrong."""
    text = """<mujoco><worldbody><body name="lab" pos="0 0 {}"><geom type="plane" size="5 5 .1"/></body>
      <body pos="0 0 1"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    scene = load_scene(text.format(-0.2))
    bound = ForwardModel.for_scene(scene, **SIZES).bind(scene, parameters_key="parameters")
    for other in (load_scene(text.format(-0.3)), with_factors(scene, {"body_pos": ["lab"]}, [1.5])):
        with pytest.raises(ValueError, match="is not a variant of .*: plane that contact points touch differ"):
            bound.parameters_of(other)


def test_bad_parameters_are_named(variants, samples, model):
    bound = model.bind(variants[0], parameters_key="parameters")
    state, action, parameters = inputs(samples, bound, variants)
    with pytest.raises(KeyError, match="reads each sample's physical parameters at 'parameters'"):
        bound(TensorDict({"state": state, "action": action}, [3]))
    with pytest.raises(ValueError, match=r"no batch or that of the state, \[3\], got \[2\]"):
        bound.step(state, action, parameters[:2])
    with pytest.raises(KeyError, match=r"\['mass'\] are not known; use some of \['nodes'"):
        bound.step(state, action, parameters.set("mass", torch.zeros(3)))
    with pytest.raises(ValueError, match=r"'child_anchor' must be \[3, 3, 3\], got \[3, 3, 2\]"):
        bound.step(state, action, parameters.exclude("mass").set("child_anchor", torch.zeros(3, 3, 2)))


@pytest.mark.slow
@pytest.mark.parametrize("window", [1, 3])
def test_the_loss_reads_every_samples_values(variants, samples, model, window):
    bound = model.bind(variants[0], parameters_key="parameters")
    loss = ForwardModelLoss(bound)
    assert loss.in_keys == ["state", "action", ("next", "state"), "parameters"]
    parameters = torch.stack([bound.parameters_of(scene) for scene in variants])
    every = samples.clone().set("parameters", parameters.unsqueeze(1).expand(3, 2)).flatten()
    batch = trajectory_buffer(every, batch_size=5, window=window, seed=0).sample()
    total = loss(batch)["loss_forward_model"]
    total.backward()
    assert all(p.grad is not None for p in model.core.first.parameters())
    alone = []
    for sample in batch:
        which = int(sample["index"].flatten()[0]) // 2
        own = ForwardModelLoss(model.bind(variants[which]))
        alone.append(own(sample.exclude("parameters").unsqueeze(0))["loss_forward_model"])
    torch.testing.assert_close(total, torch.stack(alone).mean())


@pytest.mark.slow
def test_a_model_env_of_variants(variants, samples, model):
    bound = model.requires_grad_(False).bind(variants[0], parameters_key="parameters")
    state, _, parameters = inputs(samples, bound, variants)
    start = TensorDict({"state": state, "parameters": parameters}, [3])
    for module in (bound, specialize(bound)):
        env = ModelEnv(module, seed=0)
        executed = env.rollout(4, tensordict=env.reset(start.clone(), set_state=True), auto_reset=False)
        expected = bound.rollout(state, executed["action"], parameters)[0]
        torch.testing.assert_close(executed["next", "state"], expected[:, 1:])
    # Without values of its own a start has the scene's.
    executed = env.rollout(3, tensordict=TensorDict(batch_size=[2]))
    expected = model.bind(variants[0]).rollout(executed["state"][:, 0], executed["action"])[0]
    torch.testing.assert_close(executed["next", "state"], expected[:, 1:])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchrl_gn.dynamics.UnseenParameterWarning")
def test_an_inferred_graph_is_read_as_it_is_and_gets_gradients(variants, samples):
    torch.manual_seed(0)
    scene = variants[0]
    model = ForwardModel.for_scene(scene, parameters="inferred", inferred=(4, 3, 2), **SIZES).double()
    bounds = [model.bind(scene, parameters_key="parameters", reference=plain) for plain in (True, False)]
    ForwardModelLoss(model.bind(scene)).fit_normalizers(trajectory_buffer(samples[0], batch_size=64, seed=0).sample())
    state, action = samples["state"][:, 0, 0], samples["action"][:, 0, 0]
    shapes = {"nodes": (scene.num_nodes, 4), "edges": (scene.num_edges, 3), "globals_": (2,)}
    leaves = {name: torch.randn(3, *shape, dtype=torch.float64, requires_grad=True) for name, shape in shapes.items()}
    parameters = (
        bounds[0].own_parameters().expand(3).clone().update(leaves)
    )  # joint anchors beside the graph, where bodies are projected
    outs = [bound.step(state, action, parameters)[0] for bound in bounds]
    torch.testing.assert_close(*outs, rtol=0, atol=1e-12)
    gradients = [torch.autograd.grad(out.square().sum(), list(leaves.values())) for out in outs]
    for plain, folded in zip(*gradients, strict=True):
        assert plain.norm() > 0
        torch.testing.assert_close(plain, folded)
    quick = specialize(bounds[1]).step(state, action, parameters)[0]
    torch.testing.assert_close(quick, outs[0], rtol=0, atol=1e-12)
    assert not quick.requires_grad
    nothing = model.bind(scene).step(state, action)[0]  # without a graph: zeros
    assert (nothing - outs[0]).abs().max() > 1e-6

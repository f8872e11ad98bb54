"""Forward models built on the device, moved to it and bound there predict as on the CPU, without waiting."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict

import torchrl_gn as gn
from torchrl_gn.data import log_trajectories, log_tree, simulate_log, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, MujocoPhysics
from torchrl_gn.dynamics.bound import update_parameter_normalizers
from torchrl_gn.scenes import PhysicalParameters, sample_variants
from torchrl_gn.training import load_pretrained

from .conftest import SYSTEMS, close
from .device import without_waits

scenes = pytest.mark.parametrize("name", SYSTEMS)


def inputs(data, name, device="cpu"):
    """States ``[4, 13]`` and actions ``[4, 6]``."""
    return data[name]["state"][:, 0].to(device), data[name]["action"][:, :6].to(device)


@scenes
def test_predictions_are_those_of_the_cpu(gpu, systems, data, pair, name):
    (here, there), scene = pair(systems[name]), systems[name]
    wanted, moved = here.bind(scene), copy.deepcopy(here).bind(scene).to(gpu)
    (state, action), (far, actions) = inputs(data, name), inputs(data, name, gpu)
    states = data[name]["state"][:, :6]
    for found in (there.bind(scene), moved):
        close(found.step(far, actions[:, 0])[0], wanted.step(state, action[:, 0])[0])
        close(found.rollout(far, actions)[0], wanted.rollout(state, action)[0])
        close(found.delta(far, actions[:, 0]), wanted.delta(state, action[:, 0]))
        close(found.teacher_forced(states.to(gpu), actions)[0], wanted.teacher_forced(states, action)[0])
        entries = TensorDict({"state": state, "action": action[:, 0]}, [4])
        close(found(entries.to(gpu))["next", "state"], wanted(entries)["next", "state"])
        assert found.in_range(far, 10.0).device == gpu
    slow, reference = (each.bind(scene, reference=True) for each in (there, here))
    close(slow.rollout(far, actions)[0], reference.rollout(state, action)[0])


@scenes
def test_gradients_are_those_of_the_cpu(gpu, systems, data, pair, name):
    found = []
    for model, device in zip(pair(systems[name]), ("cpu", gpu), strict=True):
        state, action = (each.clone().requires_grad_() for each in inputs(data, name, device))
        weights = [each for each in model.parameters() if each.numel()]
        loss = model.bind(systems[name]).rollout(state, action)[0].square().sum()
        found.append(torch.autograd.grad(loss, (state, action, *weights), materialize_grads=True))
    for here, there in zip(*found, strict=True):
        close(there, here, tolerance=1e-7)


@scenes
def test_steps_and_rollouts_never_wait(gpu, systems, data, pair, name):
    here, there = pair(systems[name])
    state, action = inputs(data, name, gpu)
    native = gn.specialize(here.bind(systems[name])).to(gpu)
    predictors = [there.bind(systems[name]), gn.specialize(there.bind(systems[name]), executor="eager"), native]
    for predictor in predictors:
        predictor.rollout(state, action[:, :1])  # constants go there once
        with without_waits():
            predictor.step(state, action[:, 0])
            states = predictor.rollout(state.clone().requires_grad_(), action.clone().requires_grad_())[0]
            predictor.in_range(states.detach(), 10.0)
            states.square().sum().backward()


@scenes
@pytest.mark.parametrize("executor", ["eager", "native"])
def test_specialised_models_move_and_refresh(gpu, systems, data, pair, name, executor):
    here, there = (model.bind(systems[name]) for model in pair(systems[name]))
    (state, action), (far, actions) = inputs(data, name), inputs(data, name, gpu)
    wanted = gn.specialize(here, executor=executor)
    expected = wanted.rollout(state, action)[0]
    made, moved = (gn.specialize(each, executor=executor).to(gpu) for each in (there, here))
    for predictor in (made, moved, copy.deepcopy(made)):
        close(predictor.rollout(far, actions)[0], expected)
        for source in (there, here):
            predictor.refresh(source)
            close(predictor.rollout(far, actions)[0], expected)
        assert predictor.reason == (None if executor == "eager" else "on fakegpu, it runs by torch operations")
        assert "swimmer6" in str(predictor) or name != "swimmer6"
    torch.testing.assert_close(moved.cpu().rollout(state, action)[0], expected, rtol=1e-9, atol=1e-9)
    assert moved.reason is None


def test_models_are_built_on_the_device(gpu, systems, data, pair):
    here, scene = pair(systems["cheetah"])[0], systems["cheetah"]
    with torch.device(gpu):
        built = [ForwardModel.from_description(here.description()).double()]
    torch.set_default_device(gpu)
    try:
        built.append(ForwardModel.from_description(here.description()).double())
        bound = [each.bind(scene) for each in built]
        special = gn.specialize(bound[1])
    finally:
        torch.set_default_device("cpu")
    for each in (*built, *bound, special):
        assert {tensor.device for tensor in each.state_dict().values()} <= {gpu}
    (state, action), (far, actions) = inputs(data, "cheetah"), inputs(data, "cheetah", gpu)
    for each, predictor in zip(built, bound, strict=True):
        each.load_state_dict(here.state_dict())
        close(predictor.rollout(far, actions)[0], here.bind(scene).rollout(state, action)[0])


@pytest.mark.parametrize("core", ["mlp", "recurrent"])
def test_other_cores(gpu, systems, data, core):
    scene = systems["swimmer6"]
    torch.manual_seed(0)
    here = ForwardModel.for_scene(scene, core=core, hidden=8, layers=1).double()
    there = copy.deepcopy(here).to(gpu).bind(scene)
    (state, action), (far, actions) = inputs(data, "swimmer6"), inputs(data, "swimmer6", gpu)
    wanted = here.bind(scene).rollout(state, action)[0]
    close(there.rollout(far, actions)[0], wanted)
    close(gn.specialize(there).rollout(far, actions)[0], wanted)
    assert gn.fit(there, data["swimmer6"], steps=1, progress=False).losses[0] > 0


def test_each_sample_has_its_own_parameters(gpu, systems, data, make_model):
    scene, variants = systems["swimmer6"], sample_variants("swimmer6", 4, rng=0)
    model = make_model(scene).double()
    varied = torch.stack([PhysicalParameters.of(each).tensordict() for each in variants])
    update_parameter_normalizers(model.bind(scene, parameters_key="parameters"), varied)
    found = {}
    for device in ("cpu", gpu):
        bound = copy.deepcopy(model).to(device).bind(scene, parameters_key="parameters")
        parameters = torch.stack([bound.parameters_of(each) for each in variants])
        assert parameters["nodes"].device == torch.device(device)
        state, action = inputs(data, "swimmer6", device)
        predictors = [bound, gn.specialize(bound), gn.specialize(bound, executor="eager")]
        moved = gn.specialize(copy.deepcopy(model).bind(scene, parameters_key="parameters")).to(device)
        moved.refresh(bound)
        found[device] = [each.rollout(state, action, parameters)[0] for each in (*predictors, moved)]
    for here, there in zip(*found.values(), strict=True):
        close(there, here)


@pytest.mark.parametrize("history", [0, 3])
def test_robots_known_by_their_joints(gpu, history):
    log = simulate_log(gn.load_scene("acrobot"), 3, 60, 0)
    tree, data = (
        log_tree(log, "double", commands=[[0], []], history=history),
        log_trajectories(log, 20, history=history)[0],
    )
    torch.manual_seed(0)
    here = ForwardModel.for_scene(tree, hidden=[8]).double()
    gn.ForwardModelLoss(here.bind(tree)).fit_normalizers(trajectory_buffer(data, batch_size=50, seed=0).sample())
    there = copy.deepcopy(here).to(gpu).bind(tree)
    wanted = here.bind(tree).rollout(data["state"][:, 0], data["action"])[0]
    for predictor in (there, gn.specialize(there)):
        close(predictor.rollout(data["state"][:, 0].to(gpu), data["action"].to(gpu))[0], wanted)


def test_physics_outside_of_torch(gpu, systems, data):
    scene = systems["swimmer6"]
    torch.manual_seed(0)
    here = ForwardModel.for_scene(scene, hidden=4, layers=1, physics=MujocoPhysics(scene)).double()
    there = copy.deepcopy(here).to(gpu).bind(scene)
    (state, action), (far, actions) = inputs(data, "swimmer6"), inputs(data, "swimmer6", gpu)
    wanted = here.bind(scene).rollout(state, action)[0]
    for predictor in (there, gn.specialize(there)):
        close(predictor.rollout(far, actions)[0], wanted)


def test_checkpoints(gpu, systems, data, pair, tmp_path):
    here, there = pair(systems["jaco"])
    gn.save_checkpoint(path := tmp_path / "model.safetensors", there)
    kept = load_pretrained(path).model
    assert {each.device.type for each in kept.state_dict().values()} == {"cpu"}
    state, action = inputs(data, "jaco")
    wanted = here.bind(systems["jaco"]).rollout(state, action)[0]
    torch.testing.assert_close(kept.bind(systems["jaco"]).rollout(state, action)[0], wanted, rtol=0, atol=0)
    close(kept.to(gpu).bind(systems["jaco"]).rollout(*inputs(data, "jaco", gpu))[0], wanted)
    there.load_state_dict(kept.cpu().state_dict())


def test_exports(gpu, systems, data, pair, tmp_path):
    here, there = (each.bind(systems["swimmer6"]) for each in pair(systems["swimmer6"]))
    step = torch.export.load(gn.export_step(there, tmp_path / "step.pt2")).module()
    state, action = inputs(data, "swimmer6", gpu)
    close(step(state, action[:, 0].float()), here.step(state.cpu(), action[:, 0].cpu().float())[0])
    texts = [gn.export_c(each, tmp_path / str(i) / "model") / "model.cpp" for i, each in enumerate((here, there))]
    assert texts[0].read_text() == texts[1].read_text()
    assert there.movable.device == gpu  # stays where it was

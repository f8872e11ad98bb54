"""Ensembles on the device: predictions, planners, losses, guards and adaptation."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

import torchrl_gn as gn
from torchrl_gn.dynamics import Adaptation, AdaptedPredictor, BoundEnsemble
from torchrl_gn.planners import Guarded
from torchrl_gn.policies import StatePolicy, StateValue

from ..sizes import SMALL
from .conftest import close, task
from .device import without_waits


@pytest.fixture(scope="session")
def made(systems, data) -> gn.Ensemble:
    torch.manual_seed(0)
    ensemble = gn.Ensemble.for_scene(systems["cheetah"], count=2, **SMALL)
    bound = ensemble.bind(systems["cheetah"])
    gn.fit_ensemble(bound, data["cheetah"], steps=2, progress=False)
    ensemble.double()
    gn.calibrate(bound, data["cheetah"])
    return ensemble


@pytest.fixture
def both(gpu, systems, made) -> list[BoundEnsemble]:
    """Return the specialised ensemble on the CPU and on the device."""
    bound = [copy.deepcopy(made).to(device).bind(systems["cheetah"]) for device in ("cpu", gpu)]
    return [gn.specialize(each, executor="eager") for each in bound]


def test_predictions_and_doubts(gpu, data, both):
    state, action = data["cheetah"]["state"][:, 0], data["cheetah"]["action"][:, :3]
    here, there = both[0].predict(state, action), both[1].predict(state.to(gpu), action.to(gpu))
    for one, other in zip(there, here, strict=True):
        close(one, other, tolerance=1e-6)
    close(both[1].doubt(state.to(gpu), action[:, 0].to(gpu)), both[0].doubt(state, action[:, 0]), tolerance=1e-6)


def test_imagination_of_members_never_waits(gpu, data, both):
    env = gn.ModelEnv(both[1], task, trust=3.0).by_member()
    now = TensorDict({"state": data["cheetah"]["state"][:, 0].to(gpu)}, [4])
    action = data["cheetah"]["action"][:, :3].float().to(gpu)
    env.imagine_steps(now, action)
    with without_waits():
        env.imagine_steps(now, action.requires_grad_()).rewards.sum().backward()


def test_pessimistic_plans(gpu, data, both):
    plans, options = [], {"iterations": 2, "samples": 4, "candidates": 2, "seed": 0, "pessimism": 1.0}
    for ensemble, device in zip(both, ("cpu", gpu), strict=True):
        planner = gn.GradientPlanner(gn.ModelEnv(ensemble, task), 3, **options)
        plans.append(planner(TensorDict({"state": data["cheetah"]["state"][:, 0].to(device)}, [4]))["action"])
    close(plans[1], plans[0], tolerance=1e-4)


def test_the_actor_critic_in_an_ensemble(gpu, systems, data, both):
    scene, state = systems["cheetah"], data["cheetah"]["state"]
    torch.manual_seed(0)
    networks = StatePolicy(scene, hidden=(8,)), StateValue(scene, hidden=(8,))
    losses = []
    for ensemble, device in zip(both, ("cpu", gpu), strict=True):
        policy, value = (copy.deepcopy(each).to(device) for each in networks)
        loss = gn.SHACLoss(policy, value, gn.ModelEnv(ensemble, task), steps=2, pessimism=1.0).to(device)
        loss.fit_normalizers(state.flatten(0, 1).to(device), torch.rand(20, 1).to(device))
        out = loss(TensorDict({"state": state[:, 0].to(device)}, [4]))
        (out["loss_actor"] + out["loss_value"]).backward()
        losses.append(out["loss_actor"])
    assert losses[1].device == gpu and losses[1].isfinite().cpu() and losses[0].isfinite()


def test_a_guard(gpu, data, both):
    actions = [
        TensorDictModule(lambda state, v=v: v + 0 * state[..., 1:7, 0], ["state"], ["action"]) for v in (0.5, 0.0)
    ]
    found = []
    for ensemble, device in zip(both, ("cpu", gpu), strict=True):
        policy = Guarded(*actions, ensemble, trust=1.0)
        found.append(policy(TensorDict({"state": data["cheetah"]["state"][:, 0].to(device)}, [4])))
    close(found[1]["doubt"], found[0]["doubt"], tolerance=1e-6)
    assert torch.equal(found[1]["guarded"].cpu(), found[0]["guarded"])


def test_adaptation(gpu, data, both):
    found = []
    for ensemble, device in zip(both, ("cpu", gpu), strict=True):
        predictor, given = ensemble.members[0], data["cheetah"].to(device)
        adaptation, belief = Adaptation(predictor, given), None
        belief = adaptation.start(4)
        for step in range(5):
            belief = adaptation.update(
                belief, given["state"][:, step], given["action"][:, step], given["state"][:, step + 1]
            )
        commands = adaptation.read(belief, guarded=False)
        adapted = AdaptedPredictor(predictor, type(commands)(*(part[0] for part in commands)))
        found.append((commands.gain, adapted.step(given["state"][:, 0], given["action"][:, 0])))
    for here, there in zip(*found, strict=True):
        close(there, here, tolerance=1e-5)

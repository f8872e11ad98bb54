"""Losses refuse networks whose normalisers have no data; after the first data, the check costs no time."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.objectives import LossModule

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.maths import Normalizer
from torchrl_gn.objectives import (
    ForwardModelLoss,
    IdentificationLoss,
    ObservationModelLoss,
    SeveralScenesLoss,
    SVGLoss,
)
from torchrl_gn.policies import Agent
from torchrl_gn.scenes import ObservationGraph, load_scene

from ..sizes import SMALL

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")


class Case(NamedTuple):
    """A fresh loss, a batch for it, its fit, the remedy in its refusal, and all weights."""

    loss: LossModule
    batch: TensorDictBase | list[TensorDictBase]
    fit: Callable[[], object]
    remedy: str
    weights: nn.Module


def forward_model(**options) -> Case:
    scene = load_scene("pendulum")
    loss = ForwardModelLoss(ForwardModel.for_scene(scene, **SMALL, **options).bind(scene))
    batch = transitions("pendulum")
    return Case(
        loss,
        batch,
        lambda: loss.fit_normalizers(batch),
        r"Call fit_normalizers\(transitions\) of the loss",
        loss.trained,
    )


def several_scenes() -> Case:
    model = ForwardModel.for_scene(load_scene("pendulum"), **SMALL)
    names = ("pendulum", "cartpole")
    loss = SeveralScenesLoss([ForwardModelLoss(model.bind(load_scene(name))) for name in names])
    batch = [transitions(name) for name in names]
    return Case(loss, batch, lambda: loss.fit_normalizers(batch), r"Call fit_normalizers.* of each scene", loss.trained)


def identification() -> Case:
    scene = load_scene("pendulum")
    forward = ForwardModel.for_scene(scene, parameters="inferred", inferred=(3, 3, 3), **SMALL)
    loss = IdentificationLoss(IdentifyingModel(forward), scene, context_length=3)
    batch = transitions("pendulum", window=4)
    flat = transitions("pendulum")
    return Case(loss, batch, lambda: loss.fit_normalizers(flat), r"Call fit_normalizers\(transitions\)", loss.trained)


def transitions(name: str, **options) -> TensorDictBase:
    trajectories = collect_trajectories(load_scene(name), 4, 10)
    return trajectory_buffer(trajectories, batch_size=20, seed=0, **options).sample()


def agent_case(kind: str) -> Case:
    graph, sizes = ObservationGraph.swimmer(3), {"latent": 4, "hidden": [8]}
    policy = "graph" if kind == "policy" else "mlp"
    options = {"policy_options": sizes} if policy == "graph" else {"model": "gn", "model_options": sizes}
    agent = Agent(graph, policy=policy, hidden=(8,), learned_reward=True, **options)
    ended = torch.zeros(20, 1, dtype=torch.bool)
    after = {"observation": torch.randn(20, 13), "reward": torch.randn(20, 1), "done": ended, "terminated": ended}
    batch = TensorDict({"observation": torch.randn(20, 13), "action": torch.rand(20, 2), "next": after}, [20])
    if kind == "observations":
        loss: LossModule = ObservationModelLoss(agent.model, agent.reward)
    else:
        loss = SVGLoss(agent.policy, agent.value, agent.model, agent.reward, steps=int(kind == "planning"))
    keys = ("observation", "action", ("next", "observation"))
    return Case(
        loss,
        batch,
        lambda: agent.update_normalizers(*(batch[key] for key in keys)),
        r"Call update_normalizers\(observation, action, next_observation\) of the Agent",
        agent,
    )


CASES = {
    "forward model": forward_model,
    "recurrent": lambda: forward_model(core="recurrent", hidden_state=(3, 3, 3)),
    "true parameters hidden": lambda: forward_model(parameters="none"),
    "several scenes": several_scenes,
    "identification": identification,
    "observations": lambda: agent_case("observations"),
    "planning": lambda: agent_case("planning"),
    "policy": lambda: agent_case("policy"),
}


@pytest.fixture(params=CASES)
def make(request) -> Callable[[], Case]:
    torch.manual_seed(0)
    return CASES[request.param]


def test_what_was_never_fitted_is_refused_and_asked_for_until_it_passed_once(make):
    case = make()
    for _ in range(2):
        with pytest.raises(RuntimeError, match=f"{type(case.loss).__name__}: .* have seen no data.* {case.remedy}"):
            case.loss(case.batch)
    case.fit()
    case.loss(case.batch)
    for module in case.weights.modules():
        if isinstance(module, Normalizer):
            module.reset()
    case.loss(case.batch)  # it does not look again


def test_statistics_that_came_with_weights_count(make):
    trained, fresh = make(), make()
    trained.fit()
    fresh.weights.load_state_dict(trained.weights.state_dict())
    assert all(bool(value.isfinite().all()) for value in fresh.loss(fresh.batch).values())


@pytest.mark.parametrize(
    "part", ["node", "edge", "parameter_node", "parameter_edge", "parameter_global", "residual", "delta"]
)
def test_a_model_of_which_a_part_was_never_fitted_is_refused(part):
    """Fitted by hand, and one forgotten."""
    case = forward_model()
    case.fit()
    normalizer = getattr(case.weights, f"{part}_normalizer")
    normalizer.load_state_dict({name: torch.zeros_like(value) for name, value in normalizer.state_dict().items()})
    with pytest.raises(RuntimeError, match="ForwardModelLoss: normalisers of its ForwardModel have seen no data"):
        case.loss(case.batch)


def test_predictions_need_no_data():
    """Benchmarks predict with random weights: bodies coast without statistics."""
    case = forward_model()
    bound = case.loss.model
    state, _ = bound.step(case.batch["state"], case.batch["action"])
    assert bool(state.isfinite().all())


@pytest.mark.slow
def test_noise_needs_a_scale(make_loss, windows):
    """A trained model has statistics; the loss must be told the scale of its states."""
    trained = make_loss().model.model.state_dict()
    batch = windows["swimmer6"].reshape(-1)
    quiet, noisy = make_loss(fitted=False), make_loss(fitted=False, noise=0.1)
    for loss in (quiet, noisy):
        loss.model.model.load_state_dict(trained)
    quiet(batch)
    with pytest.raises(RuntimeError, match=r"noise=0.1 is in standard deviations .* Call fit_scales\(transitions\)"):
        noisy(batch)
    noisy.fit_scales(batch)
    noisy(batch)
    assert all(torch.equal(value, trained[name]) for name, value in noisy.model.model.state_dict().items())
    assert torch.equal(noisy.noise_scale, make_loss(noise=0.1).noise_scale)


def test_scales_are_fitted_through_the_losses_that_hold_others():
    several, identifying = several_scenes(), identification()
    several.loss.fit_scales(several.batch)
    identifying.loss.fit_scales(transitions("pendulum"))
    for loss in (*several.loss.scene_losses, identifying.loss.prediction):
        assert bool(loss.noise_scale.any()) and bool((loss.error_weight >= 0).all())
        assert not loss.trained.fitted

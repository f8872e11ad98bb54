"""Refusals of a predictor name the input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.dynamics import specialize
from torchrl_gn.envs import ModelEnv
from torchrl_gn.policies import ObservationModel, StatePolicy, StateValue

WRONG = {
    "an array": (np.asarray, r"must be a tensor, not numpy.ndarray: convert it with torch.as_tensor"),
    "a list": (lambda x: x.tolist(), "must be a tensor, not list"),
    "complex": (lambda x: x.to(torch.complex64), "must be real numbers, not complex64"),
    "bool": (lambda x: x.bool(), "must be real numbers, not bool"),
    "whole": (lambda x: x.long(), "must be floating-point numbers, not int64"),
}
METHODS = ["step", "rollout", "delta", "teacher_forced"]


@pytest.fixture
def predictors(scenes, make_model):
    bound = make_model(scenes["pendulum"]).bind(scenes["pendulum"])
    return bound, specialize(bound)


def inputs(scene, method: str, states, actions):
    """State and action of a batch of 3, in the shapes that a method reads."""
    many = {"rollout": (3, 2), "teacher_forced": (3, 2)}.get(method, (3,))
    state = states(scene, *(many if method == "teacher_forced" else (3,)))
    return state, actions(scene, *many)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_states_in_16_bits_are_refused(scenes, predictors, random_states, random_actions, dtype, method):
    state, action = inputs(scenes["pendulum"], method, random_states, random_actions)
    for predictor in predictors:
        with pytest.raises(
            TypeError, match=f"The state must be float32 or float64, not {str(dtype)[6:]}: convert it with float"
        ):
            getattr(predictor, method)(state.to(dtype), action)
        getattr(predictor, method)(state.float(), action.to(dtype))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("wrong", WRONG)
def test_inputs_that_are_no_tensors_of_numbers(scenes, predictors, random_states, random_actions, wrong, method):
    change, message = WRONG[wrong]
    state, action = inputs(scenes["pendulum"], method, random_states, random_actions)
    for predictor in predictors:
        with pytest.raises(TypeError, match=f"The state {message}"):
            getattr(predictor, method)(change(state), action)
        if wrong != "whole":
            with pytest.raises(TypeError, match=f"The action {message}"):
                getattr(predictor, method)(state, change(action))


@pytest.mark.parametrize("method", METHODS)
def test_whole_actions_are_numbers(scenes, predictors, random_states, random_actions, method):
    state, action = inputs(scenes["pendulum"], method, random_states, random_actions)
    action = action.round()
    for predictor in predictors:
        wanted, got = (getattr(predictor, method)(state, each) for each in (action, action.long()))
        torch.testing.assert_close(got, wanted, rtol=1e-6, atol=1e-9)


def test_misshapen_steps(scenes, predictors, random_states, random_actions):
    scene = scenes["pendulum"]
    states, actions = random_states(scene, 3, 2), random_actions(scene, 3, 2)
    for predictor in predictors:
        for wrong in (actions[0, 0], actions[:2], actions[..., :0]):
            with pytest.raises(ValueError, match="Action of scene 'pendulum' must be"):
                predictor.rollout(states[:, 0], wrong)
        with pytest.raises(ValueError, match="State of scene 'pendulum' must be"):
            predictor.rollout(states[0, 0, 0], actions)
        with pytest.raises(ValueError, match="no state to predict from"):
            predictor.teacher_forced(states[:, :0], actions[:, :0])


@pytest.mark.parametrize("wrong", WRONG)
def test_policies_values_and_environments(scenes, predictors, random_states, random_actions, wrong):
    change, message = WRONG[wrong]
    scene = scenes["pendulum"]
    state = random_states(scene, 3)
    for network in (StatePolicy(scene, hidden=[4]).act, StateValue(scene, hidden=[4])):
        with pytest.raises(TypeError, match=message):
            network(change(state))
    if wrong != "whole":
        with pytest.raises(TypeError, match=f"The actions {message}"):
            ModelEnv(predictors[0]).imagine(TensorDict({"state": state}, [3]), change(random_actions(scene, 3, 2)))


@pytest.mark.parametrize("wrong", WRONG)
def test_observations(observation_graphs, transitions, wrong):
    change, message = WRONG[wrong]
    model = ObservationModel(observation_graphs["swimmer3"], latent=4, hidden=(4,))
    observation, action, _ = transitions(model.graph, 3)
    with pytest.raises(TypeError, match=message):
        model.step(change(observation), action)

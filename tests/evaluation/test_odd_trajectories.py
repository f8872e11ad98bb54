"""Trajectories without meaning are refused by all that measures or fits with them; they gave numbers."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import Adaptation, AdaptedPredictor, Ensemble, RobotChange
from torchrl_gn.evaluation import (
    calibrate,
    evaluate_errors,
    half_step_errors,
    identification_errors,
    joint_errors,
    pose_errors,
)
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import fit, fit_physics, identify_parameters, load_pretrained

STEPS = 12


class Sliding(nn.Module):
    """Physics with a parameter to fit."""

    def __init__(self) -> None:
        super().__init__()
        self.share = nn.Parameter(torch.ones(()))

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return torch.cat((state[..., :3] + 0.01 * self.share * state[..., 7:10], state[..., 3:]), -1)


@pytest.fixture(scope="module")
def data() -> TensorDict:
    return collect_trajectories(load_scene("pendulum"), 6, STEPS, seed=0)


@pytest.fixture(scope="module")
def measures() -> dict[str, Callable[[TensorDict], object]]:
    scene = load_scene("pendulum")
    bound = load_pretrained("pendulum").bind(scene)
    ensemble = Ensemble.for_scene(scene, count=2, hidden=8).bind(scene)
    identifying = load_pretrained("identified_pendulum").trained
    assert isinstance(identifying, IdentifyingModel)
    reader = identifying.bind(scene)
    return {
        "evaluate": lambda data: evaluate_errors(bound, data, horizons=(10,)),
        "joints": lambda data: joint_errors(bound, data),
        "poses": lambda data: pose_errors(bound, data),
        "half step": lambda data: half_step_errors(scene, data, horizons=(10,)),
        "calibrate": lambda data: calibrate(ensemble, data),
        "identification": lambda data: identification_errors(*reader, data, data, horizons=(10,)),
        "adaptation": lambda data: Adaptation(bound, data),
        "fit": lambda data: fit(load_pretrained("pendulum").bind(scene), data, steps=1, progress=False),
        "physics": lambda data: fit_physics(Sliding(), scene, data, steps=1, window=2, batch_size=4),
        "parameters": lambda data: identify_parameters(scene, data, {"body_mass": None}, window=2, iterations=1),
    }


MEASURES = (
    *("evaluate", "joints", "poses", "half step", "calibrate", "identification", "adaptation", "fit", "physics"),
    "parameters",
)


def changed(data: TensorDict, how: str) -> TensorDict:
    data = data.clone()
    if how == "lost state":
        data["state"][2, -1, 1, 7] = torch.nan
    elif how == "lost action":
        data["action"][2, 5] = torch.inf
    elif how == "padding":
        data["state"][2, 8:] = 0
    elif how == "other step":
        data["physics"][..., 0] *= 2
    elif how == "lost times":
        data["physics"][1, :, 0] = torch.nan
    else:
        data = data[:0]
    return data


@pytest.mark.parametrize("name", MEASURES)
@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("lost state", "Trajectory 2 contains states that are not finite"),
        ("lost action", "Trajectory 2 contains actions that are not finite"),
        ("padding", "Trajectory 2 contains states with a zero quaternion"),
        ("other step", "States of trajectory 0 are 40 ms apart"),
        ("lost times", "States 0 and 1 of trajectory 1 are nan ms apart"),
        ("none", r"[Tt]rajector|sequence"),
    ],
)
def test_trajectories_without_meaning_are_refused(name, how, message, data, measures):
    with pytest.raises(ValueError, match=message):
        measures[name](changed(data, how))


@pytest.mark.parametrize("name", MEASURES)
def test_the_same_whole_trajectories_are_measured(name, data, measures):
    measures[name](data)


def test_poses_by_known_physics_need_finite_states_of_one_episode(data):
    with pytest.raises(ValueError, match="Trajectory 2 contains states that are not finite"):
        pose_errors(lambda state, action: state, changed(data, "lost state"), node=1)
    done = torch.zeros(*data["action"].shape[:2], 1, dtype=torch.bool)
    done[1, 3] = True
    with pytest.raises(ValueError, match="ends .* inside the trajectories"):
        pose_errors(lambda state, action: state, data.clone().set(("next", "done"), done), node=1)


def test_half_steps_need_trajectories_as_long(data):
    scene = load_scene("pendulum")
    for horizons in ((STEPS + 1,), ()):
        with pytest.raises(ValueError, match=f"must be from 1 to the trajectories' {STEPS} steps"):
            half_step_errors(scene, data, horizons=horizons)


def test_adaptation_needs_two_steps():
    scene = load_scene("pendulum")
    with pytest.raises(ValueError, match="two steps or more"):
        Adaptation(load_pretrained("pendulum").bind(scene), collect_trajectories(scene, 1, 1, seed=0))


def test_a_burn_in_leaves_a_step(data):
    bound = load_pretrained("pendulum").bind(load_scene("pendulum"))
    for burn_in in (STEPS, STEPS + 5):
        with pytest.raises(ValueError, match=f"burn_in={burn_in} must be less than the trajectories' {STEPS} steps"):
            evaluate_errors(bound, data, horizons=(), burn_in=burn_in)


def test_a_change_that_is_none_is_not_taken():
    adapted = AdaptedPredictor(load_pretrained("pendulum").bind(load_scene("pendulum")))
    none = torch.zeros(0)
    for value, message in (
        (torch.tensor([torch.nan]), "gain of the change has nan"),
        (torch.ones(2), r"gain must be \[1\], of one robot, got \[2\]"),
        (torch.ones(3, 1), r"gain must be \[1\], of one robot, got \[3, 1\]"),
    ):
        with pytest.raises(ValueError, match=message):
            adapted.take(RobotChange(value, value, value, value, none, none))
    with pytest.raises(ValueError, match="offset of the change has inf"):
        adapted.take(RobotChange(torch.tensor([0.5]), none, torch.tensor([torch.inf]), none, none, none))
    assert adapted.gain.tolist() == [1.0] and adapted.offset.tolist() == [0.0]

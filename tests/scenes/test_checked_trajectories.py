"""Trajectories from which a model would learn nonsense are refused, by fitting and by measuring alike."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

import torchrl_gn as gn
from torchrl_gn.training import identify_parameters


@pytest.fixture(scope="module")
def scene():
    return gn.load_scene("pendulum")


@pytest.fixture(scope="module")
def played(scene) -> TensorDict:
    return gn.collect_trajectories(scene, 4, steps=12, seed=0)


@pytest.fixture(params=["fit", "fit_ensemble", "errors", "calibrate", "coverage", "identify"])
def use(request, scene, played):
    """Use trajectories in one of the library's ways."""
    model = gn.ForwardModel.for_scene(scene, hidden=8, layers=1).bind(scene)
    ensemble = gn.Ensemble.for_scene(scene, count=2, hidden=8, layers=1).bind(scene)
    if request.param == "coverage":
        gn.fit_ensemble(ensemble, played, steps=1, batch_size=4, progress=False)
        gn.calibrate(ensemble, played)
    options = {"steps": 1, "batch_size": 4, "progress": False}
    return {
        "fit": lambda data: gn.fit(model, data, **options),
        "fit_ensemble": lambda data: gn.fit_ensemble(ensemble, data, **options),
        "errors": lambda data: gn.evaluate_errors(model, data, horizons=(6,)),
        "calibrate": lambda data: gn.calibrate(ensemble, data),
        "coverage": lambda data: gn.evaluate_coverage(ensemble, data, horizons=(1, 6)),
        "identify": lambda data: identify_parameters(scene, data, {"dof_damping": None}, window=6),
    }[request.param]


def test_another_control_step_is_refused(use, scene, played):
    use(played)
    slow = gn.collect_trajectories(gn.load_scene("pendulum", timestep=2 * scene.timestep), 2, steps=12, seed=0)
    with pytest.raises(ValueError, match="trajectory 0 are 40 ms apart, but the control step .* is 20 ms: load it"):
        use(slow)
    with pytest.raises(ValueError, match="trajectory 4 are 40 ms apart"):
        use(torch.cat([played, slow]))
    every_second = played.apply(lambda x: x[:, ::2], batch_size=[4])
    every_second["action"] = played["action"][:, ::2]
    with pytest.raises(ValueError, match="trajectory 0 are 40 ms apart"):
        use(every_second)


def test_gaps_and_resets_inside_are_refused(use, played):
    """As in rows of a collector, cut to trajectories without their flags."""
    half = played["action"].shape[1] // 2
    for missing, apart in ((3, 80), (-half, -100)):
        broken = played.clone()
        broken["physics"][1, half + 1 :, 0] += missing * 0.02
        with pytest.raises(ValueError, match=f"States {half} and {half + 1} of trajectory 1 are {apart} ms .* Cut"):
            use(broken)
        with pytest.raises(ValueError, match="another episode begins"):
            gn.trajectory_buffer(broken, batch_size=4, window=3)
    late = played.clone()
    late["physics"] = (late["physics"] + 1e3).float()
    use(late)


def test_a_log_is_no_trajectories(use, played):
    with pytest.raises(TypeError, match="must be a TensorDict .*, got tuple; logs become trajectories by log_traj"):
        use((played["state"], played["action"]))


@pytest.mark.parametrize(
    ("key", "index", "value", "what"),
    [
        ("state", (2, 3, 1, 10), torch.nan, "Trajectory 2 contains states that are not finite"),
        ("state", (3, 6, 1, slice(3, 7)), 0.0, "Trajectory 3 contains states with a zero quaternion"),
        ("action", (1, 5), torch.inf, "Trajectory 1 contains actions that are not finite"),
    ],
)
def test_numbers_that_are_no_states_or_actions_are_refused(use, played, key, index, value, what):
    broken = played.clone()
    broken[key][index] = value
    with pytest.raises(ValueError, match=what):
        use(broken)


def test_episodes_that_end_inside_are_refused(use, played):
    done = torch.zeros(4, 12, 1, dtype=torch.bool)
    done[:, -1] = True
    use(played.clone().set(("next", "done"), done.clone()))
    done[2, 3] = True
    with pytest.raises(ValueError, match="ends .* inside the trajectories"):
        use(played.clone().set(("next", "done"), done))


def test_trajectories_without_times_are_used_as_they_are(use, played):
    use(played.select("state", "action"))
    use(played.clone().set("physics", played["physics"].float()))
    use(played.clone().apply(lambda x: x.requires_grad_()))

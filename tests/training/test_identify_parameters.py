"""Numbers of a MuJoCo model from trajectories."""

from __future__ import annotations

import importlib

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import Simulator, collect_trajectories
from torchrl_gn.scenes import load_scene, with_factors
from torchrl_gn.training import identify_parameters, parameter_names

module = importlib.import_module("torchrl_gn.training.identify_parameters")  # the folder's name is the function's

ARM = """<mujoco model="arm"><option integrator="implicitfast" timestep="0.005"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.5" armature="0.05"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" contype="0" conaffinity="0"/>
    <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.2" armature="0.02"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" contype="0" conaffinity="0"/></body></body></worldbody>
  <actuator><motor joint="shoulder" ctrlrange="-20 20"/><motor joint="elbow" ctrlrange="-5 5"/></actuator></mujoco>"""
NUMBERS = {"dof_armature": None, "dof_damping": ["elbow"], "body_mass": ["lower"]}
FACTORS = np.array([3.0, 0.4, 1.7, 1.5])


@pytest.fixture(scope="module")
def arm():
    return load_scene(ARM, timestep=0.01)


@pytest.fixture(scope="module")
def played(arm) -> TensorDict:
    return collect_trajectories(with_factors(arm, NUMBERS, FACTORS), 6, 60, seed=0)


def measured(arm, played: TensorDict, seed: int) -> TensorDict:
    """Trajectories with noise of 1 mrad and 10 mrad/s."""
    rng, physics = np.random.default_rng(seed), played["physics"].numpy().copy()
    physics[..., 1:3] += 1e-3 * rng.standard_normal(physics[..., 1:3].shape)
    physics[..., 3:5] += 1e-2 * rng.standard_normal(physics[..., 3:5].shape)
    return TensorDict({"state": Simulator(arm).observe(physics), "action": played["action"]}, played.shape)


def test_it_finds_the_numbers_to_rounding(arm, played):
    found = identify_parameters(arm, played, NUMBERS, window=30)
    names = ("dof_armature shoulder", "dof_armature elbow", "dof_damping elbow", "body_mass lower")
    assert found.names == parameter_names(arm, NUMBERS) == names
    np.testing.assert_allclose(found.factor, FACTORS, rtol=1e-7)
    np.testing.assert_allclose(found.value[:3], [0.15, 0.008, 0.34], rtol=1e-7)
    assert found.model.dof_damping[1] == found.value[2] and found.error < 1e-8
    lower = found.model.body("lower").id
    np.testing.assert_allclose(found.model.body_inertia[lower], 1.5 * arm.model.body_inertia[lower], rtol=1e-6)
    assert arm.model.dof_damping[1] == 0.2 and str(found).count("\n") == 4
    assert (found.interval()[:, 0] <= found.value).all()


def test_contacts_do_not_hide_the_minimum():
    """Over whole windows the squares have many minima; the first steps of each show the way."""
    cheetah, numbers = load_scene("cheetah"), {"dof_damping": None, "body_mass": ["torso"]}
    factors = np.exp(np.random.default_rng(1).uniform(-0.69, 0.69, 7))
    played = collect_trajectories(with_factors(cheetah, numbers, factors), 6, 60, seed=1)
    found = identify_parameters(cheetah, played, numbers, window=30)
    np.testing.assert_allclose(found.factor, factors, rtol=1e-6)


def test_a_parameter_that_noise_made_vanish_is_found_again(arm, played, monkeypatch):
    """Logarithms have no slope there: the others were fitted around it, with narrow intervals."""

    def begun(self, log, iterations):
        return log - 30 * np.array([name == "dof_damping" for name, _ in self.rows])

    monkeypatch.setattr(module._Problem, "begun", begun)
    noisy = measured(arm, played, 0)
    found = identify_parameters(arm, noisy, NUMBERS, window=60, fit_starts=True)
    assert (np.abs(np.log(found.factor / FACTORS)) < 4 * found.std).all() and (found.std < 0.1).all()


def test_starts_follow_from_states(arm, played):
    found = identify_parameters(arm, played.exclude("physics"), NUMBERS, window=30)
    np.testing.assert_allclose(found.factor, FACTORS, rtol=1e-5)


def test_noise_is_within_what_is_stated(arm, played):
    errors, plain = [], []
    for seed in range(5):
        noisy = measured(arm, played, seed)
        found = identify_parameters(arm, noisy, NUMBERS, window=60, fit_starts=True)
        errors.append(np.log(found.factor / FACTORS) / found.std)
        assert (found.std < 0.1).all()
        plain.append(np.log(identify_parameters(arm, noisy, NUMBERS, window=60).factor / FACTORS))
    errors = np.abs(errors)
    assert (errors < 2).mean() >= 0.8 and (errors < 4).all()
    # Starts as measured bias the numbers.
    assert np.square(plain).mean() > np.square(errors * found.std).mean()


def test_what_nothing_tells_is_unknown(arm):
    still = {"state": torch.zeros(1, 11, 3, 13).double(), "action": torch.zeros(1, 10, 2).double()}
    physics = torch.zeros(1, 11, arm.physics_size).double()
    physics[..., 0] = 0.01 * torch.arange(11)
    hanging = with_factors(arm, {"dof_damping": None}, np.ones(2))
    hanging.model.opt.gravity[:] = 0
    state = Simulator(hanging).rollout(physics[:, 0], still["action"])["state"]
    data = TensorDict({**still, "state": state, "physics": physics}, [1])
    found = identify_parameters(hanging, data, {"dof_armature": ["elbow"]}, window=10)
    assert found.factor == 1 and np.isinf(found.std).all()


@pytest.mark.slow
def test_a_robot_that_never_moves_has_no_known_friction(played):
    """Any larger damping fits as well; the search went on to 1e65, with a narrow interval."""
    still = played.clone()
    for key, rates in (("state", slice(7, None)), ("physics", slice(3, None))):
        still[key][:, 1:] = still[key][:, :1]
        still[key][..., rates] = 0
    still["physics"][..., 0] = played["physics"][..., 0]
    weightless = load_scene(ARM.replace("<option", '<option gravity="0 0 0"'), timestep=0.01)
    assert np.isinf(identify_parameters(weightless, still, {"dof_damping": None}, window=30).std).all()


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_numbers_of_which_only_a_product_shows_are_unknown(noise, arm, played):
    """A motor's gain times its gear; and all masses, gains, dampings and armatures together."""
    noisy = played.clone()
    moves = torch.as_tensor(arm.predicted)[:, None]
    noisy["state"] = played["state"] + noise * moves * torch.randn(played["state"].shape, dtype=torch.float64)
    own, gear, gain = "dof_armature shoulder", "actuator_gear actuator0", "actuator_gainprm actuator0"
    found = identify_parameters(arm, noisy, {"dof_armature": ["shoulder"], "actuator_gear": ["actuator0"]}, window=30)
    assert np.isfinite(found.std).all()
    numbers = {"dof_armature": ["shoulder"], "actuator_gear": ["actuator0"], "actuator_gainprm": ["actuator0"]}
    found = identify_parameters(arm, noisy, numbers, window=30)
    assert dict(zip(found.names, np.isinf(found.std), strict=True)) == {own: False, gear: True, gain: True}
    assert found.interval()[1:].tolist() == [[0, np.inf]] * 2 and np.isfinite(found.factor).all()
    together = {"body_mass": None, "actuator_gear": None, "dof_damping": None, "dof_armature": None}
    assert np.isinf(identify_parameters(arm, noisy, together, window=30).std).all()


def test_what_does_not_fit_is_named(arm, played):
    for parameters, what in (
        ({"nv": None}, "'nv' is not an array of mjModel"),
        ({"dof_armature": ["wrist"]}, r"dof_armature: the model has no 'wrist', only \['shoulder', 'elbow'\]"),
        ({"dof_frictionloss": ["elbow"]}, "dof_frictionloss of 'elbow' is 0"),
        ({"dof_frictionloss": None}, "There is nothing to change"),
    ):
        with pytest.raises(ValueError, match=what):
            identify_parameters(arm, played, parameters)
    with pytest.raises(ValueError, match="window=61 must be from 1 to the trajectories' 60 steps"):
        identify_parameters(arm, played, NUMBERS, window=61)
    for option in ("window", "max_windows"):
        with pytest.raises(ValueError, match=f"{option}=0 must be a whole number"):
            identify_parameters(arm, played, NUMBERS, **{option: 0})


def test_a_robot_at_rest_tells_nothing(arm, played):
    rest = played.clone()
    rest["state"] = played["state"][:, :1].expand_as(played["state"]).clone()
    assert np.isinf(identify_parameters(arm, rest, {"dof_damping": ["elbow"]}, window=30).std).all()


def test_several_robots_are_refused(arm):
    robots = [with_factors(arm, {"dof_damping": None}, [factor, 1.0]) for factor in (1.0, 2.0)]
    played = collect_trajectories(robots, 4, 10, seed=0)
    with pytest.raises(ValueError, match=r"of several robots: .*Identify one at a time"):
        identify_parameters(arm, played, {"dof_damping": None}, window=10)
    found = identify_parameters(arm, played[1::2], {"dof_damping": ["shoulder"]}, window=10)
    np.testing.assert_allclose(found.factor, 2.0, rtol=1e-5)


def test_windows_are_drawn(arm, played):
    found = identify_parameters(arm, played, {"body_mass": ["lower"]}, window=10, max_windows=3)
    assert np.isfinite(found.std).all() and mujoco.MjModel is type(found.model)


def test_parameters_with_one_effect_do_not_determine_each_other():
    """A motor's gear, inertia and damping scale together without gravity; another joint's damping is known."""
    hinge = """<body pos="0 {0} 0"><joint name="j{0}" axis="0 1 0" armature="0.1" damping="0.2"/>
      <inertial pos="0 0 0" mass="1" diaginertia="1e-9 1e-9 1e-9"/></body>"""
    scene = load_scene(
        f"""<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>{hinge.format(0)}{hinge.format(1)}</worldbody>
        <actuator><motor name="m" joint="j0" ctrlrange="-1 1"/><motor joint="j1" ctrlrange="-1 1"/></actuator>
        </mujoco>""",
        timestep=0.02,
    )
    numbers = {"dof_armature": ["j0", "j1"], "dof_damping": ["j0"], "actuator_gear": ["m"]}
    factors = np.array([1.3, 0.6, 1.7, 0.8])
    played = collect_trajectories(with_factors(scene, numbers, factors), 10, 60, seed=0)
    for some in (slice(None), slice(0, 3)):  # with few windows, each step is a cluster
        found = identify_parameters(scene, played[some], numbers, window=30)
        assert found.names[1] == "dof_armature j1" and np.isinf(found.std).tolist() == [True, False, True, True]
        assert found.factor[1] == pytest.approx(0.6) and found.std[1] < 1e-6
        np.testing.assert_allclose(found.factor[[0, 2]] / found.factor[3], factors[[0, 2]] / 0.8, rtol=1e-6)


def late(arm, delays: tuple[float, float], *, count: int = 6, steps: int = 60) -> TensorDict:
    """Trajectories of the arm with armatures tripled, simulated by MuJoCo's own delayed actuators, seconds."""
    if not hasattr(mujoco.MjModel, "actuator_history"):
        pytest.skip("needs MuJoCo 3.5")
    text = ARM
    for joint, delay in zip(("shoulder", "elbow"), delays, strict=True):
        kept = int(np.ceil(delay / 0.005 - 1e-6)) + 1
        text = text.replace(f'<motor joint="{joint}"', f'<motor joint="{joint}" delay="{delay}" nsample="{kept}"')
    model = mujoco.MjModel.from_xml_string(text.replace("nsample", 'interp="linear" nsample'))
    model.dof_armature *= 3
    mujoco.mj_setConst(model, mujoco.MjData(model))
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (count, steps, 2)) * [20.0, 5.0]
    physics = np.zeros((count, steps + 1, 5))
    for row, given in zip(physics, actions, strict=True):
        data = mujoco.MjData(model)
        for step, action in enumerate(given):
            data.ctrl = action
            mujoco.mj_step(model, data, nstep=2)
            row[step + 1] = [data.time, *data.qpos, *data.qvel]
    state = Simulator(arm).observe(physics)
    return TensorDict(
        {"state": state, "physics": torch.from_numpy(physics), "action": torch.from_numpy(actions)}, [count]
    )


EACH = {"dof_armature": None, "actuator_delay": None}
ALL = {"dof_armature": None, "actuator_delay": [("actuator0", "actuator1")]}  # the scene's actuator_names


@pytest.mark.parametrize(
    "delays",
    [(0.0131, 0.0275), *(pytest.param(each, marks=pytest.mark.slow) for each in ((0.015, 0.05), (0.0, 0.0075)))],
)
def test_delays_are_mujocos(delays, arm):
    """Fractions of physics steps, whole ones, less than a control step, and none.

    MuJoCo's interpolated delays below a physics step are one.
    """
    found = identify_parameters(arm, late(arm, delays).exclude("physics"), EACH, window=20)
    assert found.names == parameter_names(arm, EACH)
    assert found.names[2:] == ("actuator_delay actuator0", "actuator_delay actuator1")
    np.testing.assert_allclose(found.factor[:2], 3.0, rtol=1e-7)
    np.testing.assert_allclose(found.value[2:], delays, atol=1e-9)
    assert np.isnan(found.factor[2:]).all() and (found.std < 1e-6).all()
    low, high = found.interval().T
    assert (low[2:] >= 0).all() and np.isfinite(high).all()


@pytest.mark.slow
def test_one_delay_of_all_commands_is_found_far_from_the_start(arm):
    """Random commands tell no direction from a delay of several control steps less."""
    found = identify_parameters(arm, late(arm, (0.0862, 0.0862)), ALL, window=20)
    assert found.names[2:] == ("actuator_delay actuator0 and 1 more",)
    assert found.value[2] == pytest.approx(0.0862, abs=1e-9)


@pytest.mark.slow
def test_noise_on_delays_is_within_what_is_stated(arm):
    played, off = late(arm, (0.0131, 0.0275)), []
    for seed in range(5):
        found = identify_parameters(arm, measured(arm, played, seed), EACH, window=50, fit_starts=True)
        off.append((found.value[2:] - [0.0131, 0.0275]) / found.std[2:])
        assert (found.std[2:] < 1e-3).all()
    assert (np.abs(off) < 2).mean() >= 0.8 and (np.abs(off) < 4).all()


@pytest.mark.slow
def test_a_delay_beyond_its_bound_is_unknown(arm):
    found = identify_parameters(arm, late(arm, (0.035, 0.035)), ALL, window=20, max_delay=0.03)
    assert found.value[2] == 0.03 and np.isinf(found.std[2]) and found.interval()[2].tolist() == [0, np.inf]


def test_delays_that_do_not_fit_are_named(arm, played):
    for value in (-0.01, 0.0, np.nan, np.inf):
        with pytest.raises(ValueError, match=r"max_delay=.* must be seconds, above 0"):
            identify_parameters(arm, played, ALL, max_delay=value)
    with pytest.raises(ValueError, match=r"window=51 must be from 1 to .* 60 steps, less the 10 of max_delay=0.1"):
        identify_parameters(arm, played, ALL, window=51)
    with pytest.raises(ValueError, match="max_delay=0.7"):  # longer than a trajectory
        identify_parameters(arm, played, ALL, window=1, max_delay=0.7)
    with pytest.raises(ValueError, match="actuator_delay: the model has no 'wrist'"):
        identify_parameters(arm, played, {"actuator_delay": ["wrist"]})
    idle = load_scene(ARM.replace('timestep="0.005"/>', 'timestep="0.005"><flag actuation="disable"/></option>'))
    with pytest.raises(ValueError, match="actuator_delay of 'actuator1' would have no effect: .* actuation off"):
        parameter_names(idle, {"actuator_delay": ["actuator1"]})
    with pytest.raises(ValueError, match="actuator_delay: 'actuator0' is named twice"):
        identify_parameters(arm, played, {"actuator_delay": ["actuator0", ("actuator0", "actuator1")]})
    slow = load_scene(
        ARM.replace('<motor joint="elbow"', '<motor joint="elbow" delay="0.01" nsample="4"'), timestep=0.01
    )
    again = collect_trajectories(slow, 2, 60, seed=0)
    with pytest.raises(ValueError, match=r"actuator_delay: actuators \['actuator1'\] of scene .* load it without them"):
        identify_parameters(slow, again, ALL)

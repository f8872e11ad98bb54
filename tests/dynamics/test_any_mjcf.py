"""Scenes of any MJCF: with every kind of actuator, and random ones, which load or are refused by name."""

from __future__ import annotations

import collections
import re

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from torchrl_gn.data import Simulator, sample_start_states, spline_controls
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.bound import update_dynamic_normalizers, update_parameter_normalizers
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.maths.quaternion import to_matrix
from torchrl_gn.scenes import Scene, SceneError, load_scene

from .. import zoo
from ..random_mjcf import random_mjcf

HIDDEN_8 = {"latent": 8, "edge_hidden": (8,), "node_hidden": (8,), "global_hidden": (8,)}
pytestmark = [
    pytest.mark.filterwarnings("ignore::torchrl_gn.data.start_poses.StartPoseWarning"),
    pytest.mark.filterwarnings("ignore:Inertia matrix is too close to singular:UserWarning"),
    pytest.mark.filterwarnings("ignore::torchrl_gn.dynamics.UnseenParameterWarning"),  # of one that moves little
]
SEEDS = 20
BLOCK = 50  # of a slow test


def simulate(scene: Scene, count: int = 4, steps: int = 5) -> tuple[Tensor, Tensor]:
    """States ``[n, T + 1, N, 13]`` and actions ``[n, T, A]`` of the stable ones of ``count`` simulations."""
    rng = np.random.default_rng(0)
    low, high = np.nan_to_num(scene.action_low, neginf=-1.0), np.nan_to_num(scene.action_high, posinf=1.0)
    actions = rng.uniform(low, high, (count, steps, scene.num_actions))
    rollout = Simulator(scene, 1).rollout(sample_start_states(scene, count, rng), actions)
    return rollout["state"][rollout["stable"]], torch.as_tensor(actions)[rollout["stable"]]


def fitted_model(scene: Scene, states: Tensor, actions: Tensor, seed: int = 0) -> ForwardModel:
    """A small model with random weights that has seen some transitions."""
    torch.manual_seed(seed)
    model = ForwardModel.for_scene(scene, **HIDDEN_8)
    bound = model.bind(scene)
    update_parameter_normalizers(bound)
    before, after = states[:, :-1].flatten(0, 1), states[:, 1:].flatten(0, 1)
    update_dynamic_normalizers(bound, before, actions.flatten(0, 1), after)
    return model.requires_grad_(False)


def difference(model: ForwardModel, scene: Scene, states: Tensor, actions: Tensor, executor: str) -> float:
    """Norm of an executor's difference from message passing, relative to the change of the state."""
    before = states[:, 0]
    expected, _ = model.bind(scene, reference=True).step(before, actions[:, 0])
    found, _ = specialize(model.bind(scene), executor=executor).step(before, actions[:, 0])
    assert expected.isfinite().all() and found.isfinite().all()
    rounding = 1e-5 * before.norm()  # of large states
    return float((found - expected).norm() / ((expected - before).norm() + rounding))


@pytest.mark.slow
@pytest.mark.parametrize("executor", ["eager", "native"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 2e-5)])
@pytest.mark.parametrize("name", ["quadrotor", "gripper", "tendon_arm", "machine"])
def test_every_executor_predicts_scenes_with_other_actuators(name, dtype, tolerance, executor):
    scene = zoo.load(name)
    states, actions = simulate(scene)
    model = fitted_model(scene, states, actions).to(dtype)
    assert difference(model, scene, states, actions, executor) <= tolerance
    leaf = actions[:1, 0].clone().requires_grad_()
    model.bind(scene).delta(states[:1, 0], leaf).square().sum().backward()
    assert leaf.grad is not None and (leaf.grad != 0).all()  # every action reaches some node


def check(seed: int, executor: str) -> str:
    """Load and predict a random model; return the outcome."""
    text = random_mjcf(seed)
    try:
        scene = load_scene(text)
    except SceneError as error:
        return refusal(str(error), text)
    assert str(scene) and load_scene(text).fingerprint() == scene.fingerprint()
    if scene.unbounded:
        with pytest.raises(SceneError, match="action_bounds"):
            spline_controls(scene, 1, 2, 0)
        assert not load_scene(text, action_bounds=(-1, 1)).unbounded
    states, actions = simulate(scene)
    if not len(states):
        return "unstable"
    assert states.isfinite().all()
    model = fitted_model(scene, states, actions, seed).double()
    error = difference(model, scene, states, actions, executor)
    assert error <= 1e-9, f"seed {seed}: {executor} differs by {error}"
    return "loaded"


def refusal(message: str, text: str) -> str:
    """The message without names and numbers; AssertionError if it names neither an element nor its line."""
    names = set(re.findall(r'name="(\w+)"', text))
    quoted = set(re.findall(r"'(\w+)'", message))
    located = re.search(r"line \d+|'(world|(joint|body|actuator)\d+)'|has no joint", message)
    assert quoted & names or located, message
    return re.sub(r"'\w*'|[\d.-]+", "#", message.replace("\n", " "))


def random_physics(scene: Scene, count: int, rng: np.random.Generator) -> np.ndarray:
    """Physics ``[count, S]`` with joints within their limits, else anywhere, turns away if states count them."""
    model, kind, physics = scene.model, mujoco.mjtJoint, np.tile(scene.rest_physics, (count, 1))
    for joint, start in enumerate(1 + model.jnt_qposadr):
        if model.jnt_type[joint] in (int(kind.mjJNT_FREE), int(kind.mjJNT_BALL)):
            start += 3 * (model.jnt_type[joint] == int(kind.mjJNT_FREE))
            quats = rng.normal(size=(count, 4))
            physics[:, start : start + 4] = quats / np.linalg.norm(quats, axis=1, keepdims=True)
        elif model.jnt_limited[joint]:
            low, high = model.jnt_range[joint]
            physics[:, start] = rng.uniform(low, high, count)
        else:
            physics[:, start] += rng.uniform(-1, 1, count) * (9 if joint in scene.unwrapped.joint else 3)
    physics[:, 1 + model.nq : 1 + model.nq + model.nv] = rng.normal(size=(count, model.nv))
    return physics


def test_states_of_random_models_give_back_their_joints():
    compared = 0
    for seed in range(SEEDS):
        try:
            scene = load_scene(random_mjcf(seed))
        except SceneError:
            continue
        model, physics = scene.model, random_physics(scene, 5, np.random.default_rng(seed))
        state, coordinates = Simulator(scene, 1).observe(physics), JointCoordinates(scene, partly=True)
        found = coordinates.joints(state, to_matrix(state[..., 3:7]).unflatten(-1, (3, 3)))
        scalar = np.isin(model.jnt_type, (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)))
        which = np.flatnonzero(scalar & coordinates.known.numpy())
        position, rate = physics[:, 1 + model.jnt_qposadr], physics[:, 1 + model.nq + model.jnt_dofadr]
        np.testing.assert_allclose(found.coordinate[:, which], position[:, which], atol=1e-6, err_msg=f"seed {seed}")
        np.testing.assert_allclose(found.rate[:, which], rate[:, which], atol=1e-4, err_msg=f"seed {seed}")
        compared += len(which)
    assert compared > 2 * SEEDS


@pytest.mark.slow
@pytest.mark.skipif(
    tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 6), reason="compiling raises the solver's warnings there"
)
def test_random_models_load_or_are_refused_by_name():
    outcomes = collections.Counter(check(seed, "eager") for seed in range(SEEDS))
    assert outcomes["loaded"] > SEEDS / 2 and len(outcomes) > 3


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 150, BLOCK))
def test_more_random_models(first):
    outcomes = collections.Counter(check(seed, "native") for seed in range(first, first + BLOCK))
    assert outcomes["loaded"] > BLOCK / 3

"""Forward models that correct known physics."""

from __future__ import annotations

import math
from typing import Any, cast

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_gn.data import collect_trajectories, log_trajectories, log_tree, simulate_log, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, MujocoPhysics, export_c, specialize
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.envs import ModelEnv
from torchrl_gn.evaluation import baseline_errors, evaluate_errors
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.planners import GradientPlanner
from torchrl_gn.scenes import KinematicTree, UnsupportedSceneError, load_scene
from torchrl_gn.training import Budget, Trainer, fit_physics, load_pretrained, make_optimizer, save_checkpoint

from .. import zoo
from ..sizes import SMALL

pytestmark = pytest.mark.filterwarnings("ignore::torchrl_gn.data.UncontrolledSceneWarning")  # a creature has no motors

TREE: Any = KinematicTree(
    "pendulum", ("hinge",), 0.02, ((0,),), action_low=np.array([-2.0]), action_high=np.array([2.0])
)


class Pendulum(nn.Module):
    """A damped pendulum, by semi-implicit Euler steps."""

    def __init__(self, gravity: float = 9.81, trained: bool = False) -> None:
        super().__init__()
        self.logarithm = nn.Parameter(torch.tensor(math.log(gravity), dtype=torch.float64), requires_grad=trained)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        joints = state[..., 1:, :]
        velocity = joints[..., 2] + TREE.timestep * (action - self.logarithm.exp() * joints[..., 1])
        angle = torch.atan2(joints[..., 1], joints[..., 0]) + TREE.timestep * velocity
        moved = torch.stack((angle.cos(), angle.sin(), velocity), dim=-1)
        return torch.cat((state[..., :1, :], moved), dim=-2)


def still(state: Tensor, action: Tensor) -> Tensor:
    return state


def simulated(physics: nn.Module, count: int = 40, steps: int = 30):
    """Trajectories of a pendulum under random torques."""
    generator = torch.Generator().manual_seed(0)
    angle = 6 * torch.rand(count, 1, generator=generator, dtype=torch.float64) - 3
    action = 4 * torch.rand(count, steps, 1, generator=generator, dtype=torch.float64) - 2
    state = torch.zeros(count, 2, 3, dtype=torch.float64)
    state[:, 0, 0], state[:, 1, :2] = 1, torch.cat((angle.cos(), angle.sin()), dim=-1)
    states = [state]
    with torch.no_grad():
        for each in action.unbind(1):
            states.append(physics(states[-1], each))
    return TensorDict({"state": torch.stack(states, 1), "action": action}, [count])


def residual_model(physics: Any, data, tree: Any = TREE, **options):
    torch.manual_seed(0)
    model = ForwardModel.for_scene(tree, physics=physics, **(SMALL | options))
    loss = ForwardModelLoss(model.bind(tree))
    loss.fit_normalizers(trajectory_buffer(data, batch_size=500, seed=0).sample())
    return model, loss


def test_perfect_physics_are_corrected_by_exactly_nothing(tmp_path):
    physics, data = Pendulum(), simulated(Pendulum())
    model, loss = residual_model(physics, data)
    assert bool(model.residual_normalizer.constant.all()) and not model.residual_normalizer.mean.any()
    assert not model.delta_normalizer.constant.any()
    bound = model.bind(TREE)
    for predictor in (bound, specialize(bound), specialize(bound, executor="eager")):
        table = evaluate_errors(predictor, data, horizons=(1, 30))
        assert table["rollout_error_30"].total < 1e-20
    batch = trajectory_buffer(data, batch_size=8, window=5, seed=0).sample()
    assert float(loss(batch)["loss_forward_model"].detach()) < 1e-20


@pytest.mark.slow
def test_physics_of_an_arm_follow_mujoco_from_body_states():
    for name in ("cartpole", "swimmer3", "cheetah", "tumbler", "arm", "joints", "creature"):
        scene = zoo.load(name)
        data = collect_trajectories(scene, 3, 12, 0)
        state, action = data["state"], data["action"]
        error = BODY_STATE.delta(MujocoPhysics(scene)(state[:, :-1], action), state[:, 1:])
        assert float(error.abs().max()) < 1e-9, name
    for name in ("parallel_hinges", "odd"):
        with pytest.raises(UnsupportedSceneError, match="do not follow from body states"):
            JointCoordinates(zoo.load(name))


def test_joint_logs_follow_mujoco_whatever_the_order_of_joints():
    scene = load_scene("acrobot")
    log = simulate_log(scene, 3, 60, 0, delay=0, time_constant=0.0, play=0.0, quantum=0.0, noise=0.0)
    tree, data = log_tree(log, "acrobot", commands=[[], [0]]), log_trajectories(log, 40)[0]
    wrong = baseline_errors(tree, data, MujocoPhysics(scene, tree, scale={"mass": 3.0}), horizons=(1, 10))
    tables = baseline_errors(tree, data, MujocoPhysics(scene, tree), horizons=(1, 10))
    # Logged velocities are differences of angles, half a step late.
    total = {name: table["rollout_error_10"].total for name, table in tables.items()}
    assert total["physics"] < 0.1 * total["constant velocity"]
    assert total["physics"] < 0.5 * wrong["physics"]["rollout_error_10"].total
    turned = KinematicTree("turned", ("b", "a"), tree.timestep, ((0,), ()), joint_parents=(-1, -1))
    there = MujocoPhysics(scene, turned, joints=scene.joint_names[::-1])
    state, action = data["state"][:, 0], data["action"][:, 0]
    swapped = there(state[:, [0, 2, 1]], action)[:, [0, 2, 1]]
    torch.testing.assert_close(swapped, MujocoPhysics(scene, tree)(state, action), rtol=0, atol=1e-12)


WIDE = """<mujoco><option timestep="0.005"/><worldbody>
  <body><joint name="wide" axis="0 0 1" range="-400 400" limited="true" damping=".2"/><geom size=".1"/></body>
  </worldbody><actuator><position joint="wide" kp="3" ctrlrange="-2 2"/></actuator></mujoco>"""


def test_robots_known_by_their_encoders_may_have_joints_of_more_than_a_turn():
    """Encoders show angles but for whole turns: they are taken for within half a turn, as before."""
    scene = load_scene(WIDE)
    assert scene.state_size == 14
    log = simulate_log(scene, 2, 40, 0, delay=0, time_constant=0.0, play=0.0, quantum=0.0, noise=0.0)
    tree, data = log_tree(log, "wide"), log_trajectories(log, 20)[0]
    after = MujocoPhysics(scene, tree)(data["state"][:, 0], data["action"][:, 0])
    assert after.shape == data["state"][:, 1].shape and after.isfinite().all()
    if hasattr(mujoco.MjModel, "actuator_history"):  # since MuJoCo 3.5
        late = load_scene(WIDE.replace("<position", '<position delay=".01" nsample="9"'))
        with pytest.raises(UnsupportedSceneError, match="States do not determine the simulation state"):
            MujocoPhysics(late, tree)


def test_physics_act_by_the_present_commands_of_robots_with_past_ones():
    scene = load_scene("acrobot")
    log = simulate_log(scene, 3, 60, 0, delay=0, time_constant=0.0, play=0.0, quantum=0.0, noise=0.0)
    options: dict[str, Any] = {"commands": [[], [0]]}
    totals = []
    for history in (0, 2):
        tree = log_tree(log, "acrobot", history=history, **options)
        data = log_trajectories(log, 40, history=history, lag=2 - history)[0]
        physics = MujocoPhysics(scene, tree)
        totals.append(baseline_errors(tree, data, physics, horizons=(1, 10))["physics"]["rollout_error_10"].total)
        predictor = ForwardModel.for_scene(tree, physics=physics, **SMALL).double().bind(tree)
        assert predictor.step(data["state"][:, 0], data["action"][:, 0].double())[0].isfinite().all()
        assert fit_physics(Flywheel(), tree, data, steps=1, window=3)[0] > 0
    assert totals[1] < totals[0]  # which had commands of two steps before


def test_physics_read_commands_as_the_robot_clips_them():
    data = simulated(Pendulum())
    beyond = TensorDict({"state": data["state"].clone(), "action": 2 * data["action"].sign()}, data.shape)
    for step, action in enumerate(beyond["action"].unbind(1)):
        beyond["state"][:, step + 1] = Pendulum()(beyond["state"][:, step], action)
    beyond["action"] = 3 * beyond["action"]
    assert baseline_errors(TREE, beyond, Pendulum(), horizons=(30,))["physics"]["rollout_error_30"].total < 1e-8
    assert fit_physics(Pendulum(trained=True), TREE, beyond, steps=1, window=10)[0] < 1e-8
    model, _ = residual_model(Pendulum(), data)
    bound = model.bind(TREE)
    for predictor in (bound, specialize(bound)):
        assert evaluate_errors(predictor, beyond, horizons=(30,))["rollout_error_30"].total < 1e-8
    loss = ForwardModelLoss(bound, residual_weight=1.0, generator=torch.Generator().manual_seed(0))
    batch = trajectory_buffer(beyond, batch_size=8, seed=0).sample()
    assert float(loss(batch)["loss_forward_model"].detach()) < 1e-8


class Flywheel(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.ones(()))

    def forward(self, state, action):
        assert action.shape[-1] == 1
        joints = state[..., 1:, :]
        moved = torch.cat((joints[..., :2], joints[..., 2:] + 0.01 * self.gain * action.unsqueeze(-1)), -1)
        return torch.cat((state[..., :1, :], moved), -2)


def test_robots_that_do_not_fit_the_mjcf_are_refused():
    scene = load_scene("acrobot")
    for options, message in (
        ({"timestep": 0.013}, "control steps of"),
        ({"commands": ((0,), (1,))}, "has 0 motors"),
        ({"joint_names": ("a",), "commands": ((),)}, "pass joints="),
    ):
        given: dict[str, Any] = {
            "joint_names": ("a", "b"),
            "timestep": scene.timestep,
            "commands": ((), (0,)),
        } | options
        with pytest.raises(ValueError, match=message):
            MujocoPhysics(scene, KinematicTree("robot", **given))
    with pytest.raises(ValueError, match="scale='weight' is not known"):
        MujocoPhysics(scene, scale={"weight": 2.0})


@pytest.mark.slow
def test_gradients_flow_through_mujoco():
    scene = zoo.load("cartpole")
    data = collect_trajectories(scene, 2, 2, 0)
    state, action = data["state"][:, 1].requires_grad_(), data["action"][:, 1].double().requires_grad_()
    assert torch.autograd.gradcheck(MujocoPhysics(scene), (state, action), eps=1e-5, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("core", ["gn", "recurrent"])
def test_executors_agree_forward_and_gradient(core):
    data = simulated(Pendulum(11.0))
    model, _ = residual_model(Pendulum(), data, core=core)
    bound = model.bind(TREE)
    outs = []
    for predictor in (bound, specialize(bound), specialize(bound, executor="eager")):
        state, actions = data["state"][:4, 3].clone().requires_grad_(), data["action"][:4, 3:9].clone().requires_grad_()
        states = predictor.rollout(state, actions)[0]
        outs.append((states, *torch.autograd.grad(states.square().sum(), (state, actions))))
    for other in outs[1:]:
        for found, expected in zip(other, outs[0], strict=True):
            # The base's channels are constants: native gradients there are those of copying them.
            found, expected = (
                each[..., 1:, :] if each.ndim == 3 and each.shape[-1] == 3 else each for each in (found, expected)
            )
            torch.testing.assert_close(found, expected, rtol=2e-4, atol=2e-4)
    assert (specialize(bound).reason is None) == (core == "gn")


def test_what_is_predicted_is_the_correction():
    data = simulated(Pendulum(11.0))
    model, loss = residual_model(Pendulum(), data)
    program, state, action = loss.model.program(), data["state"][:, 4], data["action"][:, 4]
    canonical = eager.canonical_state(program, state, action)
    expected = model.layout.delta(state, Pendulum()(state, action))
    assert canonical.change is not None and torch.equal(canonical.change, expected)
    none = torch.zeros(len(state), 2, 2)
    mean = model.residual_normalizer.mean
    change = eager.change(program, state, canonical, none)
    torch.testing.assert_close(change[:, 1], expected[:, 1] + mean, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_parameters_of_physics_train_with_the_network_or_before():
    data = simulated(Pendulum(11.0))
    physics = Pendulum(trained=True)
    model, loss = residual_model(physics, data)
    windows = trajectory_buffer(data, batch_size=16, window=4, seed=0)
    list(Trainer(loss, windows, make_optimizer(model), Budget(steps=3)).run())
    assert physics.logarithm.item() != math.log(9.81)
    physics = Pendulum(trained=True)
    errors = fit_physics(physics, TREE, data, steps=60, window=10)
    assert errors[-1] < 1e-2 * errors[0] and not physics.logarithm.requires_grad
    assert float(physics.logarithm.exp()) == pytest.approx(11.0, rel=1e-2)
    with pytest.raises(ValueError, match="nothing to fit"):
        fit_physics(physics, TREE, data)


@pytest.mark.parametrize("window", [1, 3])
def test_corrections_under_other_commands_are_penalised(window):
    data = simulated(Pendulum(11.0))
    model, plain = residual_model(Pendulum(), data)
    bound, generator = model.bind(TREE), torch.Generator().manual_seed(3)
    loss = ForwardModelLoss(bound, residual_weight=2.0, residual_noise=0.1, generator=generator)
    loss.load_training_state({**plain.training_state(), "generator": None})
    batch = trajectory_buffer(data, batch_size=64, window=window, seed=0).sample()
    value = loss(batch)["loss_forward_model"]
    generator.manual_seed(3)
    states, actions = (
        cast(Tensor, batch[key]).reshape(64 * window, *tail) for key, tail in (("state", (2, 3)), ("action", (1,)))
    )
    chosen, others = (torch.randperm(64 * window, generator=generator)[:128] for _ in range(2))
    state, action = loss.perturb(states[chosen], 0.1), actions[others]
    assert (state - states[chosen]).abs().max() > 0.01
    correction = bound.delta(state, action) - bound.layout.delta(state, Pendulum()(state, action))
    scaled = (correction * loss.error_weight)[:, 1]  # an angle and a velocity
    expected = plain(batch)["loss_forward_model"] + 2 * scaled.square().mean()
    torch.testing.assert_close(value, expected, rtol=1e-5, atol=0)
    for weight, message in ((-1.0, "must not be negative"), (1.0, "physics=")):
        with pytest.raises(ValueError, match=message):
            ForwardModelLoss(ForwardModel.for_scene(TREE, **SMALL).bind(TREE), residual_weight=weight)


@pytest.mark.parametrize("executor", ["native", "eager"])
def test_a_specialised_model_keeps_the_physics_that_it_was_made_with(executor):
    physics, data = Pendulum(), simulated(Pendulum(11.0))
    bound = residual_model(physics, data)[0].bind(TREE)
    fast, state, action = specialize(bound, executor=executor), data["state"][:, 3], data["action"][:, 3]
    before, live = fast.step(state, action)[0], bound.step(state, action)[0]
    with torch.no_grad():
        physics.logarithm.add_(0.5)
    assert torch.equal(fast.step(state, action)[0], before)
    after = bound.step(state, action)[0]
    assert (after - live).norm() > 1e-3
    many = [each[:1].expand(600, *each.shape[1:]) for each in (state, action)]  # as many as C++ pays for
    torch.testing.assert_close(bound.step(*many)[0][0], after[0], rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match="physics.*Specialise it anew"):
        fast.refresh(bound)
    again = specialize(bound, executor=executor).step(state, action)[0]
    torch.testing.assert_close(again, after, rtol=1e-5, atol=1e-6)


def test_checkpoints_say_which_physics(tmp_path):
    data, path = simulated(Pendulum(11.0)), tmp_path / "residual.safetensors"
    physics = Pendulum(10.0)
    model, _ = residual_model(physics, data)
    save_checkpoint(path, model, scene=TREE)
    with pytest.raises(ValueError, match=r"test_physics:Pendulum', a function .* load_pretrained\(path, physics="):
        load_pretrained(path)
    with pytest.raises(ValueError, match="corrects the physics Pendulum, not still"):
        load_pretrained(path, physics=still)
    again = load_pretrained(path, physics=Pendulum(3.0)).model
    state, action = data["state"][:, 3], data["action"][:, 3]
    assert torch.equal(again.bind(TREE).step(state, action)[0], model.bind(TREE).step(state, action)[0])
    plain, _ = residual_model(None, data)
    save_checkpoint(path, plain, scene=TREE)
    with pytest.raises(ValueError, match="leave out physics="):
        load_pretrained(path, physics=physics)


def test_mujoco_rebuilds_itself_from_a_checkpoint(tmp_path):
    scene, path = zoo.load("cartpole"), tmp_path / "residual.safetensors"
    data = collect_trajectories(scene, 5, 12, 0)
    physics = MujocoPhysics(scene, scale={"mass": 1.2, "friction": 0.8})
    model, _ = residual_model(physics, data, scene)
    save_checkpoint(path, model, scene=scene)
    again, bound = load_pretrained(path), model.bind(scene)
    state, action = data["state"][:, 3], data["action"][:, 3]
    assert torch.equal(again.bind(again.scene()).step(state, action)[0], bound.step(state, action)[0])
    with pytest.raises(ValueError, match=r"mass times 1.2, friction times 0.8\), not MuJoCo's of cartpole"):
        load_pretrained(path, physics=MujocoPhysics(scene))
    assert "physics run outside" in str(specialize(bound))
    with pytest.raises(TypeError, match="physics run outside"):
        specialize(bound, executor="compiled")
    with pytest.raises(TypeError, match="physics run outside"):
        export_c(bound, tmp_path / "cartpole")


def test_one_plans_with_it():
    data = simulated(Pendulum(11.0))
    bound = residual_model(Pendulum(), data)[0].bind(TREE)

    def up(state, action, next_state, task):
        return -next_state[..., 1, :1]

    env = ModelEnv(specialize(bound), up, start_states=data["state"].flatten(0, 1), seed=0)
    plan = GradientPlanner(env, horizon=5, iterations=2)(env.reset())
    assert bool(plan["action"].isfinite().all())


def test_states_of_another_shape_are_refused():
    data = simulated(Pendulum())
    with pytest.raises(ValueError, match=r"must give next states \[500, 2, 3\], not \[500, 1, 3\]"):
        residual_model(lambda state, action: state[..., 1:, :], data)

"""Forward models of robots of which only the joints are known."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_gn.data import (
    Simulator,
    collect_trajectories,
    create_dataset,
    log_trajectories,
    log_tree,
    simulate_log,
    trajectory_buffer,
)
from torchrl_gn.dynamics import (
    Activations,
    BodyState,
    Constraints,
    Controls,
    Couplings,
    ForwardModel,
    JointAxes,
    PairContacts,
    Tendons,
    specialize,
)
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.evaluation import evaluate_errors, joint_errors, plot_joints, report
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.planners import GradientPlanner
from torchrl_gn.scenes import KinematicTree, load_scene, with_factors
from torchrl_gn.training import identify_parameters, load_pretrained, parameter_names, save_checkpoint

SMALL = {"hidden": (16,)}


@pytest.fixture(scope="module")
def robot():
    log = simulate_log(load_scene("jaco"), 20, 42, 0, delay=0, time_constant=0.0, play=0.0)
    return log_tree(log, "jaco"), log_trajectories(log, 40)[0]


@pytest.mark.slow
@pytest.mark.parametrize("core", ["gn", "recurrent"])
def test_it_trains_is_saved_and_evaluated_like_any_scene(robot, core, tmp_path):
    tree, data = robot
    torch.manual_seed(0)
    model = ForwardModel.for_scene(tree, core=core, **SMALL)
    bound = model.bind(tree)
    loss = ForwardModelLoss(bound, teacher_forced_steps=5)
    loss.fit_normalizers(trajectory_buffer(data, batch_size=1000, seed=0).sample())
    buffer = trajectory_buffer(data, batch_size=64, window=5 if core == "recurrent" else 1, seed=0)
    optimizer = torch.optim.Adam(model.core.parameters(), 3e-3)
    for _ in range(60):
        optimizer.zero_grad()
        loss(buffer.sample())["loss_forward_model"].backward()
        optimizer.step()
    table = evaluate_errors(bound, data, horizons=(10,), burn_in=5, keep=1)
    assert list(table["one_step_error"].components) == ["angle", "velocity"]
    assert table["one_step_error"].total < 0.5
    path = plot_joints(data["state"][0, :16], {core: table.rollouts[0]}, tree, tmp_path / "joints.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    save_checkpoint(tmp_path / "robot.safetensors", model, scene=tree)
    again = load_pretrained(tmp_path / "robot.safetensors")
    state, action = data["state"][:, 3], data["action"][:, 3]
    assert torch.equal(again.model.bind(again.scene()).step(state, action)[0], bound.step(state, action)[0])
    base = bound.step(state, action)[0][:, 0]
    assert torch.equal(base, state[:, 0])  # the base stays
    if core == "gn":
        torch.testing.assert_close(specialize(bound).step(state, action)[0], bound.step(state, action)[0])


def angles_near(targets: torch.Tensor):
    """Reward: cosine of the distance of every joint to its target."""

    def reward(state, action, next_state, task):
        cosine, sine = next_state[..., 1:, 0], next_state[..., 1:, 1]
        return (cosine * targets.cos() + sine * targets.sin()).mean(-1, keepdim=True)

    return reward


@pytest.mark.slow
@pytest.mark.parametrize("core", ["gn", "recurrent"])
def test_it_is_an_environment_and_is_planned_with(robot, core):
    tree, data = robot
    torch.manual_seed(0)
    bound = ForwardModel.for_scene(tree, core=core, **SMALL).bind(tree)
    loss = ForwardModelLoss(bound)
    loss.fit_normalizers(trajectory_buffer(data, batch_size=1000, seed=0).sample())
    starts = data["state"].flatten(0, 1)
    env = ModelEnv(bound, angles_near(torch.zeros(9)), start_states=starts, seed=0)
    check_env_specs(env)
    rollout = env.rollout(4, tensordict=env.reset(TensorDict(batch_size=[3])), auto_reset=False)
    assert rollout["state"].shape == (3, 4, 10, 3)
    assert all((starts == state).all(-1).all(-1).any() for state in rollout["state"][:, 0])
    again = bound.rollout(rollout["state"][:, 0], rollout["action"])[0]
    torch.testing.assert_close(rollout["next", "state"], again[:, 1:])
    now = env.reset(TensorDict(batch_size=[3]))
    returns = []
    for warm_up in (0, 10):
        td = GradientPlanner(env, 4, 2, warm_up=warm_up, seed=0)(now.copy())
        planned = torch.cat((td["action"].unsqueeze(1), td["plan", "actions"][:, 0, :3]), 1)
        returns.append(env.imagine(now, planned)[1].sum())
    before, after = returns
    assert after > before


def test_where_it_starts_must_be_said(robot):
    tree, _ = robot
    bound = ForwardModel.for_scene(tree, **SMALL).bind(tree)
    with pytest.raises(ValueError, match=r"Robot 'jaco' has no start .* give start_states \[M, 10, 3\]"):
        ModelEnv(bound)
    with pytest.raises(ValueError, match=r"must be \[M, 10, 3\], got \[4, 9, 3\]"):
        ModelEnv(bound, start_states=torch.zeros(4, 9, 3))


def test_several_commands_a_joint(robot):
    tree, data = robot
    commands = tuple((2 * joint, 2 * joint + 1) for joint in range(9))
    doubled = KinematicTree("jaco", tree.joint_names, tree.timestep, commands, joint_parents=tree.joint_parents)
    bound = ForwardModel.for_scene(doubled, **SMALL).bind(doubled)
    action = torch.arange(18.0).expand(len(data), 18)
    program, state = bound.program(), data["state"][:, 0]
    _, controls = eager.features(program, program.canonicalizer(state, program.parameters), action)
    assert controls[0].tolist() == [[2 * (e // 2), 2 * (e // 2) + 1] for e in range(18)]
    other = ForwardModel.for_scene(tree, **SMALL)
    with pytest.raises(ValueError, match="reads 1 controls at each edge, scene 'jaco' has 2"):
        other.bind(doubled)
    spatial = ForwardModel.for_scene(doubled, features=(BodyState(), Controls(), JointAxes()), **SMALL)
    with pytest.raises(
        TypeError, match="Feature JointAxes needs the bodies of a Scene, which the KinematicTree 'jaco'"
    ):
        spatial.bind(doubled)


def test_joints_with_fewer_commands_or_none(robot):
    tree, data = robot
    commands = ((0, 1), (), (2,), *[()] * 6)
    some = KinematicTree("jaco", tree.joint_names, tree.timestep, commands, joint_parents=tree.joint_parents)
    bound = ForwardModel.for_scene(some, **SMALL).bind(some)
    action = torch.tensor([5.0, 6.0, 7.0]).expand(len(data), 3)
    program, state = bound.program(), data["state"][:, 0]
    _, controls = eager.features(program, program.canonicalizer(state, program.parameters), action)
    assert controls[0].tolist() == [[5, 6]] * 2 + [[0, 0]] * 2 + [[7, 0]] * 2 + [[0, 0]] * 12
    with pytest.raises(ValueError, match="must be indices from 0"):
        KinematicTree("jaco", ("a", "b"), 0.01, ((0,), (-1,)))


@pytest.mark.parametrize("core", ["gn", "recurrent"])
@pytest.mark.parametrize("motors", [1, 0])
def test_a_double_pendulum_with_one_motor_or_none(core, motors):
    log = simulate_log(load_scene("acrobot"), 10, 42, 0)
    log = dataclasses.replace(log, command=log.command[:, :motors])
    tree, data = log_tree(log, "double", commands=[[0], []] if motors else None), log_trajectories(log, 40)[0]
    assert tree.num_actions == motors and tree.edge_action[:, 0].tolist() == [motors - 1] * 2 + [-1] * 2
    torch.manual_seed(0)
    model = ForwardModel.for_scene(tree, core=core, **SMALL)
    bound = model.bind(tree)
    loss = ForwardModelLoss(bound, teacher_forced_steps=5)
    loss.fit_normalizers(trajectory_buffer(data, batch_size=300, seed=0).sample())
    batch = trajectory_buffer(data, batch_size=16, window=5 if core == "recurrent" else 1, seed=0).sample()
    loss(batch)["loss_forward_model"].backward()
    assert evaluate_errors(bound, data, horizons=(5,), burn_in=5)["rollout_error_5"].total > 0
    # What the motor does is seen, and nothing else.
    state, action = data["state"][:, 3], data["action"][:, 3]
    assert torch.equal(bound.step(state, action)[0], bound.step(state, action + 1)[0]) == (motors == 0)
    env = ModelEnv(bound, start_states=data["state"].flatten(0, 1), seed=0)
    check_env_specs(env)


def test_a_command_that_never_varied_is_held_in_plans(robot):
    tree, data = robot
    low, high = tree.action_low.copy(), tree.action_high.copy()
    low[2] = high[2] = 0.25
    fixed = dataclasses.replace(tree, action_low=low, action_high=high)
    torch.manual_seed(0)
    bound = ForwardModel.for_scene(fixed, **SMALL).bind(fixed)
    ForwardModelLoss(bound).fit_normalizers(trajectory_buffer(data, batch_size=500, seed=0).sample())
    env = ModelEnv(bound, angles_near(torch.zeros(9)), start_states=data["state"].flatten(0, 1), seed=0)
    planned = GradientPlanner(env, 3, 2, seed=0)(env.reset())["action"]
    assert planned.isfinite().all() and planned[2] == 0.25


def test_a_value_of_a_user_serves_a_robot_of_joints(robot):
    tree, data = robot
    bound = ForwardModel.for_scene(tree, **SMALL).bind(tree)
    env = ModelEnv(bound, start_states=data["state"][:, 0], terminal=lambda state: state[..., 1, :1])
    assert env.terminal is not None and env.scene.num_nodes == tree.num_nodes


@pytest.mark.parametrize("feature", [Activations, Constraints, Couplings, JointAxes, PairContacts, Tendons])
def test_features_of_bodies_refuse_a_robot_of_joints(robot, feature):
    with pytest.raises(TypeError, match=f"Feature {feature.__name__} needs the bodies of a Scene, which the Kinematic"):
        ForwardModel.for_scene(robot[0], features=(BodyState(), Controls(), feature()), **SMALL).bind(robot[0])


def test_what_needs_bodies_says_so(robot):
    tree, data = robot
    bound = ForwardModel.for_scene(tree, **SMALL).bind(tree)
    for needs, call in (("joint_errors", joint_errors), ("report", lambda *of: report(*of, "unused"))):
        with pytest.raises(TypeError, match=f"{needs} needs the bodies of a Scene, which the KinematicTree 'jaco'"):
            call(bound, data)
    with pytest.raises(TypeError, match="parameters_of needs the bodies"):
        bound.parameters_of(tree)


@pytest.mark.parametrize(
    ("user", "call"),
    [
        ("identify_parameters", lambda tree, data: identify_parameters(tree, data, {"body_mass": None})),
        ("parameter_names", lambda tree, data: parameter_names(tree, {"body_mass": None})),
        ("with_factors", lambda tree, data: with_factors(tree, {"body_mass": None}, [2.0])),
        ("A simulation", lambda tree, data: Simulator(tree)),
        ("A simulation", lambda tree, data: SceneEnv(tree)),
        ("A simulation", lambda tree, data: collect_trajectories(tree, 1, 1)),
        ("A data set", lambda tree, data: create_dataset("unused", tree)),
    ],
)
def test_masses_and_simulations_of_joints_alone_are_refused(robot, user, call):
    with pytest.raises(TypeError, match=f"{user} needs the bodies of a Scene, which the KinematicTree 'jaco'"):
        call(*robot)

"""Forward models of robots that are known by their joints alone."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.data import log_chain, log_trajectories, simulate_log, trajectory_buffer
from torchrl_gn.evaluation import evaluate_errors, plot_joints
from torchrl_gn.modules import FeatureSet, ForwardModel, joint_layout, specialize
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import JointChain, load_scene
from torchrl_gn.training import load_checkpoint, save_checkpoint

SMALL = {"latent": 16, "edge_hidden": (16,), "node_hidden": (16,), "global_hidden": (16,)}


@pytest.fixture(scope="module")
def robot():
    log = simulate_log(load_scene("jaco"), 20, 42, 0, delay=0, time_constant=0.0, play=0.0)
    return log_chain(log, "jaco"), log_trajectories(log, 40)[0]


@pytest.mark.parametrize("core", ["gn", "recurrent"])
def test_it_trains_is_saved_and_evaluated_like_any_scene(robot, core, tmp_path):
    chain, data = robot
    torch.manual_seed(0)
    options = {"layout": joint_layout(chain.extras), "joint_axes": False, "contacts": False, "core": core}
    model = ForwardModel(FeatureSet.of(chain), **options, **SMALL)
    bound = model.bind(chain)
    loss = ForwardModelLoss(bound, forced=5)
    loss.fit_normalizers(trajectory_buffer(data, batch_size=1000, seed=0).sample())
    buffer = trajectory_buffer(data, batch_size=64, window=5 if core == "recurrent" else 1, seed=0)
    optimizer = torch.optim.Adam(model.core.parameters(), 3e-3)
    for _ in range(60):
        optimizer.zero_grad()
        loss(buffer.sample())["loss_forward_model"].backward()
        optimizer.step()
    table = evaluate_errors(bound, data, horizons=(10,), warm_up=5, keep=1)
    assert list(table["one_step_error"].components) == ["angle", "velocity"]
    assert table["one_step_error"].total < 0.5
    path = plot_joints(data["state"][0, :16], {core: table.rollouts[0]}, chain, tmp_path / "joints.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    save_checkpoint(tmp_path / "robot.safetensors", model, scene=chain)
    again = load_checkpoint(tmp_path / "robot.safetensors")
    state, action = data["state"][:, 3], data["action"][:, 3]
    assert torch.equal(again.model.bind(again.scene()).step(state, action), bound.step(state, action))
    base = bound.step(state, action)[:, 0]
    assert torch.equal(base, state[:, 0])  # the base stays
    if core == "gn":
        torch.testing.assert_close(specialize(bound).step(state, action), bound.step(state, action))


def test_several_commands_a_joint(robot):
    chain, data = robot
    commands = tuple((2 * joint, 2 * joint + 1) for joint in range(9))
    doubled = JointChain("jaco", chain.joint_names, chain.timestep, commands, carried_by=chain.carried_by)
    options = {"layout": joint_layout(), "joint_axes": False, "contacts": False, **SMALL}
    bound = ForwardModel(FeatureSet.of(doubled), controls=2, **options).bind(doubled)
    action = torch.arange(18.0).expand(len(data), 18)
    _, controls = bound.frame.features(bound.frame.see(data["state"][:, 0], bound.values), action, bound.values)
    assert controls[0].tolist() == [[2 * (e // 2), 2 * (e // 2) + 1] for e in range(18)]
    with pytest.raises(ValueError, match="controls=2"):
        ForwardModel(FeatureSet.of(doubled), controls=2)

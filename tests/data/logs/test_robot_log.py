"""Robot logs: reading, cutting, and the motors and encoders of a simulated robot."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchrl_gn as gn
from torchrl_gn.data import DatasetError, RobotLog, load_robot_log, log_trajectories, log_tree, simulate_log
from torchrl_gn.scenes import KinematicTree, load_scene, scene_from_description

PAM = Path(__file__).parents[4] / "shared" / "data" / "pam_arm" / "pam_arm_clean_f32.npz"
NAMES = {"angle": "q", "velocity": "dq", "command": "action"}


def smooth_log(lengths=(30, 50), joints: int = 2, timestep: float = 0.01) -> RobotLog:
    """Joints that swing at their own frequencies, with velocities that fit; commands that tell their row."""
    rows = sum(lengths)
    time = np.concatenate([np.arange(length) for length in lengths]) * timestep
    frequency = 3 + np.arange(joints)
    angle, velocity = np.sin(time[:, None] * frequency), frequency * np.cos(time[:, None] * frequency)
    command = np.arange(rows)[:, None] * np.ones(joints)
    return RobotLog(angle, velocity, command, np.array(lengths), timestep, {"load": angle**2})


def arrays_of(log: RobotLog) -> dict:
    return {"angle": log.angle, "velocity": log.velocity, "command": log.command, "length": log.length, **log.extra}


def test_npz_and_csv_give_the_same_log(tmp_path):
    log = smooth_log()
    np.savez(tmp_path / "log.npz", **arrays_of(log), timestep=0.01, name=np.array(["a", "b"]))
    header = [
        "episode",
        "time",
        *(f"{what}{joint}" for what in ("angle", "velocity", "command", "load") for joint in (0, 1)),
    ]
    episode = np.repeat([7, 8], log.length)
    time = np.concatenate([np.arange(length) for length in log.length]) * 0.01
    table = np.column_stack((episode, time, log.angle, log.velocity, log.command, log.extra["load"]))
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(header), comments="", fmt="%.17g")
    for name in ("log.npz", "log.csv"):
        read = load_robot_log(tmp_path / name)
        assert read.length.tolist() == [30, 50] and read.timestep == pytest.approx(0.01)
        np.testing.assert_array_equal(read.angle, log.angle)
        np.testing.assert_array_equal(read.extra["load"], log.extra["load"])
        assert list(read.extra) == ["load"]


def test_channels_of_several_numbers_a_joint_are_dealt_out(tmp_path):
    log = smooth_log()
    pressure = np.arange(80)[:, None] + np.array([0.0, 0.1, 0.2, 0.3])  # two of joint 0, two of joint 1
    np.savez(tmp_path / "log.npz", **arrays_of(log), pressure=pressure)
    read = load_robot_log(tmp_path / "log.npz", timestep=0.01)
    np.testing.assert_allclose(read.extra["pressure0"][5], [5.0, 5.2])
    np.testing.assert_allclose(read.extra["pressure1"][5], [5.1, 5.3])
    without = load_robot_log(tmp_path / "log.npz", timestep=0.01, names={"pressure": ""})
    assert list(without.extra) == ["load"]


def test_trajectories_hold_the_rows_and_cross_no_episode():
    log = smooth_log()
    trajectories, report = log_trajectories(log, 12)
    assert trajectories["state"].shape == (6, 13, 3, 4) and trajectories["episode"].tolist() == [0, 0, 1, 1, 1, 1]
    first = trajectories["state"][2]  # of the second episode
    torch.testing.assert_close(first[:, 1, 1], torch.from_numpy(np.sin(log.angle[30:43, 0])))
    torch.testing.assert_close(
        first[:, 2, 2:], torch.from_numpy(np.stack((log.velocity, log.extra["load"]), 2)[30:43, 1])
    )
    assert (first[:, 0] == torch.tensor([1.0, 0, 0, 0])).all()
    assert trajectories["action"][2, :, 0].tolist() == list(range(30, 42))
    assert (report.rows, report.trajectories, report.kept) == (80, 6, 72)
    late, _ = log_trajectories(log, 12, lag=3)
    assert late["action"][0, 0, 0] == 0  # the command of row 0 goes with the state of row 3
    torch.testing.assert_close(late["state"][0, 0, 1, 1], torch.tensor(np.sin(log.angle[3, 0])))
    coarse, _ = log_trajectories(log, 12, resample=0.02)
    torch.testing.assert_close(coarse["state"][0, 1, 1, 1], torch.tensor(np.sin(log.angle[2, 0])))
    assert coarse["action"][0, :2, 0].tolist() == [0.5, 2.5]
    every, _ = log_trajectories(log, 12, overlap=True)
    assert len(every) == 18 + 38
    only, _ = log_trajectories(log, 12, episodes=[1])
    assert set(only["episode"].tolist()) == {1}


def test_it_is_cut_at_jumps_and_gaps_and_says_so():
    log = smooth_log((60, 60))
    log.angle[20:60] += 2.0  # in the first episode, after row 19
    log.velocity[80] = np.nan
    trajectories, report = log_trajectories(log, 10)
    assert report.jumps == ((0, 19),) and report.not_finite == 1
    assert trajectories["state"].isfinite().all()
    commands = trajectories["action"][:, :, 0]
    assert not ((commands[:, 0] <= 19) & (commands[:, -1] >= 19)).any()  # no transition from row 19 to 20
    assert not (commands == 80).any() and not (commands == 79).any()
    assert "cut at 1 jumps, the first at row 19 of episode 0" in str(report)
    assert "dropped 1 rows that are not finite" in str(report)


def test_differences_of_angles_span_no_gap(tmp_path):
    time = np.r_[np.arange(50) * 0.01, 5 + np.arange(50) * 0.01]
    angle = np.sin(3 * time)[:, None]
    np.savez(tmp_path / "log.npz", angle=angle, command=angle, time=time)
    log = load_robot_log(tmp_path / "log.npz", names={"velocity": ""})
    assert np.isnan(log.velocity[[0, 50]]).all()
    trajectories, _ = log_trajectories(log, 20)
    at = torch.atan2(trajectories["state"][..., 1, 1], trajectories["state"][..., 1, 0])
    np.testing.assert_allclose(at.diff(dim=1) / 0.01, trajectories["state"][:, 1:, 1, 2], atol=1e-9)
    assert (trajectories["state"][:, 0, 1, 2] - at.diff(dim=1)[:, 0] / 0.01).abs().max() < 0.1


def test_differences_of_angles_span_no_jump(tmp_path):
    log = smooth_log((60, 60))
    log.angle[80:] += 2.0  # in the second episode
    np.savez(tmp_path / "log.npz", **(arrays_of(log) | {"time": np.arange(120) * 0.01}))
    read = load_robot_log(tmp_path / "log.npz", names={"velocity": ""})
    assert np.flatnonzero(np.isnan(read.velocity).any(1)).tolist() == [0, 60, 80]
    assert np.abs(read.velocity[read.finite]).max() < 4.1


@pytest.mark.parametrize("joints", [1, 2])
@pytest.mark.parametrize("name", ["Time", "timestamp", "t", "time_ms", "header.stamp", "time (s)"])
def test_times_of_another_name_are_no_channel(tmp_path, joints, name):
    log = smooth_log(joints=joints)
    arrays = arrays_of(log) | {name: np.arange(80) * 0.01}
    del arrays["load"]
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(DatasetError, match="looks like its time: say so, names="):
        load_robot_log(tmp_path / "log.npz", timestep=0.01)
    with pytest.raises(DatasetError, match="0.05 .timestep=. but 0.01 .its time stamps."):
        load_robot_log(tmp_path / "log.npz", timestep=0.05, names={"time": name})
    assert load_robot_log(tmp_path / "log.npz", timestep=0.01, names={name: ""}).extra == {}
    if joints == 1:
        assert list(load_robot_log(tmp_path / "log.npz", timestep=0.01, names={name: name}).extra) == [name]


@pytest.mark.parametrize("name, values", [("Episode", np.repeat([0, 1], [30, 50])), ("rows", np.array([30, 50]))])
def test_episodes_of_another_name_are_not_ignored(tmp_path, name, values):
    arrays = {key: each for key, each in arrays_of(smooth_log(joints=1)).items() if key != "length"}
    np.savez(tmp_path / "log.npz", **arrays, **{name: values})
    role = "episode" if name == "Episode" else "length"
    with pytest.raises(DatasetError, match=f"'{name}' looks like its {role}"):
        load_robot_log(tmp_path / "log.npz", timestep=0.01)
    read = load_robot_log(tmp_path / "log.npz", timestep=0.01, names={role: name})
    assert read.length.tolist() == [30, 50]


@pytest.mark.parametrize("channel", ["angle", "velocity"])
def test_an_infinity_hides_no_jump(channel):
    log = smooth_log((60, 60))
    log.angle[20:60] += 2.0
    getattr(log, channel)[80] = np.inf
    trajectories, report = log_trajectories(log, 10)
    assert report.jumps == ((0, 19),) and report.not_finite == 1
    assert trajectories["state"].isfinite().all()


def test_rows_that_a_trajectory_holds_are_not_left_over():
    log = smooth_log((25, 3))
    cases: list[tuple[dict[str, Any], int]] = [
        ({}, 3),
        ({"resample": 0.02}, 3),
        ({"lag": 4}, 3 + 8),
        ({"overlap": True}, 3),
    ]
    for options, short in cases:
        assert log_trajectories(log, 12, **options)[1].short == short


def test_an_angle_that_turns_over_does_not_jump():
    log = smooth_log((100,))
    rate = 4.0
    angle = (np.arange(100)[:, None] * 0.01 * rate * np.ones(2) + np.pi) % (2 * np.pi) - np.pi
    turning = RobotLog(angle, np.full((100, 2), rate), log.command, log.length, 0.01)
    assert np.abs(np.diff(angle, axis=0)).max() > 6
    assert log_trajectories(turning, 10)[1].jumps == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"velocity": None}, r"lacks \['velocity'\]; it has .* names="),
        ({"length": np.array([30, 49])}, "adds up to 79 rows, but there are 80"),
        ({"velocity": np.zeros((79, 2))}, "do not fit"),
        (
            {"load": np.zeros((80, 3))},
            "'load' has 3 columns, not a multiple of the 2 joints; name it angle, velocity, .* or leave it out",
        ),
        ({"timestep": np.array(-1.0)}, "has no time step"),
        (
            {"time": np.arange(80) * 0.02},
            r"0.01 \(its timestep\) but 0.02 \(its time stamps\); leave out the wrong one",
        ),
    ],
)
def test_bad_files_are_refused(tmp_path, change, message):
    arrays = {"timestep": 0.01, **arrays_of(smooth_log()), **change}
    np.savez(tmp_path / "log.npz", **{name: value for name, value in arrays.items() if value is not None})
    with pytest.raises(DatasetError, match=message):
        load_robot_log(tmp_path / "log.npz")


@pytest.mark.parametrize("size", [0, 1000])
def test_a_file_that_broke_off_is_refused(tmp_path, size):
    np.savez(tmp_path / "whole.npz", **arrays_of(smooth_log()))
    (tmp_path / "log.npz").write_bytes((tmp_path / "whole.npz").read_bytes()[:size])
    with pytest.raises(DatasetError, match="cannot be read as a robot log"):
        load_robot_log(tmp_path / "log.npz", timestep=0.01)


def test_a_single_joint_needs_no_second_axis(tmp_path):
    log = smooth_log(joints=1)
    np.savez(tmp_path / "log.npz", angle=log.angle[:, 0], velocity=log.velocity[:, 0], command=log.command[:, 0])
    read = load_robot_log(tmp_path / "log.npz", timestep=0.01)
    for name in ("angle", "velocity", "command"):
        np.testing.assert_array_equal(getattr(read, name), getattr(log, name))
    assert read.length.tolist() == [80]


def test_a_further_channel_of_a_single_joint_needs_none_either(tmp_path):
    log, load = smooth_log(joints=1), np.square(np.arange(80.0))
    np.savez(tmp_path / "log.npz", angle=log.angle, velocity=log.velocity, command=log.command, load=load)
    read = load_robot_log(tmp_path / "log.npz", timestep=0.01)
    np.testing.assert_array_equal(read.extra["load"], load[:, None])


def test_what_is_not_read_is_said(tmp_path):
    log = smooth_log()
    others = {
        "name": np.array(["a", "b"]),
        "mass": np.array(3.0),
        "late": np.zeros((79, 2)),
        "heat": np.zeros(80),
        "command": log.velocity,
        "u": log.command,
    }
    np.savez(tmp_path / "log.npz", **(arrays_of(log) | others))
    read = load_robot_log(tmp_path / "log.npz", timestep=0.01, names={"command": "u"})
    np.testing.assert_array_equal(read.command, log.command)
    assert list(read.extra) == ["load"] and set(read.unread) == {"name", "mass", "late", "heat", "command"}
    told = str(log_trajectories(read, 5)[1])
    assert "not read: 'name', not numbers" in told and "not read: 'mass', of shape [] and not [80, 2]" in told
    assert "not read: 'late', of shape [79, 2]" in told and "not read: 'heat', of shape [80]" in told
    assert "not read: 'command', 'u' was named for it" in told


def test_episodes_may_be_told_row_by_row(tmp_path):
    arrays = arrays_of(smooth_log())
    del arrays["length"]
    np.savez(tmp_path / "log.npz", **arrays, timestep=0.01, trial=np.repeat(["first", "second"], [30, 50]))
    assert load_robot_log(tmp_path / "log.npz", names={"episode": "trial"}).length.tolist() == [30, 50]


def test_a_robot_without_motors_says_so(tmp_path):
    arrays = arrays_of(smooth_log())
    del arrays["command"]
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(DatasetError, match=r"lacks \['command'\].* without motors"):
        load_robot_log(tmp_path / "log.npz", timestep=0.01)
    read = load_robot_log(tmp_path / "log.npz", timestep=0.01, names={"command": ""})
    assert log_trajectories(read, 12)[0]["action"].shape == (6, 12, 0)
    assert log_tree(read, "swing").num_actions == 0 == log_tree(read, "swing", history=4).history
    assert log_trajectories(read, 12, history=4)[0]["action"].shape == (5, 12, 0)


def test_a_time_step_does_not_contradict_the_log(tmp_path):
    np.savez(tmp_path / "log.npz", **arrays_of(smooth_log()), timestep=0.01)
    with pytest.raises(DatasetError, match=r"0.02 \(timestep=\) but 0.01 \(its timestep\).* resample="):
        load_robot_log(tmp_path / "log.npz", timestep=0.02)
    assert load_robot_log(tmp_path / "log.npz", timestep=0.02, names={"timestep": ""}).timestep == 0.02


def test_other_bad_input_is_named(tmp_path):
    with pytest.raises(DatasetError, match="No robot log at"):
        load_robot_log(tmp_path / "none.npz")
    (tmp_path / "log.txt").write_text("x")
    with pytest.raises(DatasetError, match=r"is a \.npz, \.csv, \.parquet, "):
        load_robot_log(tmp_path / "log.txt")
    (tmp_path / "log.npz").write_text("no zip")
    with pytest.raises(DatasetError, match="cannot be read as a robot log"):
        load_robot_log(tmp_path / "log.npz")
    with pytest.raises(ValueError, match="No piece of the log has 70 transitions"):
        log_trajectories(smooth_log(), 70)
    with pytest.raises(ValueError, match="No piece of the log has 48 transitions of 10 ms after 3 of history"):
        log_trajectories(smooth_log(), 48, history=3)
    with pytest.raises(ValueError, match="lag=-1"):
        log_trajectories(smooth_log(), 5, lag=-1)
    with pytest.raises(
        ValueError, match=r"2 commands do not divide evenly among 3 joints; .* commands=\[\[0\], \[\]\]"
    ):
        log = smooth_log(joints=3)
        log_tree(RobotLog(log.angle, log.velocity, log.command[:, :2], log.length, 0.01), "arm")
    with pytest.raises(DatasetError, match="has no 'q'"):
        np.savez(tmp_path / "ok.npz", **arrays_of(smooth_log()), timestep=0.01)
        load_robot_log(tmp_path / "ok.npz", names={"angle": "q"})


def test_columns_with_names_of_their_own(tmp_path):
    log, names = smooth_log(), ("q_hip", "q_knee", "dq_hip", "dq_knee", "tau_hip", "tau_knee")
    rows = np.hstack((log.angle, log.velocity, log.command))
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header=",".join(names), comments="")
    read = load_robot_log(
        tmp_path / "log.csv",
        timestep=0.01,
        names={"angle": ["q_knee", "q_hip"], "velocity": ["dq_knee", "dq_hip"], "command": "tau_*"},
    )
    np.testing.assert_allclose(read.angle, log.angle[:, ::-1])
    np.testing.assert_allclose(read.velocity, log.velocity[:, ::-1])
    np.testing.assert_allclose(read.command, log.command)
    assert not read.unread and not read.extra
    assert repr(read) == "RobotLog(episodes=1, rows=80, joints=2, commands=2, timestep=0.01)"
    with pytest.raises(DatasetError, match=r"has no 'q' .*take a list, or a pattern such as 'q_\*'"):
        load_robot_log(tmp_path / "log.csv", timestep=0.01, names={"angle": "q"})


@pytest.mark.parametrize(
    ("header", "names", "message"),
    [
        (
            "angle0,angle2,velocity0,velocity1,command0,command1",
            {},
            r"joints \['0', '2'\], .* 'velocity' of \['0', '1'\]",
        ),
        (
            "angle0,angle1,velocity1,velocity2,command0,command1",
            {},
            r"joints \['0', '1'\], .* 'velocity' of \['1', '2'\]",
        ),
        (
            "hip_q,knee_q,knee_dq,hip_dq,u0,u1",
            {"angle": "*_q", "velocity": "*_dq", "command": "u"},
            r"joints \['hip', 'knee'\], .* of \['knee', 'hip'\].* in the same order, names=\{'velocity': ",
        ),
    ],
)
def test_columns_of_other_joints_are_refused(header, names, message, tmp_path):
    log = smooth_log()
    rows = np.hstack((log.angle, log.velocity, log.command))
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header=header, comments="")
    with pytest.raises(DatasetError, match=message):
        load_robot_log(tmp_path / "log.csv", timestep=0.01, names=names)


def test_a_spreadsheets_byte_order_mark_is_no_part_of_a_name(tmp_path):
    log = smooth_log((50,), joints=1)
    rows = np.column_stack((0.01 * np.arange(50), log.angle, log.velocity, log.command))
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="time,angle0,velocity0,command0", comments="")
    text = (tmp_path / "log.csv").read_text()
    (tmp_path / "log.csv").write_text(text, encoding="utf-8-sig")
    read = load_robot_log(tmp_path / "log.csv", timestep=0.01)
    assert not read.extra and not read.unread and read.time is not None


def test_a_tree_without_the_past_commands_of_its_data_is_named():
    log = smooth_log()
    data, _ = log_trajectories(log, 10, history=2)
    for history in (0, 1):
        tree = log_tree(log, "arm", history=history)
        model = gn.ForwardModel.for_scene(tree, hidden=8).bind(tree)
        with pytest.raises(
            ValueError, match=r"got \[.*, 6\]\. If it holds past commands, give log_tree\(\.\.\., history=2\)"
        ):
            gn.fit(model, data, steps=1, progress=False)


def test_a_chain_is_a_graph_that_comes_back_from_its_description():
    tree = log_tree(smooth_log(joints=3), "arm", joint_parents=[-1, 0, 0])
    assert isinstance(tree, KinematicTree)
    assert tree.senders.tolist() == [0, 1, 1, 2, 1, 3] and tree.receivers.tolist() == [1, 0, 2, 1, 3, 1]
    assert tree.edge_action[:, 0].tolist() == [0, 0, 1, 1, 2, 2]
    again = scene_from_description(tree.description())
    assert again.fingerprint() == tree.fingerprint() and again.senders.tolist() == tree.senders.tolist()
    assert "joint2, parent joint0" in str(tree)
    with pytest.raises(ValueError, match="joint_parents="):
        log_tree(smooth_log(), "arm", joint_parents=[0, 1])


def test_a_chain_of_numpy_numbers_can_be_saved():
    plain = log_tree(smooth_log(joints=3), "arm", commands=[[2], [0], [1]], joint_parents=[-1, 0, 0])
    own: dict[str, Any] = {"commands": np.array([[2], [0], [1]]), "joint_parents": np.array([-1, 0, 0])}
    tree = log_tree(dataclasses.replace(smooth_log(joints=3), timestep=np.float32(0.01)), "arm", **own)
    assert json.loads(json.dumps(tree.description())) == tree.description()
    assert tree.fingerprint() == plain.fingerprint()


def test_bounds_are_of_every_command():
    with pytest.raises(ValueError, match=r"action_low of 'arm' must be \[2\], one a command, got \[1\]"):
        KinematicTree("arm", ("a", "b"), 0.01, ((0,), (1,)), action_low=np.zeros(1))
    with pytest.raises(ValueError, match=r"action_low of 'arm' must be \[1\], one a command, got \[2\]"):
        log_tree(smooth_log(), "arm", commands=[[0], [0]])


def test_a_simulated_robot_has_the_faults_of_a_real_one():
    scene = load_scene("jaco")
    faults: dict[str, Any] = {"delay": 0, "time_constant": 0.0, "play": 0.0, "quantum": 0.0, "noise": 0.0}
    clean, coarse = (simulate_log(scene, 3, 30, 0, **{**faults, **own}) for own in ({}, {"quantum": 0.01}))
    assert clean.angle.shape == (3 * 29, 9) and clean.length.tolist() == [29] * 3
    np.testing.assert_allclose(coarse.angle / 0.01, np.round(coarse.angle / 0.01), atol=1e-9)
    assert 0 < np.abs(clean.angle - coarse.angle).max() <= 0.005 + 1e-9
    change = np.diff(clean.angle[:29], axis=0) / scene.timestep
    np.testing.assert_allclose(clean.velocity[1:29], change, atol=1e-9)
    delayed = simulate_log(scene, 3, 30, 0, **(faults | {"delay": 5}))
    assert np.array_equal(delayed.command, clean.command)
    still = delayed.angle.reshape(3, 29, 9)[:, :4]
    assert np.ptp(still, axis=1).max() < 0.05 < np.ptp(clean.angle.reshape(3, 29, 9)[:, :4], axis=1).max()
    with pytest.raises(ValueError, match="no joints but hinges"):
        simulate_log(load_scene("cartpole"), 1, 10, 0)


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists(PAM), reason="the robot's logs are not here")
def test_a_real_log_is_cut_where_its_description_says():
    log = load_robot_log(PAM, timestep=0.01047, names=NAMES)
    assert log.num_joints == 4 and list(log.extra) == ["pressure0", "pressure1"]
    _, report = log_trajectories(log, 80, lag=1)
    assert report.jumps == ((1586, 84),) and report.rows == 323_726

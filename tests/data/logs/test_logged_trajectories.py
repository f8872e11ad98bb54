"""Trajectories of robot logs: their ends, and steps between rows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from torchrl_gn import ForwardModel, evaluate_errors, fit
from torchrl_gn.data import RobotLog, load_robot_log, log_trajectories, log_tree, trajectory_buffer
from torchrl_gn.scenes import KinematicTree, scene_from_description

STEP = 0.01


def turning_log(time: np.ndarray, *, joints: int = 2, commands: int = 2, length=None) -> RobotLog:
    """Joints that turn over and over, each at its rate; velocities and loads that are linear; commands of each row."""
    rate = 4.0 + np.arange(joints)
    angle = (time[:, None] * rate + np.pi) % (2 * np.pi) - np.pi
    velocity = np.broadcast_to(rate, angle.shape) + 0.1 * time[:, None]
    command = np.random.default_rng(0).normal(size=(len(time), commands))
    length = np.array([len(time)] if length is None else length)
    return RobotLog(angle, velocity, command, length, STEP, {"load": time[:, None] * rate}, time)


def test_rows_that_are_missing_end_a_trajectory(tmp_path):
    # A swing, a pause, and a swing; commands tell their row.
    time = np.arange(500) * STEP
    phase = np.r_[np.arange(150), np.full(200, 150), np.arange(150, 300)] * STEP * 10
    moves = np.r_[np.ones(150), np.zeros(200), np.ones(150)]
    table = np.column_stack((time, np.sin(phase), 10 * moves * np.cos(phase), np.arange(500)))
    table = np.delete(table, [60, *range(200, 280)], axis=0)  # mid-motion, and in the pause
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="time,angle,velocity,command", comments="")
    read = load_robot_log(tmp_path / "log.csv")
    trajectories, report = log_trajectories(read, 10)
    assert read.timestep == pytest.approx(STEP)
    assert report.gaps == ((0, 59), (0, 198)) and report.jumps == () and not report.interpolated
    assert "cut at 2 gaps, the first at row 59 of episode 0" in str(report)
    assert trajectories["action"].diff(dim=1).eq(1).all()  # none has rows on both sides
    unstamped = load_robot_log(tmp_path / "log.csv", timestep=STEP, names={"time": ""})
    trajectories, report = log_trajectories(unstamped, 10)
    assert report.gaps is None and "no time stamps" in str(report)
    assert not trajectories["action"].diff(dim=1).eq(1).all()


def test_times_that_are_not_later_end_a_trajectory(tmp_path):
    time = np.r_[np.arange(40), np.arange(30), 29, np.arange(30, 59)] * STEP  # begins anew; one twice
    log = turning_log(np.arange(100) * STEP)
    np.savez(tmp_path / "log.npz", angle=log.angle, velocity=log.velocity, command=log.command, time=time)
    read = load_robot_log(tmp_path / "log.npz")
    assert log_trajectories(read, 20)[1].gaps == ((0, 39), (0, 69))
    # Where an episode ends time may do what it likes.
    ended = RobotLog(read.angle, read.velocity, read.command, np.array([40, 60]), STEP, {}, time)
    assert log_trajectories(ended, 20)[1].gaps == ((1, 29),) and ended.gaps.sum() == 1


def test_a_row_without_a_time_is_dropped():
    log = turning_log(np.arange(60) * STEP)
    assert log.time is not None
    log.time[30] = np.nan
    _, report = log_trajectories(log, 29)
    assert (report.not_finite, report.gaps, report.trajectories) == (1, (), 1)


@pytest.mark.parametrize("every", [1, 2, 7, 10])  # 0.07 is not 7 of 0.01
@pytest.mark.parametrize("commands", [1, 3])
@pytest.mark.parametrize("stamped", [True, False])
def test_a_multiple_of_the_step_keeps_rows_as_they_are(every, commands, stamped):
    log = turning_log(np.arange(100) * STEP, commands=commands)
    if not stamped:
        log = RobotLog(log.angle, log.velocity, log.command, log.length, STEP, log.extra)
    trajectories, report = log_trajectories(log, 9, resample=every * STEP)
    count = (99 // every) // 9 * 9
    for index, channel in enumerate((np.cos(log.angle), np.sin(log.angle), log.velocity, log.extra["load"])):
        rows = torch.from_numpy(channel[: count * every : every]).unflatten(0, (-1, 9))
        assert torch.equal(trajectories["state"][:, :-1, 1:, index], rows)
    mean = log.command[: count * every].reshape(count, every, commands).mean(1)
    assert torch.equal(trajectories["action"].flatten(0, 1), torch.from_numpy(mean))
    assert not report.interpolated and report.timestep == pytest.approx(every * STEP)


def held(log: RobotLog, begin: float, end: float) -> np.ndarray:
    """Mean of the commands in force between two times, by brute force."""
    assert log.time is not None
    moments = begin + (np.arange(20_000) + 0.5) / 20_000 * (end - begin)
    return log.command[np.searchsorted(log.time, moments, side="right") - 1].mean(0)


@pytest.mark.parametrize("step", [0.4, 1.5, 2.7])
@pytest.mark.parametrize("even", [True, False])
def test_steps_between_rows_are_interpolated(step, even):
    time = np.arange(200) * STEP
    if not even:
        time[1:-1] += STEP * np.random.default_rng(1).uniform(-0.2, 0.2, 198)
    log = turning_log(time)
    trajectories, report = log_trajectories(log, 30, resample=step * STEP)
    state, action = trajectories["state"][0], trajectories["action"][0]
    assert report.interpolated and f"at steps of {10 * step:g} ms" in str(report)
    moments = torch.arange(31, dtype=torch.float64)[:, None] * step * STEP
    rate = torch.tensor([4.0, 5.0], dtype=torch.float64)
    torch.testing.assert_close(state[:, 1:, 0], (moments * rate).cos())
    torch.testing.assert_close(state[:, 1:, 1], (moments * rate).sin())
    torch.testing.assert_close(state[:, 1:, 2], rate + 0.1 * moments)
    torch.testing.assert_close(state[:, 1:, 3], moments * rate)
    for index in (0, 7, 29):
        mean = held(log, index * step * STEP, (index + 1) * step * STEP)
        np.testing.assert_allclose(action[index], mean, atol=1e-3)


def test_rows_that_are_not_even_are_put_on_even_steps():
    time = (np.arange(100) + np.random.default_rng(0).uniform(-0.2, 0.2, 100)) * STEP
    log = turning_log(time)
    trajectories, report = log_trajectories(log, 40)
    moments = time[0] + torch.arange(41, dtype=torch.float64) * STEP
    torch.testing.assert_close(trajectories["state"][0, :, 1, 0], (4 * moments).cos())
    assert report.interpolated and report.timestep == STEP and report.gaps == ()


def test_a_jump_between_uneven_rows_is_seen():
    time = (np.arange(100) + np.random.default_rng(0).uniform(-0.2, 0.2, 100)) * STEP
    log = turning_log(time)
    log.angle[50:] += 0.3  # no more than uneven rows would hide if they were taken for even
    assert log_trajectories(log, 40)[1].jumps == ((0, 49),)


def test_the_last_row_is_a_step_in_spite_of_rounding():
    log, step = turning_log(np.arange(10) * STEP), 9 * 0.001
    assert 9 / (step / STEP) < 10
    trajectories, report = log_trajectories(log, 10, resample=step)
    torch.testing.assert_close(trajectories["state"][0, -1, 1, 0], torch.tensor(np.cos(log.angle[9, 0])))
    assert report.short == 0


def test_nothing_is_interpolated_across_a_break():
    # The angle is what the piece is of: 0 before a jump, 2 behind it, 0.3 behind a gap, and 1 in the next episode.
    angle = np.repeat([0.0, 2.0, 0.3, 1.0], 25)[:, None]
    time = np.r_[np.arange(50), np.arange(60, 85), np.arange(25)] * STEP
    log = RobotLog(angle, 0.0 * angle, angle, np.array([75, 25]), STEP, {}, time)
    trajectories, report = log_trajectories(log, 7, resample=1.5 * STEP, overlap=True)
    assert (report.jumps, report.gaps) == (((0, 24),), ((0, 49),))
    cosine = trajectories["state"][:, :, 1, 0]
    assert torch.equal(cosine, cosine[:, :1].expand(-1, 8))
    assert set(trajectories["action"].unique().tolist()) == {0.0, 2.0, 0.3, 1.0}
    torch.testing.assert_close(cosine[:, :7], trajectories["action"][..., 0].cos())


def test_a_delay_is_in_rows_whatever_the_step():
    log = turning_log(np.arange(60) * STEP)
    late, _ = log_trajectories(log, 10, resample=1.5 * STEP, lag=4)
    torch.testing.assert_close(late["state"][0, 0, 1, 0], torch.tensor(np.cos(log.angle[4, 0])))
    np.testing.assert_allclose(late["action"][0, 0], (log.command[0] + log.command[1] / 2) / 1.5)


def test_a_step_that_is_none_is_refused():
    for step in (0.0, -0.01, np.nan, np.inf):
        with pytest.raises(ValueError, match="resample="):
            log_trajectories(turning_log(np.arange(60) * STEP), 10, resample=step)


def test_where_nothing_is_left_the_report_says_why():
    log = turning_log(np.r_[np.arange(10), np.arange(20, 30)] * STEP)
    with pytest.raises(
        ValueError, match="No piece of the log has 15 transitions of 10 ms; take fewer.\n.*\n.*\n.* 1 gaps"
    ):
        log_trajectories(log, 15)


def test_a_command_that_never_varies_is_named():
    log = turning_log(np.arange(60) * STEP)
    log.command[:, 1] = 3.0
    report = log_trajectories(log, 10)[1]
    assert report.constant == (1,) and "commands that never vary: 1;" in str(report)
    tree = log_tree(log, "arm")
    assert tree.action_low[1] == tree.action_high[1] == 3 and tree.action_low[0] < tree.action_high[0]


@pytest.mark.parametrize("resample", [None, 2 * STEP, 1.5 * STEP])
@pytest.mark.parametrize("lag", [0, 2])
def test_past_commands_are_those_of_the_steps_before(resample, lag):
    log = turning_log(np.arange(100) * STEP, length=[60, 40])
    plain, _ = log_trajectories(log, 12, resample=resample, lag=lag, overlap=True)
    past, report = log_trajectories(log, 12, resample=resample, lag=lag, overlap=True, history=3)
    assert past["action"].shape[-1] == 8 and len(past) == len(plain) - 2 * 3  # of each episode the first steps
    later = {
        name: torch.cat([plain[name][plain["episode"] == episode][3:] for episode in (0, 1)])
        for name in ("state", "action")
    }
    assert torch.equal(past["state"], later["state"]) and torch.equal(past["action"][..., :2], later["action"])
    for step in (1, 2, 3):
        for episode in (0, 1):
            before = plain["action"][plain["episode"] == episode][3 - step : -step]
            own = past["action"][past["episode"] == episode]
            assert torch.equal(own[..., 2 * step : 2 * step + 2], before)
    assert report.short == log_trajectories(log, 15, resample=resample, lag=lag, overlap=True)[1].short


def test_a_graph_has_the_past_commands_at_their_joints():
    log = turning_log(np.arange(100) * STEP)
    tree = log_tree(log, "arm", commands=[[1], [0]], history=2)
    assert tree.commands == ((1, 3, 5), (0, 2, 4)) and tree.num_actions == 6
    assert tree.action_low.tolist() == 3 * log.command_bounds()[0].tolist()
    again = scene_from_description(tree.description())
    assert isinstance(again, KinematicTree) and again.history == 2
    assert again.fingerprint() == tree.fingerprint() != log_tree(log, "arm").fingerprint()
    assert tree.present.commands == ((1,), (0,)) and tree.present.action_high.tolist() == tree.action_high[:2].tolist()
    assert "2 commands and those of 2 past steps" in str(tree) and "parent base: commands 1\n" in str(tree)
    with pytest.raises(ValueError, match="must be as many for each of 2 past steps"):
        dataclasses.replace(tree, commands=((1, 3), (0, 2, 4)))


def test_targets_are_smoothed_and_states_are_not():
    log = turning_log(np.arange(300) * STEP)
    rng, clean = np.random.default_rng(0), log_trajectories(log, 20)[0]
    noisy = RobotLog(
        (log.angle + 0.01 * rng.normal(size=log.angle.shape) + np.pi) % (2 * np.pi) - np.pi,
        log.velocity + 0.1 * rng.normal(size=log.velocity.shape),
        *(log.command, log.length, STEP, log.extra),
    )
    raw, (data, _) = log_trajectories(noisy, 20)[0], log_trajectories(noisy, 20, smooth={"angle": 4})
    assert torch.equal(data["state"], raw["state"]) and "smoothed" not in raw
    errors = {key: (data[key] - clean["state"])[..., 1:, :].square().mean((0, 1, 2)) for key in ("state", "smoothed")}
    assert (errors["smoothed"][:2] < 0.4 * errors["state"][:2]).all()
    assert torch.equal(data["smoothed"][..., 2:], data["state"][..., 2:])  # channels that were not named
    assert not torch.equal(log_trajectories(noisy, 20, smooth=4)[0]["smoothed"][..., 2:], data["state"][..., 2:])
    batch = trajectory_buffer(data, batch_size=8, window=5, seed=0).sample()
    trajectory, time = batch["index"].unbind(-1)
    assert torch.equal(batch["state"], data["state"][trajectory, time])
    assert torch.equal(batch["next", "state"], data["smoothed"][trajectory, time + 1])
    with pytest.raises(ValueError, match="smooth=.* must be rows of at least 0, by channel"):
        log_trajectories(noisy, 20, smooth={"torque": 4})
    data["smoothed"] = data["smoothed"][:, 1:]
    with pytest.raises(ValueError, match="smoothed states must be"):
        trajectory_buffer(data, batch_size=8)


def test_episodes_are_indices_of_the_log():
    log = turning_log(np.arange(90) * STEP, length=[30, 30, 30])
    assert log_trajectories(log, 10, episodes=np.arange(1, 3))[0]["episode"].unique().tolist() == [1, 2]
    for episodes, wrong in (([3], 3), (range(1, 5), 3), ([-1], -1)):
        with pytest.raises(ValueError, match=f"whole numbers from 0 to 2, the last of the log; got {wrong}"):
            log_trajectories(log, 10, episodes=episodes)
    with pytest.raises(ValueError, match=r"indices, not a mask: give np.flatnonzero"):
        log_trajectories(log, 10, episodes=np.array([True, True, False]))


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"steps": 2.5}, "steps=2.5 must be a whole number, 1 or more"),
        ({"lag": 0.5}, "lag=0.5 must be a whole number, 0 or more"),
        ({"history": True}, "history=True must be a whole number"),
        ({"smooth": 2.5}, "smooth of angle=2.5 must be a whole number"),
        ({"smooth": {"velocity": -1}}, "smooth of velocity=-1 must be a whole number, 0 or more"),
        ({"episodes": [0.7]}, "episodes must be whole numbers from 0 to 2, the last of the log; got 0.7"),
        ({"episodes": ["0"]}, "episodes must be whole numbers from 0 to 2, the last of the log; got '0'"),
        ({"episodes": [1, 0, 1]}, "episodes has 1 more than once"),
    ],
)
def test_counts_are_whole_and_episodes_are_given_once(option, message):
    log = turning_log(np.arange(90) * STEP, length=[30, 30, 30])
    with pytest.raises(ValueError, match=message):
        log_trajectories(log, **{"steps": 10, **option})


def test_a_count_may_be_one_of_numpys():
    log = turning_log(np.arange(90) * STEP, length=[30, 30, 30])
    expected = log_trajectories(log, 10, lag=1, smooth=3)[0]
    found = log_trajectories(log, np.int64(10), lag=np.int64(1), smooth=np.int64(3))[0]
    assert bool((found == expected).all())


def test_a_tree_of_another_time_step_is_refused():
    log = turning_log(np.arange(200) * STEP)
    trajectories, _ = log_trajectories(log, 10, resample=0.03)
    assert trajectories["timestep"].unique().tolist() == [0.03]
    for resample, fits in ((0.03, True), (None, False)):
        model = ForwardModel.for_scene(log_tree(log, "turning", resample=resample), hidden=8, layers=1)
        model = model.bind(log_tree(log, "turning", resample=resample))
        if fits:
            fit(model, trajectories, steps=1, batch_size=4, progress=False)
            continue
        with pytest.raises(ValueError, match=r"30 ms apart, .* is 10 ms: give log_tree\(..., resample=0.03\)"):
            fit(model, trajectories, steps=1, batch_size=4, progress=False)
        with pytest.raises(ValueError, match="30 ms apart"):
            evaluate_errors(model, trajectories, horizons=(5,))

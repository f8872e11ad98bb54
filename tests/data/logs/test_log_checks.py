"""Logs whose numbers contradict each other are refused, or warned of, with the number that shows it."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from torchrl_gn.data import DatasetError, LogContentWarning, load_pose_log, load_robot_log

STEP, ROWS, JOINTS = 0.02, 800, 2
TIME = STEP * np.arange(ROWS)


def swinging() -> dict[str, np.ndarray]:
    """Joints that swing at two frequencies, with exact velocities."""
    frequency = 2.0 + np.arange(JOINTS)
    angle = 0.8 * np.sin(TIME[:, None] * frequency)
    velocity = 0.8 * frequency * np.cos(TIME[:, None] * frequency)
    return {"angle": angle, "velocity": velocity, "command": np.sin(7 * TIME)[:, None] + [0.0, 1.0]}


def refused(tmp_path, message: str, arrays: dict, **options) -> None:
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(DatasetError, match=message):
        load_robot_log(tmp_path / "log.npz", **options)


def test_a_right_log_is_read_without_a_word_whatever_its_noise_and_filter(tmp_path):
    arrays, rng = swinging() | {"time": TIME}, np.random.default_rng(0)
    coarse = np.round((arrays["angle"] + 1e-3 * rng.normal(size=(ROWS, JOINTS))) / 2e-3) * 2e-3
    late = np.roll(arrays["velocity"], 2, axis=0) * 0.9
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for change in ({}, {"angle": coarse}, {"angle": coarse, "velocity": late}, {"angle": 0 * coarse}):
            np.savez(tmp_path / "log.npz", **arrays | change)
            load_robot_log(tmp_path / "log.npz")
        still = {"angle": 1e-3 * rng.normal(size=(ROWS, JOINTS)), "velocity": np.zeros((ROWS, JOINTS))}
        np.savez(tmp_path / "log.npz", **arrays | still)
        load_robot_log(tmp_path / "log.npz")


def test_columns_of_one_name(tmp_path):
    table = np.hstack((swinging()["angle"], swinging()["velocity"], swinging()["command"]))
    for names, message in (
        ("angle0,angle1,velocity0,velocity0,command0,command1", r"columns \[2, 3\] are all named 'velocity0'"),
        ("angle0,angle1,velocity1,velocity01,command0,command1", "several columns are 'velocity' with the number 1"),
    ):
        np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=names, comments="")
        with pytest.raises(DatasetError, match=message):
            load_robot_log(tmp_path / "log.csv", timestep=STEP)


def test_columns_of_one_name_in_parquet(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = [pa.array(np.arange(3.0))] * 4
    pq.write_table(pa.table(columns, names=["angle", "velocity", "velocity", "command"]), tmp_path / "log.parquet")
    with pytest.raises(DatasetError, match=r"columns \[1, 2\] are all named 'velocity'"):
        load_robot_log(tmp_path / "log.parquet", timestep=STEP)


def test_times_in_milliseconds(tmp_path):
    arrays = swinging() | {"time": 1e3 * TIME}
    with pytest.warns(LogContentWarning, match="20 s between rows: are its times in another unit"):
        refused(
            tmp_path, r"1\.01e\+03 times the changes.* as of times in milliseconds|1e\+03 times the changes", arrays
        )
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.warns(LogContentWarning, match="20 s between rows"):
        load_robot_log(tmp_path / "log.npz", names={"velocity": ""})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"velocity": 180 / np.pi}, r"velocities of joint . are 57\.\d* times .* as of velocities in degrees/s"),
        ({"angle": 180 / np.pi, "velocity": -180 / np.pi}, "opposite sign"),
        ({"velocity": -1}, r"velocities of joint 0, joint 1 have the opposite sign .* -(1\.00|0\.\d\d)"),
        ({"velocity": np.array([1, -1])}, "velocities of joint 1 have the opposite sign"),
        ({"velocity": np.array([1, 0.1])}, "velocities of joint 1 are 0.1"),
    ],
)
def test_units_and_signs(tmp_path, change, message):
    arrays = swinging()
    scaled = {name: factor * arrays[name] * (0.1 if name == "angle" else 1) for name, factor in change.items()}
    if "angle" in change:
        scaled = {name: 0.02 * factor * arrays[name] for name, factor in change.items()}
    refused(tmp_path, message, arrays | scaled, timestep=STEP)


def test_a_doubtful_unit_is_warned_of(tmp_path):
    arrays = swinging()
    np.savez(tmp_path / "log.npz", **arrays | {"velocity": 2 * arrays["velocity"]})
    with pytest.warns(LogContentWarning, match=r"velocities of joint . are (2|1\.9|2\.0)\d* times the changes"):
        load_robot_log(tmp_path / "log.npz", timestep=STEP)


def test_degrees(tmp_path):
    arrays = swinging()
    large = {name: np.rad2deg(arrays[name]) for name in ("angle", "velocity")}
    np.savez(tmp_path / "log.npz", **arrays | large)
    with pytest.warns(
        LogContentWarning, match=r"Angles reach 45\.8 rad, 7\.3 turns: if they are degrees, pass degrees"
    ):
        load_robot_log(tmp_path / "log.npz", timestep=STEP)
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.warns(LogContentWarning, match=r"Angles reach 0\.8 degrees: if they are radians, leave out"):
        load_robot_log(tmp_path / "log.npz", timestep=STEP, degrees=True)


def test_rows_out_of_order(tmp_path):
    order = np.random.default_rng(0).permutation(ROWS)
    shuffled = {name: values[order] for name, values in swinging().items()}
    refused(
        tmp_path, r"of 799 rows are not later than the row before: sort them by time", shuffled | {"time": TIME[order]}
    )
    refused(tmp_path, r"changes by 0\.\d+ rad from row to row, but velocities say 0\.0", shuffled, timestep=STEP)


@pytest.mark.parametrize(
    ("factor", "message"), [(-1, "body 0 have the opposite sign"), (1e3, r"1e\+03 times|999 times")]
)
def test_velocities_of_poses(tmp_path, factor, message):
    position = np.stack((np.sin(2 * TIME), np.cos(3 * TIME), TIME), 1)
    velocity = np.stack((2 * np.cos(2 * TIME), -3 * np.sin(3 * TIME), 0 * TIME + 1), 1)
    turns = np.tile([1.0, 0, 0, 0], (ROWS, 1))
    arrays = {"position": position, "quaternion": turns, "angular_velocity": 0 * position, "timestep": STEP}
    np.savez(tmp_path / "log.npz", velocity=velocity, **arrays)
    assert len(load_pose_log(tmp_path / "log.npz").state) == ROWS
    np.savez(tmp_path / "log.npz", velocity=factor * velocity, **arrays)
    with pytest.raises(DatasetError, match=message):
        load_pose_log(tmp_path / "log.npz")


@pytest.mark.parametrize("counted", [np.arange(ROWS), np.arange(ROWS) % 200, 1e6 + 20 * np.arange(ROWS), TIME + 5.0])
def test_a_count_of_rows_is_no_channel_of_a_single_joint(counted, tmp_path):
    arrays = {name: values[:, :1] for name, values in swinging().items()} | {"timestep": np.array(STEP)}
    table = np.column_stack((counted, arrays["angle"], arrays["velocity"], arrays["command"]))
    for name in ("", "seq"):  # pandas writes its index without a name
        header = f"{name},angle0,velocity0,command0"
        np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=header, comments="", fmt="%.9g")
        with pytest.raises(DatasetError, match=f"'{name}' grows by the same step from row to row, as a count of rows"):
            load_robot_log(tmp_path / "log.csv", timestep=STEP)
        left_out = load_robot_log(tmp_path / "log.csv", timestep=STEP, names={name: ""})
        assert not left_out.extra and left_out.num_joints == 1
    refused(tmp_path, "'seq' grows by the same step", arrays | {"seq": counted})


def test_flags_of_ends_within_an_episode(tmp_path):
    arrays, ends = swinging() | {"timestep": np.array(STEP)}, np.arange(ROWS) % 200 == 199
    for name, flags in (("done", ends), ("terminal", ends.astype(float)), ("is_first", np.roll(ends, 1)[:, None])):
        refused(tmp_path, f"'{name}' looks like flags of episodes' ends: say where", arrays | {name: flags})
        np.savez(tmp_path / "log.npz", **arrays, **{name: flags}, episode=np.arange(ROWS) // 200)
        log = load_robot_log(tmp_path / "log.npz")  # which agree with the episodes
        assert log.length.tolist() == [200] * 4 and set(log.unread) == {name}
    single = {name: values[..., :1] for name, values in arrays.items() if values.ndim}
    refused(tmp_path, "'done' looks like flags", single | {"done": np.zeros(ROWS)}, timestep=STEP)


def test_episodes_that_contradict_themselves(tmp_path):
    arrays, episode = swinging() | {"timestep": np.array(STEP)}, np.arange(ROWS) // 200
    for change, message in (
        ({"episode": np.where(episode == 3, np.nan, episode)}, "'episode' is not a number at row 600"),
        ({"episode": episode, "length": [400, 400]}, "'length' states 2 episodes, 'episode' 4"),
        ({"episode": episode[:-1]}, r"'episode' \(799,\) must be one of each of the 800 rows"),
        ({"episode": np.arange(ROWS) % 2}, "rows of several episodes alternate: sort them"),
        ({"time": np.stack((TIME, TIME), 1)}, r"'time' \(800, 2\) must be one of each of the 800 rows"),
    ):
        refused(tmp_path, message, arrays | change)
    np.savez(tmp_path / "log.npz", **arrays, episode=np.array(7), length=[400, 400])  # the number of the file
    assert load_robot_log(tmp_path / "log.npz").length.tolist() == [400, 400]


def test_two_arrays_of_one_channel(tmp_path):
    arrays = swinging() | {"timestep": np.array(STEP)}
    rest = {"torque": np.zeros((ROWS, 2 * JOINTS)), "torque1": np.ones((ROWS, JOINTS))}
    refused(tmp_path, "two of its arrays are the channel 'torque1'", arrays | rest)


@pytest.mark.parametrize("kind", ["datetime64[ns]", "timedelta64[us]"])
def test_dates_and_durations_are_times(kind, tmp_path):
    unit = 1e9 if "ns" in kind else 1e6
    stamps = (np.round(TIME * unit) + 1.7e9 * unit).astype(np.int64).astype(kind)
    np.savez(tmp_path / "log.npz", **swinging(), time=stamps)
    assert load_robot_log(tmp_path / "log.npz").timestep == pytest.approx(STEP)

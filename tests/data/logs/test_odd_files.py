"""Logs with odd arrays, headers and descriptions: read with the right numbers, or refused by name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from torchrl_gn.data import DatasetError, load_pose_log, load_robot_log, log_trajectories

ROWS, STEP = 60, 0.01
TIME = STEP * np.arange(ROWS)
ANGLE = np.stack((np.sin(2 * TIME), np.cos(3 * TIME)), 1)
VELOCITY = np.stack((2 * np.cos(2 * TIME), -3 * np.sin(3 * TIME)), 1)
COMMAND = np.random.default_rng(0).normal(size=(ROWS, 2))
NAMES = ("time", "angle0", "angle1", "velocity0", "velocity1", "command0", "command1")


def robot(folder: Path, **changed) -> Path:
    arrays = {"angle": ANGLE, "velocity": VELOCITY, "command": COMMAND, "time": TIME} | changed
    np.savez(folder / "log.npz", **{name: values for name, values in arrays.items() if values is not None})
    return folder / "log.npz"


def poses(folder: Path, **changed) -> Path:
    arrays = {"position": ANGLE[:, [0, 1, 0]], "quaternion": np.tile([1.0, 0, 0, 0], (ROWS, 1))} | changed
    np.savez(folder / "log.npz", **arrays)
    return folder / "log.npz"


@pytest.mark.parametrize("lost", [[0], [0, 1], [0, 1, 20, 21, 22], [ROWS - 1], [20, 21, 40]])
def test_rows_that_are_not_finite_are_dropped_wherever_they_are(lost, tmp_path):
    angle = ANGLE.copy()
    angle[lost] = np.nan
    trajectories, report = log_trajectories(load_robot_log(robot(tmp_path, angle=angle)), 1)
    kept = ~np.isin(np.arange(ROWS), lost)
    assert report.not_finite == len(lost)
    assert report.kept == int((kept[1:] & kept[:-1]).sum()) == len(trajectories)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"time": None, "timestep": np.where(np.arange(ROWS) % 2, 0.015, 0.005)}, "'timestep' varies from 0.005"),
        ({"time": None, "timestep": np.r_[np.nan, np.full(ROWS - 1, STEP)]}, "'timestep' must be finite"),
        ({"timestep": np.array("x")}, "'timestep' holds <U1"),
        ({"angle": ANGLE + 1j}, "'angle' holds complex128, not real numbers"),
        ({"angle": np.zeros(ROWS, dtype=[("x", "f8"), ("y", "f8")])}, "'angle' holds .*, not real numbers"),
        ({"length": np.array([30.5, 30.4])}, "length must be whole numbers .* it has 30.5"),
        ({"length": np.array([ROWS + 5, -5])}, "it has -5"),
        ({"length": np.array([np.nan])}, "it has nan"),
        ({"time": TIME[::-1].copy()}, "time stamps never grow within an episode"),
        ({"angle": ANGLE[:0], "velocity": VELOCITY[:0], "command": COMMAND[:0], "time": None}, "nothing in it: 0 rows"),
    ],
)
def test_odd_arrays_of_a_robot_log_are_refused_by_name(changed, message, tmp_path):
    with pytest.raises(DatasetError, match=message):
        load_robot_log(robot(tmp_path, **changed), timestep=None if "time" not in changed else STEP)


@pytest.mark.parametrize(
    "changed", [{"dt": np.full(ROWS, STEP)}, {"timestep": np.array([STEP])}, {"time": TIME[:, None]}]
)
def test_a_time_step_is_read_from_every_row(changed, tmp_path):
    log = load_pose_log(poses(tmp_path, **changed))
    assert log.timestep == pytest.approx(STEP) and len(log.state) == ROWS - 1
    np.testing.assert_allclose(log.state[:, 0, 7], np.diff(ANGLE[:, 0]) / STEP)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"dt": np.where(np.arange(ROWS) % 2, 0.015, 0.005)}, "'dt' varies from 0.005"),
        ({"time": TIME[::-1].copy()}, "time stamps never grow within an episode"),
        ({"time": np.zeros(ROWS)}, "time stamps never grow within an episode"),
        ({"time": np.stack((TIME, TIME), 1)}, "time .* must be one number for each row"),
        ({"timestep": STEP, "length": np.array([ROWS + 5, -5])}, "it has -5"),
        ({"timestep": STEP, "length": np.array([ROWS, 0])}, "it has 0"),
        ({"timestep": STEP, "position": ANGLE[:, [0, 1, 0]] + 1j}, "'position' holds complex128"),
        ({"timestep": STEP, "position": np.zeros(ROWS, dtype="f8,f8")}, "'position' holds .*, not real numbers"),
        ({"timestep": STEP, "position": np.zeros((ROWS, 0, 3)), "quaternion": np.zeros((ROWS, 0, 4))}, "0 bodies"),
    ],
)
def test_odd_arrays_of_a_pose_log_are_refused_by_name(changed, message, tmp_path):
    with pytest.raises(DatasetError, match=message):
        load_pose_log(poses(tmp_path, **changed))


def csv(folder: Path, header: str, columns: np.ndarray) -> Path:
    np.savetxt(folder / "log.csv", columns, delimiter=",", header=header, comments="", fmt="%.17g")
    return folder / "log.csv"


@pytest.mark.parametrize("header", ["# " + ",".join(NAMES), "#" + ",".join(NAMES), '"' + '","'.join(NAMES) + '"'])
def test_the_header_of_a_csv_file_may_be_a_comment_or_in_quotes(header, tmp_path):
    log = load_robot_log(csv(tmp_path, header, np.column_stack((TIME, ANGLE, VELOCITY, COMMAND))))
    np.testing.assert_array_equal(log.angle, ANGLE)
    np.testing.assert_array_equal(log.time, TIME)
    assert not log.extra


def test_a_csv_file_of_one_column_is_one_joint(tmp_path):
    log = load_robot_log(csv(tmp_path, "angle0", ANGLE[:, :1]), timestep=STEP, names={"velocity": "", "command": ""})
    np.testing.assert_array_equal(log.angle, ANGLE[:, :1])
    (tmp_path / "log.csv").write_text(",".join(NAMES) + "\n")
    with pytest.raises(DatasetError, match="it has no rows"):
        load_robot_log(tmp_path / "log.csv")


def test_a_damaged_npz_file_is_refused_or_read_whole(tmp_path):
    """Readers raise errors of many types: of zlib, of NumPy's own header, of zip files."""
    for name, arrays in (("packed", np.savez_compressed), ("plain", np.savez)):
        arrays(tmp_path / f"{name}.npz", angle=ANGLE, velocity=VELOCITY, command=COMMAND, time=TIME)
        whole = (tmp_path / f"{name}.npz").read_bytes()
        refused = 0
        for place in range(0, len(whole), len(whole) // 150):
            damaged = bytearray(whole)
            damaged[place] ^= 1 << place % 8
            (tmp_path / "log.npz").write_bytes(damaged)
            try:
                log = load_robot_log(tmp_path / "log.npz")
            except DatasetError:
                refused += 1
            else:
                np.testing.assert_array_equal(np.hstack((log.angle, log.velocity)), np.hstack((ANGLE, VELOCITY)))
        assert refused > 100, name


def test_attributes_of_an_hdf5_file_may_be_of_any_type(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values in {"angle": ANGLE, "velocity": VELOCITY, "command": COMMAND}.items():
            file[name] = values
        file.attrs.update({"timestep": STEP, "robot": np.bytes_("arm"), "joints": ["a", "b"]})
    np.testing.assert_array_equal(load_robot_log(tmp_path / "log.h5").angle, ANGLE)


@pytest.mark.parametrize(
    ("described", "message"),
    [
        ([], "has no time step"),
        ({"env_kwargs": None}, "has no time step"),
        ({"env_kwargs": {"control_freq": "100"}}, "control_freq of its env_args is '100'"),
        ({"env_kwargs": {"control_freq": -100}}, "control_freq of its env_args is -100"),
    ],
)
def test_the_description_of_demonstrations_may_be_odd(described, message, tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        demo = file.create_group("data/demo_0")
        demo["actions"], demo["obs/robot0_joint_pos"], demo["obs/robot0_joint_vel"] = COMMAND, ANGLE, VELOCITY
        file["data"].attrs["env_args"] = json.dumps(described)
    with pytest.raises(DatasetError, match=message):
        load_robot_log(tmp_path / "log.h5")
    if "does not say" in message:
        np.testing.assert_array_equal(load_robot_log(tmp_path / "log.h5", timestep=STEP).angle, ANGLE)


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ([], "has no time step"),
        ({"fps": "100"}, "fps of meta/info.json is '100'"),
        ({"fps": 100, "features": []}, None),
        ({"fps": 100, "features": {"action": None}}, None),
    ],
)
def test_the_description_of_a_lerobot_folder_may_be_odd(info, message, tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    (tmp_path / "meta").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    columns = {"observation.state": list(ANGLE), "action": list(COMMAND), "episode_index": [0] * ROWS}
    pq.write_table(pa.table(columns), tmp_path / "data" / "all.parquet")
    if message is None:
        np.testing.assert_array_equal(load_robot_log(tmp_path).angle, ANGLE)
    else:
        with pytest.raises(DatasetError, match=message):
            load_robot_log(tmp_path)


def test_pages_of_a_parquet_file_are_compared_with_their_checksums(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = dict(zip(NAMES, np.column_stack((TIME, ANGLE, VELOCITY, COMMAND)).T, strict=True))
    file = tmp_path / "log.parquet"
    pq.write_table(pa.table(columns), file, compression="none", use_dictionary=False, write_page_checksum=True)
    np.testing.assert_array_equal(load_robot_log(file).angle, ANGLE)
    damaged = bytearray(file.read_bytes())
    damaged[damaged.index(ANGLE[30:33, 0].tobytes()) + 3] ^= 1
    file.write_bytes(damaged)
    with pytest.raises(DatasetError, match="log.parquet cannot be read"):
        load_robot_log(file)

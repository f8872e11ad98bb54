"""Robot logs in .parquet and .hdf5 files and in LeRobot folders say the same as in .npz."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from torchrl_gn.data import DatasetError, RobotLog, load_robot_log, log_trajectories

LENGTH, STEP, JOINTS = (30, 50), 0.02, 3


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    """Joints that swing in two episodes; time stamps restart in each."""
    time = np.concatenate([np.arange(length) for length in LENGTH]) * STEP
    frequency = 3.0 + np.arange(JOINTS)
    angle, velocity = np.sin(time[:, None] * frequency), frequency * np.cos(time[:, None] * frequency)
    command = np.random.default_rng(0).normal(size=(len(time), 2))
    return {
        "angle": angle,
        "velocity": velocity,
        "command": command,
        "time": time,
        "episode": np.repeat([0, 1], LENGTH),
    }


def assert_same(log: RobotLog, arrays: dict[str, np.ndarray], rtol: float = 0.0) -> None:
    for name in ("angle", "velocity", "command"):
        np.testing.assert_allclose(getattr(log, name), arrays[name], rtol=rtol)
    assert log.length.tolist() == list(LENGTH) and log.timestep == pytest.approx(STEP)


def lerobot(folder, arrays, *, version: str, stamped: bool = True, velocities: bool = True) -> None:
    """A dataset folder as LeRobot 2 (a file an episode) or 3 (all in one) writes it."""
    pa = pytest.importorskip("pyarrow")
    pq = pytest.importorskip("pyarrow.parquet")
    state = np.hstack((arrays["angle"], arrays["velocity"])) if velocities else arrays["angle"]
    names = [f"joint{joint}.{what}" for what in ("pos", "vel")[: 1 + velocities] for joint in range(JOINTS)]
    rows = len(state)
    columns = {
        "observation.state": pa.array(list(state), pa.list_(pa.float64(), state.shape[1])),
        "action": pa.array(arrays["command"].tolist(), pa.list_(pa.float64())),
        "frame_index": pa.array(np.arange(rows)),
        "episode_index": pa.array(arrays["episode"]),
        "observation.image": pa.array([{"path": "x"}] * rows),
    }
    if stamped:
        columns["timestamp"] = pa.array(arrays["time"])
    table, chunk = pa.table(columns), folder / "data" / "chunk-000"
    (folder / "meta").mkdir(parents=True)
    chunk.mkdir(parents=True)
    feature = {"dtype": "float32", "shape": [len(names)], "names": names if version == "v3.0" else {"motors": names}}
    info = {"codebase_version": version, "fps": 1 / STEP, "features": {"observation.state": feature}}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    if version == "v3.0":
        pq.write_table(table, chunk / "file-000.parquet")
        return
    for episode, begin in enumerate((0, LENGTH[0])):
        pq.write_table(table.slice(begin, LENGTH[episode]), chunk / f"episode_{episode:06d}.parquet")


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("stamped", [True, False])
@pytest.mark.parametrize("chosen", ["[:3] [3:]", ".*pos .*vel"])
def test_a_lerobot_folder(version, stamped, chosen, arrays, tmp_path):
    lerobot(tmp_path / "set", arrays, version=version, stamped=stamped)
    angle, velocity = (f"observation.state{which}" for which in chosen.split())
    log = load_robot_log(tmp_path / "set", names={"angle": angle, "velocity": velocity})
    assert_same(log, arrays)
    assert not log.extra and log.unread == {
        "observation.image": "neither numbers nor text, nor lists of them",
        "frame_index": "no name is given to it",
    }
    assert (log.time is not None) is stamped
    with pytest.raises(DatasetError, match=r"no 'observation.state.\*torque'.*has columns \['joint0.pos'"):
        load_robot_log(tmp_path / "set", names={"angle": "observation.state.*torque"})


def test_velocities_are_differences_where_there_are_none(arrays, tmp_path):
    lerobot(tmp_path / "set", arrays, version="v3.0", velocities=False)
    log = load_robot_log(tmp_path / "set")
    trajectories, report = log_trajectories(log, 10)
    assert report.not_finite == 2 and trajectories["state"].isfinite().all()  # the first row of each episode
    np.testing.assert_allclose(log.velocity[1:30], np.diff(arrays["angle"][:30], axis=0) / STEP)
    turning = RobotLog(arrays["angle"], arrays["velocity"], arrays["command"], np.array(LENGTH), STEP)
    np.savez(tmp_path / "turning.npz", angle=turning.angle + np.pi, command=turning.command, timestep=STEP)
    wrapped = (turning.angle + 2 * np.pi) % (2 * np.pi) - np.pi
    np.savez(tmp_path / "wrapped.npz", angle=wrapped, command=turning.command, timestep=STEP)
    plain, short = (load_robot_log(tmp_path / f"{name}.npz", names={"velocity": ""}) for name in ("turning", "wrapped"))
    np.testing.assert_allclose(plain.velocity[1:], short.velocity[1:], atol=1e-9)


def test_degrees_become_radians(arrays, tmp_path):
    degrees = {name: np.rad2deg(arrays[name]) if name in ("angle", "velocity") else arrays[name] for name in arrays}
    np.savez(tmp_path / "log.npz", **degrees)
    assert_same(load_robot_log(tmp_path / "log.npz", degrees=True), arrays, rtol=1e-12)


@pytest.mark.parametrize("wrapped", [False, True])
def test_velocities_from_degrees_are_those_of_the_same_angles_in_radians(wrapped, tmp_path):
    """A joint may turn by more than pi degrees from row to row, and pass 180 degrees."""
    time = 0.05 * np.arange(60)
    angle, rate = 3 + 2 * np.sin(2 * time), 4 * np.cos(2 * time)  # up to 4 rad/s, 11 degrees a row, from 57 to 286
    seen = np.arctan2(np.sin(angle), np.cos(angle)) if wrapped else angle
    np.savez(tmp_path / "log.npz", angle=np.rad2deg(seen)[:, None], command=np.sin(time), time=time)
    log = load_robot_log(tmp_path / "log.npz", names={"velocity": ""}, degrees=True)
    np.testing.assert_allclose(log.velocity[1:, 0], np.diff(angle) / 0.05, rtol=1e-9)
    assert np.abs(log.velocity[1:, 0] - (rate[1:] + rate[:-1]) / 2).max() < 0.02


def test_a_folder_of_something_else_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="a folder is read if it is a LeRobot dataset"):
        load_robot_log(tmp_path)


@pytest.mark.parametrize("lists", [True, False])
def test_a_parquet_file(lists, arrays, tmp_path):
    pa = pytest.importorskip("pyarrow")
    pq = pytest.importorskip("pyarrow.parquet")
    columns = {"episode": arrays["episode"], "note": ["x"] * sum(LENGTH), "ragged": [[1.0], [1.0, 2.0]] * 40}
    stamps = pa.array((arrays["time"] * 1e6).round().astype(np.int64), pa.timestamp("us", tz="UTC"))
    for name in ("angle", "velocity", "command"):
        columns |= {name: arrays[name].tolist()} if lists else {f"{name}{k}": v for k, v in enumerate(arrays[name].T)}
    pq.write_table(pa.table({**columns, "time": stamps}), tmp_path / "log.parquet")
    log = load_robot_log(tmp_path / "log.parquet")
    assert_same(log, arrays)
    assert log.unread == {"note": "not numbers", "ragged": "of lists of several lengths"}


def test_robomimic_demonstrations(arrays, tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": 1 / STEP}})
        for demo, begin in ((10, LENGTH[0]), (2, 0)):  # by number: 2 comes first
            rows = slice(begin, begin + LENGTH[demo == 10])
            group = data.create_group(f"demo_{demo}")
            group["states"] = np.zeros((LENGTH[demo == 10], 11))
            group["actions"] = arrays["command"][rows]
            group["obs/robot0_joint_pos"], group["obs/robot0_joint_vel"] = (
                arrays["angle"][rows],
                arrays["velocity"][rows],
            )
            group["obs/robot0_joint_torque"] = arrays["angle"][rows]
            group["obs/image"] = np.zeros((LENGTH[demo == 10], 2, 2, 3), np.uint8)
    log = load_robot_log(tmp_path / "demo.hdf5")
    assert_same(log, arrays)
    assert not log.extra and {"obs/image", "obs/robot0_joint_torque", "states"} == log.unread.keys()
    named = load_robot_log(tmp_path / "demo.hdf5", names={"torque": "obs/robot0_joint_torque"})
    assert list(named.extra) == ["torque"]


def test_a_flat_hdf5_file(arrays, tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["joints/q"], file["joints/dq"], file["u"] = arrays["angle"], arrays["velocity"], arrays["command"]
        file["trial"] = arrays["episode"]
        file.attrs["timestep"], file.attrs["robot"] = STEP, "arm"
    names = {"angle": "joints/q", "velocity": "joints/dq", "command": "u", "episode": "trial"}
    assert_same(load_robot_log(tmp_path / "log.h5", names=names), arrays)
    with pytest.raises(
        DatasetError, match=r"lacks \['angle', 'command', 'velocity'\]; it has \['joints/dq', 'joints/q'"
    ):
        load_robot_log(tmp_path / "log.h5")
    (tmp_path / "log.h5").write_text("no hdf5")
    with pytest.raises(DatasetError, match="cannot be read as a robot log"):
        load_robot_log(tmp_path / "log.h5")


def test_links_of_hdf5_files_read_no_other_file(arrays, tmp_path):
    """Linked groups may form a cycle."""
    h5py = pytest.importorskip("h5py")
    rows, secret = len(arrays["angle"]), tmp_path / "secret.h5"
    (tmp_path / "secret").write_bytes(bytes(8 * rows))
    with h5py.File(secret, "w") as file:
        file["q"], file["demo_1/actions"] = np.zeros(rows), np.zeros((3, 1))
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["angle"], file["velocity"], file["command"] = arrays["angle"], arrays["velocity"], arrays["command"]
        file["length"], file["timestep"] = LENGTH, STEP
        file["a/linked"], file["a/dead"] = h5py.ExternalLink(str(secret), "q"), h5py.SoftLink("/nothing")
        file["a/through"] = h5py.SoftLink("/a/linked")
        file.create_dataset("a/raw", (rows,), "f8", external=[(str(tmp_path / "secret"), 0, 8 * rows)])
        layout = h5py.VirtualLayout((rows,), "f8")
        layout[:] = h5py.VirtualSource(str(secret), "q", (rows,))
        file["a"].create_virtual_dataset("virtual", layout)
        group = file["a"]
        group["self"] = group
        for _ in range(40):  # 2**40 ways down
            deeper = group.create_group("one")
            group["two"] = group = deeper
    log = load_robot_log(tmp_path / "log.h5")
    assert_same(log, {name: arrays[name] for name in arrays if name != "episode"})
    named = {f"a/{name}" for name in ("linked", "dead", "through", "raw", "virtual", "self")}
    assert named <= log.unread.keys() and len(log.unread) == len(named) + 40
    assert set(log.unread.values()) == {"in another file, or the same as another group"}
    with h5py.File(tmp_path / "demo.h5", "w") as file:
        file["data/demo_1"] = h5py.ExternalLink(str(secret), "demo_1")
    with pytest.raises(DatasetError, match=r"\['demo_1'\] of its data lie in another file"):
        load_robot_log(tmp_path / "demo.h5")


@pytest.mark.parametrize(("suffix", "package"), [(".parquet", "pyarrow"), (".h5", "h5py")])
def test_a_missing_package_is_named(suffix, package, tmp_path, monkeypatch):
    for name in [package, *(name for name in sys.modules if name.startswith(f"{package}."))]:
        monkeypatch.setitem(sys.modules, name, None)  # as if it were not installed
    (tmp_path / f"log{suffix}").write_bytes(b"")
    with pytest.raises(ImportError, match=rf"needs {package}.*pip install 'torchrl_gn\[logs\]'"):
        load_robot_log(tmp_path / f"log{suffix}")


def test_attributes_of_the_name_of_an_array_tell_of_it(tmp_path, arrays):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values in arrays.items():
            file[name] = values
        file.attrs.update({"time": "2026-11-30", "angle": "rad", "velocity": "rad/s"})
    log = load_robot_log(tmp_path / "log.h5")
    assert_same(log, arrays)
    np.testing.assert_array_equal(log.time, arrays["time"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"action": [[0.0, 1.0], [0.0]] * 40},
            r"'action' \(for 'command'\) cannot be read: of lists of several",
        ),
        ({"fps": 10}, r"seconds between rows are 0\.1 \(its timestep\) but 0\.02 \(its time stamps\)"),
    ],
)
def test_lerobot_folders_that_contradict_themselves(tmp_path, arrays, change, message):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    (tmp_path / "meta").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"fps": change.get("fps", round(1 / STEP))}))
    columns = {"observation.state": list(arrays["angle"]), "action": change.get("action", list(arrays["command"]))}
    columns |= {"episode_index": arrays["episode"], "timestamp": arrays["time"]}
    pq.write_table(pa.table(columns), tmp_path / "data" / "all.parquet")
    with pytest.raises(DatasetError, match=message):
        load_robot_log(tmp_path)

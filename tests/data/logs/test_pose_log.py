"""Logs of body poses: the same motion in every layout, order and frame, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_gn.data import DatasetError, LogContentWarning, Simulator, load_pose_log, pose_trajectories
from torchrl_gn.maths import quaternion
from torchrl_gn.scenes import Scene, load_scene

STEP = 0.01
LENGTH = np.array([9, 6])
SPIN = torch.tensor([0.3, -1.1, 2.0], dtype=torch.float64)  # rad/s, world frame
BOX = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="9 9 1"/>{}
<body name="box" pos="0 0 1"><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>"""


def motion(bodies: int = 1) -> dict[str, np.ndarray]:
    """Bodies that fly and turn steadily about an axis fixed in space: velocities are exact differences."""
    rows = np.concatenate([np.arange(n, dtype=float) for n in LENGTH])
    velocity = np.array([1.0, -2.0, 0.5]) * (1 + np.arange(bodies))[:, None]
    start = quaternion.normalize(torch.tensor([0.1, 0.7, -0.4, 0.2], dtype=torch.float64))
    turns = quaternion.product(quaternion.exp(STEP * torch.from_numpy(rows)[:, None] * SPIN), start)
    return {
        "position": rows[:, None, None] * STEP * velocity,
        "quaternion": turns.numpy()[:, None].repeat(bodies, 1),
        "velocity": np.broadcast_to(velocity, (len(rows), bodies, 3)),
        "angular_velocity": np.broadcast_to(SPIN.numpy(), (len(rows), bodies, 3)),
    }


def written(path, arrays: dict, **more):
    np.savez(path / "log.npz", **{"length": LENGTH, "timestep": STEP} | arrays | more)
    return path / "log.npz"


@pytest.fixture(scope="module")
def box() -> Scene:
    return load_scene(BOX.format(""), timestep=STEP)


def test_every_layout_order_and_frame_gives_the_same_states(tmp_path):
    arrays = motion()
    log = load_pose_log(written(tmp_path, arrays))
    state = np.concatenate(list(arrays.values()), -1)
    assert repr(log) == "PoseLog(episodes=2, rows=15, bodies=1, actions=0, timestep=0.01)"
    np.testing.assert_allclose(log.state, state, atol=1e-15)
    padded = np.full((2, 11, 13), np.nan)
    for index, rows in enumerate(np.split(state[:, 0], LENGTH[:1])):
        padded[index, : len(rows)] = rows
    turns = torch.from_numpy(arrays["quaternion"])
    inside = quaternion.rotate(quaternion.conjugate(turns), SPIN.expand(*turns.shape[:-1], 3)).numpy()
    readings: tuple[tuple[dict, dict], ...] = (
        ({"state": padded}, {}),
        ({name: values[:, 0] for name, values in arrays.items()}, {}),
        (arrays | {"angular_velocity": inside}, {"frame": "body"}),
        (arrays | {"quaternion": np.roll(arrays["quaternion"], -1, -1)}, {"order": "xyzw"}),
    )
    for given, options in readings:
        other = load_pose_log(written(tmp_path, given), **options)
        np.testing.assert_allclose(other.state, state, atol=1e-12)
        assert other.length.tolist() == LENGTH.tolist()


@pytest.mark.parametrize("without", [["velocity", "angular_velocity"], ["velocity"], ["angular_velocity"]])
def test_velocities_that_are_missing_are_backward_differences(tmp_path, without):
    arrays = motion(bodies=2)
    log = load_pose_log(written(tmp_path, {name: arrays[name] for name in arrays if name not in without}))
    first = np.r_[0, LENGTH[0]]  # of each episode: there is no row before it
    np.testing.assert_allclose(log.state, np.delete(np.concatenate(list(arrays.values()), -1), first, 0), atol=1e-12)
    assert log.length.tolist() == [8, 5]


def test_angular_velocities_show_a_wrong_order_or_frame(tmp_path):
    arrays = motion()
    with pytest.raises(DatasetError, match="as order='wxyz', frame='world': give these"):
        load_pose_log(written(tmp_path, arrays), frame="body")
    with pytest.raises(DatasetError, match="as order='wxyz', frame='world': give these"):
        load_pose_log(written(tmp_path, arrays), order="xyzw")
    still = arrays | {"angular_velocity": 0 * arrays["position"], "quaternion": arrays["quaternion"][:1].repeat(15, 0)}
    assert load_pose_log(written(tmp_path, still), frame="body").state[..., 10:].max() == 0  # nothing to tell by


def changed(name: str, row: int, value: float) -> dict[str, np.ndarray]:
    arrays = {key: values.copy() for key, values in motion().items()}
    arrays[name][row] = value
    return arrays


@pytest.mark.parametrize(
    ("arrays", "more", "message"),
    [
        (changed("position", 11, np.nan), {}, "position is not finite at row 2 of episode 1"),
        (changed("quaternion", 3, 0.9), {}, "unit length, at row 3 of episode 0 it is 1.8"),
        (motion(), {"length": [9, 7]}, "length adds up to 16 rows, but there are 15"),
        (motion(), {"length": [14, 1]}, "episode 1 has too few rows"),
        (motion(), {"timestep": np.nan}, "has no time step"),
        (motion(), {"dt": 0.02}, r"0.01 \(its timestep\) but 0.02 \(its dt\); leave out the wrong one"),
        (
            motion(),
            {"time": np.r_[np.arange(9), np.arange(4), 5, 6] * STEP},
            "time stamps are not even, 0.01 to 0.02 s",
        ),
        ({"position": motion()["position"]}, {}, r"lacks \['quaternion'\]"),
        (motion() | {"velocity": np.zeros((15, 2, 3))}, {}, "different numbers of bodies"),
        ({"state": np.zeros((15, 12))}, {}, r"state \(15, 12\) must be \[..., 13\]"),
    ],
)
def test_what_is_wrong_with_a_file_is_named(tmp_path, arrays, more, message):
    with pytest.raises(DatasetError, match=message):
        load_pose_log(written(tmp_path, arrays, **more))


def test_time_stamps_alone_tell_the_step(tmp_path):
    time = np.concatenate([np.arange(n) for n in LENGTH]) * STEP
    path = written(tmp_path, motion() | {"time": time})
    with np.load(path) as file:
        arrays: dict = {name: file[name] for name in file.files if name != "timestep"}
    np.savez(path, **arrays)
    assert load_pose_log(path).timestep == pytest.approx(STEP)


def test_files_and_options_that_are_none(tmp_path):
    with pytest.raises(DatasetError, match="No log of poses at"):
        load_pose_log(tmp_path / "log.npz")
    with pytest.raises(ValueError, match="order='wzyx' must be one of"):
        load_pose_log(written(tmp_path, motion()), order="wzyx")  # pyright: ignore


def test_trajectories_stay_within_episodes(tmp_path, box):
    log = load_pose_log(written(tmp_path, motion()))
    found = pose_trajectories(log, box, 4, stride=2)
    # Of 8 transitions trajectories of 4 begin at rows 0, 2 and 4, of 5 at row 0.
    assert found["episode"].tolist() == [0, 0, 0, 1] and found["action"].shape == (4, 4, 0)
    for index, row in enumerate((0, 2, 4, 9)):
        np.testing.assert_array_equal(found["state"][index, :, 1].numpy(), log.state[row : row + 5, 0])
    assert found["state"][:, :, 0].eq(torch.from_numpy(box.reference_state)[0]).all()  # the world
    assert pose_trajectories(log, box, 4)["episode"].tolist() == [0, 0, 1]
    assert pose_trajectories(log, box, 5, episodes=[1])["state"].shape == (1, 6, 2, 13)


def test_logs_that_do_not_fit_the_scene_are_refused(tmp_path, box):
    log = load_pose_log(written(tmp_path, motion()))
    with pytest.raises(ValueError, match="No episode has 9 steps; the longest has 9 rows"):
        pose_trajectories(log, box, 9)
    with pytest.raises(ValueError, match=r"2 bodies and 0 actions; scene .* moves \['box'\]"):
        pose_trajectories(load_pose_log(written(tmp_path, motion(2))), box, 4)
    with pytest.raises(ValueError, match="control steps of 10 ms"):
        pose_trajectories(log, load_scene(BOX.format(""), timestep=0.02), 4)
    with pytest.raises(ValueError, match="stride=0"):
        pose_trajectories(log, box, 4, stride=0)


def test_actions_go_with_their_rows(tmp_path):
    motor = '<actuator><motor site="" joint="lift" ctrlrange="-1 1"/></actuator>'.replace('site="" ', "")
    scene = load_scene(
        f'<mujoco><option timestep="0.01"/><worldbody><body><joint name="lift" type="slide"/><geom size=".1"/></body>'
        f"</worldbody>{motor}</mujoco>",
        timestep=STEP,
    )
    action = np.arange(15.0)[:, None]
    log = load_pose_log(written(tmp_path, motion(), action=action))
    assert pose_trajectories(log, scene, 5)["action"][1, :, 0].tolist() == [9, 10, 11, 12, 13]
    bare = {name: value for name, value in motion().items() if "velocity" not in name}
    shorter = load_pose_log(written(tmp_path, bare, action=action))  # without first rows
    assert shorter.action[:, 0].tolist() == [*range(1, 9), *range(10, 15)]


def tumbling() -> dict[str, np.ndarray]:
    """A box that flies and tumbles for 60 rows, simulated."""
    scene = load_scene(BOX.format(""), timestep=STEP)
    physics = scene.rest_physics[None].copy()
    physics[0, 3], physics[0, 8:14] = 20.0, [1, 2, 5, 3, -1, 4]
    state = Simulator(scene).rollout(physics, np.zeros((1, 59, 0)))["state"][0, :, 1].numpy()
    split = np.split(state, (3, 7, 10), axis=-1)
    return dict(zip(("position", "quaternion", "velocity", "angular_velocity"), split, strict=True)) | {"length": [60]}


CONJUGATE = np.array([1, -1, -1, -1])
TURNS = {
    "the velocity in the body's frame": (
        "are in the bodies' frames: rotate them",
        "velocity",
        lambda a, turned: turned,
    ),
    "the inverse rotation": ("conjugate the quaternions", "quaternion", lambda a, _: a * CONJUGATE),
    "degrees a second": ("as of velocities in degrees/s", "angular_velocity", lambda a, _: np.rad2deg(a)),
    "a spin of the other sign": ("turn the sign of the angular", "angular_velocity", lambda a, _: -a),
    "a reset of the place": ("position of body 0 jumps after row 39 of", "position", lambda a, _: at_reset(a, 3.0)),
    "a reset of the turn": ("rotation of body 0 jumps after row 39 of", "quaternion", lambda a, _: at_reset(a)),
}


def at_reset(values: np.ndarray, by: float = 0.0) -> np.ndarray:
    """The last 20 rows, 3 m away or turned by half a turn about the box's x axis."""
    moved = values[40:] + by if by else values[40:, [1, 0, 3, 2]] * [-1, 1, 1, -1]
    return np.concatenate((values[:40], moved))


@pytest.mark.parametrize("case", TURNS)
def test_velocities_show_wrong_frames_signs_units_and_resets(tmp_path, case):
    message, name, change = TURNS[case]
    arrays = tumbling()
    assert load_pose_log(written(tmp_path, arrays)).state.shape == (60, 1, 13)
    back = torch.from_numpy(arrays["quaternion"] * CONJUGATE)
    turned = quaternion.rotate(back, torch.from_numpy(arrays["velocity"])).numpy()
    with pytest.raises(DatasetError, match=message):
        load_pose_log(written(tmp_path, arrays | {name: change(arrays[name], turned)}))


@pytest.mark.parametrize("name", ["position", "quaternion"])
def test_resets_show_without_velocities(tmp_path, name):
    arrays = {key: values for key, values in tumbling().items() if "velocity" not in key}
    assert load_pose_log(written(tmp_path, arrays)).state.shape == (59, 1, 13)
    arrays |= {name: at_reset(arrays[name], 3.0 if name == "position" else 0.0)}
    what = "position" if name == "position" else "rotation"
    with pytest.raises(DatasetError, match=f"the {what} of body 0 jumps after row 39 of episode 0, by"):
        load_pose_log(written(tmp_path, arrays))
    assert load_pose_log(written(tmp_path, arrays | {"length": [40, 20]})).state.shape == (58, 1, 13)


@pytest.mark.parametrize(
    "name, values, message",
    [
        ("t", STEP * np.arange(15.0), "'t' looks like its time, but is not read: name it 'time'"),
        ("Actions", np.ones((15, 2)), "'Actions' looks like its action, but is not read: name it 'action'"),
        ("episode_id", np.repeat([0, 1], LENGTH), "'episode_id' looks like its episode, .* name it 'episode'"),
        ("done", np.arange(15) == 7, "'done' looks like flags of episodes' ends: give length or episode"),
        ("lengths", np.array([5, 10]), "'lengths' looks like its length"),
    ],
)
def test_names_that_are_not_quite_right_are_refused(tmp_path, name, values, message):
    length = {} if name == "lengths" else {"length": LENGTH}
    arrays = {"timestep": STEP, **motion(), **length, name: values}
    np.savez(tmp_path / "log.npz", **arrays)
    with pytest.raises(DatasetError, match=message):
        load_pose_log(tmp_path / "log.npz")


def test_episodes_may_be_given_by_row(tmp_path):
    file, arrays = tmp_path / "log.npz", {"timestep": STEP, **motion()}
    expected = load_pose_log(written(tmp_path, arrays))
    for episode in (np.repeat([3, 4], LENGTH), np.repeat([["a"], ["b"]], LENGTH, axis=0)):
        np.savez(file, **arrays, episode=episode)
        found = load_pose_log(file)
        np.testing.assert_array_equal(found.length, LENGTH)
        np.testing.assert_array_equal(found.state, expected.state)
    for episode, message in (
        (np.r_[np.zeros(14), np.nan], "'episode' is not a number at row 14"),
        (np.zeros(14), "must be one of each of 15 rows, without length"),
    ):
        np.savez(file, **arrays, episode=episode)
        with pytest.raises(DatasetError, match=message):
            load_pose_log(file)
    with pytest.raises(DatasetError, match="without length"):
        load_pose_log(written(tmp_path, arrays, episode=np.repeat([0, 1], LENGTH)))


def test_a_linear_velocity_is_no_angular_one(tmp_path):
    arrays = motion()
    arrays["linear_velocity"] = arrays.pop("velocity")
    del arrays["angular_velocity"]
    with pytest.raises(DatasetError, match=r"'linear_velocity' looks like its velocity, .* name it 'velocity'"):
        load_pose_log(written(tmp_path, arrays))


@pytest.mark.parametrize("kind", ["datetime64[us]", "timedelta64[us]"])
def test_dates_and_durations_are_times(kind, tmp_path):
    arrays = {name: values for name, values in tumbling().items() if name != "timestep"}
    time = np.round(np.arange(60) * STEP * 1e6).astype(np.int64) + 1_700_000_000_000_000
    assert load_pose_log(written(tmp_path, arrays | {"time": time.astype(kind)})).timestep == pytest.approx(STEP)


def test_padding_without_length_is_not_many_bodies_silently(tmp_path):
    turns = np.tile([1.0, 0, 0, 0], (3, 40, 1))
    np.savez(tmp_path / "log.npz", position=np.zeros((3, 40, 3)), quaternion=turns, timestep=STEP)
    with pytest.warns(LogContentWarning, match="40 bodies in 3 rows: padded arrays need length"):
        load_pose_log(tmp_path / "log.npz")


def test_impacts_and_quaternions_of_either_sign_are_no_jumps(tmp_path, recwarn):
    arrays = tumbling()
    sign = np.where(np.arange(60) % 3 == 0, -1.0, 1.0)[:, None]
    arrays["quaternion"] = arrays["quaternion"] * sign
    arrays["velocity"][30:] *= -0.5
    arrays["position"][30:] = arrays["position"][30] + STEP * np.cumsum(arrays["velocity"][30:], 0)
    arrays["quaternion"][30:] = arrays["quaternion"][:30][::-1]
    arrays["angular_velocity"][30:] = -arrays["angular_velocity"][:30][::-1]
    assert load_pose_log(written(tmp_path, arrays)).state.shape == (60, 1, 13) and not recwarn.list
    bare = {key: values for key, values in arrays.items() if "velocity" not in key}
    assert load_pose_log(written(tmp_path, bare)).state.shape == (59, 1, 13)

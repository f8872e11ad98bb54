"""Videos: geoms stand where MuJoCo has them, every frame is written, and failed writes leave no part."""

from __future__ import annotations

import math
import warnings

import mujoco
import numpy as np
import pytest
from PIL import Image, ImageColor

from torchrl_gn.drawing import canvas
from torchrl_gn.drawing.geometry import SceneGeometry, choose_view
from torchrl_gn.drawing.panels import convex_outline, nice_spacing
from torchrl_gn.evaluation import rollout_frames, rollout_video
from torchrl_gn.evaluation.video import frame_stride
from torchrl_gn.scenes import load_scene

from .conftest import moving_states


@pytest.fixture
def silent(capfd):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Said of ffmpeg once jax was imported, by a test of the same process.
        warnings.filterwarnings("ignore", r"os.fork\(\) was called", RuntimeWarning)
        yield
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


def simulated(scene, configuration):
    """``[1, N, 13]`` state and MuJoCo's data at joint positions."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = configuration
    mujoco.mj_kinematics(scene.model, data)
    state = np.zeros((1, scene.num_nodes, 13))
    state[0, :, :3], state[0, :, 3:7] = data.xpos[scene.body], data.xquat[scene.body]
    return state, data


@pytest.mark.parametrize("name", ["pendulum", "swimmer6", "cheetah", "jaco"])
def test_geom_poses_of_node_states_are_mujocos(name):
    scene = load_scene(name)
    rng = np.random.default_rng(0)
    state, data = simulated(scene, scene.model.qpos0 + rng.uniform(-1, 1, scene.model.nq))
    geometry = SceneGeometry(scene)
    positions, matrices = geometry.poses(state)
    np.testing.assert_allclose(positions[0], data.geom_xpos, atol=1e-12)
    np.testing.assert_allclose(matrices[0].reshape(-1, 9), data.geom_xmat, atol=1e-12)
    anchors = geometry.anchors(state)[0]
    assert len(anchors) and all(np.abs(data.xanchor - anchor).sum(-1).min() < 1e-12 for anchor in anchors)
    assert sum(not fixed for fixed in geometry.fixed) >= scene.num_nodes - 1


def test_views_look_at_the_plane_of_motion(scenes):
    above, side = choose_view(scenes["swimmer6"]), choose_view(scenes["cheetah"])
    assert above.planar and above.toward.tolist() == [0, 0, 1]
    assert side.planar and side.right.tolist() == [1, 0, 0] and side.up.tolist() == [0, 0, 1]
    spatial = choose_view(load_scene("jaco"))
    assert not spatial.planar and spatial.up[2] > 0.9
    for view in (above, side, spatial):
        axes = np.stack((view.right, view.up, view.toward))
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) > 0


def test_outline_of_a_capsule_is_exact():
    points = np.array([[[-2.0, 0.0], [2.0, 0.0]]])
    outline = convex_outline(points, 0.5)[0]
    distance = np.linalg.norm(outline - np.stack((np.clip(outline[:, 0], -2, 2), 0 * outline[:, 1]), -1), axis=-1)
    np.testing.assert_allclose(distance, 0.5, atol=1e-12)
    assert outline[:, 0].max() == pytest.approx(2.5)
    assert [nice_spacing(value) for value in (0.19, 0.2, 0.7, 3.0, 99.0)] == pytest.approx([0.1, 0.2, 0.5, 2.0, 50.0])


@pytest.mark.parametrize("name", ["pendulum", "swimmer6"])
def test_gif_has_every_frame_in_real_time(scenes, tmp_path, silent, name):
    truth = moving_states(scenes[name], 24)
    path = rollout_video(scenes[name], truth, truth.roll(1, 0).float(), tmp_path / "a" / "v.gif", size=96)
    assert path == tmp_path / "a" / "v.gif" and [p.name for p in path.parent.iterdir()] == ["v.gif"]
    with Image.open(path) as video:
        assert video.n_frames == 25
        duration = 0
        for frame in range(25):
            video.seek(frame)
            duration += video.info["duration"]
        assert duration == pytest.approx(25 * 1000 * scenes[name].timestep, abs=10)


def test_short_steps_are_skipped_and_long_ones_kept(scenes, tmp_path, silent):
    assert [frame_stride(interval) for interval in (0.0025, 0.01, 0.02, 0.1)] == [8, 2, 1, 1]
    path = rollout_video(scenes["cheetah"], moving_states(scenes["cheetah"], 20), None, tmp_path / "v.gif", size=64)
    with Image.open(path) as video:
        assert video.n_frames == 11


@pytest.mark.slow
def test_mp4_has_every_frame(scenes, tmp_path, silent):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    truth = moving_states(scenes["swimmer6"], 10)
    path = rollout_video(scenes["swimmer6"], truth, truth, tmp_path / "v.mp4", size=96)
    assert imageio_ffmpeg.count_frames_and_secs(str(path))[0] == 11


@pytest.mark.filterwarnings("ignore:.*FileIO:pytest.PytestUnraisableExceptionWarning")  # imageio's broken pipe
@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
@pytest.mark.parametrize("room", [10, 4000])
def test_a_full_disk_leaves_no_part_of_a_video(scenes, tmp_path, files_end_at, suffix, room):
    """ffmpeg may not report that it was stopped."""
    if suffix == ".mp4":
        pytest.importorskip("imageio_ffmpeg")
    truth = moving_states(scenes["swimmer6"], 40)
    (path := tmp_path / f"v{suffix}").write_text("old")
    with files_end_at(room), pytest.raises(OSError, match=r"^[^\n]* free some space[^\n]*$"):
        rollout_video(scenes["swimmer6"], truth, truth, path, size=96)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_panels_show_truth_prediction_and_divergence(scenes, silent):
    scene = scenes["swimmer6"]
    truth = moving_states(scene, 3)
    prediction = truth + 0.0
    prediction[2, 3, 0] = 1e30  # flies away, not an error
    prediction[3] = math.nan
    frames = [np.asarray(frame).astype(int) for frame in rollout_frames(scene, truth, prediction, size=128)]
    assert len(frames) == 4 and all(frame.shape == frames[0].shape for frame in frames)
    assert frames[0].shape[0] % 2 == 0 and frames[0].shape[1] % 2 == 0
    warm = [(frame[60:, :, 0] - frame[60:, :, 2] > 60) for frame in frames]
    middle = frames[0].shape[1] // 2
    assert warm[0][:, middle:].sum() > 50 and not warm[0][:, :middle].any()
    assert 0 < warm[2].sum() < warm[1].sum()
    assert not warm[3].any()


def test_camera_follows_the_truth_only_where_place_does_not_matter(scenes, silent):
    scene = scenes["swimmer6"]
    truth = moving_states(scene, 1)[:1].repeat(2, 1, 1)
    truth[1, 1:, 0] += 5.0
    frames = [np.asarray(frame) for frame in rollout_frames(scene, truth, size=128)]
    blue = np.array(ImageColor.getrgb(canvas.TRUTH))
    places = [np.argwhere(np.abs(frame[60:].astype(int) - blue).sum(-1) < 80).mean(0) for frame in frames]
    np.testing.assert_allclose(places[0], places[1], atol=0.5)


def test_bad_input_is_named(scenes, tmp_path):
    scene, truth = scenes["swimmer6"], moving_states(scenes["swimmer6"], 2)
    cases = [
        (dict(path="v.avi"), ".gif or .mp4"),
        (dict(truth=truth[..., :12]), "Truth of scene 'swimmer6'"),
        (dict(prediction=truth[:1]), "they must agree"),
        (dict(truth=truth * math.nan), "not finite"),
        (dict(speed=0.0), "speed"),
        (dict(size=33), "even"),
    ]
    for change, message in cases:
        options = dict(scene=scene, truth=truth, prediction=truth, path="v.gif") | change
        options["path"] = tmp_path / options["path"]
        with pytest.raises(ValueError, match=message):
            rollout_video(**options)
    assert not list(tmp_path.iterdir())

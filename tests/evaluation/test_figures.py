"""Figures: the drawn values are the data's, labels fit their axes, and bad input is refused."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
from PIL import Image

from torchrl_gn.atomic import atomic_path
from torchrl_gn.evaluation import (
    ErrorTable,
    PredictionError,
    figures,
    plot_bars,
    plot_body_trajectory,
    plot_errors,
    plot_learning_curves,
    plot_loglog,
    plot_motions,
    plot_planning_curves,
    plot_rewards,
    plot_training_curve,
    summary,
)
from torchrl_gn.evaluation.motion_figures import align_signs, node_index, rotation_angle

from .conftest import moving_states

NAMES = ["position", "orientation", "linear_velocity", "angular_velocity"]


@pytest.fixture
def drawn(monkeypatch) -> list:
    """Figures that would be saved."""
    found = []
    monkeypatch.setattr(figures, "save", lambda figure, path: found.append(figure))
    return found


@pytest.fixture(autouse=True)
def silent(capfd):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


def error(name: str, value: float, left_out: tuple[str, ...] = ()) -> PredictionError:
    components = {key: value for key in NAMES if key not in left_out}
    return PredictionError(
        name,
        components,
        dict.fromkeys(NAMES, 1.0),
        dict.fromkeys(NAMES, 1.0),
        left_out,
        10,
        math.isinf(value),
    )


def table(*values: float) -> ErrorTable:
    errors = [error(name, value) for name, value in zip(("one_step_error", "rollout_error_100"), values, strict=True)]
    return ErrorTable({e.name: e for e in errors}, torch.zeros(0))


def is_picture(path) -> bool:
    with Image.open(path) as picture:
        return picture.format == "PNG" and np.asarray(picture).std() > 5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendulum", "swimmer6"])
def test_body_trajectory(scenes, tmp_path, name):
    truth = moving_states(scenes[name], 20)
    prediction = truth * 1.1
    prediction[15:] = math.nan
    path = plot_body_trajectory(truth, prediction, scenes[name], tmp_path / "new" / "body.png")
    assert path == tmp_path / "new" / "body.png" and is_picture(path)
    assert [p.name for p in path.parent.iterdir()] == ["body.png"]
    pdf = plot_body_trajectory(truth, prediction, scenes[name], tmp_path / "body.pdf", node=1)
    assert pdf.read_bytes().startswith(b"%PDF")


def test_default_body_is_link_3_of_swimmer6(scenes):
    assert node_index(scenes["swimmer6"], None) == 3
    assert node_index(scenes["swimmer6"], "head") == 1
    with pytest.raises(ValueError, match="no node 'tail'"):
        node_index(scenes["swimmer6"], "tail")
    with pytest.raises(ValueError, match="nodes 0 to 6"):
        node_index(scenes["swimmer6"], 9)


def test_quaternions_are_shown_without_jumps():
    angle = np.linspace(0, 3, 50)
    smooth = np.zeros((50, 13))
    smooth[:, 3], smooth[:, 6] = np.cos(angle), np.sin(angle)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], 50)
    jumping, other = smooth.copy(), smooth.copy()
    jumping[1:, 3:7] *= signs[1:, None]
    other[:, 3:7] *= -signs[:, None]
    true, predicted = align_signs(jumping, other, slice(3, 7))
    np.testing.assert_allclose(true, smooth)
    np.testing.assert_allclose(predicted, smooth)


@pytest.mark.slow
def test_training_curve_and_errors(tmp_path):
    curves = {"loss": ([1, 2, 3], [1.0, 0.1, math.nan]), "empty": ([], [])}
    assert is_picture(plot_training_curve(curves, tmp_path / "curve.png"))
    tables = {"a": table(0.01, 0.2), "b": table(3.0, math.inf), "c": table(0.0, 1.0)}
    assert is_picture(plot_errors(tables, tmp_path / "errors.png"))
    assert is_picture(plot_errors(tables, tmp_path / "one.png", errors=["one_step_error"]))
    rows = summary(tables).splitlines()
    assert [row.split() for row in rows[2:]] == [
        ["a", "1.00e-02", "0.200"],
        ["b", "3.000", "inf"],
        ["c", "0.000", "1.000"],
        ["persistence", "baseline", "1.000", "1.000"],
        *([["b,", "rollout_error_100:", *row.split()[2:]] for row in rows[6:]]),
    ]


@pytest.mark.slow
def test_rewards_of_episodes_that_ended_early(tmp_path):
    rewards = torch.rand(3, 50, generator=torch.Generator().manual_seed(0))
    rewards[1, 20:] = rewards[:, 40:] = torch.nan
    assert is_picture(plot_rewards({"a": rewards, "b": rewards + 1}, tmp_path / "rewards.png", timestep=0.1))
    plot_rewards({"a": rewards[:, :40], "b": rewards[:, :40] + 1}, tmp_path / "same.png", timestep=0.1)
    assert (tmp_path / "rewards.png").read_bytes() == (tmp_path / "same.png").read_bytes()
    every = torch.full((2, 5), torch.nan)
    assert is_picture(plot_rewards({"none": every}, tmp_path / "none.png", timestep=0.1))


def test_learning_curves_of_one_or_several_seeds(tmp_path):
    curves = {
        "SVG(1)": ([0, 100, 200], [[0.0, 5.0, 9.0], [1.0, 2.0, 12.0], [0.5, 3.0, 7.0]]),
        "DDPG": ([0, 200], [[0.0, 4.0]]),
    }
    assert is_picture(plot_learning_curves(curves, tmp_path / "curves.png"))
    curves["SVG(0)"] = ([0, 100, 200], [[0.0, 5.0, 9.0], [1.0, 2.0]])
    with pytest.raises(ValueError, match=r"Every seed of 'SVG\(0\)' must have 3 returns, got \[3, 2\]"):
        plot_learning_curves(curves, tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


def test_rewards_over_planning_time(drawn):
    curves = {"gn": ([20, 60.0, 200], [1.0, 1.5, 1.7], [0.1, 0.1, 0.3]), "ilqg": ([90], [2.0], [0.0])}
    plot_planning_curves(curves, "x.png")
    axes = drawn[0].axes[0]
    assert axes.get_xscale() == "log" and axes.get_yscale() == "linear"
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["gn", "ilqg"]
    np.testing.assert_allclose(axes.containers[0].lines[0].get_xydata(), [[20, 1.0], [60, 1.5], [200, 1.7]])


def test_motions_count_whole_turns(scenes, tmp_path):
    angle = torch.linspace(0, 9, 40, dtype=torch.float64)
    turned = torch.stack((torch.cos(angle / 2), 0 * angle, torch.sin(angle / 2), 0 * angle), 1)
    np.testing.assert_allclose(rotation_angle(turned, turned[:1], 1), angle)
    states = moving_states(scenes["swimmer6"], 40).expand(3, -1, -1, -1)
    panels = {"with control": (states, states[:, 20:])}
    path = plot_motions(panels, scenes["swimmer6"], tmp_path / "motions.png", labels=("a", "b", "c"))
    assert is_picture(path)


def test_counts_on_logarithmic_axes_are_labelled_as_such(drawn):
    times = [1.0, 2.0, 8.0, 20.0]
    panel = {"a": ([3, 6, 12], times[:3]), "b": ([3, 25], times[2:])}
    plot_loglog({"links": panel, "error": {"a": (times, times)}}, "x.png", ylabel="ms")
    plot_loglog({"error": {"a": ([1e-3, 2e-2], [1, 3])}}, "x.png", ylabel="ms")
    counted, powers = drawn[0].axes[0], drawn[1].axes[0]
    assert [label.get_text() for label in counted.get_xticklabels()] == ["3", "6", "12", "25"]
    assert not len(counted.get_xticks(minor=True)) and len(counted.get_yticks(minor=True))
    assert len(powers.get_xticks(minor=True))


@pytest.mark.slow
def test_bars(tmp_path):
    bars = {"GN": {"a": (0.01, 0.001), "b": (math.inf, 0.0)}, "MLP": {"a": (0.5, 0.0)}}
    assert is_picture(plot_bars({"one step": bars, "100 steps": bars}, tmp_path / "bars.png"))
    with pytest.raises(ValueError, match="at least one bar"):
        plot_bars({"one step": {"GN": {}}}, tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


def test_bad_input_is_named(scenes, tmp_path):
    truth = moving_states(scenes["swimmer6"], 3)
    with pytest.raises(ValueError, match="swimmer6"):
        plot_body_trajectory(truth, truth[1:], scenes["swimmer6"], tmp_path / "x.png")
    with pytest.raises(ValueError, match="above zero"):
        plot_training_curve({"loss": ([1], [math.nan])}, tmp_path / "x.png")
    with pytest.raises(ValueError, match="2 times and 1 values"):
        plot_training_curve({"loss": ([1, 2], [1])}, tmp_path / "x.png")
    with pytest.raises(ValueError, match="rollout_error_7"):
        plot_errors({"a": table(1.0, 1.0)}, tmp_path / "x.png", errors=["rollout_error_7"])
    assert not list(tmp_path.iterdir())


def test_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "figure.png"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="halfway"), atomic_path(path) as temporary:
        temporary.write_text("new")
        raise RuntimeError("halfway")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]

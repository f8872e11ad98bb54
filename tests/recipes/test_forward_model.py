"""The contract of recipes, tried as a user would: exit codes, resuming, and a run folder left whole."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import UnseenParameterWarning
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import load_pretrained

pytestmark = pytest.mark.slow  # programs from start to end

ROOT = Path(__file__).parents[2]
SMALL = ("system=pendulum", "data.train=20", "data.validation=5", "data.test=5")


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory, start) -> Path:
    """Folder of a run that Ctrl-C stopped in the middle of its training."""
    folder = tmp_path_factory.mktemp("run")
    process = start(*SMALL, "steps=null", "minutes=5", "checkpoint_seconds=0", f"run_dir={folder}")
    deadline = time.monotonic() + 300
    while not list(folder.glob("checkpoint/*.safetensors")):
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    return folder


def test_an_interrupted_run_goes_on_to_its_end(interrupted, run):
    done = load_pretrained(interrupted).training["progress"]["step"]
    assert done > 0
    code, output, errors = run(*SMALL, f"steps={done + 5}", f"run_dir={interrupted}", "logger=wandb")
    assert code == 0, errors
    assert "warning" not in errors.lower()
    metrics = json.loads((interrupted / "metrics.json").read_text())
    assert metrics["steps"] == done + 5
    assert {"one_step_error", "rollout_error_20", "rollout_error_100", "seed", "wall_clock_seconds"} <= metrics.keys()
    assert metrics["rollout_error_100/left_out/position"] == 1  # a pendulum's position never moves
    printed = [line for line in output.splitlines() if Path(line).is_file()]
    assert {Path(line).name for line in printed} >= {"prediction.png", "rollout.gif", "metrics.json"}
    assert list(interrupted.glob("log/wandb/offline-run-*/files/media/images/prediction*.png"))


def test_bad_options_end_in_one_line_and_touch_nothing(interrupted, call):
    def times() -> dict[Path, int]:
        """Return the modification times of all files but the lock, which this process may make."""
        return {path: path.stat().st_mtime_ns for path in interrupted.rglob("[!.]*") if path.is_file()}

    before = times()
    for options, message in (
        (("noise=0.5", "minutes=9"), "other options: noise=0.5"),
        (("steps=null", "minutes=null"), "needs a limit: give steps, minutes or both"),
        (("horizons=[200]", "minutes=9"), "horizons=[200] must be from 1 to data.length=100"),
        (("steps=abc",), "steps=abc must be a number"),
        (("data.train=1.5",), "data.train=1.5 must be a whole number, 1 or more"),
        (("model.hidden=0",), "model.hidden=0 must be a whole number, 1 or more"),
        (("system=null",), "system=null must be given, such as swimmer6"),
        (("data.bounds={fast: 3}",), "bounds have no 'fast'"),
    ):
        code, _, errors = call(*SMALL, *options, f"run_dir={interrupted}", recipe="forward_model")
        assert code == 1
        assert message in errors
        assert "Traceback" not in errors
    assert times() == before


def test_a_run_that_its_minutes_cut_short_says_so_and_how_to_go_on(tmp_path, call):
    options = (*SMALL, f"run_dir={tmp_path}")
    code, output, errors = call(*options, "steps=100000", "minutes=0.01", recipe="forward_model")
    assert code == 0, errors
    done = json.loads((tmp_path / "metrics.json").read_text())["steps"]
    note = f"Cut short by minutes=0.01, at {done:,} of 100,000 steps"
    assert note in output and f"the same command with run_dir={tmp_path} minutes=0.02" in output
    code, output, errors = call(*options, f"steps={done + 3}", "minutes=5", recipe="forward_model")
    assert code == 0, errors
    assert "Cut short" not in output
    assert json.loads((tmp_path / "metrics.json").read_text())["steps"] == done + 3


def test_a_short_run_keeps_every_loss_and_says_when_it_is_finished(tmp_path, call):
    options = (*SMALL, f"run_dir={tmp_path}", "steps=5")
    code, output, errors = call(*options, recipe="forward_model")
    assert code == 0 and "is finished" not in output + errors, errors
    assert len(load_pretrained(tmp_path).training["curves"]["loss"]) == 5
    code, output, errors = call(*options, recipe="forward_model")
    assert code == 0, errors
    assert f"The training in {tmp_path} is finished (5 steps" in output + errors
    code, output, errors = call(*options, "horizons=5", recipe="forward_model")
    assert code == 0, errors
    assert "rollout_error_5" in json.loads((tmp_path / "metrics.json").read_text())


def test_bad_options_make_no_folder(tmp_path, call):
    for bad in ("horizons=[200]", "steps=abc", "data.train=1.5", "model.hidden=0", "data.length=50", "data.pace=slow"):
        code, _, errors = call(*SMALL, bad, f"run_dir={tmp_path / 'run'}", recipe="forward_model")
        assert code == 1 and errors.startswith(f"ValueError: {bad.split('=')[0]}"), errors
    assert not (tmp_path / "run").exists()


def test_variants_are_trained_on_and_the_standard_system_is_evaluated_too(tmp_path, call):
    options = (*SMALL, "parametrized=true", "steps=5", f"run_dir={tmp_path}")
    code, output, errors = call(*options, recipe="forward_model")
    assert code == 0, errors
    assert "warning" not in errors.lower() and "standard pendulum" in output
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert 0 < metrics["one_step_error"] != metrics["standard pendulum/one_step_error"] > 0
    request = json.loads((tmp_path / "data" / "pendulum_variants" / "manifest.json").read_text())["request"]
    assert request["variants"] == 20 and list(request["parameters"]) == ["length", "mass"]


def test_several_systems_share_a_model_and_others_are_only_evaluated(tmp_path, call):
    small = (*SMALL[1:], "system=[swimmer3,pendulum]", "zero_shot=[swimmer4]")
    options = (*small, "steps=5", "parametrized=true", f"run_dir={tmp_path}")
    code, output, errors = call(*options, recipe="forward_model")
    assert code == 0, errors
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    systems = ["swimmer3", "pendulum", "standard swimmer3", "standard pendulum", "swimmer4 (zero-shot)"]
    assert all(0 < metrics[f"{name}/one_step_error"] for name in systems)
    assert "one_step_error" not in metrics
    assert [line.split("  ")[0] for line in output.splitlines() if line.startswith(tuple(systems))] == systems
    assert {path.name for path in tmp_path.glob("*/rollout.gif")} and (tmp_path / "errors.png").is_file()
    saved = load_pretrained(tmp_path)
    assert [scene.name for scene in saved.scenes()] == ["swimmer3", "pendulum"]


def test_a_model_goes_on_from_another_with_episodes_as_half_of_its_data(tmp_path, call):
    scene = load_scene("pendulum")
    episodes = collect_trajectories(scene, 3, 120, seed=9)
    episodes["state"][2, 50:] = torch.nan  # its simulation became unstable
    save_file({"state": episodes["state"], "action": episodes["action"].float()}, tmp_path / "gn.safetensors")
    small = (*SMALL, "steps=3", "lr=1e-6", "noise=1e-3", "start_from=pendulum")
    options = (*small, f"data.extra=[{tmp_path / 'gn.safetensors'}]")
    code, _, errors = call(*options, f"run_dir={tmp_path / 'run'}", recipe="forward_model")
    assert code == 0, errors
    before, after = load_pretrained("pendulum").model, load_pretrained(tmp_path / "run").model
    assert torch.equal(before.node_normalizer.mean, after.node_normalizer.mean)  # weights go with their statistics
    distance = torch.cat([(a - b).flatten() for a, b in zip(before.parameters(), after.parameters(), strict=True)])
    assert 0 < distance.abs().max() < 1e-2

    code, _, errors = call(*options, "system=cartpole", f"run_dir={tmp_path / 'other'}", recipe="forward_model")
    assert (
        code == 1
        and "of shapes [[101, 2, 13], [100, 1]]; cartpole with data.length=100 has [[101, 3, 13], [100, 1]]" in errors
    )
    code, _, errors = call(*options, "data.length=130", f"run_dir={tmp_path / 'long'}", recipe="forward_model")
    assert code == 1 and "episodes of 120 steps, fewer than data.length=130" in errors and "Traceback" not in errors


def test_a_checkpoint_is_evaluated_on_another_scene(interrupted, tmp_path, call):
    options = (f"checkpoint={interrupted}", "sequences=5", f"run_dir={tmp_path}")
    with pytest.warns(UnseenParameterWarning, match="cartpole"):
        code, _, errors = call(*options, "system=cartpole", recipe="evaluate")
    assert code == 0, errors
    assert "one_step_error" in json.loads((tmp_path / "metrics.json").read_text())
    code, _, errors = call(*options, "system=cartpole", "strict=true", recipe="evaluate")
    assert code == 1
    assert "never saw" in errors


def test_comparing_goes_on_past_a_failed_run_and_keeps_finished_ones(tmp_path, call):
    small = ["data.train=20", "data.validation=5", "data.test=5"]
    options = ["systems=[pendulum]", "minutes=0.01", f"run_dir={tmp_path}", f"overrides={small}"]
    bad = "+variants.bad=['model.hidden=zero']"
    code, output, errors = call(*options, bad, "only=[default,bad]", recipe="compare")
    assert code == 1 and "1 runs failed" in errors
    rows = {line.split("|")[1].strip(): line for line in output.splitlines() if line.startswith("|")}
    assert rows["bad"].endswith("| - |") and "| 1.00 |" in output
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["failed"] == 1 and 0 < metrics["pendulum/default/one_step_error"] < 2

    finished = tmp_path / "pendulum" / "default" / "seed0" / "metrics.json"
    before = finished.stat().st_mtime_ns
    code, output, errors = call(*options, "only=[default]", recipe="compare")
    assert code == 0, errors
    assert finished.stat().st_mtime_ns == before
    assert (tmp_path / "table.md").read_text().splitlines()[-1] in output

    code, _, errors = call(*options, "only=[defualt]", recipe="compare")
    assert code == 1 and "['defualt'] are not known; use some of ['default'" in errors

"""Run time against error, on one number of threads or several."""

from __future__ import annotations

import json

import pytest
import torch

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import RunFolder, save_checkpoint

SHORT = ("system=pendulum", "rollouts=3", "steps=4", "repeats=1", "batches=[1,5]", "state_steps=8")
TIME = "seconds_per_simulated_second"


@pytest.fixture
def model(tmp_path) -> str:
    """Option that names the checkpoint of an untrained pendulum model."""
    scene = load_scene("pendulum")
    save_checkpoint(tmp_path / "model.safetensors", ForwardModel.for_scene(scene, hidden=4), scene=scene)
    return f"checkpoints=[{tmp_path / 'model.safetensors'}]"


@pytest.mark.slow
def test_every_method_on_every_number_of_threads(call, calls, load, model, tmp_path):
    recipe = load("benchmarks/work_precision")
    seen = calls(recipe, "predict", lambda *_: torch.get_num_threads())
    simulated = calls(recipe.Simulator, "rollout", lambda self, *_: self.num_threads)
    options = (*SHORT, model, "threads=[2,1]", "ways=[specialised]", f"run_dir={tmp_path / 'run'}")
    code, output, errors = call(*options, recipe="benchmarks/work_precision")
    assert code == 0, errors
    # Errors on the first number; at both batch sizes a round to warm up and one that is timed, numbers in turn.
    assert seen == [2] + [2, 1] * 4
    assert simulated[-(2 + 16) :] == [2] * 2 + [2, 2, 1, 1] * 4
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    methods = ["MuJoCo, 1 physics steps", "MuJoCo, 1 physics steps, 1 solver iteration", "GN 2 x 4, specialised"]
    times = {f"{name}, {n}/batch {b}/{TIME}" for name in methods for n in ("1 thread", "2 threads") for b in (1, 5)}
    assert times | {f"{name}/error" for name in methods} == {
        key for key in metrics if "/" in key and "version" not in key
    }
    assert "threads" not in metrics and min(metrics[time] for time in times) > 0
    lines = output.splitlines()
    assert [line.split("  ")[0] for line in lines if "error  " in line] == ["2 threads", "1 thread"]
    assert all(sum(line.startswith(f"{name}  ") for line in lines) == 2 for name in methods)
    assert {file.name for file in (tmp_path / "run").glob("*.png")} == {
        "work_precision_1_thread.png",
        "work_precision_2_threads.png",
    }


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["2", "[2]"])
def test_names_of_one_number_of_threads_do_not_have_it(call, model, tmp_path, threads):
    options = (*SHORT, model, f"threads={threads}", "batches=[2]", f"run_dir={tmp_path / 'run'}")
    code, output, errors = call(*options, recipe="benchmarks/work_precision")
    assert code == 0, errors
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["threads"] == 2 and metrics[f"GN 2 x 4, reference/batch 2/{TIME}"] > 0
    assert output.splitlines()[1].split()[:2] == ["2", "threads"]
    assert [file.name for file in (tmp_path / "run").glob("*.png")] == ["work_precision.png"]


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("threads=[]", "threads=[] must be one number or several."),
        ("threads=[1,0]", "threads=[1, 0] must be a whole number, 1 or more."),
        ("threads=[1.5]", "threads=[1.5] must be a whole number, 1 or more."),
        ("ways=[compiled]", "ways=['compiled'] are not known; use any of"),
    ],
)
def test_refused_before_work_begins(call, tmp_path, option, said):
    code, _, errors = call(*SHORT, option, f"run_dir={tmp_path / 'run'}", recipe="benchmarks/work_precision")
    assert code == 1 and said in errors and not (tmp_path / "run").exists()


@pytest.mark.slow
def test_every_number_of_threads_has_its_own_front(load, tmp_path, capsys):
    recipe = load("benchmarks/work_precision")

    def method(name, error, *seconds):
        times = {(n + 1, 1): s for n, s in enumerate(seconds)}
        return recipe.Method(name, name, lambda *_: torch.empty(0), error, times)

    methods = [
        method("exact", 0.0, 4.0, 1.0),
        method("learned", 0.1, 2.0, 1.5),
        method("diverged", float("inf"), 1.0, 0.5),
    ]
    recipe.report(methods, [1, 2], [1], RunFolder(tmp_path / "run", "benchmarks/work_precision"))
    marked = [line.split()[0] for line in capsys.readouterr().out.splitlines() if "*" in line]
    assert marked == ["exact", "learned", "exact"]


def test_equal_points_are_both_on_the_front(load):
    pareto = load("benchmarks/work_precision").pareto
    assert pareto({"a": (1.0, 2.0), "b": (1.0, 2.0), "c": (1.0, 3.0), "d": (0.5, 4.0)}) == {"a", "b", "d"}

"""A sweep over tasks of the control suite."""

from __future__ import annotations

import json

import pytest
from hydra import compose, initialize_config_dir

from _common.sweeps import RECIPES
from suite import claim_of, make_runs, numbers_of


def runs_of(folder, *overrides: str):
    with initialize_config_dir(str(RECIPES / "config"), version_base="1.3"):
        return make_runs(compose("suite", overrides=list(overrides)), folder)


def finish(run, frames, returns, **metrics) -> None:
    """Write a finished run's metrics; minutes are a tenth of the frames."""
    for at, (now, value) in enumerate(zip(frames, returns, strict=True)):
        of_round = {"frames": now, "median_return_of_last_five": value, "minutes": now / 10}
        metrics |= {f"round {at}/{name}": each for name, each in of_round.items()}
    run.folder.mkdir(parents=True)
    (run.folder / "metrics.json").write_text(json.dumps(metrics))


def test_all_tasks_run_with_each_seed_and_own_options(tmp_path):
    runs = runs_of(tmp_path, "seeds=[0,1]", "overrides=['steps=100']")
    assert len(runs) == 40 and list(runs)[0] == "acrobot-swingup-0"
    cheetah = runs["cheetah-run-1"]
    options = ("system=suite:cheetah/run", "seed=1", "episodes=2", "steps=500", "rounds=48", "plan=true", "threads=1")
    assert cheetah.overrides == (*options, "steps=100")  # the last one of an option counts
    assert cheetah.folder == tmp_path / "cheetah_run" / "seed1"


def test_unknown_tasks_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"Tasks \['walker/jump'\] are not known; use some of \['acrobot/swingup'"):
        runs_of(tmp_path, "only=[walker/jump]")


def test_finished_runs_go_on_with_more_rounds(tmp_path):
    run = runs_of(tmp_path, "only=[walker/run]", "plan=false")["walker-run-0"]
    finish(run, [10], [1.0])
    (run.folder / "options.json").write_text(json.dumps(run.overrides))
    assert run.is_done()
    assert not runs_of(tmp_path, "only=[walker/run]", "rounds=60")["walker-run-0"].is_done()
    with pytest.raises(ValueError, match="walker_run/seed0 holds a finished run with"):
        runs_of(tmp_path, "only=[walker/run]", "overrides=['horizon=8']")["walker-run-0"].is_done()


def test_numbers_are_means_over_seeds_and_the_middle_half_of_all_runs(tmp_path):
    runs = runs_of(tmp_path, "only=[walker/run,hopper/hop]", "seeds=[0,1,2]")
    for at, name in enumerate(["walker-run-0", "walker-run-1", "hopper-hop-0", "hopper-hop-1"]):
        finish(runs[name], [100, 200], [10.0 * at, 100.0 * at], **{"planned/return": 1.0 + at})
    claim = claim_of(runs)
    assert claim["peers"]["returns"]["walker-run"] and len(claim["runs"]) == 4  # unfinished runs are left out
    numbers = numbers_of(claim, [100, 200])
    assert (numbers["walker-run/return/100"], numbers["walker-run/return/200"]) == (5, 50)
    assert (numbers["walker-run/minutes/200"], numbers["walker-run/planned"]) == (20, 1.5)
    assert numbers["interquartile_mean"] == 150 and numbers["interquartile_mean/low"] == 100
    assert not any(name.startswith("interquartile") for name in numbers_of(claim, [100, 300]))  # no run is so long

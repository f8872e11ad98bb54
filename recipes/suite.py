"""Learn tasks of the control suite, with several seeds each, and compare the returns with published agents'.

    python recipes/suite.py [only=[cheetah/run,walker/walk]] [seeds=[0,1,2]] ["overrides=['updates=50']"]

Each task and seed is a run of recipes/shac.py with its options in recipes/config/suite.yaml. All twenty tasks with one
seed take five hours of one core. The same `run_dir` keeps finished runs and resumes interrupted ones; with more
`rounds`, it resumes all. Runs that fail are listed, and the others continue. The table has means over seeds at some
numbers of frames, the best published mean, and the interquartile mean of all runs with its bootstrap interval (Agarwal
et al. 2021). Results: docs/results/control-suite.md.

Writes config.yaml, metrics.json, the table as table.md, the learning curves beside published ones as curves.png, and
each run with its log to its run folder.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

from _common import as_list, chosen_names, clean_exit, open_log, with_help
from _common.sweeps import RECIPES, Run, folder_name, override, refuse_changes, report_sweep, run_all
from _report.curves import (
    Claim,
    curve_panels,
    curve_table,
    curves_of,
    interquartile_interval,
    interquartile_mean,
    mean_at,
    planned_mean,
    values_at,
)
from _report.drawing import draw_figure
from _report.figures import ReportFigure
from _report.pages import markdown_lines
from torchrl_gn.atomic import read_json
from torchrl_gn.checks import check_count
from torchrl_gn.training import RunFolder

PUBLISHED = RECIPES.parent / "docs" / "results" / "data" / "control-suite.json"
MAY_GROW = ("rounds", "plan", "planner.horizon")  # options with which a finished run goes on


@with_help
@hydra.main(config_path="config", config_name="suite", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    frames = sorted(as_list(cfg.frames))
    for each in frames:
        check_count("frames", each, 1)
    folder = RunFolder(cfg.run_dir, "suite")
    runs = make_runs(cfg, folder.path)
    refuse_changes(runs.values())
    tracker = open_log(cfg, folder)
    failed = run_all(runs.values(), cfg.jobs, desc="tasks")

    claim = claim_of(runs)
    lines, metrics = [], {}
    if claim["runs"]:
        table = curve_table(claim, frames)
        lines = [markdown_lines([table["columns"], *table["rows"]])]
        metrics = numbers_of(claim, frames)
        if "interquartile_mean" in metrics:
            middle, low, high = (metrics[f"interquartile_mean{name}"] for name in ("", "/low", "/high"))
            lines += [
                "",
                f"Interquartile mean of all runs at {frames[-1]:,} frames: {middle:.0f} ({low:.0f} to {high:.0f})",
            ]
        options = {"kind": "curves", "frames": frames[-1], "axis": "return", "along": "frames, thousands"}
        draw_figure(ReportFigure(options, curve_panels(claim)), folder.file("curves.png"))
    report_sweep(folder, lines, {}, metrics, failed, tracker, seed=as_list(cfg.seeds)[0])


def make_runs(cfg: DictConfig, folder: Path) -> dict[str, Run]:
    """Return the runs by task and seed (``"cheetah-run-0"``), seed by seed, so that early tables have all tasks."""
    chosen = chosen_names(cfg.only, cfg.tasks, "Tasks", remedy=", or add them to tasks=")
    shared = (f"rounds={cfg.rounds}", f"plan={override(cfg.plan)}", f"threads={cfg.threads}", *as_list(cfg.overrides))
    runs = {}
    for seed, name in itertools.product(as_list(cfg.seeds), chosen):
        overrides = (f"system=suite:{name}", f"seed={seed}", *cfg.tasks[name], *shared)
        place = folder / folder_name(name) / f"seed{seed}"
        run = Run(RECIPES / "shac.py", place, overrides, f"{name}, seed {seed}", goes_on=MAY_GROW)
        runs[f"{name.replace('/', '-')}-{seed}"] = run
    return runs


def claim_of(runs: dict[str, Run]) -> Claim:
    """Return the metrics of finished runs beside published returns."""
    done = {name: {"metrics": metrics} for name, run in runs.items() if (metrics := run.metrics)}
    return {"runs": done, "peers": read_json(PUBLISHED)["peers"]}


def numbers_of(claim: Claim, frames: list[int]) -> dict[str, Any]:
    """Return means over each task's seeds, and the interquartile mean of all runs at the last number of frames."""
    curves, numbers = curves_of(claim), {}
    for task, of_task in curves.items():
        found = {f"return/{at}": mean_at(of_task, at) for at in frames}
        found |= {f"minutes/{frames[-1]}": mean_at(of_task, frames[-1], "minutes"), "planned": planned_mean(of_task)}
        numbers |= {f"{task}/{name}": value for name, value in found.items() if value is not None}
    scores = [values_at(of_task, frames[-1]) for of_task in curves.values()]
    if all(len(each) == len(of_task) for each, of_task in zip(scores, curves.values(), strict=True)):
        low, high = interquartile_interval(*scores)
        numbers |= {"interquartile_mean": interquartile_mean(*scores)}
        numbers |= {"interquartile_mean/low": low, "interquartile_mean/high": high}
    return numbers


if __name__ == "__main__":
    main()

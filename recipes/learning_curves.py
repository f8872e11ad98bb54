"""Train agents with several seeds and draw their learning curves in one figure.

    python recipes/learning_curves.py [only=[SVG(1),SVG(0)]] [seeds=[0,1,2]] ["overrides=['trainer.frames=100000']"]

Reproduces the paper's Figure "Learning curves for Swimmer6 SVG agents": the median return over seeds with quartiles,
for every agent in recipes/config/learning_curves.yaml. Each agent and seed is a run of recipes/svg.py or
recipes/ddpg.py. The same `run_dir` keeps finished runs and resumes interrupted ones; with more `trainer.frames`, it
resumes all. Results: docs/results/svg.md.

Writes config.yaml, metrics.json, the table as table.md, the figure as curves.png, and each run with its log to its run
folder.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from statistics import mean

import hydra
import numpy as np
from omegaconf import DictConfig

from _common import as_list, chosen_names, clean_exit, open_log, with_help
from _common.sweeps import RECIPES, Run, folder_name, refuse_changes, report_sweep, run_all
from torchrl_gn.atomic import read_json
from torchrl_gn.evaluation import plot_learning_curves
from torchrl_gn.training import RunFolder


def make_runs(cfg: DictConfig, folder: Path) -> dict[str, list[Run]]:
    """Return every agent's runs, one for each seed."""
    chosen = chosen_names(cfg.only, cfg.agents, "Agents")
    runs: dict[str, list[Run]] = {name: [] for name in chosen}
    for seed, name in itertools.product(as_list(cfg.seeds), chosen):  # seed by seed: early figures show all
        agent = cfg.agents[name]
        overrides = (f"seed={seed}", f"threads={cfg.threads}", *as_list(cfg.overrides), *agent.overrides)
        recipe = RECIPES / f"{agent.recipe}.py"
        place, label = folder / folder_name(name) / f"seed{seed}", f"{name}, seed {seed}"
        runs[name].append(Run(recipe, place, overrides, label, goes_on=("trainer.frames",)))
    return runs


def quartiles(values: list[float]) -> tuple[float, float, float]:
    """Return lower quartile, median and upper quartile."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    return float(low), float(middle), float(high)


def second_half(curve: dict[str, list[float]]) -> float:
    """Return the mean return of the evaluations after half of the frames."""
    half = curve["frames"][-1] / 2
    late = [value for at, value in zip(curve["frames"], curve["returns"], strict=True) if at > half]
    return mean(late or curve["returns"])


def pairs_won(halves: dict[str, list[float]]) -> dict[str, int]:
    """Count for every two agents the pairs of seeds in which the first has the higher mean return."""
    return {
        f"{name}/pairs_won/{other}": sum(one > two for one, two in itertools.product(ours, theirs))
        for (name, ours), (other, theirs) in itertools.permutations(halves.items(), 2)
    }


@with_help
@hydra.main(config_path="config", config_name="learning_curves", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    folder = RunFolder(cfg.run_dir, "learning_curves")
    runs = make_runs(cfg, folder.path)
    in_turn = [run for group in zip(*runs.values(), strict=True) for run in group]
    refuse_changes(in_turn)
    tracker = open_log(cfg, folder)
    failed = run_all(in_turn, cfg.jobs, desc="learning")

    curves, metrics, second_halves = {}, {}, {}
    lines = [
        "| agent | seeds | mean return, second half (higher is better) | mean return, last tenth | best return | frames"
        " | updates | minutes | updates/s |",
        "|---" * 9 + "|",
    ]
    for name, group in runs.items():
        found = {seed: (run, run.metrics) for seed, run in zip(as_list(cfg.seeds), group, strict=True)}
        done = {seed: values for seed, (_, values) in found.items() if values}
        if not done:
            continue
        curve_of_seed = {seed: read_json(found[seed][0].folder / "curve.json") for seed in done}
        frames = next(iter(curve_of_seed.values()))["frames"]
        returns = [curve["returns"] for curve in curve_of_seed.values()]
        curves[name] = (frames, returns)
        cells = [name, str(len(done))]
        metrics |= {f"{name}/return/{at}": quartiles(list(each))[1] for at, *each in zip(frames, *returns, strict=True)}
        second_halves[name] = [second_half(curve) for curve in curve_of_seed.values()]
        halves = zip(curve_of_seed, second_halves[name], strict=True)
        metrics |= {f"{name}/second_half_return/seed {seed}": half for seed, half in halves}
        scores = {"second_half_return": second_halves[name]}
        scores |= {key: [values[key] for values in done.values()] for key in ("last_tenth_return", "best_return")}
        for key, values in scores.items():
            low, middle, high = quartiles(values)
            metrics |= {f"{name}/{key}": middle, f"{name}/{key}/low": low, f"{name}/{key}/high": high}
            cells.append(f"{middle:.0f} ({low:.0f} to {high:.0f})")
        for key, scale in (("frames", 1), ("updates", 1), ("learning_seconds", 1 / 60), ("updates_per_second", 1)):
            metrics[f"{name}/{key}"] = quartiles([values[key] for values in done.values()])[1]
            cells.append(f"{scale * metrics[f'{name}/{key}']:,.0f}")
        lines.append("| " + " | ".join(cells) + " |")
    metrics |= pairs_won(second_halves)
    if curves:
        plot_learning_curves(curves, folder.file("curves.png"))
    report_sweep(folder, lines, {}, metrics, failed, tracker, seed=as_list(cfg.seeds)[0])


if __name__ == "__main__":
    main()

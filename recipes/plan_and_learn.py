"""Train a model on episodes planned with it, round by round.

    python recipes/plan_and_learn.py [system=cheetah] [rounds=3] [key=value ...]
    python recipes/plan_and_learn.py +robot=go1

A planner drives a system into states that random control never reaches, where the learned model is wrong. This recipe
runs planned episodes (recipes/mpc.py), trains the model further with them as half of its data (recipes/forward_model.py
start_from=... data.extra=...), and plans again, every round from new starts. Without a model of the system, it first
trains one on random controls. `+robot=NAME` chooses a real robot and its task from recipes/config/robot. The same
`run_dir` keeps finished rounds and resumes, also with more rounds. No figure of the paper. Results:
docs/results/learning-from-planning.md.

`value=true` learns the value of states from all episodes after every round (recipes/value.py), and adds it to the plans
of the next round, so that a short horizon suffices; `policy=true` starts those plans from a policy that imitates the
episodes.

Writes config.yaml, metrics.json, the table as table.md, rewards over time as rewards.png, and each round's episodes
(executed<round>), model (learned<round>, with its error table) and value (valued<round>, with its figure) to its run
folder. All options: recipes/config/plan_and_learn.yaml.
"""

from __future__ import annotations

import math
from pathlib import Path

import hydra
from omegaconf import DictConfig

from _common import as_list, clean_exit, load_system, open_log, scene_options, with_help
from _common.episodes import read_episodes
from _common.sweeps import FORWARD_MODEL, MPC, VALUE, Run, override, refuse_changes, report_sweep, run_all
from torchrl_gn.evaluation import plot_rewards
from torchrl_gn.training import RunFolder, load_pretrained, pretrained_names


def system_options(cfg: DictConfig) -> list[str]:
    """Return the options of the system, which both recipes take."""
    return [f"{key}={override(value)}" for key, value in {"system": cfg.system, **scene_options(cfg)}.items()]


def task_options(cfg: DictConfig) -> list[str]:
    """Return the options of the system and its task for recipes/mpc.py."""
    options = system_options(cfg)
    return options + [f"{key}={override(cfg[key])}" for key in ("reward", "horizon") if cfg[key] is not None]


def planning(cfg: DictConfig, folder: Path, index: int, model: str, valued: Run | None) -> Run:
    """Return the run that plans with a model and executes episodes; in the last round, baselines run too."""
    options = (*task_options(cfg), f"episodes={cfg.episodes}", f"steps={cfg.steps}", f"executor={cfg.executor}")
    options += (f"checkpoint={model}", f"seed={cfg.seed + index}", f"threads={cfg.threads}")
    if valued is not None:
        options += tuple(f"{key}={valued.folder}" for key in ("value", "policy") if cfg[key])
    last = index == cfg.rounds
    planners = [cfg.planner, *(cfg.baselines if last else ())]
    options += (
        f"video={str(last).lower()}",
        f"planner={override(planners)}",
        "gn.iterations=3",
        *as_list(cfg.planning),
    )
    # Only the last round has baselines and a video, and a resumed run with more rounds has another last one.
    return Run(MPC, folder / f"executed{index}", options, f"planning, round {index}", goes_on=("planner", "video"))


def learning(cfg: DictConfig, folder: Path, index: int, model: str | None, executed: list[Run]) -> Run:
    """Return the run that trains a model further on episodes, or a new one on random data if there is no model."""
    data = folder / "data" if cfg.data_dir is None else cfg.data_dir
    options = (*system_options(cfg), f"data.folder={data}")
    options += ("steps=null", f"clock={cfg.clock}", f"seed={cfg.seed + index}", f"threads={cfg.threads}")
    if model is None:
        options += (f"minutes={cfg.first_minutes}",)
    else:
        extra = ",".join(str(run.folder / f"{cfg.planner}.safetensors") for run in executed)
        options += (f"start_from={model}", f"data.extra=[{extra}]", f"minutes={cfg.minutes}", f"lr={cfg.lr}")
    # Options of the model itself are for new models only.
    more = [each for each in as_list(cfg.training) if model is None or not each.startswith("model.")]
    return Run(FORWARD_MODEL, folder / f"learned{index}", (*options, *more), f"learning, round {index}")


def valuing(cfg: DictConfig, folder: Path, index: int, executed: list[Run]) -> Run:
    """Return the run that learns a value and a policy from all episodes so far."""
    files = [str(run.folder / f"{cfg.planner}.safetensors") for run in executed]
    options = (f"episodes={override(files)}", f"discount={cfg.discount}", f"seed={cfg.seed + index}")
    options += (f"threads={cfg.threads}", *as_list(cfg.valuing))
    return Run(VALUE, folder / f"valued{index}", options, f"value, round {index}")


def make_runs(cfg: DictConfig, folder: Path, model: str | None) -> tuple[list[Run | None], list[Run], list[Run | None]]:
    """Return the runs of each round: training (None if the first has a model), planning, and value learning or None."""
    learned: list[Run | None] = [None if model else learning(cfg, folder, 0, None, [])]
    executed: list[Run] = []
    valued: list[Run | None] = [None]
    for index in range(cfg.rounds + 1):
        if index:
            learned.append(learning(cfg, folder, index, model, executed))
            valued.append(valuing(cfg, folder, index - 1, executed) if cfg.value or cfg.policy else None)
        if (learn := learned[-1]) is not None:
            model = str(learn.folder)
        assert model is not None
        executed.append(planning(cfg, folder, index, model, valued[-1]))
    return learned, executed, valued


@with_help
@hydra.main(config_path="config", config_name="plan_and_learn", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    scene = load_system(cfg, cfg.system)
    folder = RunFolder(cfg.run_dir, "plan_and_learn")
    model = cfg.checkpoint or (cfg.system if cfg.system in pretrained_names() else None)
    if model is not None:
        load_pretrained(model)  # refused before anything is written
    learned, executed, valued = make_runs(
        cfg, folder.path.resolve(), model
    )  # absolute: the runs' options name it and must not change
    refuse_changes([run for run in (*learned, *executed, *valued) if run is not None])
    tracker = open_log(cfg, folder)
    lines = [
        "| round | mean reward of a step, higher is better (std over starts) | ms to plan a step | one-step error,"
        " lower is better | 100-step error |",
        "|---" * 5 + "|",
    ]
    metrics: dict[str, float] = {}
    failed: list[Run] = []
    for index, execution in enumerate(executed):
        errors = {}
        if (learn := learned[index]) is not None:
            failed = run_all([learn], 1, desc=learn.name)
            if failed:
                break
            measured = learn.numbers()
            errors = {name: measured[name] for name in ("one_step_error", "rollout_error_100")}
            metrics |= {f"round {index}/{name}": value for name, value in errors.items()}
        if (value := valued[index]) is not None:
            failed = run_all([value], 1, desc=value.name)
            if failed:
                break
            metrics |= {f"round {index}/value_{key}": value.numbers()[key] for key in ("explained", "return")}
        failed = run_all([execution], 1, desc=execution.name)
        if failed:
            break
        measured = execution.numbers(math.nan)  # NaN: the reward if every episode became unstable
        for planner in (cfg.planner, *(cfg.baselines if index == cfg.rounds else ())):
            summary = {
                name.removeprefix(f"{planner}/"): value
                for name, value in measured.items()
                if name.startswith(f"{planner}/")
            }
            label = f"round {index}" if planner == cfg.planner else planner
            metrics |= {f"{label}/{name}": value for name, value in summary.items()}
            reward = f"{summary['mean_reward']:.3g} ({summary['mean_reward_std']:.2g})"
            cells = [f"{value:.1e}" for value in errors.values()] if planner == cfg.planner and errors else ["", ""]
            lines.append(f"| {label} | {reward} | {summary['planning_ms']:.0f} | " + " | ".join(cells) + " |")
    finished = [run for run in executed if run.metrics is not None]
    rewards = [read_episodes(run.folder / f"{cfg.planner}.safetensors", "reward")["reward"] for run in finished]
    if rewards:
        curves = {f"round {index}": values for index, values in enumerate(rewards)}
        plot_rewards(curves, folder.file("rewards.png"), timestep=scene.timestep, ylabel="reward")
    report_sweep(folder, lines, {}, metrics, failed, tracker, seed=cfg.seed)


if __name__ == "__main__":
    main()

"""Learn a policy by a short-horizon actor-critic (SHAC) through a graph network that is learned at the same time.

    python recipes/shac.py [system=suite:cheetah/run] [key=value ...]

In each round, the model learns from all episodes so far, and so does the reward, unless it is known. Then the policy
and a value learn in the model, from states of these episodes (SHACLoss). Then the policy runs new episodes in MuJoCo
with exploration. For tasks of the control suite, dm_control runs the episodes and its reward makes up the return; the
policy acts every `action_repeat` frames, and with `per_frame=true` model and reward predict single frames. Other
systems need a known, differentiable reward. For a policy on the suite's observations, see recipes/svg.py. The same
`run_dir` keeps finished rounds and resumes, also with more rounds. torchrl_gn.actor_critic has the trainer for your own
scripts (docs/policies.md). Results: docs/results/short-horizon-actor-critic.md.

Writes config.yaml, metrics.json, table.md, the learning curve (curve.json and curve.png), a video of the last round's
first evaluation episode (episode.gif), the policy averaged over rounds (policy.safetensors), the last value
(value.safetensors) and model (checkpoint/), and the reward, if it is learned (reward.safetensors). Every round's
networks are in rounds/. Except for tasks of the suite, recipes/mpc.py takes the run folder as policy=, value= and
checkpoint=. With several systems, a graph-network policy learns on all at once, and each system has its own value,
model and video. All options: recipes/config/shac.yaml.
"""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from tqdm import tqdm

from _common import as_list, clean_exit, finish_run, load_system, open_log, refuse_other_options, with_help
from _common.planning_task import reward_of
from torchrl_gn.actor_critic import (
    ActorCritic,
    ActorCriticOptions,
    ActorCriticTask,
    EvaluationEpisodes,
    FirstTrajectories,
    Rounds,
    SuiteActorCriticTask,
    TargetSquares,
)
from torchrl_gn.atomic import atomic_path, write_json
from torchrl_gn.checks import check_count
from torchrl_gn.dynamics import Predictor
from torchrl_gn.evaluation import evaluate_errors, plot_learning_curves, rollout_video
from torchrl_gn.interrupts import held
from torchrl_gn.policies import BoundedPolicy
from torchrl_gn.scenes import suite_name
from torchrl_gn.training import RunFolder, Tracker, load_pretrained, plain_config

MAY_CHANGE = ("rounds", "zero_shot", "plan", "planner", "threads", "device", "logger", "run_dir")
FALL = 0.15  # a round falls back if it loses more than this share of the best return
COLUMNS = {
    "frames": "frames",
    "minutes": "processor minutes",
    "reward": "mean reward of a step",
    "std": "std over starts",
    "return": "return",
    "median_return_of_last_five": "median return of last five",
    "imagined_reward": "imagined reward of a step",
    "error": "model's error, 20 steps",
    "entropy": "entropy",
}


@with_help
@hydra.main(version_base=None, config_path="config", config_name="shac")
@clean_exit
def main(cfg: DictConfig) -> None:
    check_count("rounds", cfg.rounds, 1)
    options = options_of(cfg)
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    tasks = [make_task(cfg, options, system) for system in as_list(cfg.system)]
    others = [make_task(cfg, options, system) for system in as_list(cfg.zero_shot)]
    if others and cfg.policy != "graph":
        raise ValueError(
            "zero_shot= is for policy=graph: only a graph network drives systems that it did not learn on."
        )
    run = RunFolder(cfg.run_dir, "shac")
    refuse_other_options(cfg, run, MAY_CHANGE)
    rounds = Rounds(run.path, tasks, plain_config(cfg))
    learner = rounds.begin(options)
    for task in others:
        learner.policy.for_scene(task.scene)  # raises, before any learning, if the policy cannot drive the scene
    tracker = open_log(cfg, run, label=f"shac-{tasks[0].scene.name}")
    rounds.collect()
    history, policy, evaluated = rounds.numbers(), None, []
    if history:  # the run may have stopped before it wrote these files of its last round
        policy = average(learner, rounds, len(history) - 1)
        rounds.keep_latest(policy)
        log_round(tracker, history[-1])
    with tqdm(total=cfg.rounds, initial=len(history), desc="rounds", leave=False) as bar:
        for index in range(len(history), cfg.rounds):
            began, start, seed = time.process_time(), time.perf_counter(), cfg.seed + 1000 * (index + 1)
            torch.manual_seed(seed)  # a resumed run draws the same random numbers
            losses = learner.learn(index)
            played, error = play_all(learner, seed)
            spent = {"minutes": (time.process_time() - began) / 60, "seconds": time.perf_counter() - start}
            for task, trajectories in zip(tasks, played, strict=True):
                task.add(trajectories)
            policy = average(learner, rounds, index)
            evaluated, numbers = evaluate_all(tasks, policy)
            history.append({**counted(cfg, tasks, history, spent), **numbers, "error": error, **losses})
            with held():  # Ctrl-C must not lose a finished round
                rounds.save(learner, played, history[-1])
                rounds.keep_latest(policy)
                log_round(tracker, history[-1])
            bar.set_postfix(reward=f"{history[-1]['reward']:.4g}", refresh=False)
            bar.update()
    assert policy is not None
    if not evaluated:
        evaluated, _ = evaluate_all(tasks, policy)  # for the videos
    zero_shot: dict[str, float] = {}
    if others:
        last = load_pretrained(rounds.latest[0]).policy
        zero_shot = {f"zero_shot/{task.scene.name}": evaluate(task, last)[1]["return"] for task in others}
    metrics = report(run, rounds, history, evaluated, zero_shot)
    for task in tasks if cfg.plan else []:
        folder = rounds.folder(task)
        torch.manual_seed(cfg.seed)
        planned, numbers = plan(task, policy, plain_config(cfg)["planner"])
        rollout_video(task.scene, planned["state"][0], None, run.file(f"{folder or 'episode'}_planned.gif"))
        metrics |= {"/".join(filter(None, ("planned", folder, name))): value for name, value in numbers.items()}
    finish_run(cfg, run, tracker, metrics, checkpoints=rounds.latest, step=history[-1]["frames"])


def options_of(cfg: DictConfig) -> ActorCriticOptions:
    """Return the trainer's options among the recipe's."""
    values = plain_config(cfg)
    evaluate = {name: value for name, value in values["evaluate"].items() if name != "suite_seed"}
    values |= {"first": FirstTrajectories(**values["first"]), "evaluate": EvaluationEpisodes(**evaluate)}
    return ActorCriticOptions(**{each.name: values[each.name] for each in fields(ActorCriticOptions)})


def make_task(cfg: DictConfig, options: ActorCriticOptions, system: str) -> ActorCriticTask:
    """Return the task on a system; ValueError for options that do not apply to it."""
    if (suite_seed := cfg.evaluate.suite_seed) is not None and not cfg.target_squares:
        raise ValueError("evaluate.suite_seed= is for a target: pass target_squares= too.")
    if suite_name(system) is not None:
        for name in ("timestep", "evaluation_reward", "action_bounds"):
            if cfg[name] is not None:
                raise ValueError(
                    f"{name}={cfg[name]}: {system} has its own; action_repeat= makes control steps longer."
                )
        if cfg.target_squares:
            raise ValueError(f"target_squares={list(cfg.target_squares)}: {system} has starts of its own.")
        return SuiteActorCriticTask(system, options, reward=plain_config(cfg)["reward"])
    scene = load_system(cfg, system)
    reward = reward_of(cfg, scene)
    evaluation: dict[str, Any] = {}
    if cfg.evaluation_reward is not None:
        evaluation["evaluation_reward"] = reward_of(cfg, scene, "evaluation_reward")
    if cfg.target_squares:
        squares = evaluation["squares"] = TargetSquares(scene, cfg.target_squares)
        if suite_seed is not None:
            states = squares.suite_states(cfg.evaluate.episodes, suite_seed)
            evaluation["evaluation_starts"] = lambda n, _: states[:n]
    return ActorCriticTask(scene, options, reward, **evaluation)


def play_all(learner: ActorCritic, seed: int) -> tuple[list[TensorDict], float | None]:
    """Play every task with exploration; return trajectories and the models' mean error, None if all became unstable."""
    policy = learner.playing()
    played = [task.play(policy, seed) for task in learner.tasks]
    errors = [error_of(task.members[0], new) for task, new in zip(learner.tasks, played, strict=True) if len(new)]
    return played, statistics.fmean(errors) if errors else None


def error_of(model: Predictor, played: TensorDict) -> float:
    """Return the 20-step error of a model on new trajectories."""
    return evaluate_errors(model, played, horizons=(20,), one_step=False).errors["rollout_error_20"].total


def average(learner: ActorCritic, rounds: Rounds, index: int) -> BoundedPolicy:
    """Average the last rounds' policies: the policy that is evaluated and kept after a round."""
    return learner.averaged(rounds.policies(learner.averaged_rounds(index)))


def evaluate_all(tasks: list[ActorCriticTask], policy: BoundedPolicy) -> tuple[list[TensorDict], dict[str, float]]:
    """Evaluate a policy on every task; return episodes, mean numbers and, with several tasks, each task's numbers."""
    evaluated = [evaluate(task, policy) for task in tasks]
    numbers = {name: statistics.fmean(own[name] for _, own in evaluated) for name in evaluated[0][1]}
    if len(tasks) > 1:
        for task, (_, own) in zip(tasks, evaluated, strict=True):
            numbers |= {f"{name} {task.scene.name}": value for name, value in own.items()}
    return [episodes for episodes, _ in evaluated], numbers


def plan(task: ActorCriticTask, policy: BoundedPolicy, options: dict[str, Any]) -> tuple[TensorDict, dict[str, float]]:
    """Evaluate a planner that starts from a policy; print its return; return episodes and numbers."""
    planner, began = task.planner(policy, **options), time.process_time()
    with tqdm(desc=f"planning for {task.scene.name}", unit="step", leave=False) as bar:

        def act(tensordict: TensorDictBase) -> TensorDictBase:
            bar.update()
            return planner(tensordict)

        episodes, numbers = evaluate(task, act)
    numbers["milliseconds"] = 1e3 * (time.process_time() - began) / episodes.numel()
    tqdm.write(
        f"{task.scene.name} with a planner: return {numbers['return']:.4g}, {numbers['milliseconds']:.3g} ms of the"
        " processor per control step."
    )
    return episodes, {name: numbers[name] for name in ("return", "milliseconds")}


def evaluate(
    task: ActorCriticTask, policy: Callable[[TensorDictBase], TensorDictBase]
) -> tuple[TensorDict, dict[str, float]]:
    """Play a task's evaluation episodes without exploration; return episodes and numbers.

    An episode whose simulation becomes unstable ends there. The environment starts another, which does not count.
    """
    episodes = task.evaluate(policy)
    rewards, terminated = (episodes["next", name].squeeze(-1) for name in ("reward", "terminated"))
    ended = terminated.cumsum(1) - terminated.long() > 0  # before the step
    returns = rewards.masked_fill(ended, 0.0).sum(1)
    means = returns / (~ended).sum(1)
    numbers = {
        "reward": (returns.sum() / (~ended).sum()).item(),
        "std": means.std().item() if len(rewards) > 1 else 0.0,
        "return": task.frames_per_step * returns.mean().item(),
    }
    return episodes, numbers


def counted(
    cfg: DictConfig, tasks: list[ActorCriticTask], history: list[dict[str, Any]], spent: dict[str, float]
) -> dict[str, Any]:
    """Return frames and time from the first random control to the end of a round."""
    frames = sum(task.frames_per_step for task in tasks)
    random_frames = frames * cfg.first.trajectories * cfg.first.length
    before = history[-1] if history else {"frames": random_frames, "minutes": 0.0}
    return {
        "frames": before["frames"] + frames * cfg.episodes * cfg.steps,
        "minutes": before["minutes"] + spent["minutes"],
        "seconds": before.get("seconds", 0.0) + spent["seconds"],  # wall time; rounds of older versions lack it
    }


def log_round(tracker: Tracker, numbers: dict[str, Any]) -> None:
    """Log the numbers of a round."""
    tracker.log({f"round/{name}": value for name, value in numbers.items()}, numbers["frames"])


def report(
    run: RunFolder, rounds: Rounds, history: list[dict[str, Any]], evaluated: list[TensorDict], others: dict[str, float]
) -> dict[str, Any]:
    """Write table, curve and videos; print the table and the zero-shot returns ``others``; return the metrics."""
    for index, numbers in enumerate(history):
        last = [each["return"] for each in history[max(0, index - 4) : index + 1]]
        numbers["median_return_of_last_five"] = statistics.median(last)
    folders = [rounds.folder(task) for task in rounds.tasks]
    several = {f"return {folder}": folder for folder in folders if folder}
    columns = {**COLUMNS, **several}
    rows = [list(columns.values())]
    rows += [[shown(name, numbers[name]) for name in columns] for numbers in history]
    lines = [" | ".join(["", *row, ""]).strip() for row in rows]
    lines.insert(1, "|" + "---|" * len(columns))
    with atomic_path(run.file("table.md")) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    tqdm.write("\n".join(lines))
    tqdm.write("Rewards, returns: higher is better. The model's error: lower is better; 1: no better than no motion.")
    for name, value in others.items():
        tqdm.write(f"{name}: return {value:.4g}")
    frames = [numbers["frames"] for numbers in history]
    curves = {name: [numbers[key] for numbers in history] for key, name in (several or {"return": "SHAC"}).items()}
    write_json(run.file("curve.json"), {"frames": frames, "returns": curves})
    plot_learning_curves({name: (frames, [returns]) for name, returns in curves.items()}, run.file("curve.png"))
    for task, episodes in zip(rounds.tasks, evaluated, strict=True):
        name = f"{rounds.folder(task) or 'episode'}.gif"
        rollout_video(task.scene, episodes["state"][0], None, run.file(name))
    best = max(history, key=lambda numbers: numbers["reward"])
    others = {**others, "rounds_fallen_back": float(fallen_back([numbers["return"] for numbers in history]))}
    each = {f"round {index}/{name}": value for index, numbers in enumerate(history) for name, value in numbers.items()}
    return {
        **history[-1],
        **{f"best_{name}": best[name] for name in ("reward", "return", "frames")},
        **others,
        **each,
    }


def shown(name: str, value: float | None) -> str:
    """Format a number of a round for the table."""
    if value is None:
        return "-"
    return f"{value:,}" if name == "frames" else f"{value:,.4g}"


def fallen_back(returns: list[float]) -> int:
    """Count the returns that are more than 15 % below the best so far, where that is positive."""
    highest = itertools.accumulate(returns, max)
    return sum(value < (1 - FALL) * best for value, best in zip(returns, highest, strict=True) if best > 0)


if __name__ == "__main__":
    main()

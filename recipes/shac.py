"""Learn a policy by a short-horizon actor-critic through a graph network that learns beside it.

    python recipes/shac.py [system=suite:cheetah/run] [key=value ...]

Round by round: the policy and a value learn in the model, from states that were played (SHACLoss); the policy plays in
MuJoCo, with exploration; the model learns from all that was played, and so does the reward, unless it is known. Tasks
of the control suite are played by dm_control, and what it pays is the return; the policy acts every action_repeat
frames, and with per_frame=true their model is of one. Other systems have a reward that is known, and differentiable.
For a policy from the suite's observations see recipes/svg.py. Finished rounds are kept: the same run_dir goes on, with
more rounds too. Results: docs/results/short-horizon-actor-critic.md.

Writes config.yaml, metrics.json, table.md, the learning curve (curve.json and curve.png), a video of the last round's
first judged episode (episode.gif), and the policy, averaged over rounds, and the last value and model
(policy.safetensors, value.safetensors, checkpoint/; reward.safetensors, if it is learned): recipes/mpc.py takes the run
folder of another system as policy=, value= and checkpoint=. Every round's own are in rounds/. With several systems, a
graph network as the policy learns on all at once, and each has its own value, model and video. All options:
recipes/config/shac.yaml.
"""

from __future__ import annotations

import itertools
import shutil
import statistics
import time
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from tqdm import tqdm

from _common import as_list, clean_exit, finish_run, load_system, open_log, refuse_other_options, with_help
from _common.actor_critic import WINDOW
from _common.actor_critic_rounds import ActorCritic, Round, Task
from _common.planning_task import reward_of
from _common.suite_rounds import suite_task
from torchrl_gn.atomic import atomic_path, read_json, write_json
from torchrl_gn.dynamics import Predictor
from torchrl_gn.evaluation import evaluate_errors, plot_learning_curves, rollout_video
from torchrl_gn.interrupts import held
from torchrl_gn.planners import BoundedPolicy
from torchrl_gn.planners.plan import check_count
from torchrl_gn.scenes import suite_name
from torchrl_gn.training import RunFolder, Tracker, load_pretrained
from torchrl_gn.training.checkpoint import CHECKPOINT_FILE

MAY_CHANGE = ("rounds", "zero_shot", "threads", "device", "logger", "run_dir")
FALL = 0.15  # share of the best return that a round may lose
PLACES = {"value": "value.safetensors", "reward": "reward.safetensors", "model": CHECKPOINT_FILE}  # in a run folder
COLUMNS = {
    "frames": "frames",
    "minutes": "processor minutes",
    "reward": "mean reward",
    "std": "std over starts",
    "return": "return",
    "median_return_of_last_five": "median of last five",
    "imagined_reward": "imagined",
    "error": "model's error, 20 steps",
    "entropy": "entropy",
}


def error_of(model: Predictor, played: TensorDict) -> float:
    """Error of a model over 20 steps of new trajectories."""
    return evaluate_errors(model, played, horizons=(20,), one_step=False).errors["rollout_error_20"].total


def shown(name: str, value: float | None) -> str:
    """A number of a round in the table."""
    if value is None:
        return "-"
    return f"{value:,}" if name == "frames" else f"{value:,.4g}"


def fallen_back(returns: list[float]) -> int:
    """How many returns are more than 15 % below the best before them, which is positive."""
    highest = itertools.accumulate(returns, max)
    return sum(value < (1 - FALL) * best for value, best in zip(returns, highest, strict=True) if best > 0)


def report(
    run: RunFolder, tasks: list[Task], rounds: list[dict[str, Any]], judged: list[TensorDict], others: dict[str, float]
) -> dict[str, Any]:
    """Write table, curve and videos, and say what was judged on ``others``; return the metrics."""
    for index, numbers in enumerate(rounds):
        last = [each["return"] for each in rounds[max(0, index - 4) : index + 1]]
        numbers["median_return_of_last_five"] = statistics.median(last)
    several = {f"return {task.folder}": task.folder for task in tasks} if len(tasks) > 1 else {}
    columns = {**COLUMNS, **several}
    rows = [list(columns.values())]
    rows += [[shown(name, numbers[name]) for name in columns] for numbers in rounds]
    lines = [" | ".join(["", *row, ""]).strip() for row in rows]
    lines.insert(1, "|" + "---|" * len(columns))
    with atomic_path(run.file("table.md")) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    tqdm.write("\n".join(lines))
    for name, value in others.items():
        tqdm.write(f"{name}: {value:.4g}")
    frames = [numbers["frames"] for numbers in rounds]
    curves = {name: [numbers[key] for numbers in rounds] for key, name in (several or {"return": "SHAC"}).items()}
    write_json(run.file("curve.json"), {"frames": frames, "returns": curves})
    plot_learning_curves({name: (frames, [returns]) for name, returns in curves.items()}, run.file("curve.png"))
    for task, episodes in zip(tasks, judged, strict=False):
        name = f"{task.folder}.gif" if several else "episode.gif"
        rollout_video(task.scene, episodes["state"][0], None, run.file(name))
    best = max(rounds, key=lambda numbers: numbers["reward"])
    others = {**others, "rounds_fallen_back": float(fallen_back([numbers["return"] for numbers in rounds]))}
    each = {f"round {index}/{name}": value for index, of in enumerate(rounds) for name, value in of.items()}
    return {
        **rounds[-1],
        **{f"best_{name}": best[name] for name in ("reward", "return", "frames")},
        **others,
        **each,
    }


def judge(cfg: DictConfig, task: Task, policy: BoundedPolicy) -> tuple[TensorDict, dict[str, float]]:
    """Play a task's judged episodes, without exploration; episodes and numbers."""
    episodes = task.judged(policy.for_scene(task.scene))
    rewards = episodes["next", "reward"].squeeze(-1)
    numbers = {
        "reward": rewards.mean().item(),
        "std": rewards.mean(1).std().item() if len(rewards) > 1 else 0.0,
        "return": cfg.action_repeat * rewards.sum(1).mean().item(),
    }
    return episodes, numbers


def judge_all(cfg: DictConfig, tasks: list[Task], policy: BoundedPolicy) -> tuple[list[TensorDict], dict[str, float]]:
    """Judge every task; episodes, mean numbers and, of several tasks, each one's."""
    judged = [judge(cfg, task, policy) for task in tasks]
    numbers = {name: statistics.fmean(of[name] for _, of in judged) for name in judged[0][1]}
    if len(tasks) > 1:
        for task, (_, of) in zip(tasks, judged, strict=True):
            numbers |= {f"{name} {task.folder}": value for name, value in of.items()}
    return [episodes for episodes, _ in judged], numbers


def play_round(learner: ActorCritic, seed: int) -> tuple[list[TensorDict], float | None]:
    """Play every task with exploration; trajectories, and the models' mean error; None if all became unstable."""
    policy = learner.playing()
    played = [task.play(policy.for_scene(task.scene), seed) for task in learner.tasks]
    errors = [error_of(task.members[0], new) for task, new in zip(learner.tasks, played, strict=True) if len(new)]
    return played, statistics.fmean(errors) if errors else None


def make_tasks(cfg: DictConfig, systems: list[str]) -> list[Task]:
    """The task on every system."""
    tasks = []
    for system in systems:
        if suite_name(system) is not None:
            tasks.append(suite_task(cfg, system, alone=len(systems) == 1))
            continue
        scene = load_system(cfg, system)
        reward = reward_of(cfg, scene)
        judged = reward if cfg.judged_reward is None else reward_of(cfg, scene, "judged_reward")
        tasks.append(Task(cfg, scene, reward, judged, scene.name if len(systems) > 1 else ""))
    return tasks


@with_help
@hydra.main(version_base=None, config_path="config", config_name="shac")
@clean_exit
def main(cfg: DictConfig) -> None:
    for name in ("action_repeat", "average", "members", "rounds", "horizon", "updates", "episodes", "model_steps"):
        check_count(name, cfg[name], 1)
    if cfg.steps < 1 or cfg.steps % WINDOW or cfg.first.length < WINDOW:
        raise ValueError(
            f"steps={cfg.steps} must be a multiple of {WINDOW}, and first.length={cfg.first.length} at least {WINDOW}."
        )
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    tasks, others = make_tasks(cfg, as_list(cfg.system)), make_tasks(cfg, as_list(cfg.zero_shot))
    if others and cfg.policy != "graph":
        raise ValueError(
            "zero_shot= is for policy=graph: only a graph network drives systems that it did not learn on."
        )
    run = RunFolder(cfg.run_dir, "shac")
    refuse_other_options(cfg, run, MAY_CHANGE)
    done: list[Round] = []
    while (each := Round(run.path, len(done))).finished:
        done.append(each)
    learner = ActorCritic(cfg, tasks, done[-1] if done else None)
    for task in others:
        learner.policy.for_scene(task.scene)  # raises if it cannot drive it, before anything is learned
    tracker = open_log(cfg, run, label=f"shac-{tasks[0].scene.name}")
    for task in tasks:
        task.collect(done)
    rounds: list[dict[str, Any]] = [read_json(each.numbers) for each in done]
    latest = [run.path / "policy.safetensors"]
    latest += [run.path / task.folder / PLACES[what] for task in tasks for what in task.networks]
    policy, judged = None, []
    if done:  # whose last may have ended before these were written
        policy = learner.averaged(run.path, len(done) - 1)
        keep_latest(learner, done[-1], policy, latest)
        log_round(tracker, rounds[-1])
    with tqdm(total=cfg.rounds, initial=len(done), desc="rounds", leave=False) as bar:
        for index in range(len(done), cfg.rounds):
            began, start, seed = time.process_time(), time.perf_counter(), cfg.seed + 1000 * (index + 1)
            torch.manual_seed(seed)  # a resumed run draws what it would have drawn
            losses, now = learner.learn(index), Round(run.path, index)
            played, error = play_round(learner, seed)
            minutes, seconds = (time.process_time() - began) / 60, time.perf_counter() - start
            policy = learner.averaged(run.path, index)
            judged, numbers = judge_all(cfg, tasks, policy)
            random_steps = len(tasks) * cfg.first.trajectories * cfg.first.length
            before = rounds[-1] if rounds else {"frames": cfg.action_repeat * random_steps, "minutes": 0.0}
            rounds.append(
                {
                    "frames": before["frames"] + len(tasks) * cfg.action_repeat * cfg.episodes * cfg.steps,
                    "minutes": before["minutes"] + minutes,
                    "seconds": before.get("seconds", 0.0) + seconds,  # by the clock; older rounds have none
                    **numbers,
                    "error": error,
                    **losses,
                }
            )
            with held():  # Ctrl-C does not cost a round that is played
                learner.save(now)
                for task, trajectories in zip(tasks, played, strict=True):
                    task.add(trajectories, now)
                write_json(now.numbers, rounds[-1], checked=True)
                keep_latest(learner, now, policy, latest)
                log_round(tracker, rounds[-1])
            bar.set_postfix(reward=f"{rounds[-1]['reward']:.4g}", refresh=False)
            bar.update()
    assert policy is not None
    if not judged:
        judged, _ = judge_all(cfg, tasks, policy)  # for the videos
    zero_shot: dict[str, float] = {}
    if others:
        kept = load_pretrained(latest[0]).policy
        zero_shot = {f"zero_shot/{task.scene.name}": judge(cfg, task, kept)[1]["return"] for task in others}
    metrics = report(run, tasks, rounds, judged, zero_shot)
    finish_run(cfg, run, tracker, metrics, checkpoints=latest, step=rounds[-1]["frames"])


def log_round(tracker: Tracker, numbers: dict[str, Any]) -> None:
    """Log the numbers of a round."""
    tracker.log({f"round/{name}": value for name, value in numbers.items()}, numbers["frames"])


def keep_latest(learner: ActorCritic, last: Round, policy: BoundedPolicy, latest: list[Path]) -> None:
    """Write the averaged policy, and the other networks of the last round, to their places in the run folder."""
    learner.save_policy(latest[0], policy)
    files = [last.of(what, task) for task in learner.tasks for what in task.networks]
    for source, target in zip(files, latest[1:], strict=True):
        copy_to(source, target)


def copy_to(source: Path, target: Path) -> None:
    """Copy a file, atomically."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)


if __name__ == "__main__":
    main()

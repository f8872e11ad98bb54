"""Learn a policy by a short-horizon actor-critic through a graph network that learns beside it.

    python recipes/shac.py [system=cheetah] [reward=run] [key=value ...]

Round by round: the policy and a value learn in the model, from states that were played (SHACLoss); the policy plays in
MuJoCo, with exploration; the model learns from all that was played. The reward is known, and differentiable. For a
policy from the suite's observations, whose reward may be learned too, see recipes/svg.py. Finished rounds are kept: the
same run_dir goes on, with more rounds too. Results: docs/results/short-horizon-actor-critic.md.

Writes config.yaml, metrics.json, table.md, the learning curve (curve.json and curve.png), a video of the last round's
first judged episode (episode.gif), and the last policy, value and model (policy.safetensors, value.safetensors,
checkpoint/), which recipes/mpc.py takes as policy=, value= and checkpoint=; every round's own are in rounds/. All
options: recipes/config/shac.yaml.
"""

from __future__ import annotations

import json
import math
import shutil
import statistics
import time
from pathlib import Path
from typing import Any, cast

import hydra
import torch
from omegaconf import DictConfig
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from tqdm import tqdm

from _common import clean_exit, finish_run, open_log, refuse_other_options, scene_options, with_help
from _common.actor_critic import WINDOW, ActorCriticOptimizer, play, played_windows, windows
from _common.planning_task import reward_of
from torchrl_gn.atomic import atomic_path, write_json
from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import ForwardModel, Predictor, specialize
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.evaluation import evaluate_errors, plot_learning_curves, rollout_video
from torchrl_gn.objectives import SHACLoss
from torchrl_gn.planners import StatePolicy, StateValue, task_invariances
from torchrl_gn.planners.plan import check_count
from torchrl_gn.rewards import Reward
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.training import RunFolder, fit, load_pretrained, plain_config, save_checkpoint

MAY_CHANGE = ("rounds", "threads", "logger", "run_dir")
COLUMNS = {
    "frames": "physics steps",
    "minutes": "processor minutes",
    "reward": "mean reward",
    "std": "std over starts",
    "return": "return",
    "imagined_reward": "imagined",
    "error": "model's error, 20 steps",
    "entropy": "entropy",
}


class Round:
    """What a round leaves in its folder; finished once the last file is written, its numbers."""

    def __init__(self, folder: Path, index: int) -> None:
        self.path = folder / "rounds" / f"{index:03}"
        self.model, self.policy, self.value, self.played, self.numbers = (
            self.path / name
            for name in (
                "model.safetensors",
                "policy.safetensors",
                "value.safetensors",
                "played.safetensors",
                "numbers.json",
            )
        )

    @property
    def finished(self) -> bool:
        return self.numbers.exists()

    def read_played(self) -> TensorDict:
        """Trajectories ``[M]`` that the policy played."""
        played = load_file(self.played)
        return TensorDict(played, [len(played["action"])])

    def write_played(self, played: TensorDict) -> None:
        with atomic_path(self.played) as temporary:
            save_file({key: value.contiguous() for key, value in played.items()}, temporary)


class ActorCritic:
    """Model, policy and value of a task, and how they learn from one round to the next."""

    def __init__(self, cfg: DictConfig, scene: Scene, reward: Reward, begun: Round | None) -> None:
        self.cfg, self.scene = cfg, scene
        self.config, kept = plain_config(cfg), None
        if begun is None:
            invariances = task_invariances(scene, reward)
            self.model: Predictor = ForwardModel.for_scene(scene, **self.config["model"]).bind(scene)
            self.policy = StatePolicy(scene, hidden=cfg.hidden, canonicalizer=invariances)
            self.value = StateValue(scene, discount=cfg.discount, hidden=cfg.hidden, canonicalizer=invariances)
        else:
            kept = load_pretrained(begun.policy)
            self.model = load_pretrained(begun.model).bind(scene)
            self.policy, self.value = kept.policy, load_pretrained(begun.value).value
        imagined = ModelEnv(specialize(self.model), reward)
        self.loss = SHACLoss(self.policy, self.value, imagined, steps=cfg.horizon, lmbda=cfg.lmbda)
        rates = {name: cfg[name] for name in ("policy_lr", "value_lr", "alpha_lr")}
        self.optimizer = ActorCriticOptimizer(self.loss, **rates)
        if kept is not None:
            self.optimizer.load_state_dict(kept.training)

    def learn(self, data: list[TensorDict], index: int) -> dict[str, float]:
        """Train the model on all data, then policy and value in it."""
        cfg, first = self.cfg, index == 0
        steps, lr = (cfg.first.steps, None) if first else (cfg.model_steps, cfg.model_lr)
        fit(self.model, cast(TensorDict, torch.cat(cast(Any, data))), steps=steps, lr=lr, seed=cfg.seed + index)
        newest = data[-1]["state"]
        rewards = None
        if first:
            before, after = newest[:, :-1], newest[:, 1:]
            rewards = cast(Any, self.loss.env.reward)(before, data[-1]["action"], after, None).flatten(0, 1)
        self.loss.fit_normalizers(newest.flatten(0, 1), rewards)
        states = torch.cat([part["state"][:, :-1].flatten(0, 1) for part in data])
        sizes = {"updates": cfg.updates, "batch_size": cfg.batch_size}
        return self.optimizer.learn(states, newest[:, :-1].flatten(0, 1), **sizes, desc=f"policy, round {index}")

    def save(self, of: Round) -> None:
        """Write the networks of a round, with what the next needs."""
        of.path.mkdir(parents=True, exist_ok=True)
        options = {"scene": self.scene, "config": self.config}
        save_checkpoint(of.model, self.model, **options)
        save_checkpoint(of.value, self.value, **options)
        save_checkpoint(of.policy, self.policy, **options, training=self.optimizer.state_dict())


def error_of(model: Predictor, played: TensorDict) -> float:
    """Error of a model over 20 steps of new trajectories."""
    return evaluate_errors(model, played, horizons=(20,), one_step=False).errors["rollout_error_20"].total


def report(run: RunFolder, scene: Scene, rounds: list[dict[str, Any]], judged: TensorDict | None) -> dict[str, Any]:
    """Write table, curve and video; return the metrics."""
    rows = [list(COLUMNS.values())]
    rows += [
        [f"{numbers[name]:,.4g}" if name != "frames" else f"{numbers[name]:,}" for name in COLUMNS]
        for numbers in rounds
    ]
    lines = [" | ".join(["", *row, ""]).strip() for row in rows]
    lines.insert(1, "|" + "---|" * len(COLUMNS))
    with atomic_path(run.file("table.md")) as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    tqdm.write("\n".join(lines))
    frames = [numbers["frames"] for numbers in rounds]
    write_json(run.file("curve.json"), {"frames": frames, "returns": [numbers["return"] for numbers in rounds]})
    plot_learning_curves({"SHAC": (frames, [[each["return"] for each in rounds]])}, run.file("curve.png"))
    video = run.file("episode.gif")
    if judged is not None:
        rollout_video(scene, judged["state"][0], None, video)
    best = max(rounds, key=lambda numbers: numbers["reward"])
    last = statistics.median(numbers["return"] for numbers in rounds[-5:])
    each = {f"round {index}/{name}": value for index, of in enumerate(rounds) for name, value in of.items()}
    return {
        **rounds[-1],
        "median_return_of_last_five": last,
        **{f"best_{name}": best[name] for name in ("reward", "return", "frames")},
        **each,
    }


@with_help
@hydra.main(version_base=None, config_path="config", config_name="shac")
@clean_exit
def main(cfg: DictConfig) -> None:
    for name in ("rounds", "horizon", "updates", "episodes", "model_steps"):
        check_count(name, cfg[name], 1)
    if cfg.steps < 1 or cfg.steps % WINDOW or cfg.first.length < WINDOW:
        raise ValueError(
            f"steps={cfg.steps} must be a multiple of {WINDOW}, and first.length={cfg.first.length} at least {WINDOW}."
        )
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    scene = load_scene(cfg.system, **scene_options(cfg))
    reward = reward_of(cfg, scene)
    if reward.target_shape is not None:
        raise ValueError(f"A policy of states does not know the target of {reward}.")
    judge = reward if cfg.judged_reward is None else reward_of(cfg, scene, "judged_reward")
    run = RunFolder(cfg.run_dir, "shac")
    refuse_other_options(cfg, run, MAY_CHANGE)
    tracker = open_log(cfg, run, label=f"shac-{scene.name}")
    done: list[Round] = []
    while (each := Round(run.path, len(done))).finished:
        done.append(each)
    learner = ActorCritic(cfg, scene, reward, done[-1] if done else None)
    first = collect_trajectories(scene, cfg.first.trajectories, steps=cfg.first.length, seed=cfg.seed)
    data = [windows(first["state"], first["action"]), *(each.read_played() for each in done)]
    rounds: list[dict[str, Any]] = [json.loads(each.numbers.read_text()) for each in done]
    judged: TensorDict | None = None
    latest = [run.path / "policy.safetensors", run.path / "value.safetensors", run.checkpoint]
    with tqdm(total=cfg.rounds, initial=len(done), desc="rounds", leave=False) as bar:
        for index in range(len(done), cfg.rounds):
            began, seed = time.process_time(), cfg.seed + 1000 * (index + 1)
            torch.manual_seed(seed)  # a resumed run draws what it would have drawn
            losses = learner.learn(data, index)
            env = SceneEnv(scene, reward, seed=seed)
            played = played_windows(play(env, learner.policy, episodes=cfg.episodes, steps=cfg.steps, explore=True))
            seconds = time.process_time() - began
            error = error_of(learner.model, played) if len(played) else math.nan
            judged = play(SceneEnv(scene, judge, seed=10_000), learner.policy, **cfg.evaluate, explore=False)
            rewards = judged["next", "reward"].squeeze(-1)
            before = (
                rounds[-1] if rounds else {"frames": first["action"][..., 0].numel() * scene.substeps, "minutes": 0.0}
            )
            rounds.append(
                {
                    "frames": before["frames"] + scene.substeps * cfg.episodes * cfg.steps,
                    "minutes": before["minutes"] + seconds / 60,
                    "reward": rewards.mean().item(),
                    "std": rewards.mean(1).std().item(),
                    "return": scene.substeps * rewards.sum(1).mean().item(),
                    "error": error,
                    **losses,
                }
            )
            learner.save(now := Round(run.path, index))
            now.write_played(played)
            write_json(now.numbers, rounds[-1])
            for source, target in zip((now.policy, now.value, now.model), latest, strict=True):
                copy_to(source, target)
            data.append(played)
            tracker.log({f"round/{name}": value for name, value in rounds[-1].items()}, rounds[-1]["frames"])
            bar.set_postfix(reward=f"{rounds[-1]['reward']:.4g}", refresh=False)
            bar.update()
    finish_run(cfg, run, tracker, report(run, scene, rounds, judged), checkpoints=latest)


def copy_to(source: Path, target: Path) -> None:
    """Copy a file, atomically."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)


if __name__ == "__main__":
    main()

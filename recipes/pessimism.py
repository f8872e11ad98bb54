"""Plan with models that were trained on random control: one model, an ensemble, and a pessimistic ensemble.

    python recipes/pessimism.py [system=cheetah] [reward=forward] [pessimism=[0, 1]] [key=value ...]

Trains an ensemble on trajectories of random control alone. Then plans and executes episodes in MuJoCo from the same
starts: with the first member, and with all members, for the mean of their returns minus `pessimism` standard
deviations. Compares the reward that plans predict with the reward earned. The same `run_dir` keeps its trained
ensemble. Beyond the paper.

Writes config.yaml, metrics.json, the ensemble's checkpoint, every planner's episodes (<planner>.safetensors), rewards
over time (rewards.png) and a video of each planner's first episode to its run folder. All options:
recipes/config/pessimism.yaml. Results: docs/results/pessimism.md.
"""

from __future__ import annotations

from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp
from tqdm import tqdm

from _common import (
    as_list,
    clean_exit,
    finish_run,
    load_system,
    open_log,
    refuse_without_effect,
    resumed_checkpoint,
    say_trained,
    with_help,
)
from _common.planning_task import reward_of
from torchrl_gn.checks import check_count
from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import BoundEnsemble, Ensemble, specialize
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.evaluation import plot_rewards, rollout_video
from torchrl_gn.planners import GradientPlanner
from torchrl_gn.scenes import Scene
from torchrl_gn.training import Checkpoint, RunFolder, fit_ensemble, load_pretrained, plain_config, save_checkpoint
from torchrl_gn.training.tensor_files import write_tensors

OF_TRAINING = ("members", "hidden", "train_steps", "data")  # options without effect on a checkpoint
# Options that may change when a run plans with its ensemble again.
MAY_CHANGE = ("reward", "pessimism", "horizon", "steps", "episodes", "gn", "fall", "threads", "logger", "run_dir")


def make_ensemble(cfg: DictConfig, scene: Scene, run: RunFolder, trained: Checkpoint | None) -> BoundEnsemble:
    """Return a trained ensemble, or train one on random control; specialised."""
    if trained is not None:
        return specialize(trained.ensemble.bind(scene))
    ensemble = Ensemble.for_scene(scene, count=cfg.members, hidden=cfg.hidden)
    options = {"pace": cfg.data.pace, "seed": cfg.data.seed, "split": 0}  # training data, as data sets draw them
    trajectories = collect_trajectories(scene, cfg.data.trajectories, cfg.data.length, **options)
    bound = ensemble.bind(scene)
    fit_ensemble(bound, trajectories, steps=cfg.train_steps, seed=cfg.seed)
    save_checkpoint(run.checkpoint, ensemble, scene=scene, config=plain_config(cfg))
    return specialize(bound)


def promised(imagined: ModelEnv, now: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Return each plan's predicted mean reward per step, and its standard deviation over the members, ``[B]``."""
    left, members = now["plan", "actions"][:, 0], imagined.members  # the best candidate
    actions = torch.cat((now["action"].unsqueeze(1), left[:, :-1]), dim=1)
    rewards = imagined.imagine_by_member(now.select("state"), actions).rewards
    means = rewards.mean((-2, -1)).reshape(members, -1)
    return means.mean(0), means.std(0) if members > 1 else torch.zeros_like(means[0])


@torch.no_grad()
def play(cfg: DictConfig, name: str, imagined: ModelEnv, env: SceneEnv, pessimism: float) -> TensorDict:
    """Return episodes ``[M, T]`` of a planner: states, actions, rewards, and the rewards that its plans predicted.

    Rewards are NaN from where a simulation became unstable, which ends the episode.
    """
    planner = GradientPlanner(imagined, cfg.horizon, pessimism=pessimism, seed=cfg.seed, **cfg.gn)
    env.set_seed(cfg.seed)
    now, steps = env.reset(TensorDict(batch_size=[cfg.episodes])), []
    over = torch.zeros(cfg.episodes, dtype=torch.bool)
    for _ in tqdm(range(cfg.steps), desc=name, unit="step", leave=False):
        now = planner(now)
        mean, deviation = promised(imagined, now)
        stepped = env.step(now)
        over = over | stepped["next", "terminated"].squeeze(-1)
        reward = stepped["next", "reward"].squeeze(-1).masked_fill(over, torch.nan)
        entries = {"state": now["state"], "action": now["action"], "reward": reward}
        steps.append(TensorDict({**entries, "promised": mean, "deviation": deviation}, now.shape))
        now = step_mdp(stepped, keep_other=True)
    return TensorDict.maybe_dense_stack(steps, 1)


def summarize(cfg: DictConfig, scene: Scene, episodes: TensorDict) -> dict[str, float]:
    """Summarise earned and predicted rewards, as means per step, and shares of steps.

    Steps after a simulation became unstable count nowhere, but in the number of such episodes.
    """
    reward, horizon = episodes["reward"].double(), cfg.horizon
    earned = reward.unfold(1, horizon, 1).mean(-1)  # [M, T - H + 1], mean over each plan's horizon
    whole = earned.isfinite()
    mean, deviation = (episodes[key][:, : earned.shape[1]][whole] for key in ("promised", "deviation"))
    earned, played = earned[whole], torch.isfinite(reward)
    means = reward.nanmean(1)
    means = means[means.isfinite()]
    found = {
        "reward": reward.nanmean().item(),
        "reward_std": means.std().item() if len(means) > 1 else 0.0,
        "unstable": int(torch.logical_not(played).any(1).sum()),
        "promised": mean.mean().item(),
        "earned": earned.mean().item(),
        "deviation": deviation.mean().item(),
        "kept": (earned >= mean - deviation).double().mean().item(),
    }
    if cfg.fall is not None:
        height = episodes["state"][:, :, scene.node_names.index(cfg.fall.body), 2]
        found["fallen"] = (height[played] < cfg.fall.height).double().mean().item()
    return found


def save(scene: Scene, episodes: TensorDict, path: Path) -> Path:
    """Write episodes, and a video of the first beside them; return the video's path."""
    write_tensors(path, dict(episodes.items()))
    states = episodes["state"][0]
    rollout_video(scene, states, None, path.with_suffix(".gif"), speed=min(1.0, scene.timestep / 0.01))
    return path.with_suffix(".gif")


@with_help
@hydra.main(version_base=None, config_path="config", config_name="pessimism")
@clean_exit
def main(cfg: DictConfig) -> None:
    for name in ("members", "episodes", "steps", "horizon"):
        check_count(name, cfg[name], 1)
    if cfg.steps < cfg.horizon:
        raise ValueError(f"steps={cfg.steps} must be at least the horizon, {cfg.horizon}.")
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    scene = load_system(cfg, cfg.system)
    reward, trained = reward_of(cfg, scene), None
    if cfg.checkpoint is not None:
        trained, because = load_pretrained(cfg.checkpoint), f"checkpoint={cfg.checkpoint}"
        refuse_without_effect(cfg, Path(__file__), OF_TRAINING, because=because, trained=trained.config)
    run = RunFolder(cfg.run_dir, "pessimism")
    if (resumed := resumed_checkpoint(cfg, run, MAY_CHANGE)) is not None:
        trained = resumed
        say_trained(run)
    tracker = open_log(cfg, run, label=f"pessimism-{scene.name}")
    ensemble = make_ensemble(cfg, scene, run, trained)
    env = SceneEnv(scene, reward, num_threads=1)
    planners = {"one model": (ModelEnv(ensemble.members[0], reward), 0.0)}
    for value in map(float, as_list(cfg.pessimism)):
        planners[f"pessimism {value:g}"] = (ModelEnv(ensemble, reward), value)
    metrics, curves, videos = {}, {}, []
    tqdm.write(
        "Rewards of a step (higher is better): reward: over whole episodes; promised, earned: over each plan's horizon,"
        " as predicted and as executed; deviation: stated for promised; kept: share of plans that earned at least"
        " promised minus deviation; fallen: share of steps (lower is better); unstable: episodes that ended as their"
        " simulation became so."
    )
    for name, (imagined, pessimism) in planners.items():
        episodes = play(cfg, name, imagined, env, pessimism)
        found = summarize(cfg, scene, episodes)
        metrics |= {f"{name}/{key}": value for key, value in found.items()}
        curves[name] = episodes["reward"]
        videos.append(save(scene, episodes, run.file(f"{name.replace(' ', '_')}.safetensors")))
        tqdm.write(f"{name:16}" + "  ".join(f"{key} {value:.3g}" for key, value in found.items()))
    figure = run.file("rewards.png")
    plot_rewards(curves, figure, timestep=scene.timestep, ylabel="reward")
    checkpoints = [run.checkpoint] if cfg.checkpoint is None else []
    finish_run(cfg, run, tracker, metrics, files=[figure, *videos], checkpoints=checkpoints, step=cfg.steps)


if __name__ == "__main__":
    main()

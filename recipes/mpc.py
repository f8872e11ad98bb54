"""Control a system by planning, through the learned model or on the true physics.

    python recipes/mpc.py [system=pendulum] [reward=balance] [planner=gn] [key=value ...]
    python recipes/mpc.py system=cartpole "planner=[gn,ilqg,cem,random]"

Plays episodes in MuJoCo, all from the same start states for every planner: gn plans by gradients through the learned
model (paper, SM "MPC planner with learned models"), cem and mppi are TorchRL's own planners on that model, ilqg (paper,
SM "Baseline Mujoco-based planner"), cem_true and mppi_true plan on MuJoCo itself, random plays random controls. A
checkpoint of an inference model first identifies the system from random controls; `variants=true` plays a random
variant of the system in every episode, with a checkpoint that was trained on such (those that come with the package
identify pendulums and cheetahs). What was played is kept: the same `run_dir` goes on, with more steps or planners too.

Where MuJoCo's simulation becomes unstable an episode is over: its states and rewards are NaN from there on and count in
no number, and the table says of how many episodes. With a recurrent model only gn remembers what was played; cem and
mppi plan as if nothing had been.

Leaves config.yaml, metrics.json, every planner's episodes (<planner>.safetensors), rewards over time (rewards.png) and
a video of the first episode (<planner>.gif), with gn and ilqg beside what the plan said a horizon before, if it is
longer than that. All options: recipes/config/mpc.yaml. What came out: docs/results.md.
"""

from __future__ import annotations

import re
import time
from functools import partial
from pathlib import Path
from typing import Any, cast

import hydra
import numpy as np
import torch
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from safetensors.torch import load_file, save_file
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.modules import CEMPlanner, MPPIPlanner
from tqdm import tqdm

from torchrl_gn.atomic import atomic_path
from torchrl_gn.data import Simulator, UnstableSimulationError, sample_start_states, spline_controls
from torchrl_gn.dynamics import Predictor, specialize
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.evaluation import plot_rewards, rollout_video
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.planners import GradientPlanner, ILQGPlanner, ReturnToGo
from torchrl_gn.planners.plan import check_count
from torchrl_gn.pretrained import load_model, pretrained_names
from torchrl_gn.rewards import FreezeGoal, Reward, make_reward
from torchrl_gn.scenes import Scene, load_scene, sample_variants
from torchrl_gn.training import RunFolder, Tracker, clean_exit, with_help
from torchrl_gn.training.run_folder import CONFIG_FILE

ON_MODEL, ON_PHYSICS = ("gn", "cem", "mppi"), ("ilqg", "cem_true", "mppi_true", "random", "nothing")
SAVE_SECONDS = 60
# Options that may be others when a run goes on.
MAY_CHANGE = ("planner", "steps", "compile", "threads", "simulation_threads", "video", "logger", "run_dir")


class RandomControl(TensorDictModuleBase):
    """Smooth random controls, or none, from a step on: what planners are to beat."""

    def __init__(self, scene: Scene, episodes: int, steps: int, seed: int, factor: float, *, step: int) -> None:
        super().__init__()
        self.in_keys: list[NestedKey] = ["state"]
        self.out_keys: list[NestedKey] = ["action"]
        self.step = step
        self.controls = factor * torch.from_numpy(spline_controls(scene, episodes, steps, seed))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self.controls[:, self.step].float()
        self.step += 1
        return tensordict.set("action", action)


class Episodes:
    """Episodes under one planner, saved now and then, to go on with.

    Args:
        path: file that they are kept in.
        start: TensorDict to begin from.
    """

    def __init__(self, path: Path, start: TensorDictBase) -> None:
        self.path, self.now = path, start
        self.records: dict[str, list[Tensor]] = {"state": [start["state"]], "action": [], "reward": [], "seconds": []}
        self.records["planned"] = []
        if path.exists():
            saved = load_file(path)
            flat = {key.removeprefix("now."): value for key, value in saved.items() if key.startswith("now.")}
            batch = start.batch_size
            self.now = cast(TensorDictBase, TensorDict(flat, batch_size=batch).unflatten_keys("."))
            for name, record in self.records.items():
                values = saved[name]
                record[:] = list(values.unbind(0) if name in ("seconds", "planned") else values.unbind(1))

    def __len__(self) -> int:
        return len(self.records["action"])

    def __getitem__(self, name: str) -> Tensor:
        """``[B, T, ...]`` of states, actions and rewards; ``[T, ...]`` of the rest."""
        record = self.records[name]
        if not record:
            return torch.zeros(0)
        return torch.stack(record, dim=0 if name in ("seconds", "planned") else 1)

    @property
    def over(self) -> Tensor:
        """Which episodes ``[B]`` ended early, as their simulation became unstable."""
        return self.records["state"][-1].isnan().flatten(1).any(1)

    def save(self) -> None:
        """Write everything, atomically."""
        if not len(self):
            return
        now = {f"now.{key}": value for key, value in self.now.flatten_keys(".").items()}
        values = {name: self[name] for name in self.records}
        # Copies: a target is also the task, and safetensors refuses what shares memory.
        apart = {key: value.clone(memory_format=torch.contiguous_format) for key, value in (now | values).items()}
        with atomic_path(self.path) as temporary:
            save_file(apart, temporary)


def fill_in(cfg: DictConfig) -> None:
    """The paper's task of the system, where options are left open; refuses what is none."""
    name = re.sub(r"\d+$", "", cfg.system) if cfg.system.startswith("swimmer") else cfg.system
    if name not in cfg.tasks:
        raise ValueError(
            f"{cfg.system!r} is no system of the paper; this recipe has rewards of {list(cfg.tasks)} alone. With a"
            " reward and a model of your own it takes a few lines of Python: 'Plan with a model of your own' in"
            " docs/planning.md and docs/guides/write-a-reward.md."
        )
    task = cfg.tasks[name]
    defaults = [
        (cfg, "reward", task["rewards"][0]),
        (cfg, "horizon", task["horizon"]),
        (cfg, "steps", task["steps"]),
        (cfg.gn, "iterations", task.get("iterations", 3)),
    ]
    for part, key, value in defaults:
        if part[key] is None:
            part[key] = value
    for key in ("horizon", "steps", "episodes", "context_length", "threads"):
        check_count(key, cfg[key], 1)
    with open_dict(cfg):  # what other systems get is none of this run's business
        del cfg.tasks
    if not isinstance(cfg.planner, ListConfig):
        cfg.planner = [cfg.planner]
    unknown = [name for name in cfg.planner if name not in ON_MODEL + ON_PHYSICS]
    if unknown:
        raise ValueError(f"There is no planner {unknown[0]!r}; use some of {[*ON_MODEL, *ON_PHYSICS]}.")


def make_scenes(cfg: DictConfig) -> tuple[Scene, list[Scene]]:
    """The standard scene, and a variant for every episode if there are to be any."""
    scene = load_scene(cfg.system)
    if not cfg.variants:
        return scene, [scene]
    rng = np.random.default_rng(np.random.SeedSequence(cfg.seed, spawn_key=(2,)))
    return scene, sample_variants(cfg.system, cfg.episodes, rng)


def shipped_models(cfg: DictConfig) -> list[str]:
    """Names of models of the system, or its variants, that come with the package."""
    fitting = [cfg.system, re.sub(r"^swimmer\d+$", "swimmerN", cfg.system)]
    if cfg.variants:
        fitting = [f"identified_{cfg.system}"]
    return [name for name in fitting if name in pretrained_names()]


def bind_model(cfg: DictConfig, scene: Scene):
    """The trained model, bound to the scene, and the inference model if it has one."""
    names = shipped_models(cfg)
    if cfg.checkpoint is None and not names:
        what = f"variants of {cfg.system!r}" if cfg.variants else repr(cfg.system)
        raise ValueError(f"No trained model of {what} comes with the package; give checkpoint=PATH.")
    checkpoint = load_model(cfg.checkpoint or names[0])
    if isinstance(checkpoint.trained, IdentifyingModel):
        bound, inference = checkpoint.trained.bind(scene)
        return made_quick(bound, cfg.compile), inference
    if cfg.variants and not checkpoint.config.get("parametrized"):
        raise ValueError("The model was trained on one system, not on variants: give checkpoint=PATH of one that was.")
    bound = checkpoint.model.bind(scene, parameters_key="parameters" if cfg.variants else None)
    return made_quick(bound, cfg.compile), None


def made_quick(bound: Predictor, compile: bool) -> Predictor:
    """The model specialised, or as it is where it has a core that cannot be."""
    try:
        return specialize(bound, compile=compile)
    except TypeError:
        core = bound.model.options["core"]
        print(f"Planning through the bound model, more slowly: core={core} can be neither specialised nor compiled.")
        return bound


def draw_targets(cfg: DictConfig, reward: Reward, scene: Scene, state: Tensor) -> Tensor | None:
    """Where every episode should get to: a place for a swimmer's head, a random pose for an arm."""
    if reward.target_shape is None:
        return None
    rng, count = np.random.default_rng(np.random.SeedSequence(cfg.seed, spawn_key=(1,))), len(state)
    if reward.target_shape == (3,):
        angle = torch.from_numpy(rng.uniform(-np.pi, np.pi, count))
        way = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=-1)
        return state[:, 1, :3] + cfg.target_distance * way
    return Simulator(scene).observe(sample_start_states(scene, count, rng))


def make_planner(
    name: str, cfg: DictConfig, env: SceneEnv, imagined: ModelEnv | None, played: int
) -> TensorDictModuleBase:
    """The planner of a name, to go on after so many steps; whatever it draws, it does not draw again."""
    seed = cfg.seed + 1_000_000 * played
    torch.manual_seed(seed)  # what TorchRL's planners draw from
    if name in ("random", "nothing"):
        return RandomControl(env.scene, cfg.episodes, cfg.steps, cfg.seed + 2, float(name == "random"), step=played)
    if name == "ilqg":
        return ILQGPlanner(env, cfg.horizon, seed=seed, **cfg.ilqg)
    if name == "gn":
        assert imagined is not None
        more = {key: value for key, value in cfg.gn.items() if key != "lr"}
        optimizer = partial(torch.optim.Adam, lr=cfg.gn.lr)
        return GradientPlanner(imagined, cfg.horizon, optimizer=optimizer, seed=seed, **more)
    where = env if name.endswith("_true") else imagined
    assert where is not None
    kind = name.removesuffix("_true")
    chosen = cfg[kind]
    check_count(f"{kind}.iterations", chosen.iterations, 1)
    check_count(f"{kind}.top_k", chosen.top_k, 2)  # of which the spread is taken
    check_count(f"{kind}.candidates", chosen.candidates, chosen.top_k)
    sizes = {"optim_steps": chosen.iterations, "num_candidates": chosen.candidates, "top_k": chosen.top_k}
    if name.startswith("cem"):
        return CEMPlanner(where, planning_horizon=cfg.horizon, **sizes)
    return MPPIPlanner(where, ReturnToGo(), chosen.temperature, planning_horizon=cfg.horizon, **sizes)


def begin(cfg: DictConfig, env: SceneEnv, bound, inference) -> TensorDictBase:
    """Start states with what the model reads of each system: true parameters, or what random controls showed of it."""
    now = env.reset(TensorDict(batch_size=[cfg.episodes])).exclude("done", "terminated")
    if inference is not None:
        controls = torch.from_numpy(spline_controls(env.scene, cfg.episodes, cfg.context_length, cfg.seed + 1))
        simulated = env.simulator.rollout(now["physics"], controls)  # its scenes in turn, as reset has them
        unstable = int((~simulated["stable"]).sum())
        if unstable:
            raise UnstableSimulationError(
                f"{unstable} of {cfg.episodes} simulations became unstable under the {cfg.context_length} random"
                " controls that a system is identified from; try another seed, or a smaller context_length."
            )
        now.update({key: simulated[key][:, -1] for key in ("state", "physics")})
        with torch.no_grad():
            now["parameters"] = inference.identify(simulated["state"], controls)
    elif bound is not None and bound.parameters_key is not None:
        now["parameters"] = torch.stack([bound.parameters_of(scene) for scene in env.scenes])
    return now


def play(cfg: DictConfig, name: str, policy, env: SceneEnv, imagined: ModelEnv | None, played: Episodes) -> None:
    """Play to the end, or to Ctrl-C; what was played is saved either way."""
    last = time.monotonic()
    try:
        with torch.no_grad(), tqdm(total=cfg.steps, initial=len(played), desc=name, unit="step", leave=False) as bar:
            while len(played) < cfg.steps:
                started = time.perf_counter()
                now = policy(played.now.copy())
                seconds = time.perf_counter() - started
                if name in ("gn", "ilqg"):
                    played.records["planned"].append(planned_state(env, imagined if name == "gn" else None, now))
                stepped = env.step(now)
                played.now = stepped.exclude("next", "action", "done", "terminated")
                played.now.update(stepped["next"].exclude("reward", "done", "terminated"))
                # Such a simulation goes on from its last good state, but only for the others to be stepped beside it.
                over = stepped["next", "terminated"].squeeze(-1) | played.over
                reward = stepped["next", "reward"].squeeze(-1).masked_fill(over, torch.nan)
                state = played.now["state"].masked_fill(over[:, None, None], torch.nan)
                for key, value in (("state", state), ("action", now["action"]), ("reward", reward)):
                    played.records[key].append(value)
                played.records["seconds"].append(torch.tensor(seconds))
                bar.set_postfix(reward=f"{float(reward.nanmean()):.3g}", refresh=False)
                bar.update()
                if time.monotonic() - last > SAVE_SECONDS:
                    played.save()
                    last = time.monotonic()
    finally:
        played.save()


def planned_state(env: SceneEnv, imagined: ModelEnv | None, now: TensorDictBase) -> Tensor:
    """The last state of the first episode's plan, imagined or, without a model, simulated."""
    left = cast(Tensor, now["plan", "actions"])
    left = left if left.ndim == 3 else left[:, 0]  # of candidates the best
    actions = torch.cat((now["action"].unsqueeze(1), left[:, :-1]), dim=1)
    if imagined is None:
        ahead = env.simulator.rollout(now["physics"][:1], actions[:1])
        return ahead["state"][0, -1].where(ahead["stable"][0], torch.nan)
    # As many rows as the planner has: a compiled model is compiled for every number of them.
    rows = cast(Tensor, now["plan", "actions"]).shape[1]
    many = cast(TensorDictBase, now.repeat_interleave(rows, 0))
    return imagined.imagine(many, actions.repeat_interleave(rows, 0))[0][0, -1].detach()


def distance_left(played: Episodes, target: Tensor) -> Tensor:
    """Share ``[B]`` of a swimmer's way to its target that is left at the end."""
    away = (played["state"][:, [0, -1], 1, :2] - target[:, None, :2]).norm(dim=-1)
    return away[:, 1] / away[:, 0]


def summarize(cfg: DictConfig, played: Episodes, target: Tensor | None) -> dict[str, float]:
    """Numbers of a planner's episodes; ``target`` of those that have a place to get to."""
    rewards, seconds = played["reward"], played["seconds"]
    of = {
        "mean_reward": rewards.nanmean().item(),
        "mean_reward_std": spread(rewards.nanmean(1)),
        "last_tenth_reward": rewards[:, -max(1, cfg.steps // 10) :].nanmean().item(),
        "unstable": played.over.sum().item(),
        "planning_ms": 1e3 * seconds.median().item(),
        "planning_ms_first": 1e3 * seconds[0].item(),
    }
    if target is not None:
        left = distance_left(played, target)
        of |= {"distance_left": left.nanmean().item(), "distance_left_std": spread(left)}
    return of


def spread(values: Tensor) -> float:
    """Standard deviation of those that are numbers."""
    return (values - values.nanmean()).square().nanmean().sqrt().item()


@with_help
@hydra.main(version_base=None, config_path="config", config_name="mpc")
@clean_exit
def main(cfg: DictConfig) -> None:
    fill_in(cfg)
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    scene, scenes = make_scenes(cfg)
    reward = make_reward(cfg.reward, scene)
    env = SceneEnv(scenes, reward, num_threads=cfg.simulation_threads, seed=cfg.seed)
    # Variants are identified first whoever plans, so that all planners have the same starts.
    needed = set(cfg.planner) & set(ON_MODEL) or cfg.checkpoint or (cfg.variants and shipped_models(cfg))
    bound, inference = bind_model(cfg, scene) if needed else (None, None)
    imagined = None if bound is None else ModelEnv(bound, reward)
    run = RunFolder(cfg.run_dir, "mpc")
    if (begun := run.path / CONFIG_FILE).exists():
        run.refuse_changes(cast(DictConfig, OmegaConf.load(begun)), cfg, free=MAY_CHANGE)
    run.write_config(OmegaConf.to_yaml(cfg))
    tracker = Tracker(cfg.logger, run.path / "log", name=f"mpc-{scene.name}-{cfg.reward}", config=cfg)
    start = begin(cfg, env, bound, inference)
    target = draw_targets(cfg, reward, scene, start["state"])
    if target is not None:
        start["target"] = target

    metrics: dict[str, Any] = {"horizon": cfg.horizon, "steps": cfg.steps, "episodes": cfg.episodes}
    rows = [["planner", "mean reward", "spread", "last tenth", "way left", "became unstable", "ms a step"]]
    curves: dict[str, Tensor] = {}
    for name in cfg.planner:
        played = Episodes(run.file(f"{name}.safetensors"), start.copy())
        if len(played) > cfg.steps:
            raise ValueError(f"{played.path} has {len(played)} steps, more than steps={cfg.steps}; name a new run_dir.")
        if not torch.allclose(played.records["state"][0], start["state"]):
            raise ValueError(f"{played.path} began in other states than the other planners do; name a new run_dir.")
        planner = make_planner(name, cfg, env, imagined, len(played))
        policy = planner if target is None else TensorDictSequential([FreezeGoal(reward), planner])
        play(cfg, name, policy, env, imagined, played)
        of = summarize(cfg, played, target if reward.target_shape == (3,) else None)
        metrics |= {f"{name}/{key}": value for key, value in of.items()}
        left_text = f"{100 * of['distance_left']:.0f} %" if "distance_left" in of else ""
        numbers = [f"{of[key]:.4g}" for key in ("mean_reward", "mean_reward_std", "last_tenth_reward")]
        ended = f"{of['unstable']} of {cfg.episodes} episodes" if of["unstable"] else ""
        rows.append([name, *numbers, left_text, ended, f"{of['planning_ms']:.0f}"])
        curves[name] = played["reward"]
        if cfg.video:
            film(played, scenes[0], cfg, run.file(f"{name}.gif"))
    plot_rewards(curves, run.file("rewards.png"), timestep=scene.timestep, ylabel=f"{cfg.reward} reward")
    tracker.finish(run.write_metrics(metrics, seed=cfg.seed), run.written, cfg.steps)
    columns = [column for column in zip(*rows, strict=True) if any(column[1:])]  # only where there is something to say
    rows, widths = list(zip(*columns, strict=True)), [max(map(len, column)) for column in columns]
    for row in rows:
        print("  ".join(map(str.ljust, row, widths)).rstrip())
    for path in run.written:
        print(path)


def film(played: Episodes, scene: Scene, cfg: DictConfig, path: Path) -> None:
    """Film the first episode beside the plan of a horizon ago."""
    states, planned = played["state"][0], played["planned"]
    states = states[states.isfinite().flatten(1).all(1)]  # until its simulation became unstable
    speed, prediction = min(1.0, scene.timestep / 0.01), None
    if len(played) == len(planned) and len(states) > cfg.horizon + 1:  # older runs kept no plans of ilqg
        prediction = torch.cat((states[: cfg.horizon], planned))[: len(states)]
    rollout_video(scene, states, prediction, path, speed=speed, labels=("played", "planned a horizon before"))


if __name__ == "__main__":
    main()

"""Control a system by planning, through the learned model or in MuJoCo.

    python recipes/mpc.py [system=pendulum] [reward=balance] [planner=gn] [key=value ...]
    python recipes/mpc.py system=cartpole "planner=[gn,ilqg,cem,random]"

Runs episodes in MuJoCo with the paper's horizons (SM "Planning configuration"), from the same start states for every
planner:

- gn: gradients through the learned model (paper, SM "MPC planner with learned models")
- sampling: sampled action sequences in the learned model (MPPI), among them a policy's with `policy=PATH`
- ilqr: iLQG through the learned model, linearised by its gradients
- cem, mppi: TorchRL's planners on the learned model
- ilqg: iLQG on MuJoCo (paper, SM "Baseline Mujoco-based planner")
- cem_true, mppi_true: TorchRL's planners on MuJoCo
- policy: the policy of `policy=PATH` alone, without exploration
- random, nothing: random controls, zero controls

Any other robot (`system=PATH`) needs a model (`checkpoint=PATH`) and a task: `horizon`, `steps`, and a `reward` as a
list of terms, such as `[{type: Velocity, body: torso, axis: x}, {type: Effort, weight: 0.1}]` (docs/planning.md).

`value=PATH` adds a learned value of the states in which plans end, so that planners see beyond the horizon.
`policy=PATH` starts plans from a learned policy. recipes/value.py and recipes/shac.py learn both.

With a checkpoint of an inference model, the recipe first identifies the system from random controls. `variants=true`
gives every episode its own random variant of the system; it needs a checkpoint trained on variants (the package has
some for pendulum and cheetah). The same `run_dir` continues the saved episodes, also with more steps or planners; with
more steps, random control begins anew.

If MuJoCo's simulation becomes unstable, the episode ends: its later states and rewards are NaN and enter no average,
and the table counts such episodes. With a recurrent model, only gn and sampling carry the hidden state; cem and mppi
start each plan without one, and ilqr refuses the model.

Writes config.yaml, metrics.json, every planner's episodes (<planner>.safetensors), rewards over time (rewards.png) and
a video of the first episode (<planner>.gif). For gn, sampling, ilqr and ilqg, the video also shows the states planned
one horizon earlier, if the episode is longer than the horizon. All options: recipes/config/mpc.yaml. Results:
docs/results/planning.md.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any, cast

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import CEMPlanner, MPPIPlanner
from tqdm import tqdm

from _common import clean_exit, finish_run, open_log, refuse_other_options, with_help
from _common.episodes import Episodes, film, planned_state, summarize
from _common.planning_task import (
    ON_MODEL,
    bind_model,
    draw_targets,
    fill_in,
    load_policy,
    load_terminal,
    make_scenes,
    reward_of,
    shipped_models,
    start_states,
)
from torchrl_gn.checks import check_count
from torchrl_gn.data import spline_controls
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.evaluation import plot_rewards
from torchrl_gn.interrupts import held, let_in_at_once
from torchrl_gn.planners import GradientPlanner, ILQGPlanner, ModelPlanner, PlanAhead, ReturnToGo, SamplingPlanner
from torchrl_gn.policies import BoundedPolicy
from torchrl_gn.rewards import FreezeGoal
from torchrl_gn.scenes import Scene
from torchrl_gn.training import RunFolder

SAVE_SECONDS = 60
# Options that may change when a run resumes.
MAY_CHANGE = ("planner", "steps", "executor", "goal", "threads", "simulation_threads", "video", "logger", "run_dir")


class RandomControl(TensorDictModuleBase):
    """The baseline without planning: smooth random controls times ``factor``, from ``step`` on."""

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

    def drew(self, actions: Tensor) -> bool:
        """Return True if the first actions ``[B, T, A]`` of episodes equal these controls."""
        return not len(actions) or torch.equal(actions, self.controls[:, : actions.shape[1]].float())


def make_planner(
    name: str, cfg: DictConfig, env: SceneEnv, imagined: ModelEnv | None, done: int, policy: BoundedPolicy | None = None
) -> TensorDictModuleBase:
    """Make a planner that continues after ``done`` steps; :func:`draw_anew` seeds it before every step."""
    proposing = {} if policy is None else {"proposal": policy, "propose_every_step": bool(cfg.policy_every_step)}
    if name in ("random", "nothing"):
        return RandomControl(env.scene, cfg.episodes, cfg.steps, cfg.seed + 2, float(name == "random"), step=done)
    if name == "policy":
        assert policy is not None
        return policy
    if name == "ilqg":
        return ILQGPlanner(env, cfg.horizon, **proposing, **cfg.ilqg)
    if name == "ilqr":
        assert imagined is not None
        return ILQGPlanner(imagined, cfg.horizon, **proposing, **cfg.ilqr)
    if name == "gn":
        assert imagined is not None
        more = proposing | {key: value for key, value in cfg.gn.items() if key != "lr"}
        optimizer = partial(torch.optim.Adam, lr=cfg.gn.lr)
        return GradientPlanner(imagined, cfg.horizon, optimizer=optimizer, **more)
    if name == "sampling":
        assert imagined is not None
        return SamplingPlanner(imagined, cfg.horizon, proposal=policy, **cfg.sampling)
    where = env if name.endswith("_true") else imagined
    assert where is not None
    kind = name.removesuffix("_true")
    chosen = cfg[kind]
    check_count(f"{kind}.iterations", chosen.iterations, 1)
    check_count(f"{kind}.top_k", chosen.top_k, 2)  # for their standard deviation
    check_count(f"{kind}.candidates", chosen.candidates, chosen.top_k)
    sizes = {"optim_steps": chosen.iterations, "num_candidates": chosen.candidates, "top_k": chosen.top_k}
    if name.startswith("cem"):
        return CEMPlanner(where, planning_horizon=cfg.horizon, **sizes)
    return MPPIPlanner(where, ReturnToGo(), chosen.temperature, planning_horizon=cfg.horizon, **sizes)


def draw_anew(planner: nn.Module, seed: int) -> None:
    """Seed a planner before a step, so that a resumed run draws the same random numbers."""
    torch.manual_seed(seed)  # for TorchRL's planners
    for module in planner.modules():
        if isinstance(module, (ModelPlanner, ILQGPlanner)):
            module.set_seed(seed)


def play_step(
    cfg: DictConfig, name: str, policy, env: SceneEnv, imagined: ModelEnv | None, episodes: Episodes
) -> tuple[TensorDictBase, dict[str, Tensor]]:
    """Plan and execute the next step; return the episodes' state after it, and the step's records."""
    started = time.perf_counter()
    now = policy(episodes.now.copy())
    step = {"action": now["action"], "seconds": torch.tensor(time.perf_counter() - started)}
    if name in ("gn", "sampling", "ilqr", "ilqg") and not cfg.delay:
        step["planned"] = planned_state(env, None if name == "ilqg" else imagined, now)
    stepped = env.step(now)
    after = stepped.exclude("next", "action", "done", "terminated")
    after.update(stepped["next"].exclude("reward", "done", "terminated"))
    # An unstable simulation stays at its last good state; NaN marks that its episode is over.
    over = stepped["next", "terminated"].squeeze(-1) | episodes.over
    step["reward"] = stepped["next", "reward"].squeeze(-1).masked_fill(over, torch.nan)
    step["state"] = after["state"].masked_fill(over[:, None, None], torch.nan)
    return after, step


def execute(cfg: DictConfig, name: str, policy, env: SceneEnv, imagined: ModelEnv | None, episodes: Episodes) -> None:
    """Run and save the episodes; Ctrl-C ends them after the last whole step."""
    last = time.monotonic()
    with (
        held(),
        torch.no_grad(),
        tqdm(total=cfg.steps, initial=len(episodes), desc=name, unit="step", leave=False) as bar,
    ):
        try:
            while len(episodes) < cfg.steps:
                with let_in_at_once():
                    draw_anew(policy, cfg.seed + 1_000_000 * len(episodes))
                    after, step = play_step(cfg, name, policy, env, imagined, episodes)
                episodes.record(after, step)
                bar.set_postfix(reward=f"{float(step['reward'].nanmean()):.3g}", refresh=False)
                bar.update()
                if time.monotonic() - last > SAVE_SECONDS:
                    episodes.save()
                    last = time.monotonic()
        finally:
            episodes.save()


@with_help
@hydra.main(version_base=None, config_path="config", config_name="mpc")
@clean_exit
def main(cfg: DictConfig) -> None:
    fill_in(cfg)
    check_count("delay", cfg.delay, 0)
    torch.manual_seed(cfg.seed)
    torch.set_num_threads(cfg.threads)
    scene, scenes = make_scenes(cfg)
    reward = reward_of(cfg, scene)
    env = SceneEnv(scenes, reward, num_threads=cfg.simulation_threads, seed=cfg.seed)
    # Identification moves the starts: identify variants whichever planners run, so that all have the same starts.
    needed = set(cfg.planner) & set(ON_MODEL) or cfg.checkpoint or (cfg.variants and shipped_models(cfg))
    bound, inference = bind_model(cfg, scene) if needed else (None, None)
    value, proposal = load_terminal(cfg, reward, scene), load_policy(cfg, scene)
    imagined = None if bound is None else ModelEnv(bound, reward, terminal=value)
    physics = env  # for planners on MuJoCo
    if value is not None:
        physics = SceneEnv(scenes, reward, terminal=value, num_threads=cfg.simulation_threads)
    run = RunFolder(cfg.run_dir, "mpc")
    refuse_other_options(cfg, run, MAY_CHANGE)
    task = cfg.reward if isinstance(cfg.reward, str) else "own"
    tracker = open_log(cfg, run, label=f"mpc-{scene.name}-{task}")
    start = start_states(cfg, env, bound, inference)
    target = draw_targets(cfg, reward, scene, start["state"])
    if target is not None:
        start["target"] = target

    metrics: dict[str, Any] = {"horizon": cfg.horizon, "steps": cfg.steps, "episodes": cfg.episodes}
    titles = ("mean reward", "std over episodes", "reward, last tenth", "distance left", "goal", "became unstable")
    rows = [["planner", *titles, "ms to plan a step"]]
    curves: dict[str, Tensor] = {}
    for name in cfg.planner:
        episodes = Episodes(run.file(f"{name}.safetensors"), start.copy())
        if len(episodes) > cfg.steps:
            raise ValueError(
                f"{episodes.path} has {len(episodes)} steps, more than steps={cfg.steps}; name a new run_dir."
            )
        if not torch.allclose(episodes.records["state"][0], start["state"]):
            raise ValueError(f"{episodes.path} began in other states than the other planners do; name a new run_dir.")
        planner = make_planner(name, cfg, physics, imagined, len(episodes), proposal)
        if isinstance(planner, RandomControl) and not planner.drew(episodes["action"]):
            # Random controls of other steps=: begin anew, which takes no planning, as an uninterrupted run would.
            episodes.path.unlink()
            episodes, planner.step = Episodes(episodes.path, start.copy()), 0
        if cfg.delay and not isinstance(planner, (RandomControl, BoundedPolicy)):
            planner = PlanAhead(cast(Any, planner), cfg.delay)
        policy = planner if target is None else TensorDictSequential([FreezeGoal(reward), planner])
        execute(cfg, name, policy, env, imagined, episodes)
        summary = summarize(episodes, target if reward.target_shape == (3,) else None, cfg.goal)
        metrics |= {f"{name}/{key}": value for key, value in summary.items()}
        left_text = f"{100 * summary['distance_left']:.0f} %" if "distance_left" in summary else ""
        numbers = [f"{summary[key]:.4g}" for key in ("mean_reward", "mean_reward_std", "last_tenth_reward")]
        goal_text = f"reached by {summary['reached']}, held by {summary['held']}" if "reached" in summary else ""
        ended = f"{summary['unstable']} of {cfg.episodes} episodes" if summary["unstable"] else ""
        rows.append([name, *numbers, left_text, goal_text, ended, f"{summary['planning_ms']:.0f}"])
        curves[name] = episodes["reward"]
        if cfg.video:
            film(episodes, scenes[0], cfg.horizon, run.file(f"{name}.gif"))
    plot_rewards(curves, run.file("rewards.png"), timestep=scene.timestep, ylabel=f"{task} reward")
    columns = [column for column in zip(*rows, strict=True) if any(column[1:])]  # drop empty ones
    rows, widths = list(zip(*columns, strict=True)), [max(map(len, column)) for column in columns]
    print(f"{scene.name}, {task}: rewards of a step, over {cfg.episodes} episodes. Higher is better.")
    for row in rows:
        print("  ".join(map(str.ljust, row, widths)).rstrip())
    finish_run(cfg, run, tracker, metrics, step=cfg.steps)


if __name__ == "__main__":
    main()

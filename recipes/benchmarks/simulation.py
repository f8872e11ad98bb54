"""Measure the throughput of simulation: ours against a Python loop over TorchRL's DMControlEnv.

    python recipes/benchmarks/simulation.py [system=swimmer6] [repeats=5] [steps=200]

Times random controls on the same system, in turn and several times: the batched simulation (`Simulator`), `SceneEnv`
with one state and with many, and TorchRL's `DMControlEnv` with the scene's own control step (the same work) and with
the suite's (Swimmer: 30 ms against 20 ms, so less Python per physics step). Rates are simulated seconds per second.
`DMControlEnv` also computes observations and the suite's reward, `Simulator` and `SceneEnv` all body states; nothing is
rendered. No figure of the paper. Takes about half a minute. Results: docs/results/simulation-throughput.md.

Writes config.yaml and metrics.json to its run folder.
"""

from __future__ import annotations

import os
import re
import statistics
import sys
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "off")  # nothing is rendered; dm_control would look for a display

import hydra
import torch
from dm_control.rl import control
from omegaconf import DictConfig
from tensordict import TensorDict
from torchrl.envs import DMControlEnv, DMControlWrapper

sys.path.append(str(Path(__file__).parents[1]))  # where _common is

from _common import clean_exit, finish_run, open_run, with_help
from _timing import time_in_turn
from torchrl_gn.data import Simulator, sample_start_states, spline_controls
from torchrl_gn.envs import SceneEnv
from torchrl_gn.scenes import Scene, load_scene

SUITE_TASKS = {
    "pendulum": ("pendulum", "swingup"),
    "cartpole": ("cartpole", "balance"),
    "acrobot": ("acrobot", "swingup"),
    "cheetah": ("cheetah", "run"),
    "swimmer6": ("swimmer", "swimmer6"),
    "swimmer15": ("swimmer", "swimmer15"),
}
EPISODE = 1000  # control steps of a suite task's episode


def make_methods(cfg: DictConfig, scene: Scene) -> dict[str, tuple[Callable[[], object], int, float]]:
    """Return methods by name: the call to time, its control steps, and physics steps per control step."""
    simulator = Simulator(scene, num_threads=cfg.num_threads)
    physics = torch.as_tensor(sample_start_states(scene, cfg.rollouts, cfg.seed))
    controls = torch.as_tensor(spline_controls(scene, cfg.rollouts, cfg.steps, cfg.seed))
    env = SceneEnv(scene, num_threads=cfg.num_threads, seed=cfg.seed)
    batch_steps = max(1, cfg.steps // 4)
    domain, task = SUITE_TASKS[scene.name]
    suite_env = DMControlEnv(domain, task, _seed=cfg.seed)
    suite_substeps = round(suite_env.control_timestep() / suite_env.physics.timestep())
    same_step = control.Environment(suite_env.physics, suite_env.task, control_timestep=scene.timestep)
    baseline = DMControlWrapper(same_step)
    return {
        f"Simulator, {cfg.rollouts} rollouts": (
            lambda: simulator.rollout(physics, controls),
            cfg.rollouts * cfg.steps,
            scene.substeps,
        ),
        f"SceneEnv, batch {cfg.batch}": (
            lambda: env.rollout(batch_steps, tensordict=TensorDict(batch_size=[cfg.batch])),
            cfg.batch * batch_steps,
            scene.substeps,
        ),
        "SceneEnv, one state": (lambda: env.rollout(cfg.steps), cfg.steps, scene.substeps),
        "DMControlEnv, suite's step": (lambda: suite_env.rollout(cfg.steps), cfg.steps, suite_substeps),
        "DMControlEnv, same step": (lambda: baseline.rollout(cfg.steps), cfg.steps, scene.substeps),
    }


@with_help
@hydra.main(config_path="config", config_name="simulation", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    if cfg.system not in SUITE_TASKS:
        raise ValueError(f"system={cfg.system} has no task in the suite; there are: {', '.join(SUITE_TASKS)}")
    if cfg.steps > EPISODE:
        raise ValueError(
            f"steps={cfg.steps}: an episode of the suite has {EPISODE} control steps, and no more are timed."
        )
    scene = load_scene(cfg.system)
    run, tracker = open_run(cfg, "benchmarks/simulation")
    torch.manual_seed(cfg.seed)
    methods = make_methods(cfg, scene)
    seconds = time_in_turn({name: run for name, (run, *_) in methods.items()}, cfg.repeats)

    metrics: dict[str, float | int] = {"cpu_count": os.cpu_count() or 0}
    baseline = None
    rows = []
    for name, (_, steps, substeps) in reversed(methods.items()):
        median = statistics.median(seconds[name])
        physics_rate = steps * substeps / median
        baseline = baseline or physics_rate
        simulated = physics_rate * scene.model.opt.timestep
        rows.append((name, steps / median, physics_rate, simulated, physics_rate / baseline))
        key = re.sub(r"\W+", "_", name.lower()).strip("_")
        metrics[f"{key}_control_steps_per_second"] = steps / median
        metrics[f"{key}_physics_steps_per_second"] = physics_rate
        metrics[f"{key}_simulated_seconds_per_second"] = simulated
        metrics[f"{key}_speedup"] = physics_rate / baseline
        metrics[f"{key}_range"] = (max(seconds[name]) - min(seconds[name])) / median

    print(
        f"{scene.name}, {metrics['cpu_count']} cores: steps a second, medians of {cfg.repeats} repeats in turn. Higher"
        " is better; speed-up: physics steps over those of the last row."
    )
    print(f"{'':28}{'control steps/s':>16}{'physics steps/s':>16}{'simulated s/s':>15}{'speed-up':>10}")
    for name, control_rate, physics_rate, simulated, speedup in reversed(rows):
        print(f"{name:28}{control_rate:16,.0f}{physics_rate:16,.0f}{simulated:15,.1f}{speedup:9.1f}x")
    finish_run(cfg, run, tracker, metrics)


if __name__ == "__main__":
    main()

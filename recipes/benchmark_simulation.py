"""Throughput of the true physics: ours against a Python loop over TorchRL's DMControlEnv.

    python recipes/benchmark_simulation.py [system=swimmer6] [repeats=5] [steps=200]

Measures, in turn and several times, random controls on the same system: the batched
simulation (`Simulator`), `SceneEnv` with one state and with many, and TorchRL's
`DMControlEnv` in two settings: with the scene's own control step (the suite's task with the
paper's step, so the same work) and with the suite's (Swimmer: 30 ms against 20 ms, so less
Python per physics step). Rates are compared in simulated seconds per second. `DMControlEnv`
also computes observations and the suite's reward, `Simulator` and `SceneEnv` all body
states; nothing is rendered. Takes about half a minute; results: docs/results.md.

Writes config.yaml and metrics.json to its run folder.
"""

from __future__ import annotations

import os
import re
import statistics
import time
from collections.abc import Callable

os.environ.setdefault("MUJOCO_GL", "off")  # nothing is rendered; dm_control would look for a display

import hydra
import torch
from dm_control.rl import control
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torchrl.envs import DMControlEnv, DMControlWrapper

from torchrl_gn.data import Simulator, sample_start_states, spline_controls
from torchrl_gn.envs import SceneEnv
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.training import RunFolder, Tracker, clean_exit, with_help

RIVAL = "DMControlEnv, same step"
SUITE_TASKS = {
    "pendulum": ("pendulum", "swingup"),
    "cartpole": ("cartpole", "balance"),
    "acrobot": ("acrobot", "swingup"),
    "cheetah": ("cheetah", "run"),
    "swimmer6": ("swimmer", "swimmer6"),
    "swimmer15": ("swimmer", "swimmer15"),
}


def make_contestants(cfg: DictConfig, scene: Scene) -> dict[str, tuple[Callable[[], object], int, float]]:
    """Every contestant: what to time, control steps in it, physics steps in a control step."""
    simulator = Simulator(scene, num_threads=cfg.num_threads)
    physics = torch.as_tensor(sample_start_states(scene, cfg.rollouts, cfg.seed))
    controls = torch.as_tensor(spline_controls(scene, cfg.rollouts, cfg.steps, cfg.seed))
    env = SceneEnv(scene, num_threads=cfg.num_threads, seed=cfg.seed)
    batch_steps = max(1, cfg.steps // 4)
    domain, task = SUITE_TASKS[scene.name]
    suite_env = DMControlEnv(domain, task, _seed=cfg.seed)
    suite_substeps = round(suite_env.control_timestep() / suite_env.physics.timestep())
    same_step = control.Environment(suite_env.physics, suite_env.task, control_timestep=scene.timestep)
    rival = DMControlWrapper(same_step)
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
        RIVAL: (lambda: rival.rollout(cfg.steps), cfg.steps, scene.substeps),
    }


def measure(contestants: dict, repeats: int) -> dict[str, list[float]]:
    """Seconds of every repeat; each contestant once per round, after one round to warm up."""
    seconds = {name: [] for name in contestants}
    for turn in range(repeats + 1):
        for name, (run, *_) in contestants.items():
            start = time.perf_counter()
            run()
            if turn > 0:
                seconds[name].append(time.perf_counter() - start)
    return seconds


@with_help
@hydra.main(config_path="config", config_name="benchmark_simulation", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    if cfg.system not in SUITE_TASKS:
        raise ValueError(f"system={cfg.system} has no task in the suite; there are: {', '.join(SUITE_TASKS)}")
    scene = load_scene(cfg.system)
    run = RunFolder(cfg.run_dir, "benchmark_simulation")
    run.write_config(OmegaConf.to_yaml(cfg, resolve=True))
    tracker = Tracker(cfg.logger, run.path / "log", name="benchmark_simulation", config=cfg)
    torch.manual_seed(cfg.seed)
    contestants = make_contestants(cfg, scene)
    seconds = measure(contestants, cfg.repeats)

    metrics: dict[str, float | int] = {"cpu_count": os.cpu_count() or 0}
    rival = None
    rows = []
    for name, (_, steps, substeps) in reversed(contestants.items()):
        median = statistics.median(seconds[name])
        physics_rate = steps * substeps / median
        rival = rival or physics_rate
        simulated = physics_rate * scene.model.opt.timestep
        rows.append((name, steps / median, physics_rate, simulated, physics_rate / rival))
        key = re.sub(r"\W+", "_", name.lower()).strip("_")
        metrics[f"{key}_control_steps_per_second"] = steps / median
        metrics[f"{key}_physics_steps_per_second"] = physics_rate
        metrics[f"{key}_simulated_seconds_per_second"] = simulated
        metrics[f"{key}_speedup"] = physics_rate / rival
        metrics[f"{key}_spread"] = (max(seconds[name]) - min(seconds[name])) / median
    tracker.finish(run.write_metrics(metrics, seed=cfg.seed), run.written)

    print(f"{scene.name}, {cfg.repeats} repeats in turn, medians, {metrics['cpu_count']} cores")
    print(f"{'':28}{'control steps/s':>16}{'physics steps/s':>16}{'simulated s/s':>15}{'speed-up':>10}")
    for name, control_rate, physics_rate, simulated, speedup in reversed(rows):
        print(f"{name:28}{control_rate:16,.0f}{physics_rate:16,.0f}{simulated:15,.1f}{speedup:9.1f}x")
    for path in run.written:
        print(path)


if __name__ == "__main__":
    main()

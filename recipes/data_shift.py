"""Measure the errors of models trained on random control, on a swimmer that swims on purpose.

    python recipes/data_shift.py [system=swimmer6] [minutes=4] [seeds=[0]] [run_dir=PATH]
    python recipes/data_shift.py policy=runs/ddpg/<time>

Reproduces the paper's Figure "Swimmer6 prediction errors ... for data in the training set, in the validation set, and
data from DDPG agent trajectories". In MuJoCo, the swimmer follows a learned policy (of recipes/ddpg.py or svg.py, to
random targets), or variations of a gait: waves of control along the body, found by the cross-entropy method. Trains a
graph network and an MLP for equal time, on random trajectories and on a mixture, half random and half swimming.
Compares them on random trajectories of the training data, on new random trajectories, and on new swimming trajectories.
The same `run_dir` keeps finished runs and resumes. Results: docs/results/data-shift.md.

Writes config.yaml, metrics.json, the table as table.md, bars of the errors as errors.png, a video of the swimmer as
swimming.gif, and each run with its log to its run folder.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from statistics import mean

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from _common import as_list, clean_exit, open_log, refuse_other_options, with_help
from _common.sweeps import FORWARD_MODEL, Run, mean_and_half_range, refuse_changes, report_sweep, run_all
from torchrl_gn.data import Simulator, UnstableSimulationError, create_dataset, sample_start_states, save_tensors
from torchrl_gn.envs import SceneEnv
from torchrl_gn.evaluation import evaluate_errors, rollout_video
from torchrl_gn.policies import Agent, SwimmerObservation
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.training import RunFolder, load_pretrained

ERRORS = {"one_step_error": "one step", "rollout_error_20": "20 steps", "rollout_error_100": "100 steps"}
LOW, HIGH = np.array([0.1, 0.2, -np.pi]), np.array([1.0, 2.0, np.pi])  # of a wave: height, Hz, lag from joint to joint
# Options that may change when a run resumes. Any other would change the data under finished trainings.
MAY_CHANGE = ("minutes", "seeds", "sequences", "jobs", "threads", "data_dir", "logger", "run_dir")


def make_runs(cfg: DictConfig, folder: Path, swimming: Path) -> dict[tuple[str, str], list[Run]]:
    """Return the trainings of each network on each kind of data, one for each seed."""
    runs = {}
    networks = {"GN": [], "MLP": ["model.core=mlp", *as_list(cfg.mlp)]}
    data = {"random": [], "mixture": [f"data.extra={swimming}"]}
    for network, trained_on in itertools.product(networks, data):
        place = folder / f"{network}_{trained_on}"
        minutes = ("steps=null", f"minutes={cfg.minutes}", f"clock={cfg.clock}")
        options = (f"system={cfg.system}", *minutes, f"threads={cfg.threads}")
        options += (*(f"data.{name}={size}" for name, size in cfg.random.items()), f"data.length={cfg.length}")
        options += (f"data.folder={cfg.data_dir}", *as_list(cfg.overrides), *networks[network], *data[trained_on])
        runs[network, trained_on] = [
            Run(FORWARD_MODEL, place / f"seed{seed}", (*options, f"seed={seed}"), f"{network} on {trained_on} data")
            for seed in as_list(cfg.seeds)
        ]
    return runs


def waves(scene: Scene, gaits: np.ndarray, steps: int, phase: np.ndarray) -> np.ndarray:
    """Return controls ``[n, T, A]`` of gaits ``[n, 3]`` (height as share of the bounds, Hz, lag) and phases ``[n]``."""
    time = np.arange(steps) * scene.timestep
    height, frequency, lag = (column[:, None, None] for column in gaits.T)
    angle = 2 * np.pi * frequency * time[None, :, None] - lag * np.arange(scene.num_actions) + phase[:, None, None]
    middle, half = (scene.action_high + scene.action_low) / 2, (scene.action_high - scene.action_low) / 2
    return middle + half * height * np.sin(angle)


def distance(states: torch.Tensor) -> np.ndarray:
    """Return the distance ``[n]`` in metres that the mean position of the bodies covers."""
    middle = states[:, :, 1:, :3].mean(2)
    return (middle[:, -1] - middle[:, 0]).norm(dim=-1).numpy()


def find_gait(scene: Scene, cfg: DictConfig, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Find the gait ``[3]`` that swims farthest, by the cross-entropy method; return it and its distance in metres."""
    simulator, center, std = Simulator(scene), (LOW + HIGH) / 2, (HIGH - LOW) / 2
    for _ in tqdm(range(cfg.search.generations), desc="looking for a gait", leave=False):
        gaits = np.clip(rng.normal(center, std, (cfg.search.population, 3)), LOW, HIGH)
        # Several starts for every gait, so that none wins by luck.
        every = np.repeat(gaits, cfg.search.starts, axis=0)
        starts = np.tile(sample_start_states(scene, cfg.search.starts, rng), (len(gaits), 1))
        actions = waves(scene, every, cfg.search.steps, np.zeros(len(every)))
        swum = simulator.rollout(starts, actions)
        far = np.where(swum["stable"], distance(swum["state"]), 0.0)  # an unstable swimmer gets nowhere
        far = far.reshape(len(gaits), -1).mean(1)
        elite = gaits[np.argsort(-far)[: max(2, len(gaits) // 8)]]
        center, std = elite.mean(0), elite.std(0) + 1e-3
    return center, float(np.sort(far)[::-1][: len(elite)].mean())


def swim(scene: Scene, gait: np.ndarray, count: int, steps: int, rng: np.random.Generator) -> TensorDict:
    """Simulate ``count`` trajectories of variations of a gait, after a run-up."""
    gaits = np.clip(gait * rng.uniform(0.8, 1.2, (count, 3)), LOW, HIGH)
    gaits[:, 2] *= rng.choice([-1, 1], count)  # in either direction
    going = 100
    actions = waves(scene, gaits, going + steps, rng.uniform(0, 2 * np.pi, count))
    half = (scene.action_high - scene.action_low) / 2
    actions = np.clip(actions + 0.1 * half * rng.normal(size=actions.shape), scene.action_low, scene.action_high)
    found = Simulator(scene).rollout(sample_start_states(scene, count, rng), actions)
    if unstable := int((~found["stable"]).sum()):
        raise UnstableSimulationError(f"{unstable} of {count} swimmers became unstable; try another seed.")
    action = torch.from_numpy(actions[:, going:])
    return TensorDict({"state": found["state"][:, going:].clone(), "action": action}, [count])


def swim_by_policy(scene: Scene, agent: Agent, hold: int, count: int, steps: int, seed: int) -> TensorDict:
    """Simulate ``count`` trajectories under a learned policy, each to its own target, after a run-up.

    Each action is held for ``hold`` control steps, as in the policy's training.
    """
    env, going = SceneEnv(scene, seed=seed), 100
    policy = TensorDictSequential([SwimmerObservation(scene), agent.policy])
    generator = torch.Generator().manual_seed(seed)
    now = env.reset(TensorDict(batch_size=[count]))
    targets = 4 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 2  # as in the suite, metres
    now["target"] = torch.cat((targets, torch.full((count, 1), 0.05, dtype=torch.float64)), dim=1)
    states, actions = [], []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for step in tqdm(range(going + steps + 1), desc="swimming", leave=False):
            states.append(now["state"])
            if step % hold == 0:
                now = policy(now)
            actions.append(now["action"].double())
            now.update(env.step(now)["next"].select("state", "physics", "terminated"))
            if unstable := int(now["terminated"].sum()):
                raise UnstableSimulationError(f"{unstable} of {count} swimmers became unstable; try another seed.")
    tensors = {"state": torch.stack(states[going:], 1), "action": torch.stack(actions[going:-1], 1)}
    return TensorDict(tensors, [count])


def table(results: dict[tuple[str, str], dict[str, dict[str, list[float]]]]) -> list[str]:
    """Return tables of mean errors by network, training and test data, with ratios to the error on training data."""
    tests = list(next(iter(results.values())))
    lines = []
    for key, title in ERRORS.items():
        corner = f"error, {title} (over the first column's); lower is better"
        lines += [f"| {corner} | " + " | ".join(tests) + " |", "|---" * (len(tests) + 1) + "|"]
        for (network, trained_on), errors in results.items():
            base = mean(errors[tests[0]][key])
            cells = [f"{mean(errors[test][key]):.1e} ({mean(errors[test][key]) / base:.2g})" for test in tests]
            lines.append(f"| {network}, {trained_on} | " + " | ".join(cells) + " |")
        lines.append("")
    return lines[:-1]


@with_help
@hydra.main(config_path="config", config_name="data_shift", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    folder = RunFolder(cfg.run_dir, "data_shift")
    if cfg.data_dir is None:
        cfg.data_dir = str(folder.data)
    refuse_other_options(cfg, folder, MAY_CHANGE)
    place = folder.path / "swimming"
    runs = make_runs(cfg, folder.path, place)
    refuse_changes(run for group in runs.values() for run in group)
    tracker = open_log(cfg, folder)
    scene, rng = load_scene(cfg.system), np.random.default_rng(cfg.seed)
    metrics: dict[str, float | int] = {}
    if cfg.policy is not None:
        loaded, sizes = load_pretrained(cfg.policy), cfg.swimming
        agent = loaded.agent  # raises if the checkpoint holds no agent
        hold = max(1, round(loaded.config["task"]["timestep"] / scene.timestep))
        swimming = {
            name: swim_by_policy(scene, agent, hold, sizes[name], cfg.length, cfg.seed + index)
            for index, name in enumerate(("train", "test"))
        }
    else:
        gait, far = find_gait(scene, cfg, rng)
        print(f"The best gaits swim {far:.2f} m in {cfg.search.steps * scene.timestep:g} s on average.")
        swimming = {name: swim(scene, gait, cfg.swimming[name], cfg.length, rng) for name in ("train", "test")}
        metrics["gait/distance"] = far
        metrics |= {f"gait/{name}": float(value) for name, value in zip(("height", "Hz", "lag"), gait, strict=True)}
    save_tensors(place, swimming["train"])
    state = swimming["test"]["state"][0]
    rollout_video(scene, state, state, folder.file("swimming.gif"))

    failed = run_all([run for group in runs.values() for run in group], cfg.jobs)
    sizes = [int(cfg.random[name]) for name in ("train", "validation", "test")]
    dataset = create_dataset(Path(cfg.data_dir) / scene.name, scene, *sizes, steps=cfg.length)
    count = cfg.sequences
    tests: dict[str, TensorDictBase] = {
        "random, trained on": dataset.train[:count],
        "random, new": dataset.test[:count],
        "swimming, new": swimming["test"][:count],
    }
    results: dict[tuple[str, str], dict[str, dict[str, list[float]]]] = {}
    done = [(key, run) for key, group in runs.items() for run in group if run.metrics is not None]
    for key, run in tqdm(done, desc="evaluating", leave=False):
        model = load_pretrained(run.folder).model.bind(scene)
        for test, trajectories in tests.items():
            errors = evaluate_errors(model, trajectories)
            for error in ERRORS:
                found = results.setdefault(key, {}).setdefault(test, {}).setdefault(error, [])
                found.append(errors[error].total)

    bars: dict[str, dict[str, dict[str, tuple[float, float]]]] = {}
    for (network, trained_on), errors in results.items():
        for test, error in itertools.product(tests, ERRORS):
            found = errors[test][error]
            center, half_range = mean_and_half_range(found)
            metrics[f"{network}/{trained_on}/{test}/{error}"] = center
            metrics[f"{network}/{trained_on}/{test}/{error}/half_range"] = half_range
            if math.isfinite(center):
                panel = bars.setdefault(ERRORS[error], {})
                panel.setdefault(f"{network}, {trained_on}", {})[test] = (center, half_range)
    lines = table(results) if results else []
    report_sweep(folder, lines, bars, metrics, failed, tracker, seed=cfg.seed)


if __name__ == "__main__":
    main()

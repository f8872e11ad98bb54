"""Measure how fast a forward model adapts when a motor dies, weakens or slips, or the robot picks up a load.

    python recipes/adaptation.py [system=cheetah] [checkpoint=PATH] [key=value ...]
    python recipes/adaptation.py system=arm.xml "load={body: hand, masses: [0.5, 4]}" "faults=[{body: hand, mass: 2}]"

Simulates one fault after the other: commands that act as `gain * command + offset`, or a heavier body. Adaptation
learns from every control step after the fault. Prints the model's errors before the fault, after it without adaptation,
and after 0.5, 2 and 10 seconds of adaptation. With `load=`, the model reads physical parameters, and the mass of that
body is learned too; without a checkpoint, the recipe first trains such a model on variants of the scene, which the same
`run_dir` keeps. Beyond the paper.

Writes config.yaml, metrics.json and a figure of the gains over time (gains.png) to its run folder. All options:
recipes/config/adaptation.yaml. Results: docs/results/adaptation.md.
"""

from __future__ import annotations

import math
import statistics
import time
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor
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
from torchrl_gn.checks import check_count
from torchrl_gn.data import Simulator, collect_trajectories
from torchrl_gn.dynamics import Adaptation, AdaptedPredictor, ForwardModel, Predictor, RobotChange, specialize
from torchrl_gn.evaluation import evaluate_errors, plot_rewards
from torchrl_gn.scenes import Scene, with_factors
from torchrl_gn.training import RunFolder, fit, load_pretrained, plain_config, save_checkpoint

ERRORS = {"one step": "one_step_error", "20 steps": "rollout_error_20"}
OF_TRAINING = ("minutes", "train", "variants", "hidden", "load.masses")  # options without effect on a trained model
# Options that may change when a run adapts its model again.
MAY_CHANGE = ("faults", "seconds", "memory", "robots", "calibration", "test", "threads", "logger", "run_dir")


def learn(cfg: DictConfig, scene: Scene) -> ForwardModel:
    """Train a model that reads physical parameters, on variants with other masses of the load's body."""
    low, high = (math.log(each) for each in as_list(cfg.load.masses))
    factors = np.exp(np.random.default_rng(cfg.seed).uniform(low, high, cfg.variants))
    variants = [with_factors(scene, {"body_mass": [cfg.load.body]}, [factor]) for factor in factors]
    train, validation = (
        collect_trajectories(variants, count, cfg.length, seed=cfg.seed, split=split)
        for split, count in enumerate((cfg.train, max(1, cfg.train // 20)))
    )
    torch.manual_seed(cfg.seed)
    model = ForwardModel.for_scene(scene, hidden=cfg.hidden)
    fit(model.bind(scene, parameters_key="parameters"), train, minutes=cfg.minutes, validation=validation)
    return model


def faulty(scene: Scene, fault: dict[str, Any]) -> tuple[Scene, Tensor, Tensor]:
    """Return the scene after a fault, and the commands' gains and offsets ``[A]``.

    Raises:
        ValueError: if the fault names neither a command of the scene nor a body.
    """
    gain, offset = torch.ones(scene.num_actions).double(), torch.zeros(scene.num_actions).double()
    if "body" in fault:
        return with_factors(scene, {"body_mass": [fault["body"]]}, [fault["mass"]]), gain, offset
    if not (isinstance(which := fault.get("command"), int) and 0 <= which < scene.num_actions):
        raise ValueError(f"A fault has a command below {scene.num_actions}, or a body and its mass; got {fault}.")
    gain[which], offset[which] = fault.get("gain", 1.0), fault.get("offset", 0.0)
    return scene, gain, offset


def simulate(scene: Scene, fault: dict[str, Any], count: int, steps: int, seed: int) -> TensorDict:
    """Simulate ``count`` trajectories of random control after a fault; leave out those that become unstable."""
    commanded = collect_trajectories(scene, count, steps, seed=seed)
    changed, gain, offset = faulty(scene, fault)
    simulated = Simulator(changed).rollout(commanded["physics"][:, 0], gain * commanded["action"] + offset)
    found = TensorDict({"state": simulated["state"], "action": commanded["action"]}, [count])
    return found[simulated["stable"]]


def errors(model: AdaptedPredictor, trajectories: TensorDict) -> dict[str, float]:
    """Return errors relative to the persistence baseline."""
    table = evaluate_errors(model, trajectories, horizons=(20,))
    return {name: table.errors[key].total for name, key in ERRORS.items()}


def adapt(adaptation: Adaptation, stream: TensorDict, at: list[int]) -> tuple[dict[int, RobotChange], Tensor, float]:
    """Return the changes of robots ``[M]`` after steps ``at``, gains and amounts ``[T, M, A + K]``, and ms a step.

    Milliseconds are the median processor time of an update and of reading its change.
    """
    belief, read, lines, times = adaptation.start(len(stream)), {}, [], []
    for step in tqdm(range(stream["action"].shape[1]), desc="adapting", unit="step", leave=False):
        start = time.process_time()
        belief = adaptation.update(
            belief, stream["state"][:, step], stream["action"][:, step], stream["state"][:, step + 1]
        )
        change = adaptation.read(belief)
        times.append(time.process_time() - start)
        lines.append(torch.cat((change.gain, change.amount), -1))
        if step + 1 in at:
            read[step + 1] = change
    return read, torch.stack(lines), 1e3 * statistics.median(times)


def adapted(predictor: Predictor, change: RobotChange, robot: int, variants: list[Scene]) -> AdaptedPredictor:
    """Return the predictor adapted to one robot."""
    return AdaptedPredictor(predictor, RobotChange(*(part[robot] for part in change)), variants=variants)


@with_help
@hydra.main(version_base=None, config_path="config", config_name="adaptation")
@clean_exit
def main(cfg: DictConfig) -> None:
    for name in ("robots", "calibration", "test"):
        check_count(name, cfg[name], 1)
    torch.set_num_threads(cfg.threads)
    scene, seconds = load_system(cfg, cfg.system), [float(each) for each in as_list(cfg.seconds)]
    at = [max(1, round(each / scene.timestep)) for each in seconds]
    variants = [] if cfg.load is None else [with_factors(scene, {"body_mass": [cfg.load.body]}, [2.0])]
    trains = bool(variants) and cfg.checkpoint is None
    if not trains:
        checkpoint = load_pretrained(cfg.checkpoint or cfg.system)
        because = f"checkpoint={cfg.checkpoint}" if cfg.checkpoint else "a run without load="
        refuse_without_effect(cfg, Path(__file__), OF_TRAINING, because=because, trained=checkpoint.config)
        model = checkpoint.model
    run = RunFolder(cfg.run_dir, "adaptation")
    resumed = resumed_checkpoint(cfg, run, MAY_CHANGE)
    if resumed is not None:
        model = resumed.model
        say_trained(run)
    tracker = open_log(cfg, run, label=f"adaptation-{scene.name}")
    if trains and resumed is None:
        model = learn(cfg, scene)
        save_checkpoint(run.checkpoint, model, scene=scene, config=plain_config(cfg))
    predictor = specialize(model.bind(scene, parameters_key="parameters" if variants else None))
    # As long as the streams below: the model's errors on a robot that fell long ago differ from those at the start.
    unchanged = collect_trajectories(scene, cfg.calibration, max(at), seed=cfg.seed)
    adaptation = Adaptation(predictor, unchanged, variants=variants, memory=cfg.memory)
    still = AdaptedPredictor(predictor, variants=variants)
    before = errors(still, collect_trajectories(scene, cfg.test, cfg.length, seed=cfg.seed + 1))
    metrics = {f"unchanged/{name}": value for name, value in before.items()}
    print(
        f"{scene.name}: error of one step / over 20 steps, means over {cfg.robots} robots. Lower is better; 1: as bad"
        " as predicting that nothing moves."
    )
    titles = ("before the fault", "not adapted", *(f"after {each:g} s" for each in seconds))
    print(f"{'fault':30}" + "".join(f"{title:>22}" for title in titles))
    lines: dict[str, Tensor] = {}
    for number, fault in enumerate(as_list(cfg.faults)):
        label = ", ".join(f"{key} {value}" for key, value in fault.items())
        stream = simulate(scene, fault, cfg.robots, max(at), cfg.seed + 2 + number)
        test = simulate(scene, fault, cfg.test, cfg.length, cfg.seed + 1)
        changes, learned, _ = adapt(adaptation, stream, at)
        milliseconds = adapt(adaptation, stream[:1], [])[2]  # of one robot
        columns = {"without": errors(still, test)}
        for step, second in zip(at, seconds, strict=True):
            each = [errors(adapted(predictor, changes[step], robot, variants), test) for robot in range(len(stream))]
            columns[f"{second:g} s"] = {name: statistics.fmean(row[name] for row in each) for name in ERRORS}
        metrics |= {f"{label}/{at}/{name}": value for at, row in columns.items() for name, value in row.items()}
        metrics[f"{label}/milliseconds"] = milliseconds
        cells = [" / ".join(f"{value:.3g}" for value in row.values()) for row in (before, *columns.values())]
        tqdm.write(f"{label:30}" + "".join(f"{cell:>22}" for cell in cells))
        if "command" in fault:
            lines[label] = learned[:, :, fault["command"]].mT
        elif cfg.load is not None and fault["body"] == cfg.load.body:
            lines[label] = learned[:, :, -1].mT
    files = []
    if lines:
        files.append(run.file("gains.png"))
        plot_rewards(lines, files[0], timestep=scene.timestep, ylabel="gain of the command, or amount of the load")
    checkpoints = [run.checkpoint] if trains else []
    finish_run(cfg, run, tracker, metrics, files=files, checkpoints=checkpoints, step=max(at))


if __name__ == "__main__":
    main()

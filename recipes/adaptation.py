"""A motor dies, weakens or slips while a robot acts: how fast its forward model follows.

    python recipes/adaptation.py [system=cheetah] [checkpoint=PATH] [key=value ...]

Simulates robots whose commands act as `gain * command + offset` from some moment on, one fault after the other. Every
control step teaches CommandAdaptation. Prints the errors of the model before the fault and after it, without adaptation
and after 0.5, 2 and 10 seconds of it. Beyond the paper.

Writes config.yaml, metrics.json and a figure of the gains over time (gains.png) to its run folder. All options:
recipes/config/adaptation.yaml. Results: docs/results/adaptation.md.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from _common import as_list, clean_exit, finish_run, load_system, open_log, with_help
from torchrl_gn.data import Simulator, collect_trajectories
from torchrl_gn.dynamics import AdaptedPredictor, CommandAdaptation, Commands, Predictor, specialize
from torchrl_gn.evaluation import evaluate_errors, plot_rewards
from torchrl_gn.planners.plan import check_count
from torchrl_gn.scenes import Scene, with_factors
from torchrl_gn.training import RunFolder, load_pretrained

ERRORS = {"one step": "one_step_error", "20 steps": "rollout_error_20"}


def faulty(scene: Scene, fault: dict[str, Any]) -> tuple[Scene, Tensor, Tensor]:
    """The scene after a fault, and the gain and offset ``[A]`` of its commands.

    ValueError for a fault that is not known.
    """
    gain, offset = torch.ones(scene.num_actions).double(), torch.zeros(scene.num_actions).double()
    if "body" in fault:
        return with_factors(scene, {"body_mass": [fault["body"]]}, np.array([fault["mass"]])), gain, offset
    if not (isinstance(which := fault.get("command"), int) and 0 <= which < scene.num_actions):
        raise ValueError(f"A fault has a command below {scene.num_actions}, or a body and its mass; got {fault}.")
    gain[which], offset[which] = fault.get("gain", 1.0), fault.get("offset", 0.0)
    return scene, gain, offset


def simulate(scene: Scene, fault: dict[str, Any], count: int, steps: int, seed: int) -> TensorDict:
    """Trajectories ``[count]`` of random control after a fault; those that become unstable are left out."""
    given = collect_trajectories(scene, count, steps, seed=seed)
    changed, gain, offset = faulty(scene, fault)
    simulated = Simulator(changed).rollout(given["physics"][:, 0], gain * given["action"] + offset)
    found = TensorDict({"state": simulated["state"], "action": given["action"]}, [count])
    return found[simulated["stable"]]


def errors(model: Predictor | AdaptedPredictor, trajectories: TensorDict) -> dict[str, float]:
    """Errors relative to standing still."""
    table = evaluate_errors(model, trajectories, horizons=(20,))
    return {name: table.errors[key].total for name, key in ERRORS.items()}


def adapt(
    adaptation: CommandAdaptation, stream: TensorDict, at: list[int]
) -> tuple[dict[int, Commands], Tensor, float]:
    """Commands ``[M, A]`` after some of the steps, gains ``[T, M, A]`` over time, and milliseconds of an update."""
    belief, read, gains, start = adaptation.start(len(stream)), {}, [], time.process_time()
    for step in tqdm(range(stream["action"].shape[1]), desc="adapting", unit="step", leave=False):
        belief = adaptation.update(
            belief, stream["state"][:, step], stream["action"][:, step], stream["state"][:, step + 1]
        )
        commands = adaptation.read(belief)
        gains.append(commands.gain)
        if step + 1 in at:
            read[step + 1] = commands
    return read, torch.stack(gains), 1e3 * (time.process_time() - start) / len(gains)


@with_help
@hydra.main(version_base=None, config_path="config", config_name="adaptation")
@clean_exit
def main(cfg: DictConfig) -> None:
    for name in ("robots", "calibration", "test"):
        check_count(name, cfg[name], 1)
    torch.set_num_threads(cfg.threads)
    scene, seconds = load_system(cfg, cfg.system), [float(each) for each in as_list(cfg.seconds)]
    at = [max(1, round(each / scene.timestep)) for each in seconds]
    run = RunFolder(cfg.run_dir, "adaptation")
    tracker = open_log(cfg, run, label=f"adaptation-{scene.name}")
    predictor = specialize(load_pretrained(cfg.checkpoint or cfg.system).model.bind(scene))
    # As long as what is remembered: a robot that fell an hour ago errs otherwise than one that has just begun.
    unchanged = collect_trajectories(scene, cfg.calibration, max(at), seed=cfg.seed)
    adaptation = CommandAdaptation(predictor, unchanged, memory=cfg.memory)
    before = errors(predictor, collect_trajectories(scene, cfg.test, cfg.length, seed=cfg.seed + 1))
    metrics = {f"unchanged/{name}": value for name, value in before.items()}
    print(f"{scene.name}, {cfg.robots} robots; errors relative to standing still, of one step / over 20 steps")
    print(f"{'fault':30}{'before it':>22}{'without':>22}" + "".join(f"{f'{each:g} s':>22}" for each in seconds))
    lines: dict[str, Tensor] = {}
    for number, fault in enumerate(as_list(cfg.faults)):
        label = ", ".join(f"{key} {value}" for key, value in fault.items())
        stream = simulate(scene, fault, cfg.robots, max(at), cfg.seed + 2 + number)
        test = simulate(scene, fault, cfg.test, cfg.length, cfg.seed + 1)
        commands, gains, milliseconds = adapt(adaptation, stream, at)
        columns = {"without": errors(predictor, test)}
        for step, second in zip(at, seconds, strict=True):
            each = [
                errors(AdaptedPredictor(predictor, Commands(*(part[robot] for part in commands[step]))), test)
                for robot in range(len(stream))
            ]
            columns[f"{second:g} s"] = {name: statistics.fmean(of[name] for of in each) for name in ERRORS}
        metrics |= {f"{label}/{at}/{name}": value for at, of in columns.items() for name, value in of.items()}
        metrics[f"{label}/milliseconds"] = milliseconds
        cells = [" / ".join(f"{value:.3g}" for value in of.values()) for of in (before, *columns.values())]
        tqdm.write(f"{label:30}" + "".join(f"{cell:>22}" for cell in cells))
        if "command" in fault:
            lines[label] = gains[:, :, fault["command"]].mT
    files = []
    if lines:
        files.append(run.file("gains.png"))
        plot_rewards(lines, files[0], timestep=scene.timestep, ylabel="gain of the command")
    finish_run(cfg, run, tracker, metrics, files=files, step=max(at))


if __name__ == "__main__":
    main()

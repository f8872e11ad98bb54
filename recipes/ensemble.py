"""Train an ensemble of forward models, calibrate it, and measure the coverage of its standard deviations.

    python recipes/ensemble.py [system=swimmer6] [members=5] [steps=1000] [checkpoint=RUN] [key=value ...]

Trains the members on the same random trajectories, each with its own initial weights and batches. Calibrates the
predicted standard deviations on other trajectories. Then counts, on new trajectories, the errors within one and two
standard deviations, in rollouts of 1, 10, 50 and 100 steps: under the same random control, and under control that
changes three times as slowly. `checkpoint=` calibrates and tests a trained ensemble on data of its system; the same
`run_dir` does so with its own. Beyond the paper.

Writes config.yaml, metrics.json, the checkpoint and a figure of a prediction with its band, prediction.png, to its run
folder. All options: recipes/config/ensemble.yaml. Results: docs/results/how-sure.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict

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
from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import Ensemble, specialize
from torchrl_gn.evaluation import calibrate, evaluate_coverage, plot_band
from torchrl_gn.scenes import Scene
from torchrl_gn.training import RunFolder, fit_ensemble, load_pretrained, plain_config, save_checkpoint

SLOWER = 3  # factor on the knot interval of the random controls in the split "other"
SPLITS = ("train", "calibration", "test", "other")
OF_TRAINING = ("members", "hidden", "steps", "minutes", "seed", "data.train")  # options without effect on a checkpoint
# Options that may change when a run measures its ensemble again.
MAY_CHANGE = ("horizons", "data.calibration", "data.test", "data.other", "threads", "logger", "run_dir")


def make_data(cfg: DictConfig, scene: Scene, splits: Sequence[str]) -> dict[str, TensorDict]:
    """Collect random trajectories for each split."""
    data = {}
    for index, split in enumerate(SPLITS):
        if split not in splits:
            continue
        interval = cfg.data.knot_interval * (SLOWER if split == "other" else 1)
        count, options = cfg.data[split], {"split": index, "knot_interval": interval, "pace": cfg.data.pace}
        data[split] = collect_trajectories(scene, count, cfg.data.length, cfg.data.seed, **options)
    return data


@with_help
@hydra.main(version_base=None, config_path="config", config_name="ensemble")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    horizons = as_list(cfg.horizons)
    if max(horizons) > cfg.data.length:
        raise ValueError(f"horizons={horizons} must be up to data.length={cfg.data.length} steps.")
    scene = load_system(cfg, cfg.system)
    if cfg.checkpoint is None:
        ensemble = Ensemble.for_scene(scene, count=cfg.members, hidden=cfg.hidden)
    else:
        checkpoint = load_pretrained(cfg.checkpoint)
        because = f"checkpoint={cfg.checkpoint}"
        refuse_without_effect(cfg, Path(__file__), OF_TRAINING, because=because, trained=checkpoint.config)
        ensemble = checkpoint.ensemble
    run = RunFolder(cfg.run_dir, "ensemble")
    resumed = resumed_checkpoint(cfg, run, MAY_CHANGE)
    trains, metrics = cfg.checkpoint is None and resumed is None, {"steps": 0.0}
    if cfg.checkpoint is None and resumed is not None:
        ensemble = resumed.ensemble
        metrics = resumed.resume(lambda state: {name: float(state[name]) for name in ("training_seconds", "steps")})
        say_trained(run)
    tracker = open_log(cfg, run, label=f"ensemble-{scene.name}")
    data = make_data(cfg, scene, SPLITS if trains else SPLITS[1:])
    bound = ensemble.bind(scene)
    described: dict[str, Any] = {"scene": scene, "config": plain_config(cfg)}
    if trains:
        histories = fit_ensemble(bound, data["train"], steps=cfg.steps, minutes=cfg.minutes, seed=cfg.seed)
        steps = float(sum(each.steps[-1] for each in histories))
        metrics = {"training_seconds": sum(each.seconds[-1] for each in histories), "steps": steps}
        save_checkpoint(run.checkpoint, ensemble, training=metrics, **described)  # what follows may be interrupted
    spent = dict(metrics)
    quick = specialize(bound)
    calibrate(quick, data["calibration"])
    for split, name in (("test", "the same control"), ("other", f"control that changes {SLOWER} times as slowly")):
        found = evaluate_coverage(quick, data[split], horizons=horizons)
        metrics |= {f"{split}/{key}": value for key, value in found.to_metrics().items()}
        print(f"{scene.name}, {len(quick.members)} members, {len(data[split])} rollouts under {name}:\n{found}")
    save_checkpoint(run.checkpoint, ensemble, training=spent, **described)
    one = {name: data["test"][name][:1] for name in ("state", "action")}
    prediction = quick.predict(one["state"][:, 0], one["action"])
    figure = plot_band(one["state"][0], prediction.mean[0], prediction.std[0], scene, run.file("prediction.png"))
    finish_run(cfg, run, tracker, metrics, files=[figure], checkpoints=[run.checkpoint], step=int(metrics["steps"]))


if __name__ == "__main__":
    main()

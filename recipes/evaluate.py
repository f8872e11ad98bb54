"""Evaluate a trained forward model, on its own system or on another one.

    python recipes/evaluate.py checkpoint=runs/forward_model/<time> [system=swimmer8] [key=value ...]
    python recipes/evaluate.py checkpoint=swimmerN system=swimmer12

Collects fresh test trajectories and prints the error table (docs/evaluation.md defines the errors). Takes seconds. All
options: recipes/config/evaluate.yaml.

Writes config.yaml, metrics.json, a figure and a video to its run folder.
"""

from __future__ import annotations

import hydra
import torch
from omegaconf import DictConfig

from _common import clean_exit, finish_run, open_run, with_help
from _common.progress import HORIZON, collecting
from torchrl_gn.data import collect_trajectories
from torchrl_gn.evaluation import report
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import load_pretrained


@with_help
@hydra.main(version_base=None, config_path="config", config_name="evaluate")
@clean_exit
def main(cfg: DictConfig) -> None:
    if cfg.checkpoint is None:
        raise ValueError("Say what to evaluate: checkpoint=runs/forward_model/<time>, or a trained model's name.")
    checkpoint = load_pretrained(cfg.checkpoint)
    scene = load_scene(cfg.system, timestep=cfg.timestep) if cfg.system else checkpoint.scene()
    model = checkpoint.model.bind(scene, strict=cfg.strict)
    if cfg.length < HORIZON:
        raise ValueError(f"length={cfg.length} is too short: errors are measured over {HORIZON} steps.")
    torch.set_num_threads(cfg.threads)
    run, tracker = open_run(cfg, "evaluate")
    with collecting("test data") as show:
        test = collect_trajectories(scene, cfg.sequences, cfg.length, cfg.seed, split=3, progress=show)
    table, files = report(model, test, run.path)
    print(table)
    finish_run(cfg, run, tracker, table.to_metrics(), files=files)


if __name__ == "__main__":
    main()

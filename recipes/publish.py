"""Shrink a trained model and store its errors in its file, to ship or share it.

    python recipes/publish.py checkpoint=runs/forward_model/<time> file=swimmer6.safetensors [also=[swimmer7]]

Stores weights in half precision, drops the training state, and keeps only the last part of every path in the
configuration. Evaluates the result on fresh trajectories of every system that the model was trained on, and of those in
`also`; a model with identification, on random variants of them. Prints the errors and stores them in the file
(`load_pretrained(file).metrics`). No figure of the paper. All options: recipes/config/publish.yaml.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from tqdm import tqdm

from _common import as_list, clean_exit, with_help
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.evaluation import fresh_errors, summary
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.scenes import load_scene, require_bodies
from torchrl_gn.training import load_pretrained, save_checkpoint


def without_places(value: Any) -> Any:
    """Return a configuration with every path cut to its last part, to hide the folders of its author."""
    if isinstance(value, Mapping):
        return {key: without_places(each) for key, each in value.items()}
    if isinstance(value, list):
        return [without_places(each) for each in value]
    return Path(value).name if isinstance(value, str) and os.sep in value else value


@with_help
@hydra.main(version_base=None, config_path="config", config_name="publish")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    for name in ("checkpoint", "file"):
        if cfg[name] is None:
            raise ValueError(f"{name}= is needed: checkpoint=runs/forward_model/<time> file=model.safetensors, say.")
    loaded = load_pretrained(cfg.checkpoint)
    own = [require_bodies(scene, "recipes/publish.py") for scene in loaded.scenes()]
    file = Path(cfg.file)
    if file.is_dir() or loaded.path is not None and file.exists() and file.samefile(loaded.path):
        raise ValueError(
            f"file={file} is a folder, or the checkpoint itself, whose training would be lost; name another."
        )
    half = loaded.trained.half()
    if lost := [name for name, value in half.state_dict().items() if not bool(value.isfinite().all())]:
        raise ValueError(f"{cfg.checkpoint} has weights beyond half precision, 65504: {', '.join(lost)}.")
    model, how = copy.deepcopy(half).float(), {key: cfg[key] for key in ("sequences", "length", "seed")}
    if not isinstance(model, (ForwardModel, IdentifyingModel)):
        raise ValueError(f"{cfg.checkpoint} holds no model that predicts states; only those can be published.")
    scenes = tqdm([*own, *map(load_scene, as_list(cfg.also))], desc="evaluating", leave=False)
    tables = {scene.name: fresh_errors(model, scene, **how) for scene in scenes}
    errors = {name: {key: error.total for key, error in table.errors.items()} for name, table in tables.items()}
    save_checkpoint(file, half, scene=own, config=without_places(loaded.config), metrics={**errors, "evaluation": how})
    print(summary(tables))
    print(f"{file} ({file.stat().st_size / 1e6:.2f} MB)")


if __name__ == "__main__":
    main()

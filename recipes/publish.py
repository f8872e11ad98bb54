"""Make a trained model small and write down its errors, to ship it or to send it to somebody.

    python recipes/publish.py checkpoint=runs/forward_model/<time> file=swimmer6.safetensors [also=[swimmer7]]

Weights become half-precision numbers and the state of the training is left out. What is written is evaluated on fresh
trajectories of every system that the model was trained on, and of those named by `also`; the errors go into the file
(`load_checkpoint(file).metrics`) and are printed. All options: recipes/config/publish.yaml.
"""

from __future__ import annotations

import copy
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from tqdm import tqdm

from torchrl_gn.data import collect_trajectories
from torchrl_gn.evaluation import evaluate_errors, summary
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import clean_exit, load_checkpoint, save_checkpoint


@hydra.main(version_base=None, config_path="config", config_name="publish")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    loaded = load_checkpoint(cfg.checkpoint)
    own, file = loaded.scenes(), Path(cfg.file)
    half = loaded.model.half()
    model, tables = copy.deepcopy(half).float(), {}
    for scene in tqdm([*own, *map(load_scene, cfg.also)], desc="evaluating", leave=False):
        test = collect_trajectories(scene, cfg.sequences, cfg.length, cfg.seed, split=3)
        tables[scene.name] = evaluate_errors(model.bind(scene), test)
    errors = {name: {key: error.total for key, error in table.errors.items()} for name, table in tables.items()}
    how = {"sequences": cfg.sequences, "length": cfg.length, "seed": cfg.seed}
    save_checkpoint(file, half, scene=own, config=loaded.config, metrics={**errors, "evaluation": how})
    print(summary(tables))
    print(f"{file} ({file.stat().st_size / 1e6:.2f} MB)")


if __name__ == "__main__":
    main()

"""Measure the run time of features of force elements: steps with them and without, in turn.

    python recipes/benchmarks/features.py [systems=[cheetah,jaco]] [key=value ...]

Times a step of specialised, untrained models of a scene: with all features that suit it, with the features of bodies
and controls alone, and with each of the others left out, in processor time of one thread. Prints medians over rounds of
the times, and of ratios and differences within a round. No figure of the paper. Takes minutes. Results:
docs/results/force-elements.md.

Writes config.yaml and metrics.json to its run folder.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import cast

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[1]))  # where _common is

from _common import clean_exit, finish_run, open_run, with_help
from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, SpecializedPredictor, specialize
from torchrl_gn.dynamics.features import Actuators, Contacts, Joints, Tendons, WorldContacts
from torchrl_gn.dynamics.features.feature import Feature
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import Scene, load_scene

FORCES = (Joints, Actuators, Tendons, Contacts, WorldContacts)


def make_models(cfg: DictConfig, scene: Scene, sample: TensorDictBase) -> dict[str, SpecializedPredictor]:
    """Return specialised models with all features, those of bodies and controls, and all but one, by name."""

    def make(features: Sequence[Feature]) -> SpecializedPredictor:
        torch.manual_seed(cfg.seed)
        bound = ForwardModel.for_scene(scene, hidden=cfg.hidden, features=features).bind(scene)
        ForwardModelLoss(bound).fit_normalizers(sample)
        return specialize(bound)

    every = ForwardModel.for_scene(scene, hidden=cfg.hidden).features
    forces = [each for each in every if isinstance(each, FORCES)]
    models = {"all": make(every), "bodies": make([each for each in every if each not in forces])}
    return models | {type(one).__name__: make([each for each in every if each != one]) for one in forces}


@torch.no_grad()
def measure(
    cfg: DictConfig, models: dict[str, SpecializedPredictor], state: torch.Tensor, action: torch.Tensor
) -> dict[str, list[float]]:
    """Return milliseconds of a step by model and round."""
    start = time.process_time()
    for model in models.values():
        model.step(state, action)
    steps = max(1, round(cfg.seconds * len(models) / (time.process_time() - start)))
    found: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(cfg.rounds):
        for name, model in models.items():
            start = time.process_time()
            for _ in range(steps):
                model.step(state, action)
            found[name].append(1e3 * (time.process_time() - start) / steps)
    return found


@with_help
@hydra.main(version_base=None, config_path="config", config_name="features")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    run, tracker = open_run(cfg, "benchmarks/features")
    metrics: dict[str, float] = {"threads": cfg.threads}
    lines = ["Milliseconds of a step with all features (lower is better), with bodies' states alone, and their ratio."]
    lines += [f"{'scene':16}{'nodes':>6}{'batch':>6}{'ms':>9}{'bodies alone':>14}{'ratio':>7}  ms of each feature"]
    for system in tqdm(cfg.systems, desc="measuring", leave=False):
        scene = load_scene(system)
        data = collect_trajectories(scene, 8, cfg.steps, seed=cfg.seed)
        models = make_models(cfg, scene, trajectory_buffer(data, batch_size=64, seed=cfg.seed).sample())
        states, actions = (cast(torch.Tensor, each) for each in (data["state"][:, :-1], data["action"]))
        metrics[f"{scene.name}/nodes"] = scene.num_nodes
        for batch in cfg.batches:
            chosen = torch.arange(batch) % (len(data) * cfg.steps)
            found = measure(cfg, models, states.flatten(0, 1)[chosen], actions.flatten(0, 1)[chosen])
            rounds = [dict(zip(found, each, strict=True)) for each in zip(*found.values(), strict=True)]
            features = [each for each in found if each not in ("all", "bodies")]
            costs = {name: median(each["all"] - each[name] for each in rounds) for name in features}
            ratio = median(each["all"] / each["bodies"] for each in rounds)
            whole, bodies = median(found["all"]), median(found["bodies"])
            name = f"{scene.name}/batch {batch}"
            metrics |= {f"{name}/ms": whole, f"{name}/bodies_ms": bodies, f"{name}/ratio": ratio}
            metrics |= {f"{name}/{each}_ms": cost for each, cost in costs.items()}
            parts = ", ".join(f"{each} {cost:.3f}" for each, cost in costs.items())
            lines.append(
                f"{scene.name:16}{scene.num_nodes:>6}{batch:>6}{whole:>9.3f}{bodies:>14.3f}{ratio:>7.2f}  {parts}"
            )
    print("\n".join(lines))
    finish_run(cfg, run, tracker, metrics)


if __name__ == "__main__":
    main()

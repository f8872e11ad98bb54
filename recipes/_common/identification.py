"""Evaluation of an inference model: errors, a linear probe, and a figure of identification with and without control."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from torchrl_gn.data import Simulator, collect_trajectories, spline_controls
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.evaluation import identification_errors, linear_probe, plot_motions
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.scenes import Scene, make_variants, parameter_ranges, sample_parameters


class TestSystems:
    """New variants with three trajectories each: one with and one without control to identify from, one to predict."""

    def __init__(self, cfg: DictConfig, scene: Scene) -> None:
        system = scene.origin["system"]
        rng = np.random.default_rng(np.random.SeedSequence(cfg.data.seed, spawn_key=(5,)))
        self.parameters = sample_parameters(system, cfg.test.systems, rng)
        self.names = list(parameter_ranges(system))
        self.scenes = make_variants(system, self.parameters, timestep=scene.timestep)
        count = cfg.test.systems
        both = collect_trajectories(self.scenes, 2 * count, cfg.data.length, cfg.data.seed, split=4)
        self.observed, self.predicted = (cast(TensorDictBase, half) for half in (both[:count], both[count:]))
        none = torch.zeros_like(cast(Tensor, self.observed.get("action"))[:, : cfg.context_length])
        start = cast(Tensor, self.observed.get("physics"))[:, 0]
        self.uncontrolled = Simulator(self.scenes).rollout(start, none).set("action", none)


def identified_errors(cfg: DictConfig, model: IdentifyingModel, scene: Scene, systems: TestSystems):
    """Return error tables by kind of estimate, and the 100-step error by number of observed steps."""
    bound, inference = model.bind(scene)
    pairs = bound, inference, systems.observed, systems.predicted
    tables = {
        "identified": identification_errors(*pairs, steps=cfg.context_length),
        "identified from another system": identification_errors(*pairs, steps=cfg.context_length, wrong=True),
        "identified without control": identification_errors(bound, inference, systems.uncontrolled, systems.predicted),
    }
    curve = {}
    for steps in tqdm([steps for steps in cfg.test.steps if steps <= cfg.data.length], desc="evaluating", leave=False):
        table = identification_errors(*pairs, steps=steps, one_step=False)
        curve[steps] = table["rollout_error_100"].total
    return tables, curve


def probe(cfg: DictConfig, model: IdentifyingModel, scene: Scene, systems: TestSystems) -> dict[str, float]:
    """Return the share of each parameter's variance that a linear map reads from the inferred graph."""
    _, inference = model.bind(scene)
    state, action = (cast(Tensor, systems.observed.get(key)) for key in ("state", "action"))
    with torch.no_grad():
        parameters = inference.identify(state[:, : cfg.context_length + 1], action[:, : cfg.context_length])
    features = torch.cat([cast(Tensor, value).flatten(1) for value in parameters.values()], dim=1)
    share = linear_probe(features, torch.from_numpy(systems.parameters), train=int(0.75 * len(features)))
    return dict(zip(systems.names, share.tolist(), strict=True))


def control_figure(cfg: DictConfig, model: IdentifyingModel, scene: Scene, path: Path) -> Path:
    """Draw predictions of three systems, identified with and without control."""
    bound, inference = model.bind(scene)
    system, ranges = scene.origin["system"], parameter_ranges(scene.origin["system"])
    low, high = (np.array([getattr(one, side) for one in ranges.values()]) for side in ("low", "high"))
    scenes = make_variants(system, np.array([low, (low + high) / 2, high]), timestep=scene.timestep)
    simulator, rng, each = Simulator(scenes), np.random.default_rng(cfg.seed), np.arange(3)
    # All from one state, under one control: only the systems differ.
    start = np.repeat(draw_start_states(simulator, np.zeros(1, dtype=np.int64), rng)[0], 3, axis=0)
    controls = np.repeat(spline_controls(scene, 1, cfg.data.length, rng), 3, axis=0)
    panels = {}
    for title, factor in (("with control", 1.0), ("without control", 0.0)):
        actions = controls.copy()
        actions[:, : cfg.context_length] *= factor
        states = cast(Tensor, simulator.rollout(start, actions, each).get("state"))
        actions = torch.from_numpy(actions)
        with torch.no_grad():
            parameters = inference.identify(states[:, : cfg.context_length + 1], actions[:, : cfg.context_length])
            predicted, _ = bound.rollout(states[:, cfg.context_length], actions[:, cfg.context_length :], parameters)
        panels[f"identified {title}"] = (states, predicted)
    return plot_motions(panels, scene, path, labels=("smallest", "middle", "largest"))

"""Stress-test the numerics of a trained forward model, in float32, float64 and bfloat16.

    python recipes/stability.py checkpoint=swimmer6 [steps=10000]
    python recipes/stability.py system=swimmer6 minutes=2

`checkpoint` is a run folder or the name of a model of the package; without one, the recipe trains a model first. Every
check measures one number for each dtype of the network (states are float64), and has a limit for each. If a number is
over its limit, the recipe ends with exit code 1 (limits=false: with 0). No figure of the paper. Takes about three
minutes. Results: docs/results/stability.md.

Writes config.yaml, metrics.json and, if it trains one, the model to its run folder.
"""

from __future__ import annotations

import copy
from pathlib import Path

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from tqdm import tqdm

import _stability_checks as checks
from _common import clean_exit, finish_run, open_run, refuse_without_effect, with_help
from _common.sweeps import FORWARD_MODEL, Run, refuse_failures, run_all
from _stability_checks import DTYPES, Check, Setting
from torchrl_gn.data import Simulator, sample_start_states, spline_controls
from torchrl_gn.maths import BODY_STATE
from torchrl_gn.scenes import Scene, has_variants, require_bodies
from torchrl_gn.training import load_pretrained


def all_checks(scene: Scene, steps: int) -> list[Check]:
    """Return all checks with their limits; checks of random variants only if the scene has variants."""

    def same(limit: float) -> dict[str, float]:
        return dict.fromkeys(DTYPES, limit)

    def graded(*limits: float) -> dict[str, float]:
        return dict(zip(DTYPES, limits, strict=False))

    variants = (
        Check("variants at corners: change over largest", lambda s: checks.variants_at_corners(s)[0], same(1e5)),
        Check(
            "variants at corners against float64", lambda s: checks.variants_at_corners(s)[1], graded(1e-4, 1e-12, 1.0)
        ),
    )
    return [
        Check(f"{steps:,} steps: quaternions off unit length", lambda s: checks.long_rollout(s)[0], same(1e-6)),
        Check(f"{steps:,} steps: kinetic energy over MuJoCo's", lambda s: checks.long_rollout(s)[1], same(2.0)),
        Check("one step against float64", checks.one_step, graded(1e-5, 1e-12, 5e-2)),
        Check("1 km from the origin", checks.far_away(1e3), graded(1e-6, 1e-9, 5e-2)),
        Check("1e6 m from the origin", checks.far_away(1e6), graded(1e-4, 1e-4, 5e-2)),
        Check("-q for q", checks.scaled_quaternions(-1), graded(1e-6, 1e-12, 5e-2)),
        Check("1000 q for q", checks.scaled_quaternions(1000), graded(1e-5, 1e-12, 5e-2)),
        Check("zero quaternion: length after a step off 1", checks.zero_quaternion, same(1e-6)),
        Check("speeds and actions times 1e6: largest change", checks.wild_inputs, same(1e12)),
        Check("actions at their limits: change over largest", checks.saturated(1), same(10)),
        Check("actions at 1000 limits: change over largest", checks.saturated(1e3), same(1e4)),
        *(variants if has_variants(scene) else ()),
        Check("one body, no actions, no globals: error", checks.small_scenes, graded(1e-5, 1e-12, 5e-2)),
        Check("unstable model: share of steps predicted", checks.unstable_model, same(0.1)),
        Check("gradient through 200 steps against float64", checks.long_gradient, graded(1e-2, 1e-9)),
        Check("gradient against differences", checks.finite_difference, graded(5e-2, 1e-5)),
        Check("orientation loss at 1e-6 rad", checks.orientation_loss, graded(1e-5, 1e-8)),
    ]


def settings(cfg: DictConfig, checkpoint: Path | str) -> dict[str, Setting]:
    """Return the model in every dtype, with states and actions to test it on."""
    loaded = load_pretrained(checkpoint)
    scene = require_bodies(loaded.scene(), "recipes/stability.py")
    rng = np.random.default_rng(cfg.seed)
    physics = torch.as_tensor(sample_start_states(scene, 64, rng))
    actions = torch.as_tensor(spline_controls(scene, 64, 20, rng))
    states = Simulator(scene).rollout(physics, actions)["state"]
    true = BODY_STATE.delta(states[:, :-1], states[:, 1:]).unflatten(-1, (4, 3)).norm(dim=-1)
    largest = true.flatten(0, -2).amax(0)
    exact = copy.deepcopy(loaded.model).double().requires_grad_(False).bind(scene)
    single = loaded.model.requires_grad_(False).bind(scene)
    rounded = checks.specialize_at(single, torch.bfloat16)
    inputs = exact, scene, states[:, -2], actions[:, -1], largest, cfg
    return {
        "float32": Setting(single, single.model, *inputs),
        "float64": Setting(exact, exact.model, *inputs),
        "bfloat16": Setting(rounded, single.model, *inputs),
    }


@with_help
@hydra.main(config_path="config", config_name="stability", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    if cfg.checkpoint:
        refuse_without_effect(cfg, Path(__file__), ("system", "minutes"), because=f"checkpoint={cfg.checkpoint}")
    run, tracker = open_run(cfg, "stability")
    checkpoint = cfg.checkpoint or run.path / "model"
    if not cfg.checkpoint:
        minutes = ("steps=null", f"minutes={cfg.minutes}")
        options = (f"system={cfg.system}", *minutes, f"seed={cfg.seed}", f"threads={cfg.threads}")
        refuse_failures(run_all([Run(FORWARD_MODEL, run.path / "model", options, cfg.system)], 1))
    prepared = settings(cfg, checkpoint)

    metrics: dict[str, float | int] = {}
    failed, lines = [], []
    for check in tqdm(all_checks(prepared["float64"].scene, cfg.steps), desc="checks", leave=False):
        cells = ""
        for name, setting in prepared.items():
            if name not in check.limits:
                cells += f"{'-':>11}"
                continue
            figure = check.figure(setting)
            passed = figure <= check.limits[name]
            cells += f"{figure:10.1e}{' ' if passed else '!'}"
            metrics[f"{check.name}/{name}"] = figure
            metrics[f"{check.name}/{name}/limit"] = check.limits[name]
            if not passed:
                failed.append(f"{check.name}, {name}: {figure:.1e} > {check.limits[name]:.1e}")
        limits = sorted({f"{limit:.0e}" for limit in check.limits.values()}, key=float)
        lines.append(f"{check.name:46}{cells}   {' '.join(limits)}")
    print(f"{prepared['float64'].scene.name}: results of the checks by dtype of the network (!: above its limit)")
    print(f"{'':46}" + "".join(f"{name:>10} " for name in DTYPES) + "   limits")
    print("\n".join(lines))
    finish_run(cfg, run, tracker, {**metrics, "failed": len(failed)})
    if failed and cfg.limits:
        raise ValueError(f"{len(failed)} checks failed: " + "; ".join(failed))


if __name__ == "__main__":
    main()

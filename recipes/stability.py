"""Stress-test the numerics of a trained forward model, in float32, float64 and bfloat16.

    python recipes/stability.py checkpoint=runs/forward_model/... [steps=10000]
    python recipes/stability.py system=swimmer6 minutes=2

Without a checkpoint a model is trained first. Every check gives one figure for each dtype of the network (states are
float64) and has a limit that it can fail; the recipe ends with exit code 1 if one does (limits=false: with 0).
Takes about three minutes; results: docs/performance.md.

Writes config.yaml, metrics.json and, if it trains one, the model to its run folder.
"""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import hydra
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from tqdm import tqdm

from torchrl_gn.data import Simulator, sample_start_states, spline_controls
from torchrl_gn.evaluation import kinetic_energy
from torchrl_gn.modules import BODY_STATE, BoundForwardModel, Normalizer, quaternion, specialize
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import Scene
from torchrl_gn.training import RunFolder, clean_exit, load_checkpoint

RECIPES = Path(__file__).parent
DTYPES = {"float32": torch.float32, "float64": torch.float64, "bfloat16": torch.bfloat16}


@dataclass(frozen=True)
class Setting:
    """What the checks of one dtype work on."""

    model: BoundForwardModel
    exact: BoundForwardModel
    scene: Scene
    state: Tensor
    action: Tensor
    cfg: DictConfig

    def error(self, value: Tensor, expected: Tensor) -> float:
        """Norm of the difference over that of what is expected; infinite if not finite."""
        value = value.double()
        if not bool(torch.isfinite(value).all()):
            return torch.inf
        return float((value - expected).norm() / expected.norm())


@dataclass(frozen=True)
class Check:
    """A figure, and the largest that passes in each dtype; it is not measured in those without a limit."""

    name: str
    figure: Callable[[Setting], float]
    limits: dict[str, float]


def long_rollout(s: Setting) -> tuple[float, float]:
    """Largest deviation of a quaternion's length from 1, and largest kinetic energy over MuJoCo's largest."""
    scene, cfg = s.scene, s.cfg
    rng = np.random.default_rng(cfg.seed)
    physics = torch.as_tensor(sample_start_states(scene, cfg.rollouts, rng))
    actions = torch.as_tensor(spline_controls(scene, cfg.rollouts, cfg.steps, rng))
    truth = Simulator(scene).rollout(physics, actions)["state"]
    limit = float(kinetic_energy(truth, scene).max())
    state, length, energy = truth[:, 0], 0.0, 0.0
    with torch.no_grad():
        for first in range(0, cfg.steps, 100):
            states = s.model.rollout(state, actions[:, first : first + 100])
            state = states[:, -1]
            if not bool(torch.isfinite(states).all()):
                return torch.inf, torch.inf
            length = max(length, float((states[..., 3:7].norm(dim=-1) - 1).abs().max()))
            energy = max(energy, float(kinetic_energy(states, scene).max()))
    return length, energy / limit


def far_away(distance: float) -> Callable[[Setting], float]:
    """Error of the predicted change after a shift of the whole scene."""

    def figure(s: Setting) -> float:
        axes = torch.as_tensor(s.scene.translation_invariant, dtype=torch.float64)
        far = s.state.clone()
        far[:, 1:, :3] += distance * axes
        return s.error(s.model.delta(far, s.action), s.model.delta(s.state, s.action).double())

    return figure


def other_sign(s: Setting) -> float:
    """Difference of the prediction for -q."""
    flipped = s.state.clone()
    flipped[..., 3:7] *= -1
    return s.error(s.model.delta(flipped, s.action), s.model.delta(s.state, s.action).double())


def other_length(s: Setting) -> float:
    """Difference of the prediction for 1000 q."""
    long = s.state.clone()
    long[..., 3:7] *= 1000
    return s.error(s.model.delta(long, s.action), s.model.delta(s.state, s.action).double())


def zero_quaternion(s: Setting) -> float:
    """Deviation of the next quaternions' lengths from 1 where one had none."""
    broken = s.state.clone()
    broken[:, 1, 3:7] = 0
    after = s.model.step(broken, s.action)
    return float((after[..., 3:7].norm(dim=-1) - 1).abs().nan_to_num(torch.inf).max())


def wild_inputs(s: Setting) -> float:
    """Largest change predicted for speeds and actions a million times too large; infinite if not finite."""
    wild = s.state.clone()
    wild[:, 1:, 7:] *= 1e6
    delta = s.model.delta(wild, 1e6 * s.action)
    return float(delta.abs().nan_to_num(torch.inf).max())


def one_step(s: Setting) -> float:
    """Error against float64."""
    return s.error(s.model.delta(s.state, s.action), s.exact.delta(s.state, s.action))


def long_gradient(s: Setting) -> float:
    """Error of the gradient to the actions through a rollout of 200 steps, against float64."""
    repeats = -(-200 // len(s.action))
    actions = s.action.repeat(repeats, 1)[:200].unsqueeze(0).expand(4, -1, -1)

    def gradient(model: BoundForwardModel) -> Tensor:
        leaf = actions.clone().requires_grad_()
        model.rollout(s.state[:4], leaf)[:, -1, 1:, :3].square().sum().backward()
        assert leaf.grad is not None
        return leaf.grad

    return s.error(gradient(s.model), gradient(s.exact))


def finite_difference(s: Setting) -> float:
    """Difference between gradient and central differences of one step, along random directions."""
    state, action = s.state[:8].clone(), s.action[:8].clone().requires_grad_()
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(state.shape, generator=generator, dtype=torch.float64)
    along = torch.randn(action.shape, generator=generator, dtype=torch.float64)
    (slope,) = torch.autograd.grad((s.model.step(state, action) * weight).sum(), action)
    step = 1e-7 if s.model.network_dtype == torch.float64 else 1e-3
    with torch.no_grad():
        ends = [((s.model.step(state, action + sign * step * along)) * weight).sum((-2, -1)) for sign in (1, -1)]
    return s.error((slope * along).sum(-1), (ends[0] - ends[1]) / (2 * step))


def orientation_loss(s: Setting) -> float:
    """Error of the loss of rotations that are off by 1e-6 rad."""
    loss = ForwardModelLoss(s.exact)
    turned = s.state.clone()
    off = 1e-6 * torch.as_tensor(s.scene.live[:, 3:6], dtype=torch.float64)
    turned[..., 3:7] = quaternion.product(quaternion.exp(off.expand(len(turned), -1, -1)), turned[..., 3:7])
    target = BODY_STATE.delta(s.state, turned).to(s.model.network_dtype).double()
    where = BODY_STATE.delta_slices["orientation"]
    scale = s.exact.model.delta_normalizer.inverse_std[where]
    weight = s.exact.live[:, where] * scale
    expected = (off * weight).square().sum() / (weight > 0).sum()
    errors = loss._component_errors(torch.zeros_like(target), target)
    return s.error(errors[BODY_STATE.names.index("orientation")], expected)


def rotations(s: Setting) -> float:
    """Error of rotation vectors of 0, 1e-8, ... pi through quaternions and back."""
    dtype = s.model.network_dtype
    axis = quaternion.normalize(torch.tensor([0.0, 1.0, -2.0, 3.0], dtype=torch.float64))[1:]
    worst = 0.0
    for angle in (0.0, 1e-12, 1e-8, 1e-4, 1.0, 3.1, np.pi):
        vector = (angle * axis).to(dtype)
        back = quaternion.log(quaternion.exp(vector)).double()
        worst = max(worst, float((back.abs() - vector.double().abs()).norm()) / max(angle, 1e-30))
    return worst


def shifted_features(s: Setting) -> float:
    """Error of normalised features whose mean is a million times their spread."""
    generator = torch.Generator().manual_seed(0)
    clean = torch.randn(10_000, 1, generator=generator, dtype=torch.float64)
    normalizer = Normalizer(1)
    normalizer.update(clean + 1e6)
    expected = (clean - clean.mean()) / clean.std(correction=0)
    return s.error(normalizer(clean + 1e6, s.model.network_dtype), expected)


def many_samples(s: Setting) -> float:
    """Error of a normaliser's spread after a billion samples, merged from shards of 1 to 512 million."""
    generator = torch.Generator().manual_seed(0)
    shard = Normalizer(1)
    values = 1e3 + torch.randn(1_000_000, 1, generator=generator, dtype=torch.float64)
    shard.update(values)
    total = Normalizer(1)
    for _ in range(10):
        total.merge(shard)
        shard.merge(copy.deepcopy(shard))
    return s.error(total.std, values.std(correction=0))


def memo(function: Callable[[Setting], tuple[float, ...]]) -> Callable[[int], Callable[[Setting], float]]:
    """The entries of a figure of several, computed once a setting."""
    seen: dict[int, tuple[float, ...]] = {}

    def entry(index: int) -> Callable[[Setting], float]:
        def figure(s: Setting) -> float:
            if id(s) not in seen:
                seen[id(s)] = function(s)
            return seen[id(s)][index]

        return figure

    return entry


def all_checks(steps: int) -> list[Check]:
    """The suite."""
    rollout = memo(long_rollout)

    def same(limit: float) -> dict[str, float]:
        return dict.fromkeys(DTYPES, limit)

    return [
        Check(f"{steps:,} steps: quaternions off unit length", rollout(0), same(1e-6)),
        Check(f"{steps:,} steps: kinetic energy over MuJoCo's", rollout(1), same(2.0)),
        Check("one step against float64", one_step, {"float32": 1e-5, "float64": 1e-12, "bfloat16": 5e-2}),
        Check("1 km from the origin", far_away(1e3), {"float32": 1e-6, "float64": 1e-9, "bfloat16": 5e-2}),
        Check("1e6 m from the origin", far_away(1e6), {"float32": 1e-4, "float64": 1e-4, "bfloat16": 5e-2}),
        Check("-q for q", other_sign, {"float32": 1e-6, "float64": 1e-12, "bfloat16": 5e-2}),
        Check("1000 q for q", other_length, {"float32": 1e-5, "float64": 1e-12, "bfloat16": 5e-2}),
        Check("zero quaternion: length after a step off 1", zero_quaternion, same(1e-6)),
        Check("speeds and actions times 1e6: largest change", wild_inputs, same(1e12)),
        Check("gradient through 200 steps against float64", long_gradient, {"float32": 1e-2, "float64": 1e-9}),
        Check("gradient against differences", finite_difference, {"float32": 5e-2, "float64": 1e-5}),
        Check("orientation loss at 1e-6 rad", orientation_loss, {"float32": 1e-5, "float64": 1e-8}),
        Check("rotations of 0, 1e-12, ..., pi and back", rotations, {"float32": 1e-5, "float64": 1e-12}),
        Check("features of mean / spread 1e6", shifted_features, {"float32": 1e-6, "float64": 1e-9}),
        Check("spread after 1e9 samples in shards", many_samples, {"float64": 1e-9}),
    ]


def settings(cfg: DictConfig, checkpoint: Path) -> dict[str, Setting]:
    """The model in every dtype, and states to try."""
    loaded = load_checkpoint(checkpoint)
    scene = loaded.scene()
    rng = np.random.default_rng(cfg.seed)
    physics = torch.as_tensor(sample_start_states(scene, 64, rng))
    actions = torch.as_tensor(spline_controls(scene, 64, 20, rng))
    states = Simulator(scene).rollout(physics, actions)["state"]
    exact = copy.deepcopy(loaded.model).double().requires_grad_(False).bind(scene)
    single = loaded.model.requires_grad_(False).bind(scene)
    models = {"float32": single, "float64": exact, "bfloat16": specialize(single, dtype=torch.bfloat16)}
    return {name: Setting(model, exact, scene, states[:, -2], actions[:, -1], cfg) for name, model in models.items()}


@hydra.main(config_path="config", config_name="stability", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    run = RunFolder(cfg.run_dir, "stability")
    run.write_config(OmegaConf.to_yaml(cfg, resolve=True))
    checkpoint = Path(cfg.checkpoint) if cfg.checkpoint else run.path / "model"
    if not cfg.checkpoint:
        options = [f"system={cfg.system}", f"minutes={cfg.minutes}", f"run_dir={checkpoint}"]
        subprocess.run([sys.executable, RECIPES / "forward_model.py", *options], check=True, stdout=subprocess.DEVNULL)
    prepared = settings(cfg, checkpoint)

    metrics: dict[str, float | int] = {}
    failed, lines = [], []
    for check in tqdm(all_checks(cfg.steps), desc="checks", leave=False):
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
    run.write_metrics({**metrics, "failed": len(failed)}, seed=cfg.seed)
    print(f"{prepared['float64'].scene.name}: figures by dtype of the network (!: over its limit)")
    print(f"{'':46}" + "".join(f"{name:>10} " for name in DTYPES) + "   limits")
    print("\n".join(lines))
    for path in run.written:
        print(path)
    if failed and cfg.limits:
        raise ValueError(f"{len(failed)} checks failed: " + "; ".join(failed))


if __name__ == "__main__":
    main()

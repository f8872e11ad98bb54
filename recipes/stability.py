"""Stress-test the numerics of a trained forward model, in float32, float64 and bfloat16.

    python recipes/stability.py checkpoint=swimmer6 [steps=10000]
    python recipes/stability.py system=swimmer6 minutes=2

`checkpoint` is a run's folder or a model that comes with the package; without one a model is trained first. Every
check gives one figure for each dtype of the network (states are float64) and has a limit that it can fail; the recipe
ends with exit code 1 if one does (limits=false: with 0). Takes about three minutes; results: docs/performance.md.

Writes config.yaml, metrics.json and, if it trains one, the model to its run folder.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import cast

import hydra
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from torchrl_gn.data import Simulator, collect_trajectories, sample_start_states, spline_controls, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, Predictor, SpecializedPredictor, UnseenParameterWarning, specialize
from torchrl_gn.evaluation import guarded_rollout, kinetic_energy
from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.pretrained import load_model
from torchrl_gn.processor import SlowDtypeWarning
from torchrl_gn.scenes import ParameterNames, Scene, has_variants, load_scene, make_variants, parameter_ranges
from torchrl_gn.training import RunFolder, Tracker, clean_exit, with_help
from torchrl_gn.training.sweep import Run, refuse_failures, run_all

RECIPE = Path(__file__).with_name("forward_model.py")
DTYPES = {"float32": torch.float32, "float64": torch.float64, "bfloat16": torch.bfloat16}

# One body with a motor, without, and afloat in the wind: there is no smaller scene, as something must move.
BOB = '<body><joint name="j" axis="0 1 0"/><geom size=".1" pos="0 0 -.3"/></body>'
BOX = '<body><freejoint/><geom type="box" size=".1 .2 .3" fluidshape="ellipsoid"/></body>'
SMALL_SCENES = (
    f'<mujoco><worldbody>{BOB}</worldbody><actuator><motor joint="j" ctrlrange="-1 1"/></actuator></mujoco>',
    f"<mujoco><worldbody>{BOB}</worldbody></mujoco>",
    f'<mujoco><option wind="3 2 1" density="50"/><worldbody>{BOX}</worldbody></mujoco>',
)


@dataclass(frozen=True, eq=False)
class Setting:
    """What the checks of one dtype work on."""

    model: Predictor
    exact: Predictor
    scene: Scene
    state: Tensor
    action: Tensor
    largest: Tensor
    cfg: DictConfig

    def bind(self, weights: ForwardModel, scene: Scene, **options) -> Predictor:
        """Other weights or another scene, as this setting's model is."""
        bound = weights.bind(scene, **options)
        return specialize(bound, dtype=self.model.dtype) if isinstance(self.model, SpecializedPredictor) else bound

    def size(self, delta: Tensor) -> float:
        """Largest change, relative to the largest true one of its component; infinite if not finite."""
        sizes = delta.double().unflatten(-1, (4, 3)).norm(dim=-1).flatten(0, -2).amax(0)
        return float((sizes / self.largest)[self.largest > 0].nan_to_num(torch.inf).max())

    def error(self, value: Tensor, expected: Tensor) -> float:
        """Norm of the difference over that of what is expected; infinite if not finite."""
        value = value.double()
        if not bool(torch.isfinite(value).all()):
            return torch.inf
        return float((value - expected).norm() / expected.norm().clamp(min=1e-300))


@dataclass(frozen=True)
class Check:
    """A figure, and the largest that passes in each dtype; it is not measured in those without a limit."""

    name: str
    figure: Callable[[Setting], float]
    limits: dict[str, float]


@cache
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
            guarded = guarded_rollout(s.model, state, actions[:, first : first + 100])
            if bool(guarded.diverged.any()):
                return torch.inf, torch.inf
            states, state = guarded.states, guarded.states[:, -1]
            length = max(length, float((states[..., 3:7].norm(dim=-1) - 1).abs().max()))
            energy = max(energy, float(kinetic_energy(states, scene).max()))
    return length, energy / limit


def unchanged(change: Callable[[Setting, Tensor], object]) -> Callable[[Setting], float]:
    """Error of the predicted change after a change of the states, in place, that should not matter."""

    def figure(s: Setting) -> float:
        other = s.state.clone()
        change(s, other)
        return s.error(s.model.delta(other, s.action), s.model.delta(s.state, s.action).double())

    return figure


def far_away(distance: float) -> Callable[[Setting], float]:
    """The same for a shift of the whole scene."""

    def shift(s: Setting, state: Tensor) -> None:
        state[:, 1:, :3] += distance * torch.as_tensor(s.scene.translation_invariant, dtype=torch.float64)

    return unchanged(shift)


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


def saturated(factor: float) -> Callable[[Setting], float]:
    """Largest change when every action is at a limit times ``factor``, in 1000 random corners."""

    def figure(s: Setting) -> float:
        generator = torch.Generator().manual_seed(0)
        high = torch.rand(1000, s.scene.num_actions, generator=generator) < 0.5
        bounds = torch.as_tensor(s.scene.action_low), torch.as_tensor(s.scene.action_high)
        rows = torch.arange(1000) % len(s.state)
        return s.size(s.model.delta(s.state[rows], factor * torch.where(high, bounds[1], bounds[0])))

    return figure


@cache
def corners(exact: Predictor, count: int, seed: int) -> TensorDictBase:
    """Physical parameters of variants whose parameters are each at an end of the paper's random range."""
    system = exact.scene.origin["system"]
    ends = np.array([(one.low, one.high) for one in parameter_ranges(system).values()])
    chosen = np.random.default_rng(seed).integers(2, size=(count, len(ends)))
    variants = make_variants(system, ends[np.arange(len(ends)), chosen], timestep=exact.scene.timestep)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnseenParameterWarning)  # far outside of what was trained on, on purpose
        return cast(TensorDictBase, torch.stack([exact.parameters_of(variant) for variant in variants]))


@cache
def variants_at_corners(s: Setting) -> tuple[float, float]:
    """Largest change, and error against float64, of variants at the ends of the paper's random ranges."""
    parameters = corners(s.exact, len(s.state), s.cfg.seed)
    models = (
        s.bind(s.model.model, s.scene, parameters_key="parameters"),
        s.exact.model.bind(s.scene, parameters_key="parameters"),
    )
    delta, exact = (model.delta(s.state, s.action, model.fold(parameters)) for model in models)
    return s.size(delta), s.error(delta, exact)


def small_scenes(s: Setting) -> float:
    """Difference from the plain model on the smallest graphs; infinite if a rollout or its gradient is not finite."""
    worst = 0.0
    for source in SMALL_SCENES:
        scene = load_scene(source, timestep=0.02)
        data = collect_trajectories(scene, 8, 20, s.cfg.seed)
        for features in (ParameterNames.of(scene), ParameterNames()):  # with and without globals
            torch.manual_seed(s.cfg.seed)
            weights = ForwardModel(features, latent=32).to(s.model.network_dtype)
            plain = weights.bind(scene, plain=True)
            ForwardModelLoss(plain).fit_normalizers(trajectory_buffer(data, batch_size=100, seed=0).sample())
            model, state, action = s.bind(weights, scene), data["state"][:, 0].clone().requires_grad_(), data["action"]
            states = model.rollout(state, action)
            (gradient,) = torch.autograd.grad(states[:, -1].square().sum(), state)
            with torch.no_grad():
                error = s.error(model.delta(state, action[:, 0]), plain.delta(state, action[:, 0]).double())
            worst = max(worst, error if bool(states.isfinite().all() & gradient.isfinite().all()) else torch.inf)
    return worst


def unstable_model(s: Setting) -> float:
    """Share of 1,000 steps that are predicted of a model that blows up; infinite if a sample is not flagged."""
    weights, predicted = copy.deepcopy(s.model.model), []
    with torch.no_grad():
        for parameter in weights.core.parameters():
            parameter *= 2
    model = s.bind(weights, s.scene)
    rollout = model.rollout_and_hidden_state

    def counted(
        state: Tensor,
        actions: Tensor,
        parameters: TensorDictBase | None = None,
        hidden_state: TensorDictBase | None = None,
    ) -> tuple[Tensor, TensorDictBase | None]:
        predicted.append(actions.shape[:-1].numel())
        return rollout(state, actions, parameters, hidden_state)

    model.rollout_and_hidden_state = counted
    guarded = guarded_rollout(model, s.state, s.action.unsqueeze(1).expand(-1, 1000, -1))
    return sum(predicted) / (1000 * len(s.state)) if bool(guarded.diverged.all()) else torch.inf


def one_step(s: Setting) -> float:
    """Error against float64."""
    return s.error(s.model.delta(s.state, s.action), s.exact.delta(s.state, s.action))


def long_gradient(s: Setting) -> float:
    """Error of the gradient to the actions through a rollout of 200 steps, against float64."""
    repeats = -(-200 // len(s.action))
    actions = s.action.repeat(repeats, 1)[:200].unsqueeze(0).expand(4, -1, -1)

    def gradient(model: Predictor) -> Tensor:
        leaf = actions.clone().requires_grad_()
        model.rollout(s.state[:4], leaf)[:, -1, 1:, :3].square().sum().backward()
        assert leaf.grad is not None
        return leaf.grad

    return s.error(gradient(s.model), gradient(s.exact))


def finite_difference(s: Setting) -> float:
    """Difference between gradient and central differences of one step, along random directions."""
    # Inside the limits: beyond them actions change nothing.
    state, action = s.state[:8].clone(), (0.9 * s.action[:8]).requires_grad_()
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
    off = 1e-6 * torch.as_tensor(s.scene.movable[:, 3:6], dtype=torch.float64)
    turned[..., 3:7] = quaternion.product(quaternion.exp(off.expand(len(turned), -1, -1)), turned[..., 3:7])
    target = BODY_STATE.delta(s.state, turned).to(s.model.network_dtype).double()
    where = BODY_STATE.delta_slices["orientation"]
    scale = s.exact.model.delta_normalizer.inverse_std[where]
    weight = s.exact.movable[:, where] * scale
    expected = (off * weight).square().sum() / (weight > 0).sum()
    errors = loss._component_errors(torch.zeros_like(target), target)
    return s.error(errors[BODY_STATE.names.index("orientation")], expected)


def all_checks(scene: Scene, steps: int) -> list[Check]:
    """The suite; of a scene that has no random variants, without those."""

    def same(limit: float) -> dict[str, float]:
        return dict.fromkeys(DTYPES, limit)

    def graded(*limits: float) -> dict[str, float]:
        return dict(zip(DTYPES, limits, strict=False))

    variants = (
        Check("variants at corners: change over largest", lambda s: variants_at_corners(s)[0], same(1e5)),
        Check("variants at corners against float64", lambda s: variants_at_corners(s)[1], graded(1e-4, 1e-12, 1.0)),
    )
    return [
        Check(f"{steps:,} steps: quaternions off unit length", lambda s: long_rollout(s)[0], same(1e-6)),
        Check(f"{steps:,} steps: kinetic energy over MuJoCo's", lambda s: long_rollout(s)[1], same(2.0)),
        Check("one step against float64", one_step, graded(1e-5, 1e-12, 5e-2)),
        Check("1 km from the origin", far_away(1e3), graded(1e-6, 1e-9, 5e-2)),
        Check("1e6 m from the origin", far_away(1e6), graded(1e-4, 1e-4, 5e-2)),
        Check("-q for q", unchanged(lambda s, state: state[..., 3:7].mul_(-1)), graded(1e-6, 1e-12, 5e-2)),
        Check("1000 q for q", unchanged(lambda s, state: state[..., 3:7].mul_(1000)), graded(1e-5, 1e-12, 5e-2)),
        Check("zero quaternion: length after a step off 1", zero_quaternion, same(1e-6)),
        Check("speeds and actions times 1e6: largest change", wild_inputs, same(1e12)),
        Check("actions at their limits: change over largest", saturated(1), same(10)),
        Check("actions at 1000 limits: change over largest", saturated(1e3), same(1e4)),
        *(variants if has_variants(scene) else ()),
        Check("one body, no actions, no globals: error", small_scenes, graded(1e-5, 1e-12, 5e-2)),
        Check("unstable model: share of steps predicted", unstable_model, same(0.1)),
        Check("gradient through 200 steps against float64", long_gradient, graded(1e-2, 1e-9)),
        Check("gradient against differences", finite_difference, graded(5e-2, 1e-5)),
        Check("orientation loss at 1e-6 rad", orientation_loss, graded(1e-5, 1e-8)),
    ]


def settings(cfg: DictConfig, checkpoint: Path | str) -> dict[str, Setting]:
    """The model in every dtype, and states to try."""
    loaded = load_model(checkpoint)
    scene = loaded.scene()
    rng = np.random.default_rng(cfg.seed)
    physics = torch.as_tensor(sample_start_states(scene, 64, rng))
    actions = torch.as_tensor(spline_controls(scene, 64, 20, rng))
    states = Simulator(scene).rollout(physics, actions)["state"]
    true = BODY_STATE.delta(states[:, :-1], states[:, 1:]).unflatten(-1, (4, 3)).norm(dim=-1)
    largest = true.flatten(0, -2).amax(0)
    exact = copy.deepcopy(loaded.model).double().requires_grad_(False).bind(scene)
    single = loaded.model.requires_grad_(False).bind(scene)
    with warnings.catch_warnings():  # its digits are wanted here, however slow
        warnings.simplefilter("ignore", SlowDtypeWarning)
        rounded = specialize(single, dtype=torch.bfloat16)
    models = {"float32": single, "float64": exact, "bfloat16": rounded}
    inputs = scene, states[:, -2], actions[:, -1], largest, cfg
    return {name: Setting(model, exact, *inputs) for name, model in models.items()}


@with_help
@hydra.main(config_path="config", config_name="stability", version_base="1.3")
@clean_exit
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(cfg.threads)
    torch.manual_seed(cfg.seed)
    run = RunFolder(cfg.run_dir, "stability")
    run.write_config(OmegaConf.to_yaml(cfg, resolve=True))
    tracker = Tracker(cfg.logger, run.path / "log", name="stability", config=cfg)
    checkpoint = cfg.checkpoint or run.path / "model"
    if not cfg.checkpoint:
        minutes = ("steps=null", f"minutes={cfg.minutes}")
        options = (f"system={cfg.system}", *minutes, f"seed={cfg.seed}", f"threads={cfg.threads}")
        refuse_failures(run_all([Run(RECIPE, run.path / "model", options, cfg.system)], 1))
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
    tracker.finish(run.write_metrics({**metrics, "failed": len(failed)}, seed=cfg.seed), run.written)
    print(f"{prepared['float64'].scene.name}: figures by dtype of the network (!: over its limit)")
    print(f"{'':46}" + "".join(f"{name:>10} " for name in DTYPES) + "   limits")
    print("\n".join(lines))
    for path in run.written:
        print(path)
    if failed and cfg.limits:
        raise ValueError(f"{len(failed)} checks failed: " + "; ".join(failed))


if __name__ == "__main__":
    main()

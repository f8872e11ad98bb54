"""Checks of a forward model's numerics: each measures one number, smaller is better."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, cast

import numpy as np
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_gn.data import (
    Simulator,
    UncontrolledSceneWarning,
    collect_trajectories,
    sample_start_states,
    spline_controls,
    trajectory_buffer,
)
from torchrl_gn.dynamics import (
    BoundPredictor,
    ForwardModel,
    Predictor,
    SpecializedPredictor,
    UnseenParameterWarning,
    specialize,
)
from torchrl_gn.evaluation import guarded_rollout, kinetic_energy
from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.processor import SlowDtypeWarning
from torchrl_gn.scenes import Scene, load_scene, make_variants, parameter_ranges, require_bodies

DTYPES = {"float32": torch.float32, "float64": torch.float64, "bfloat16": torch.bfloat16}

# The smallest scenes, as something must move: one body with a motor, one without, and one floating in the wind.
BOB = '<body><joint name="j" axis="0 1 0"/><geom size=".1" pos="0 0 -.3"/></body>'
BOX = '<body><freejoint/><geom type="box" size=".1 .2 .3" fluidshape="ellipsoid"/></body>'
SMALL_SCENES = (
    f'<mujoco><worldbody>{BOB}</worldbody><actuator><motor joint="j" ctrlrange="-1 1"/></actuator></mujoco>',
    f"<mujoco><worldbody>{BOB}</worldbody></mujoco>",
    f'<mujoco><option wind="3 2 1" density="50"/><worldbody>{BOX}</worldbody></mujoco>',
)


def specialize_at(bound: BoundPredictor, dtype: torch.dtype | None) -> SpecializedPredictor:
    """Specialise a predictor in a dtype, without the warning that it is slow: only its numbers matter here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SlowDtypeWarning)
        return specialize(bound, dtype=dtype)


@dataclass(frozen=True, eq=False)
class Setting:
    """The inputs of the checks of one dtype."""

    model: Predictor
    weights: ForwardModel  # of ``model``
    exact: BoundPredictor
    scene: Scene
    state: Tensor
    action: Tensor
    largest: Tensor
    cfg: DictConfig

    def bind(self, weights: ForwardModel, scene: Scene, **options) -> Predictor:
        """Bind weights to a scene, specialised in the same dtype if this setting's model is."""
        bound = weights.bind(scene, **options)
        return specialize_at(bound, self.model.dtype) if isinstance(self.model, SpecializedPredictor) else bound

    def size(self, delta: Tensor) -> float:
        """Return the largest change, relative to the largest true change of its component; infinite if not finite."""
        sizes = delta.double().unflatten(-1, (4, 3)).norm(dim=-1).flatten(0, -2).amax(0)
        return float((sizes / self.largest)[self.largest > 0].nan_to_num(torch.inf).max())

    def error(self, value: Tensor, expected: Tensor) -> float:
        """Return the norm of the difference over the norm of ``expected``; infinite if not finite."""
        value = value.double()
        if not bool(torch.isfinite(value).all()):
            return torch.inf
        return float((value - expected).norm() / expected.norm().clamp(min=1e-300))


@dataclass(frozen=True)
class Check:
    """A number to measure, and its limit in each dtype; dtypes without a limit are not measured."""

    name: str
    figure: Callable[[Setting], float]
    limits: dict[str, float]


@cache
def long_rollout(s: Setting) -> tuple[float, float]:
    """Return the largest deviation of a quaternion's length from 1, and the largest kinetic energy over MuJoCo's."""
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
    """Return a check: the error of the delta after an in-place ``change`` of the states that should not affect it."""

    def figure(s: Setting) -> float:
        other = s.state.clone()
        change(s, other)
        return s.error(s.model.delta(other, s.action), s.model.delta(s.state, s.action).double())

    return figure


def far_away(distance: float) -> Callable[[Setting], float]:
    """Return a check of the delta after a shift of the whole scene by ``distance`` metres."""

    def shift(s: Setting, state: Tensor) -> None:
        state[:, 1:, :3] += distance * torch.as_tensor(s.scene.translation_invariant, dtype=torch.float64)

    return unchanged(shift)


def scaled_quaternions(factor: float) -> Callable[[Setting], float]:
    """Return a check of the delta for quaternions times ``factor``."""
    return unchanged(lambda s, state: state[..., 3:7].mul_(factor))


def zero_quaternion(s: Setting) -> float:
    """Return the deviation of the next quaternions' lengths from 1, after one quaternion of length 0."""
    broken = s.state.clone()
    broken[:, 1, 3:7] = 0
    after, _ = s.model.step(broken, s.action)
    return float((after[..., 3:7].norm(dim=-1) - 1).abs().nan_to_num(torch.inf).max())


def wild_inputs(s: Setting) -> float:
    """Return the largest delta predicted for speeds and actions a million times too large; infinite if not finite."""
    wild = s.state.clone()
    wild[:, 1:, 7:] *= 1e6
    delta = s.model.delta(wild, 1e6 * s.action)
    return float(delta.abs().nan_to_num(torch.inf).max())


def saturated(factor: float) -> Callable[[Setting], float]:
    """Return a check: the largest delta if every action is at a limit times ``factor``, in 1000 random corners."""

    def figure(s: Setting) -> float:
        generator = torch.Generator().manual_seed(0)
        high = torch.rand(1000, s.scene.num_actions, generator=generator) < 0.5
        bounds = torch.as_tensor(s.scene.action_low), torch.as_tensor(s.scene.action_high)
        rows = torch.arange(1000) % len(s.state)
        return s.size(s.model.delta(s.state[rows], factor * torch.where(high, bounds[1], bounds[0])))

    return figure


@cache
def corners(exact: Predictor, count: int, seed: int) -> TensorDictBase:
    """Return physical parameters of variants whose parameters are each at an end of the paper's random range."""
    system = require_bodies(exact.scene, "This check").origin["system"]
    ends = np.array([(one.low, one.high) for one in parameter_ranges(system).values()])
    chosen = np.random.default_rng(seed).integers(2, size=(count, len(ends)))
    variants = make_variants(system, ends[np.arange(len(ends)), chosen], timestep=exact.scene.timestep)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnseenParameterWarning)  # outside the training range on purpose
        return cast(TensorDictBase, torch.stack([exact.parameters_of(variant) for variant in variants]))


@cache
def variants_at_corners(s: Setting) -> tuple[float, float]:
    """Return the largest delta, and the error against float64, of variants at the ends of the paper's random ranges."""
    parameters = corners(s.exact, len(s.state), s.cfg.seed)
    models = (
        s.bind(s.weights, s.scene, parameters_key="parameters"),
        s.exact.model.bind(s.scene, parameters_key="parameters"),
    )
    delta, exact = (model.delta(s.state, s.action, parameters) for model in models)
    return s.size(delta), s.error(delta, exact)


def small_scenes(s: Setting) -> float:
    """Return the error against the reference on the smallest graphs; infinite if rollout or gradient is not finite."""
    worst = 0.0
    for source in SMALL_SCENES:
        scene = load_scene(source, timestep=0.02)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UncontrolledSceneWarning)
            data = collect_trajectories(scene, 8, 20, s.cfg.seed)
        for read in ("scene", "none"):  # with and without globals
            torch.manual_seed(s.cfg.seed)
            weights = ForwardModel.for_scene(scene, parameters=read, latent=32).to(s.model.dtype)
            reference = weights.bind(scene, reference=True)
            ForwardModelLoss(reference).fit_normalizers(trajectory_buffer(data, batch_size=100, seed=0).sample())
            model, state, action = s.bind(weights, scene), data["state"][:, 0].clone().requires_grad_(), data["action"]
            states, _ = model.rollout(state, action)
            (gradient,) = torch.autograd.grad(states[:, -1].square().sum(), state)
            with torch.no_grad():
                error = s.error(model.delta(state, action[:, 0]), reference.delta(state, action[:, 0]).double())
            worst = max(worst, error if bool(states.isfinite().all() & gradient.isfinite().all()) else torch.inf)
    return worst


def unstable_model(s: Setting) -> float:
    """Return the share of 1,000 steps that a diverging model predicts; infinite if a sample is not flagged."""
    weights, predicted = copy.deepcopy(s.weights), []
    with torch.no_grad():
        for parameter in weights.core.parameters():
            parameter *= 2
    model = s.bind(weights, s.scene)
    rollout = model.rollout

    def counted(state: Tensor, actions: Tensor, *inputs: TensorDictBase | None) -> tuple[Tensor, TensorDict | None]:
        predicted.append(actions.shape[:-1].numel())
        return rollout(state, actions, *inputs)

    model.rollout = cast(Any, counted)
    guarded = guarded_rollout(model, s.state, s.action.unsqueeze(1).expand(-1, 1000, -1))
    return sum(predicted) / (1000 * len(s.state)) if bool(guarded.diverged.all()) else torch.inf


def one_step(s: Setting) -> float:
    """Return the error of one step against float64."""
    return s.error(s.model.delta(s.state, s.action), s.exact.delta(s.state, s.action))


def long_gradient(s: Setting) -> float:
    """Return the error of the gradient to the actions through a rollout of 200 steps, against float64."""
    repeats = -(-200 // len(s.action))
    actions = s.action.repeat(repeats, 1)[:200].unsqueeze(0).expand(4, -1, -1)

    def gradient(model: Predictor) -> Tensor:
        leaf = actions.clone().requires_grad_()
        model.rollout(s.state[:4], leaf)[0][:, -1, 1:, :3].square().sum().backward()
        assert leaf.grad is not None
        return leaf.grad

    return s.error(gradient(s.model), gradient(s.exact))


def finite_difference(s: Setting) -> float:
    """Return the error of the gradient of one step against central differences, along random directions."""
    # Inside the limits, beyond which actions change nothing.
    state, action = s.state[:8].clone(), (0.9 * s.action[:8]).requires_grad_()
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(state.shape, generator=generator, dtype=torch.float64)
    along = torch.randn(action.shape, generator=generator, dtype=torch.float64)
    (slope,) = torch.autograd.grad((s.model.step(state, action)[0] * weight).sum(), action)
    step = 1e-7 if s.model.dtype == torch.float64 else 1e-3
    with torch.no_grad():
        ends = [(s.model.step(state, action + sign * step * along)[0] * weight).sum((-2, -1)) for sign in (1, -1)]
    return s.error((slope * along).sum(-1), (ends[0] - ends[1]) / (2 * step))


def orientation_loss(s: Setting) -> float:
    """Return the error of the loss for rotations that are off by 1e-6 rad."""
    loss = ForwardModelLoss(s.exact)
    turned = s.state.clone()
    off = 1e-6 * torch.as_tensor(s.scene.movable[:, 3:6], dtype=torch.float64)
    turned[..., 3:7] = quaternion.product(quaternion.exp(off.expand(len(turned), -1, -1)), turned[..., 3:7])
    target = BODY_STATE.delta(s.state, turned).to(s.model.dtype).double()
    where = BODY_STATE.delta_slices["orientation"]
    scale = s.exact.model.delta_normalizer.inverse_std[where]
    weight = s.exact.movable[:, where] * scale
    expected = (off * weight).square().sum() / (weight > 0).sum()
    errors = loss.component_errors(torch.zeros_like(target), target)
    return s.error(errors[BODY_STATE.names.index("orientation")], expected)

"""Online adaptation to a changed robot, by recursive Bayesian estimation through its forward model."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_gn.dynamics.features.controls import ControlInputs
from torchrl_gn.dynamics.parameters import refuse_variants
from torchrl_gn.dynamics.predictor import Predictor
from torchrl_gn.finite import require_finite
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.networks.evaluation_mode import evaluation_mode
from torchrl_gn.scenes import Scene
from torchrl_gn.scenes.checked_trajectories import check_trajectories

_STEP = 0.1  # finite-difference step of amounts
# Points of a standard normal number and their probabilities, with its mean and variance. They reach far, because what a
# stiff servo does depends on the side of its command on which it is.
_POINTS = (0.0, 0.604, -0.604, 1.308, -1.308, 2.616, -2.616)
_SHARES = (0.2358, 0.211, 0.211, 0.1455, 0.1455, 0.0256, 0.0256)
_HARDLY = 0.01  # share of a uniform command's standard deviation below which a command hardly varies
_LEAST = 1e-3  # least standard deviation of the points, in standard deviations of a command: float32 resolves it
_COMPARED = 1.0  # seconds: time constant of the errors that are compared with and without adaptation
_FREEDOM = 4.0  # degrees of freedom of the errors' Student's t distribution
_DIVERGED = 1e3  # error, in units of the noise, that stands for a prediction that is not finite
_SMALL, _SMALL_SQUARE = 0.9, 2.706  # a probability, and that quantile of a squared standard normal number
_SURE = 3.0  # standard deviations that count as a change: among dozens of estimates, one is off by two by chance
# Factor on the variance of what is not linear: a servo far from its command tells the same at every step.
_REPEATED = 4.0
_EARLY = 5  # the noise is calibrated after the first 1 / _EARLY of the trajectories' steps


class RobotChange(NamedTuple):
    """Estimated change of a robot.

    The changed robot responds to ``command``, clipped to its bounds, as the unchanged one to ``gain * command +
    offset``. Its physical parameters are the scene's plus, for each variant, ``amount`` times the variant's difference
    from the scene.
    """

    gain: Tensor  # [*B, A]; 1: unchanged, 0: dead motor
    gain_std: Tensor  # [*B, A] standard deviation
    offset: Tensor  # [*B, A], in the command's unit
    offset_std: Tensor  # [*B, A]
    amount: Tensor  # [*B, K] for each variant; 0: unchanged, 1: the variant
    amount_std: Tensor  # [*B, K]


class Belief(NamedTuple):
    """Gaussian belief about a robot's change, immutable; made and read by :class:`Adaptation`."""

    precision: Tensor  # [*B, P, P] precision of gains, offsets and amounts from the steps, without the prior
    moment: Tensor  # [*B, P] precision times mean
    errors: Tensor  # [*B, 2] recent one-step log(1 + squared error / noise variance), without and with adaptation


class _Linearised(NamedTuple):
    """Predicted changes of F velocities in units of the noise, linearised over a belief."""

    without: Tensor  # [*B, F] of the unchanged robot
    adapted: Tensor  # [*B, F] with the estimate's significant parts
    lift: Tensor  # [*B, F] mean over the belief, less ``adapted``
    used: Tensor  # [*B, P] significant parts of the estimate, around which it is linear
    slopes: Tensor  # [*B, F, P] by gains, offsets and amounts
    bends: Tensor  # [*B, F, D] rest at each point, times the root of its probability


class VariantMixture(Float64Buffers):
    """Physical parameters between a scene and its variants: for example with half of a variant's load.

    Args:
        predictor: predictor that reads each sample's parameters (``bind(scene, parameters_key="parameters")``).
        variants: ``K`` variants of the scene, for example from :func:`~torchrl_gn.scenes.with_factors`; none:
            parameters stay the scene's.

    Raises:
        ValueError: if there are variants but the predictor reads no parameters of samples, or if a variant differs in
            none of the parameters that it reads.
    """

    def __init__(self, predictor: Predictor, variants: Sequence[Scene]) -> None:
        super().__init__()
        self.count = len(variants)
        if variants and predictor.parameters_key is None:
            raise ValueError("Variants need a model that reads parameters: bind(scene, parameters_key='parameters').")
        self.names: list[str] = []
        if not variants:
            return
        base = predictor.own_parameters()
        others = [predictor.parameters_of(each) for each in variants]
        differences = [{str(name): value - base[name] for name, value in each.items()} for each in others]
        for number, each in enumerate(differences):
            if not any(bool((off != 0).any()) for off in each.values()):
                raise ValueError(f"The model reads no physical parameter in which variant {number} differs.")
        self.names = [name for name in differences[0] if any(bool((each[name] != 0).any()) for each in differences)]
        for name in self.names:
            self.register_buffer(f"own_{name}", base[name].double())
            self.register_buffer(f"difference_{name}", torch.stack([each[name] for each in differences], -1).double())

    def forward(self, amount: Tensor) -> TensorDict | None:
        """Return the predictor's parameter entry ``[*B]`` for amounts ``[*B, K]``; None without variants."""
        if not self.count:
            return None
        entries = {}
        for name in self.names:
            base, differences = getattr(self, f"own_{name}"), getattr(self, f"difference_{name}")
            shaped = amount.double().reshape(*amount.shape[:-1], *[1] * base.ndim, self.count)
            entries[name] = base + (differences * shaped).sum(-1)
        return TensorDict(entries, amount.shape[:-1])


class Adaptation(Float64Buffers):
    r"""Online estimator of a robot's changes: a dead or weak motor, a shifted zero, a load in its hand.

    The changed robot's command :math:`u` acts as :math:`g u + b`, and the physical parameters move by amounts :math:`a`
    to variants. At every step, the next velocities that the forward model predicts are linearised over the belief: each
    command takes seven values, as wide apart as the belief is uncertain about :math:`g u + b`. A line is fitted through
    the predictions, and what is not linear is noise (statistical linearisation; a stiff servo's torque saturates after
    milliradians). Recursive Bayesian linear regression of the model's errors estimates gains, offsets and amounts, with
    one call of the model on ``6 A + K + 2`` samples per step. Adapted predictions cost nothing extra: the model reads
    other commands and parameters (:class:`AdaptedPredictor`). Beyond the paper.

    Beliefs are immutable: :meth:`start` makes one, :meth:`update` returns the next, and :meth:`read` the change with
    its standard deviations. Each element of a batch ``[*B]`` is a separate robot.

    Args:
        predictor: predictor of one scene, not recurrent; specialise it for speed.
        trajectories: ``[M]`` trajectories of the unchanged robot, 20 or more, that the predictor was not trained on:
            its errors on them are the noise. They should be as long as ``memory`` and cover the situations that the
            robot meets.
        variants: ``K`` variants that the robot may move to, such as one with a load. They need a predictor that reads
            each sample's parameters and was trained on such variants.
        memory: time constant of forgetting, seconds; a step this old counts for 1/e.
        gain_std: prior standard deviation of gains.
        offset_std: prior standard deviation of offsets, in standard deviations of the trajectories' commands. A command
            that hardly varies there counts as uniform within its bounds.
        amount_std: prior standard deviation of amounts.

    Raises:
        ValueError: if the predictor has a hidden state or no action, if variants are given without a predictor that
            reads parameters or the other way round, if the trajectories are of other variants than the predictor's
            scene, not finite, of another control step or shape, or of less than two steps, or if an option is not
            positive.
    """

    middle: Tensor  # [A] mean of the trajectories' commands
    unit: Tensor  # [A] their standard deviation, or that within the bounds if they hardly vary
    weight: Tensor  # [N, V] inverse standard deviation of one-step errors; 0 for fixed channels
    prior: Tensor  # [P] prior precision of gains, offsets and amounts
    inflation: Tensor  # [] factor on the errors' variance, as errors of a step are not independent
    stretch: Tensor  # [P] further factor on the variance of each estimate
    floor: Tensor  # [P] standard deviation of the unchanged robot's estimates that remains after whole trajectories

    def __init__(
        self,
        predictor: Predictor,
        trajectories: TensorDictBase,
        *,
        variants: Sequence[Scene] = (),
        memory: float = 10.0,
        gain_std: float = 0.5,
        offset_std: float = 0.1,
        amount_std: float = 1.0,
    ) -> None:
        super().__init__()
        if predictor.recurrent:
            raise ValueError("Adaptation needs a model without hidden state.")
        if predictor.parameters_key is not None and not variants:
            raise ValueError(
                "The model reads parameters of each sample: give variants, or bind it without parameters_key."
            )
        if not predictor.scene.num_actions:
            raise ValueError(f"Scene {predictor.scene.name!r} has no commands to adapt.")
        if not (min(memory, gain_std, offset_std, amount_std) > 0):
            raise ValueError(
                f"memory={memory}, gain_std={gain_std}, offset_std={offset_std} and amount_std={amount_std} must be"
                " positive."
            )
        refuse_variants(predictor.scene, trajectories)
        check_trajectories(trajectories, predictor.scene, layout=predictor.layout)
        if trajectories["action"].shape[:2].numel() < 2:
            raise ValueError("Adaptation needs trajectories of two steps or more: one has no standard deviation.")
        self.mixture = VariantMixture(predictor, variants)
        self.predictor, self.scene = predictor, predictor.scene
        self._rates, self._controls = _rate_channels(predictor.layout), ControlInputs(self.scene)
        self.keep = math.exp(-self.scene.timestep / memory)
        self._compared = math.exp(-self.scene.timestep / _COMPARED)
        state, action = (cast(Tensor, trajectories[key]) for key in ("state", "action"))
        flat = self._controls.to(action.device).clipped(action.flatten(0, -2).double())
        self.register_buffer("middle", flat.mean(0))
        width = torch.as_tensor(self.scene.action_high - self.scene.action_low).to(flat)
        spread, uniform = flat.std(0), width / math.sqrt(12)
        varies = spread > _HARDLY * uniform
        self.register_buffer("unit", torch.where(varies, spread, uniform).clamp(min=1e-9))
        with torch.no_grad():
            predicted = self._step(state[:, :-1], action)
        error = self._velocities(state[:, :-1], state[:, 1:]) - self._velocities(state[:, :-1], predicted)
        error = error.flatten(0, 1)
        spread = error.square().mean(0).sqrt()
        self.register_buffer("weight", torch.where(spread > 1e-9 * spread.max(), 1 / spread, 0.0))
        count = action.shape[-1]
        prior = flat.new_tensor([gain_std] * count + [offset_std] * count + [amount_std] * len(variants))
        self.register_buffer("prior", prior**-2)
        self.register_buffer("floor", torch.zeros_like(prior))
        self.register_buffer("stretch", torch.ones_like(prior))
        self.register_buffer("inflation", self.prior.new_ones(()))
        self._calibrate(state, action, varies)

    def start(self, *batch: int) -> Belief:
        """Return the belief before any step, for robots of batch shape ``batch``."""
        size, zeros = len(self.prior), self.prior.new_zeros
        return Belief(zeros(*batch, size, size), zeros(*batch, size), zeros(*batch, 2))

    @torch.no_grad()
    @without_autocast
    def update(self, belief: Belief, state: Tensor, action: Tensor, next_state: Tensor) -> Belief:
        """Return the belief after a step from states ``[*B, N, 13]``; unchanged where the step is not finite."""
        return self._updated(belief, state, action, next_state, self.keep)

    def _updated(self, belief: Belief, state: Tensor, action: Tensor, next_state: Tensor, keep: float) -> Belief:
        """Return the belief after a step; the previous belief is discounted by ``keep``."""
        mean, covariance = self._posterior(belief)
        guess = self._predictions(state, action, mean, covariance)
        true = (self._velocities(state, next_state) * self.weight).flatten(-2)
        without, adapted = true - guess.without, true - guess.adapted  # [*B, F]
        error = adapted - guess.lift - (guess.slopes @ (mean - guess.used).unsqueeze(-1)).squeeze(-1)
        known = guess.slopes.isfinite().flatten(-2).all(-1) & guess.bends.isfinite().flatten(-2).all(-1)
        known &= adapted.isfinite().all(-1) & error.isfinite().all(-1)
        # A diverging adapted model counts as a large error, but nothing is learned from the step.
        adapted = torch.where(known.unsqueeze(-1), adapted, _DIVERGED)
        slopes, bends = (torch.where(known[..., None, None], each, 0.0) for each in (guess.slopes, guess.bends))
        error = torch.where(known.unsqueeze(-1), error, 0.0)
        count, one = (self.weight > 0).sum(), torch.eye(error.shape[-1], dtype=error.dtype, device=error.device)
        bent = _REPEATED * bends @ bends.mT  # what is not linear within the belief is noise, common to all velocities
        expected = one + self.inflation * (bent + slopes @ covariance @ slopes.mT)
        size = self.inflation * (error * _solved(expected, error.unsqueeze(-1)).squeeze(-1)).sum(-1) / count
        # Errors have long tails, for example at ground contacts: Student's t weights reduce the largest ones.
        trust = (_FREEDOM + 1) / (_FREEDOM + size)
        targets = error + (slopes @ mean.unsqueeze(-1)).squeeze(-1)
        informed = _solved(one + bent, torch.cat((slopes, targets.unsqueeze(-1)), -1))
        learned = trust[..., None, None] * (slopes.mT @ informed)
        sizes = torch.stack([self.inflation * each.square().sum(-1) / count for each in (without, adapted)], -1)
        after = Belief(
            keep * belief.precision + learned[..., :-1],
            keep * belief.moment + learned[..., -1],
            self._compared * belief.errors + (1 - self._compared) * sizes.log1p(),
        )
        # Ignore steps that are not finite, for example after a lost packet.
        good = next_state.isfinite().flatten(-2).all(-1) & without.isfinite().all(-1)
        return Belief(
            *(
                torch.where(good.reshape(*good.shape, *[1] * (new.ndim - good.ndim)), new, old)
                for new, old in zip(after, belief, strict=True)
            )
        )

    @torch.no_grad()
    def read(self, belief: Belief, *, guarded: bool = True) -> RobotChange:
        """Return the estimated change with its standard deviations.

        Args:
            belief: belief ``[*B]``.
            guarded: drop estimates within three standard deviations of no change, and all of a robot's estimates if
                its recent predictions (of about a second) are no better with them. So an unchanged robot keeps its
                model.
        """
        theta, covariance = self._posterior(belief)
        covariance = self._calibrated(covariance)
        std = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        if guarded:
            without, adapted = belief.errors.unbind(-1)
            theta = torch.where((adapted < without).unsqueeze(-1), _significant(theta, std), 0.0)
        gain, shift, amount = self._parts(theta)
        gain_std, shift_std, amount_std = self._parts(std)
        offset = self.unit * shift - gain * self.middle
        offset_std = self._acting_variance(covariance, -self.middle / self.unit).sqrt() * self.unit
        return RobotChange(1 + gain, gain_std, offset, offset_std, amount, amount_std)

    def _parts(self, theta: Tensor) -> Sequence[Tensor]:
        """Split estimates into gains less 1 ``[*B, A]``, offsets in units ``[*B, A]`` and amounts ``[*B, K]``."""
        count = len(self.unit)
        return theta.split((count, count, theta.shape[-1] - 2 * count), -1)

    def _posterior(self, belief: Belief) -> tuple[Tensor, Tensor]:
        """Return the mean ``[*B, P]`` and covariance of gains less 1, offsets in units, and amounts."""
        covariance = torch.linalg.inv(belief.precision + torch.diag(self.prior))
        return (covariance @ belief.moment.unsqueeze(-1)).squeeze(-1), covariance

    def _calibrated(self, covariance: Tensor) -> Tensor:
        """Return the covariance of estimates from that of :meth:`_posterior`."""
        stretch = self.stretch.sqrt()
        return stretch[:, None] * covariance * stretch + torch.diag(self.floor.square())

    def _acting_variance(self, covariance: Tensor, scaled: Tensor) -> Tensor:
        """Return the variance ``[*B, A]`` of ``gain * scaled + shift`` in units, as both err together."""
        count = len(self.unit)
        gain, shift, _ = self._parts(covariance.diagonal(dim1=-2, dim2=-1))
        both = covariance.diagonal(offset=count, dim1=-2, dim2=-1)[..., :count]
        return (scaled.square() * gain + shift + 2 * scaled * both).clamp(min=0)

    def _step(self, state: Tensor, action: Tensor, parameters: TensorDict | None = None) -> Tensor:
        """Return the predictor's next states; dropout would be an error of the model."""
        with evaluation_mode(self.predictor):
            return self.predictor.step(state, action, parameters)[0]

    def _velocities(self, state: Tensor, next_state: Tensor) -> Tensor:
        """Return the changes ``[*B, N, V]`` of the velocity components, in float64."""
        return self.predictor.layout.delta(state, next_state)[..., self._rates].double()

    def _predictions(self, state: Tensor, action: Tensor, mean: Tensor, covariance: Tensor) -> _Linearised:
        """Predict velocity changes, and linearise them over the belief."""
        # The robot clips commands before its change acts.
        commanded, batch, count = self._controls.clipped(action.double()), action.shape[:-1], action.shape[-1]
        scaled = (commanded - self.middle) / self.unit
        used = _significant(mean, self._calibrated(covariance).diagonal(dim1=-2, dim2=-1).sqrt())
        gain, shift, amount = self._parts(used)
        acting = commanded + self.unit * (gain * scaled + shift)  # equivalent commands of the unchanged robot
        gain, shift, _ = self._parts(mean - used)
        variance = self._acting_variance(covariance, scaled) + (gain * scaled + shift).square()
        std = variance.sqrt().clamp(min=_LEAST)  # [*B, A] in units, around the equivalent commands
        points, shares = std.new_tensor(_POINTS[1:]), std.new_tensor(_SHARES[1:])
        # One command at a time moves to the other points: [D, A, *B, A].
        moved = torch.tensordot(points, torch.diag_embed(std * self.unit).movedim(-1, 0), 0).flatten(0, 1)
        heavier = torch.diag_embed(torch.full_like(amount, _STEP)).movedim(-1, 0)
        zeros = torch.zeros_like(acting)
        commands = acting + torch.cat(
            ((commanded - acting)[None], zeros[None], moved, zeros.expand(len(heavier), *zeros.shape))
        )
        zeros = torch.zeros_like(amount)
        amounts = amount + torch.cat((-amount[None], zeros.expand(1 + len(moved), *zeros.shape), heavier))
        states = state.expand(len(commands), *batch, *state.shape[-2:])
        after = self._step(states, commands.to(action.dtype), self.mixture(amounts))
        change = (self._velocities(states, after) * self.weight).flatten(-2)  # [S, *B, F]
        without, adapted, by_command, by_amount = change.split((1, 1, len(moved), len(heavier)))
        by_command = (by_command - adapted).unflatten(0, (len(points), count))  # [D, A, *B, F]
        tilt = torch.tensordot(shares * points, by_command, 1)  # change for one standard deviation
        lift = torch.tensordot(shares, by_command, 1)
        bends = torch.cat((-lift[None], by_command - lift - torch.tensordot(points, tilt, 0)))
        roots = std.new_tensor(_SHARES).sqrt().reshape(-1, *[1] * (bends.ndim - 1))
        by_shift = (tilt / std.movedim(-1, 0).unsqueeze(-1)).movedim(0, -1)  # [*B, F, A]
        by_amount = ((by_amount - adapted) / _STEP).movedim(0, -1)
        slopes = torch.cat((by_shift * scaled.unsqueeze(-2), by_shift, by_amount), -1)
        return _Linearised(
            without[0], adapted[0], lift.sum(0), used, slopes, (roots * bends).flatten(0, 1).movedim(0, -1)
        )

    @torch.no_grad()
    @without_autocast
    def _calibrate(self, state: Tensor, action: Tensor, varies: Tensor) -> None:
        """Fit ``inflation``, ``stretch`` and ``floor`` so that an unchanged robot is within its standard deviations.

        Commands ``[A]`` that hardly vary (``varies`` is False) tell nothing of gains, which then err like offsets.
        """
        steps, inflation, belief = action.shape[1], self.inflation.clone(), self.start(len(action))
        early = max(1, steps // _EARLY)
        for step in range(steps):
            belief = self._updated(belief, state[:, step], action[:, step], state[:, step + 1], 1.0)
            if step + 1 == early:
                mean, covariance = self._posterior(belief)
                square = _size(mean.square() / covariance.diagonal(dim1=-2, dim2=-1))
                inflation = square.median().clamp(min=1.0)
                self.stretch.copy_((square / inflation).clamp(min=1.0))
        self.floor.copy_(_size(self._posterior(belief)[0].square()).sqrt())
        for values in (self.stretch, self.floor):
            gain, shift, _ = self._parts(values)
            gain.copy_(torch.where(varies, gain, shift))
        self.weight /= inflation.sqrt()
        self.inflation.copy_(inflation)


class AdaptedPredictor(TensorDictModuleBase):
    """Predictor of a changed robot.

    Environments, planners and losses use it as any other model. A rollout is one call of the given predictor, and
    differentiable.

    Args:
        predictor: predictor of the unchanged robot, see :class:`Adaptation`.
        change: estimated change of the robot; default: none.
        variants: see :class:`Adaptation`. With variants, the samples' own parameters are not read.
    """

    gain: Tensor  # [A]
    offset: Tensor  # [A]
    amount: Tensor  # [K]

    def __init__(
        self, predictor: Predictor, change: RobotChange | None = None, *, variants: Sequence[Scene] = ()
    ) -> None:
        super().__init__()
        self.predictor, self.scene, self.layout = predictor, predictor.scene, predictor.layout
        self.fixed_batch = predictor.fixed_batch
        at = next(itertools.chain(predictor.parameters(), predictor.buffers())).device
        self.register_buffer("gain", torch.ones(predictor.scene.num_actions, device=at))
        self.register_buffer("offset", torch.zeros(predictor.scene.num_actions, device=at))
        self._controls = ControlInputs(self.scene).to(at)
        self.mixture = VariantMixture(predictor, variants)
        self.register_buffer("amount", torch.zeros(len(variants), device=at))
        self.in_keys: list[NestedKey] = list(predictor.in_keys[:2])
        self.out_keys: list[NestedKey] = list(predictor.out_keys)
        if change is not None:
            self.take(change)

    def parameters_in(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Return None with variants, as adaptation sets the parameters; else see :meth:`Predictor.parameters_in`."""
        return None if self.mixture.count else self.predictor.parameters_in(tensordict)

    def take(self, change: RobotChange) -> None:
        """Set the change in place, so that planners that hold the model use it.

        Raises:
            ValueError: if the change is of several robots, has another number of commands or variants, or is not
                finite. The model then keeps its earlier change.
        """
        for name in ("gain", "offset", "amount"):
            value, own = getattr(change, name), getattr(self, name)
            if value.shape != own.shape:
                raise ValueError(
                    f"The change's {name} must be {list(own.shape)}, of one robot, got {list(value.shape)}."
                )
            require_finite(value, f"{name} of the change")
        self.gain.copy_(change.gain)
        self.offset.copy_(change.offset)
        self.amount.copy_(change.amount)

    def step(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the next states ``[*B, N, 13]`` under commands ``[*B, A]``."""
        return self.predictor.step(state, self._acting(action), self.mixture(self.amount))[0]

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """Return states ``[*B, T + 1, N, 13]`` from a start state under commands ``[*B, T, A]``."""
        return self.predictor.rollout(state, self._acting(actions), self.mixture(self.amount))[0]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next state."""
        self.parameters_in(tensordict)
        state, action = (tensordict[key] for key in self.in_keys[:2])
        return tensordict.set(self.out_keys[0], self.step(state, action))

    def _acting(self, action: Tensor) -> Tensor:
        # The robot clips a command before its change acts.
        return self.gain.to(action.dtype) * self._controls.clipped(action) + self.offset.to(action.dtype)


def _solved(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve for positive definite matrices ``[*B, F, F]``."""
    return torch.cholesky_solve(right, torch.linalg.cholesky(matrix))


def _size(squares: Tensor) -> Tensor:
    """Estimate the mean squares ``[P]`` of normal numbers from squares ``[M, P]``.

    Uses a quantile, which outliers hardly change.
    """
    return squares.quantile(_SMALL, dim=0) / _SMALL_SQUARE


def _significant(theta: Tensor, std: Tensor) -> Tensor:
    """Set estimates within three standard deviations of 0 to 0."""
    return torch.where(theta.abs() > _SURE * std, theta, 0.0)


def _rate_channels(layout: StateLayout) -> list[int]:
    """List the channels of a state change that are velocities."""
    rates, channels = {component.rate for component in layout.components}, range(layout.delta_size)
    return [channel for name, where in layout.delta_slices.items() if name in rates for channel in channels[where]]

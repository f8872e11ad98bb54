"""Adaptation while a robot acts: what its commands do now, by recursive Bayes through its forward model."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_gn.dynamics.predictor import Predictor
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.maths.state_layout import StateLayout

_STEP = 0.1  # of a finite difference, in standard deviations of a command
_JUDGED = 1.0  # seconds over which the model with and without adaptation is judged
_FREEDOM = 4.0  # degrees of freedom of the errors' distribution
_DIVERGED = 1e3  # times the noise that an adapted model errs which is not finite
_EARLY = 5  # fraction of trajectories, 1 / so much, after which the noise is calibrated


class Commands(NamedTuple):
    """What a robot makes of its commands: as the model's of ``gain * command + offset``."""

    gain: Tensor  # [*B, A]; 1 of an unchanged robot, 0 of a dead motor
    gain_std: Tensor  # [*B, A] standard deviation
    offset: Tensor  # [*B, A], in the command's unit
    offset_std: Tensor  # [*B, A]


class Belief(NamedTuple):
    """Belief about a robot's commands, a value; made and read by :class:`CommandAdaptation`."""

    precision: Tensor  # [*B, P, P] what steps told of gains and offsets, without the prior
    moment: Tensor  # [*B, P]
    errors: Tensor  # [*B, 2] recent log(1 + squared error by the noise) of one step, without and with adaptation


class CommandAdaptation(Float64Buffers):
    r"""Learn from every step what a robot's commands do: a dead or weak motor, another gear, a shifted zero.

    To first order a command :math:`u` that acts as :math:`g u + b` changes the next velocities by :math:`\sum_j
    \partial v / \partial u_j ((g_j - 1) u_j + b_j)`, with derivatives of the forward model. Gains and offsets follow
    by Bayesian linear regression of its errors, recursively (an extended Kalman filter): one call of the model with
    ``A + 2`` commands a step.
    Prediction costs nothing more: the model reads other commands (:class:`AdaptedPredictor`). Beyond the paper.

    A belief is a value: :meth:`start` gives one, :meth:`update` the next, :meth:`read` gains and offsets with their
    standard deviations. Batches ``[*B]`` are robots of their own.

    Args:
        predictor: of one scene, specialised to be quick; neither recurrent nor with parameters of each sample.
        trajectories: ``[M]`` of the unchanged robot, some 20 or more, with which the predictor was not trained: their
            errors are the noise. Best as long as the memory, in situations that the robot comes into.
        memory: seconds after which a step counts for a third.
        gain_std: standard deviation of gains before anything is seen.
        offset_std: of offsets, in standard deviations of the trajectories' commands.

    Raises:
        ValueError: if the predictor has a hidden state, parameters of each sample or no action, or an option is not
            positive.
    """

    middle: Tensor  # [A] of the trajectories' commands
    unit: Tensor  # [A] their standard deviation
    weight: Tensor  # [N, V] inverse standard deviation of the errors of one step; 0 of channels that do not move
    prior: Tensor  # [P] precision of gains and offsets before anything is seen
    inflation: Tensor  # [] of the variance, as a step's errors are not independent
    floor: Tensor  # [P] standard deviation that remains, of the unchanged robot after whole trajectories

    def __init__(
        self,
        predictor: Predictor,
        trajectories: TensorDictBase,
        *,
        memory: float = 10.0,
        gain_std: float = 0.5,
        offset_std: float = 0.1,
    ) -> None:
        super().__init__()
        if predictor.recurrent or predictor.parameters_key is not None:
            raise ValueError("Adaptation needs a model without hidden state and without parameters of each sample.")
        if not predictor.scene.num_actions:
            raise ValueError(f"Scene {predictor.scene.name!r} has no commands to adapt.")
        if not (min(memory, gain_std, offset_std) > 0):
            raise ValueError(f"memory={memory}, gain_std={gain_std} and offset_std={offset_std} must be positive.")
        self.predictor, self.scene = predictor, predictor.scene
        self._rates = _rate_channels(predictor.layout)
        self.keep = math.exp(-self.scene.timestep / memory)
        self._judged = math.exp(-self.scene.timestep / _JUDGED)
        state, action = (cast(Tensor, trajectories[key]) for key in ("state", "action"))
        flat = action.flatten(0, -2).double()
        self.register_buffer("middle", flat.mean(0))
        self.register_buffer("unit", flat.std(0).clamp(min=1e-9))
        with torch.no_grad():
            predicted = predictor.step(state[:, :-1], action)[0]
        error = self._velocities(state[:, :-1], state[:, 1:]) - self._velocities(state[:, :-1], predicted)
        error = error.flatten(0, 1)
        spread = error.square().mean(0).sqrt()
        self.register_buffer("weight", torch.where(spread > 1e-9 * spread.max(), 1 / spread, 0.0))
        count = action.shape[-1]
        prior = flat.new_tensor([gain_std] * count + [offset_std] * count)
        self.register_buffer("prior", prior**-2)
        self.register_buffer("floor", self.prior.new_zeros(2 * count))
        self.register_buffer("inflation", self.prior.new_ones(()))
        self._calibrate(state, action)

    def start(self, *batch: int) -> Belief:
        """Belief before anything is seen, of ``batch`` robots."""
        size, zeros = len(self.prior), self.prior.new_zeros
        return Belief(zeros(*batch, size, size), zeros(*batch, size), zeros(*batch, 2))

    @torch.no_grad()
    @without_autocast
    def update(self, belief: Belief, state: Tensor, action: Tensor, next_state: Tensor) -> Belief:
        """Belief after a step from states ``[*B, N, 13]``; the same where the step is not finite."""
        return self._updated(belief, state, action, next_state, self.keep)

    def _updated(self, belief: Belief, state: Tensor, action: Tensor, next_state: Tensor, keep: float) -> Belief:
        """Belief after a step, of which what was known before counts ``keep``."""
        theta = _significant(*self._estimate(belief))
        predicted, by_command = self._predictions(state, action, self._acting(action, theta))
        true = self._velocities(state, next_state)
        errors = (true - predicted) * self.weight  # [2, *B, N, V] of the commands as given, and as they are said to act
        inputs = self._inputs(by_command, action)  # [*B, N V, P]
        without, adapted = errors.flatten(-2)
        known = inputs.isfinite().flatten(-2).all(-1) & adapted.isfinite().all(-1)
        # Where the adapted model diverges, that is judged, but nothing is learned.
        adapted = torch.where(known.unsqueeze(-1), adapted, _DIVERGED)
        inputs = torch.where(known[..., None, None], inputs, 0.0)
        count = (self.weight > 0).sum()
        size = torch.stack([self.inflation * each.square().sum(-1) / count for each in (without, adapted)], -1)
        # Errors have long tails, as where bodies hit the ground: those of a Student's t weigh less the larger they are.
        trusted = inputs.mT * ((_FREEDOM + 1) / (_FREEDOM + size[..., 1]))[..., None, None]
        wanted = adapted.unsqueeze(-1) + inputs @ theta.unsqueeze(-1)  # linear about what is known (extended Kalman)
        after = Belief(
            keep * belief.precision + trusted @ inputs,
            keep * belief.moment + (trusted @ wanted).squeeze(-1),
            self._judged * belief.errors + (1 - self._judged) * size.log1p(),
        )
        # What is not finite, as a lost packet, teaches nothing.
        good = next_state.isfinite().flatten(-2).all(-1) & without.isfinite().all(-1)
        return Belief(
            *(
                torch.where(good.reshape(*good.shape, *[1] * (new.ndim - good.ndim)), new, old)
                for new, old in zip(after, belief, strict=True)
            )
        )

    @torch.no_grad()
    def read(self, belief: Belief, *, guarded: bool = True) -> Commands:
        """Gains and offsets with their standard deviations.

        ``guarded``: 1 and 0 where that is within two standard deviations, or where in the last second the model
        predicted no worse without; so an unchanged robot keeps its model.
        """
        theta, std = self._estimate(belief)
        if guarded:
            without, adapted = belief.errors.unbind(-1)
            theta = torch.where((adapted < without).unsqueeze(-1), _significant(theta, std), 0.0)
        gain, shift = theta.chunk(2, -1)
        gain_std, shift_std = std.chunk(2, -1)
        return Commands(1 + gain, gain_std, self.unit * shift - gain * self.middle, self.unit * shift_std)

    def _acting(self, action: Tensor, theta: Tensor) -> Tensor:
        """Commands of the unchanged robot that act as these do, in float64."""
        gain, shift = theta.chunk(2, -1)
        return action.double() + gain * (action.double() - self.middle) + shift * self.unit

    def _estimate(self, belief: Belief) -> tuple[Tensor, Tensor]:
        """:meth:`_mean` and its standard deviations ``[*B, P]``."""
        std = (self._covariance(belief).diagonal(dim1=-2, dim2=-1) + self.floor.square()).sqrt()
        return self._mean(belief), std

    def _mean(self, belief: Belief) -> Tensor:
        """Gains less 1, and offsets in units, ``[*B, P]``."""
        return torch.linalg.solve(belief.precision + torch.diag(self.prior), belief.moment)

    def _covariance(self, belief: Belief) -> Tensor:
        return torch.linalg.inv(belief.precision + torch.diag(self.prior))

    def _velocities(self, state: Tensor, next_state: Tensor) -> Tensor:
        """Changes ``[*B, N, V]`` of the components that are rates of others, in float64."""
        return self.predictor.layout.delta(state, next_state)[..., self._rates].double()

    def _predictions(self, state: Tensor, action: Tensor, acting: Tensor) -> tuple[Tensor, Tensor]:
        """Changes of velocities ``[2, *B, N, V]`` under commands and under others, with derivatives by the others.

        Those are ``[*B, N, V, A]`` by a unit of each command.
        """
        count, batch = action.shape[-1], action.shape[:-1]
        # Towards the middle: models clip commands to their bounds.
        step = torch.where(acting > self.middle, -_STEP, _STEP)  # [*B, A]
        moved = acting.unsqueeze(0) + torch.diag_embed(step * self.unit).movedim(-1, 0)
        commands = torch.cat((action.double().unsqueeze(0), acting.unsqueeze(0), moved)).to(action.dtype)
        states = state.expand(count + 2, *batch, *state.shape[-2:])
        after = self._velocities(states, self.predictor.step(states, commands)[0])
        return after[:2], (after[2:] - after[1:2]).movedim(0, -1) / step[..., None, None, :]

    def _inputs(self, by_command: Tensor, action: Tensor) -> Tensor:
        """Inputs ``[*B, N V, P]`` of the regression, by the noise."""
        weighted = by_command * self.weight.unsqueeze(-1)
        scaled = (action.double() - self.middle) / self.unit
        return torch.cat((weighted * scaled[..., None, None, :], weighted), -1).flatten(-3, -2)

    @torch.no_grad()
    @without_autocast
    def _calibrate(self, state: Tensor, action: Tensor) -> None:
        """Weigh steps, and find what remains, so that an unchanged robot's gains are within what is stated."""
        steps, inflation, belief = action.shape[1], self.inflation.clone(), self.start(len(action))
        early = max(1, steps // _EARLY)
        for step in range(steps):
            belief = self._updated(belief, state[:, step], action[:, step], state[:, step + 1], 1.0)
            if step + 1 == early:
                square = self._mean(belief).square() / self._covariance(belief).diagonal(dim1=-2, dim2=-1)
                inflation = square.mean().clamp(min=1.0)
        self.floor.copy_(self._mean(belief).square().mean(0).sqrt())
        self.weight /= inflation.sqrt()
        self.inflation.copy_(inflation)


class AdaptedPredictor(TensorDictModuleBase):
    """A predictor of a robot whose commands act as its own of ``gain * command + offset``.

    For environments, planners and losses, as any model: it rolls out in the predictor's one call, differentiably.

    Args:
        predictor: of the unchanged robot, as of :class:`CommandAdaptation`.
        commands: what is known of the robot; default: it is unchanged.
    """

    gain: Tensor  # [A]
    offset: Tensor  # [A]

    def __init__(self, predictor: Predictor, commands: Commands | None = None) -> None:
        super().__init__()
        self.predictor, self.scene, self.layout = predictor, predictor.scene, predictor.layout
        self.fixed_batch = predictor.fixed_batch
        at = next(itertools.chain(predictor.parameters(), predictor.buffers())).device
        self.register_buffer("gain", torch.ones(predictor.scene.num_actions, device=at))
        self.register_buffer("offset", torch.zeros(predictor.scene.num_actions, device=at))
        self.in_keys: list[NestedKey] = list(predictor.in_keys)
        self.out_keys: list[NestedKey] = list(predictor.out_keys)
        if commands is not None:
            self.take(commands)

    def parameters_in(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """As of the predictor, which refuses those of another variant."""
        return self.predictor.parameters_in(tensordict)

    def take(self, commands: Commands) -> None:
        """Take what is known now, in place, so that planners that hold the model see it."""
        self.gain.copy_(commands.gain)
        self.offset.copy_(commands.offset)

    def step(self, state: Tensor, action: Tensor) -> Tensor:
        """Next states ``[*B, N, 13]`` under commands ``[*B, A]``."""
        return self.predictor.step(state, self._acting(action))[0]

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """States ``[*B, T + 1, N, 13]`` from a start state under commands ``[*B, T, A]``."""
        return self.predictor.rollout(state, self._acting(actions))[0]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next state."""
        self.parameters_in(tensordict)
        state, action = (tensordict[key] for key in self.in_keys[:2])
        return tensordict.set(self.out_keys[0], self.step(state, action))

    def _acting(self, action: Tensor) -> Tensor:
        return self.gain.to(action.dtype) * action + self.offset.to(action.dtype)


def _significant(theta: Tensor, std: Tensor) -> Tensor:
    """Numbers that are more than two standard deviations off 0; 0 for the others."""
    return torch.where(theta.abs() > 2 * std, theta, 0.0)


def _rate_channels(layout: StateLayout) -> list[int]:
    """Channels of a state change that are rates of others."""
    rates, channels = {component.rate for component in layout.components}, range(layout.delta_size)
    return [channel for name, where in layout.delta_slices.items() if name in rates for channel in channels[where]]

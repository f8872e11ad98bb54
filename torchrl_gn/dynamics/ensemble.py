"""Ensembles: forward models that differ only in their weights, and uncertainty from their spread."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_gn.dynamics.model import ForwardModel
from torchrl_gn.dynamics.predictor import Predictor
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.scenes import Articulation
from torchrl_gn.scenes.load import as_scene


class Calibration(Float64Buffers):
    """Map from the spread of an ensemble's members to standard deviations of the error.

    The standard deviation of a channel after ``t`` steps is ``factor[t] * sqrt(spread ** 2 + floor[t] ** 2)``. Steps
    beyond those fitted use the last numbers. :func:`~torchrl_gn.evaluation.calibrate` fits the numbers.

    Args:
        steps: number of fitted steps ``T``; 0: not fitted.
        components: number of components of the state ``C``.
    """

    factor: Tensor  # [T, C]
    floor: Tensor  # [T, C], in the components' units
    typical: Tensor  # [C], root mean square of one step's standard deviations over data; 0 for fixed components

    def __init__(self, steps: int, components: int) -> None:
        super().__init__()
        self.register_buffer("factor", torch.zeros(steps, components, dtype=torch.float64))
        self.register_buffer("floor", torch.zeros(steps, components, dtype=torch.float64))
        self.register_buffer("typical", torch.zeros(components, dtype=torch.float64))

    @property
    def fitted(self) -> bool:
        """True if there are numbers for at least one step."""
        return len(self.factor) > 0

    def require_fitted(self) -> None:
        """Raise RuntimeError unless fitted."""
        if not self.fitted:
            raise RuntimeError(
                "The ensemble is not calibrated: its members' spread is several times smaller than their error. Call"
                " torchrl_gn.evaluation.calibrate(ensemble, trajectories) with trajectories that no member trained on."
            )

    def set(self, factor: Tensor, floor: Tensor, typical: Tensor) -> None:
        """Set ``factor`` and ``floor`` ``[T, C]``, for any number of steps, and ``typical`` ``[C]``."""
        values = (each.double().to(self.factor.device) for each in (factor, floor, typical))
        self.factor, self.floor, self.typical = values

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Take the saved number of steps, which differs from this one's where only one of the two was fitted."""
        for name in ("factor", "floor"):
            saved, own = state_dict.get(prefix + name), getattr(self, name)
            if isinstance(saved, Tensor) and saved.ndim == 2 and saved.shape[1:] == own.shape[1:]:
                setattr(self, name, own.new_zeros(saved.shape))
        super()._load_from_state_dict(state_dict, prefix, *args)

    def clear(self) -> None:
        """Forget all numbers."""
        none = self.factor.new_zeros(0, self.factor.shape[1])
        self.set(none, none.clone(), torch.zeros_like(self.typical))

    def forward(self, spread: Tensor, layout: StateLayout, steps: Sequence[int] | None = None) -> Tensor:
        """Return standard deviations ``[*B, T, N, D]`` for spreads after steps 1 to T, or after the given ``steps``.

        Numbers of fixed channels are meaningless. Raises RuntimeError unless fitted.
        """
        self.require_fitted()
        count, device = spread.shape[-3], spread.device
        step = torch.arange(count, device=device) if steps is None else torch.tensor(steps, device=device) - 1
        step = step.clamp(max=len(self.factor) - 1)
        parts = []
        for index, where in enumerate(layout.delta_slices.values()):
            factor, floor = (each[step, index].view(-1, 1, 1) for each in (self.factor, self.floor))
            parts.append(factor * (spread[..., where].square() + floor.square()).sqrt())
        return torch.cat(parts, dim=-1)

    def by_typical(self, squares: Tensor) -> Tensor:
        """Return the root mean square ``[*B]`` over moving components, from mean squares ``[*B, C]``.

        Each component counts in units of its typical standard deviation.
        """
        moving = self.typical > 0
        ratios = squares / torch.where(moving, self.typical.square(), 1.0)
        # No indexing by a mask: it would synchronise with the device.
        return (torch.where(moving, ratios, 0.0).sum(-1) / moving.sum()).sqrt()


class Prediction(NamedTuple):
    """Rollouts predicted by an ensemble."""

    mean: Tensor  # [*B, T + 1, N, 13]; the start state comes first
    std: Tensor  # [*B, T + 1, N, 12] standard deviation of the error: m, rad, m/s, rad/s; inf where a member diverged
    members: Tensor  # [K, *B, T + 1, N, 13] states predicted by each member


class Ensemble(nn.Module):
    """Forward models of one scene that differ only in their weights (Lakshminarayanan et al. 2017; PETS 2018).

    Disagreement of the members signals that none of them can be trusted. :func:`~torchrl_gn.training.fit_ensemble`
    trains each member from its own initial weights and batches; :func:`~torchrl_gn.evaluation.calibrate` relates their
    disagreement to the size of errors. Beyond the paper.

    Args:
        members: two or more models with the same options.

    Raises:
        ValueError: if there are fewer than two members, or their options differ.
    """

    def __init__(self, members: Sequence[ForwardModel]) -> None:
        super().__init__()
        if len(members) < 2:
            raise ValueError(f"An ensemble needs two members or more, not {len(members)}.")
        first = members[0].description()
        if any(member.description() != first for member in members):
            raise ValueError("The members of an ensemble must have the same options.")
        self.members = nn.ModuleList(members)
        self.calibration = Calibration(0, len(members[0].layout.names))

    @classmethod
    def for_scene(cls, scene: Articulation | str | os.PathLike, *, count: int = 5, **options) -> Ensemble:
        """Build an ensemble with fresh weights, drawn from torch's global generator.

        Args:
            scene: the scene, or its name or path.
            count: number of members ``K``.
            **options: options of :meth:`ForwardModel.for_scene`.
        """
        scenes = as_scene(scene)
        return cls([ForwardModel.for_scene(scenes, **options) for _ in range(count)])

    @property
    def models(self) -> list[ForwardModel]:
        """The members."""
        return list(self.members)  # pyright: ignore[reportReturnType]

    def bind(self, scene: Articulation | str | os.PathLike, **options) -> BoundEnsemble:
        """Join the members to a scene, its name or its path; ``options`` are those of :meth:`ForwardModel.bind`."""
        known = as_scene(scene)
        return BoundEnsemble([model.bind(known, **options) for model in self.models], self.calibration)

    def description(self) -> dict:
        """Return JSON-serialisable values for :meth:`from_description`."""
        model = self.models[0].description()
        return {"count": len(self.members), "steps": len(self.calibration.factor), "member": model}

    @classmethod
    def from_description(
        cls, description: dict, *, physics: Callable[[Tensor, Tensor], Tensor] | None = None
    ) -> Ensemble:
        """Build an ensemble from its :meth:`description`, with fresh weights.

        See :meth:`ForwardModel.from_description`.
        """
        member = description["member"]
        made = cls([ForwardModel.from_description(member, physics=physics) for _ in range(description["count"])])
        made.calibration = Calibration(description["steps"], len(made.models[0].layout.names))
        return made


class BoundEnsemble(TensorDictModuleBase):
    """Ensemble bound to one scene: predicts the next state and the standard deviation of its error.

    Reads ``state`` ``[*B, N, 13]`` and ``action`` ``[*B, A]``, writes the members' mean to ``("next", "state")`` and
    the standard deviation of its error ``[*B, N, 12]`` to ``("next", "state_std")``. Differentiable like its members.

    Args:
        predictors: the members, bound to one scene or specialised.
        calibration: the ensemble's calibration.

    Raises:
        ValueError: if members have hidden states or read parameters of each sample.
    """

    movable: Tensor  # [N, D] bool
    counted: Tensor  # [N, D] bool, movable channels of predicted bodies

    def __init__(self, predictors: Sequence[Predictor], calibration: Calibration) -> None:
        super().__init__()
        if any(each.recurrent or each.parameters_key is not None for each in predictors):
            raise ValueError("Members of an ensemble must have no hidden state and read no parameters of samples.")
        self.predictors = nn.ModuleList(predictors)
        self.calibration = calibration
        self.scene, self.layout = predictors[0].scene, predictors[0].layout
        movable = torch.as_tensor(self.scene.movable, device=calibration.typical.device)
        self.register_buffer("movable", movable, persistent=False)
        predicted = torch.as_tensor(self.scene.predicted, device=movable.device)
        self.register_buffer("counted", movable & predicted.unsqueeze(-1), persistent=False)
        self.in_keys: list[NestedKey] = list(predictors[0].in_keys)
        self.out_keys: list[NestedKey] = [*predictors[0].out_keys, ("next", "state_std")]

    @property
    def members(self) -> list[Predictor]:
        """The members."""
        return list(self.predictors)  # pyright: ignore[reportReturnType]

    def parameters_in(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """See :meth:`Predictor.parameters_in`: the members refuse parameters of another variant."""
        return self.members[0].parameters_in(tensordict)

    def step(self, state: Tensor, action: Tensor) -> Tensor:
        """Return each member's next state ``[K, *B, N, 13]``."""
        return torch.stack([each.step(state, action)[0] for each in self.members])

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """Return each member's states ``[K, *B, T + 1, N, 13]`` from a start state under actions ``[*B, T, A]``."""
        return torch.stack([each.rollout(state, actions)[0] for each in self.members])

    @without_autocast
    def doubt(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the expected error of the next step ``[*B]``, in units of the typical error on calibration data.

        10 means ten times the typical error. The doubt is the root mean square of the moving components' standard
        deviations, each divided by its typical value; infinite if a member is not finite. Costs one step of each
        member. Raises RuntimeError if the ensemble is not calibrated.
        """
        return self.doubt_of(self.step(state, action))

    @without_autocast
    def doubt_of(self, members: Tensor) -> Tensor:
        """Return :meth:`doubt` ``[*B]`` of known next states of the members, ``[K, *B, N, 13]`` as of :meth:`step`."""
        _, spread = mean_and_spread(members, self.layout)
        std = self.calibration(spread.unsqueeze(-3), self.layout).squeeze(-3)
        return self.calibration.by_typical(mean_squares(std, self.counted, self.layout))

    @without_autocast
    def predict(self, state: Tensor, actions: Tensor) -> Prediction:
        """Predict rollouts with their standard deviations.

        Args:
            state: start states ``[*B, N, 13]``.
            actions: ``[*B, T, A]``.

        Raises:
            RuntimeError: if the ensemble is not calibrated.
        """
        members = self.rollout(state, actions)
        mean, spread = mean_and_spread(members, self.layout)
        std = self.calibration(spread[..., 1:, :, :], self.layout)
        std = torch.where(self.movable, std, 0.0)
        start = std.new_zeros(*std.shape[:-3], 1, *std.shape[-2:])
        return Prediction(mean, torch.cat((start, std), dim=-3), members)

    def split(self) -> SplitEnsemble:
        """Return a model in which each member predicts its share of the samples."""
        return SplitEnsemble(self)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the mean next state and the standard deviation of its error."""
        self.parameters_in(tensordict)
        state, action = (tensordict[key] for key in self.in_keys[:2])
        mean, std, _ = self.predict(state, action.unsqueeze(-2))
        tensordict.set(self.out_keys[0], mean[..., 1, :, :])
        return tensordict.set(self.out_keys[1], std[..., 1, :, :])


class SplitEnsemble(TensorDictModuleBase):
    """Ensemble in which each member predicts its share of the samples (TS-infinity of PETS, Chua et al. 2018).

    The first of ``K`` members predicts the first ``B`` of samples ``[K B, ...]``, and so on: a sample keeps its member
    from step to step. As a TensorDict module it reads ``state`` and ``action``, and writes ``("next", "state")``.

    Args:
        ensemble: the ensemble, bound to a scene or specialised.
    """

    def __init__(self, ensemble: BoundEnsemble) -> None:
        super().__init__()
        self.ensemble, self.scene, first = ensemble, ensemble.scene, ensemble.members[0]
        self.fixed_batch = first.fixed_batch
        self.in_keys: list[NestedKey] = list(first.in_keys)
        self.out_keys: list[NestedKey] = list(first.out_keys)

    @property
    def members(self) -> list[Predictor]:
        """The members."""
        return self.ensemble.members

    def parameters_in(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """See :meth:`BoundEnsemble.parameters_in`."""
        return self.ensemble.parameters_in(tensordict)

    def doubt(self, state: Tensor, action: Tensor) -> Tensor:
        """Return :meth:`BoundEnsemble.doubt` of all members together."""
        return self.ensemble.doubt(state, action)

    def rollout(self, state: Tensor, actions: Tensor) -> Tensor:
        """Return states ``[K B, ..., T + 1, N, 13]`` from start states ``[K B, ..., N, 13]``.

        Raises ValueError unless the number of samples is a multiple of ``K``.
        """
        return torch.cat(
            [member.rollout(start, share_actions)[0] for member, start, share_actions in self._shares(state, actions)]
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write each sample's next state."""
        self.parameters_in(tensordict)
        state, action = (tensordict[key] for key in self.in_keys[:2])
        after = [member.step(before, share_action)[0] for member, before, share_action in self._shares(state, action)]
        return tensordict.set(self.out_keys[0], torch.cat(after))

    def _shares(self, state: Tensor, action: Tensor) -> Iterator[tuple[Predictor, Tensor, Tensor]]:
        """Pair each member with its samples."""
        count = len(self.members)
        if len(state) % count:
            raise ValueError(f"The number of samples, {len(state)}, must be a multiple of the {count} members.")
        return zip(self.members, state.chunk(count), action.chunk(count), strict=True)


def lower_bound(values: Tensor, pessimism: float) -> Tensor:
    """Return the mean of the members' values ``[K, *B]`` less ``pessimism`` times their standard deviation, ``[*B]``.

    The result is minus infinity where a member's value is.
    """
    mean, members = values.mean(0), len(values)
    if members == 1 or pessimism == 0:
        return mean
    off = torch.where(mean.isfinite(), values, 0.0) - torch.where(mean.isfinite(), mean, 0.0)
    variance = off.square().sum(0) / (members - 1)
    # The gradient of a square root is infinite at 0, where members agree.
    spread = torch.where(variance > 0, torch.where(variance > 0, variance, 1.0).sqrt(), 0.0)
    return mean - pessimism * spread


def check_pessimism(pessimism: float, members: int) -> None:
    """Raise ValueError unless ``pessimism`` is finite, and 0 without an ensemble."""
    if not math.isfinite(pessimism):
        raise ValueError(f"pessimism={pessimism} must be finite.")
    if pessimism and members == 1:
        raise ValueError(
            f"pessimism={pessimism} needs an ensemble, whose members can disagree; the environment has one model. Make"
            " it of a BoundEnsemble, Ensemble.for_scene(scene).bind(scene)."
        )


def mean_squares(values: Tensor, counted: Tensor, layout: StateLayout) -> Tensor:
    """Return the mean square ``[*B, C]`` of each component of values ``[*B, N, D]``, over ``counted`` channels."""
    squares = torch.where(counted, values.square(), 0.0)
    parts = [
        squares[..., where].sum((-1, -2)) / counted[:, where].sum().clamp(min=1)
        for where in layout.delta_slices.values()
    ]
    return torch.stack(parts, dim=-1)


def mean_of(members: Tensor, layout: StateLayout) -> Tensor:
    """Return the mean of :func:`mean_and_spread`, without the spread's cost."""
    return _mean(members, layout)[0]


def mean_and_spread(members: Tensor, layout: StateLayout) -> tuple[Tensor, Tensor]:
    """Return the members' mean ``[*B, N, C]`` and standard deviation ``[*B, N, D]`` of states ``[K, *B, N, C]``.

    Rotations differ from their mean by rotation vectors. Where a member's state is not finite, the spread is infinite,
    and the mean is over the other members, or NaN if there are none.
    """
    mean, finite = _mean(members, layout)
    count = finite.sum(0)
    change = torch.where(finite, layout.delta(mean, torch.where(finite, members, mean)), 0.0)
    variance = change.square().sum(0) / (count - 1).clamp(min=1)
    # The gradient of a square root is infinite at 0, in fixed channels.
    spread = torch.where(variance > 0, torch.where(variance > 0, variance, 1.0).sqrt(), 0.0)
    return mean, torch.where(count == len(members), spread, torch.inf)


def _mean(members: Tensor, layout: StateLayout) -> tuple[Tensor, Tensor]:
    """Return the mean ``[*B, N, C]`` of the finite members, and the mask ``[K, *B, 1, 1]`` of these members."""
    finite = members.isfinite().flatten(-2).all(-1)[..., None, None]
    # Any finite member serves as the state near the mean that layout.mean needs.
    first = finite.to(torch.uint8).argmax(0, keepdim=True)
    return layout.mean(members, members.gather(0, first.expand_as(members[:1])).squeeze(0), finite), finite

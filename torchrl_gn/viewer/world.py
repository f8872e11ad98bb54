"""Worlds that the page shows: MuJoCo's simulation, or a recording, and a model's prediction beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_gn.checks import checked_seed
from torchrl_gn.data import Simulator, random_controls, sample_start_states
from torchrl_gn.dynamics import BoundEnsemble, Predictor
from torchrl_gn.dynamics.ensemble import mean_and_spread
from torchrl_gn.maths import quaternion
from torchrl_gn.scenes import Scene

_RANDOM_STEPS = 500  # drawn at a time
_FARTHEST = 1000.0  # times the training's range, beyond which a prediction counts as diverged

Model = Predictor | BoundEnsemble


@dataclass(frozen=True, eq=False)
class Moment:
    """The world at one control step."""

    time: float  # seconds
    state: Tensor  # [N, C] true node states, float64
    physics: np.ndarray | None  # [S] full MuJoCo state; None if only states were recorded
    action: np.ndarray | None  # [A] that led here; None at the start
    prediction: Tensor | None = None  # [N, C]; None without a model, or if it diverged
    std: Tensor | None = None  # [N] metres, standard deviation of an ensemble's predicted positions
    ahead: int = 0  # steps since the prediction was set to the truth


class World(Protocol):
    """A world that the viewer can show and advance."""

    moment: Moment

    def reset(self) -> None:
        """Go to a new start."""

    def step(self, action: np.ndarray, every: int) -> bool:
        """Advance by a control step under ``action`` ``[A]``; return False at the end.

        The prediction is set to the truth every ``every`` steps; 0: never.
        """
        ...


class Forecast:
    """A model's prediction, step by step under given actions, without gradients."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.ahead = 0
        self._states: Tensor | None = None  # [N, C], of an ensemble [K, N, C]
        self._hidden: TensorDictBase | None = None

    def restart(self, state: Tensor) -> None:
        """Set the prediction to a state ``[N, C]``."""
        model = self.model
        self._states = torch.stack([state] * len(model.members)) if isinstance(model, BoundEnsemble) else state
        self._hidden, self.ahead = None, 0

    @torch.no_grad()
    def step(self, action: Tensor) -> None:
        """Predict the state after ``action`` ``[A]``."""
        assert self._states is not None, "restart() comes first"
        self.ahead += 1
        if isinstance(self.model, BoundEnsemble):
            members = zip(self.model.members, self._states, strict=True)
            self._states = torch.stack([member.step(state, action)[0] for member, state in members])
        else:
            self._states, self._hidden = self.model.step(self._states, action, None, self._hidden)

    def read(self) -> tuple[Tensor | None, Tensor | None]:
        """Return the predicted state ``[N, C]``, None if it diverged, and the positions' standard deviation ``[N]``."""
        assert self._states is not None
        if isinstance(self.model, BoundEnsemble):
            return summary(self.model, self._states.unsqueeze(1), [self.ahead])
        return self._states if bool(self.model.in_range(self._states, _FARTHEST)) else None, None


@torch.no_grad()
def summary(model: BoundEnsemble, members: Tensor, steps: list[int]) -> tuple[Tensor | None, Tensor | None]:
    """Return mean ``[N, C]`` and standard deviation ``[N]`` of positions, metres, of members' states ``[K, 1, N, C]``.

    The standard deviation is calibrated if the ensemble is. None and None if a member diverged.
    """
    if not all(bool(each.in_range(state, _FARTHEST)) for each, state in zip(model.members, members[:, 0], strict=True)):
        return None, None
    mean, spread = mean_and_spread(members, model.layout)
    if model.calibration.fitted and steps[0] > 0:
        spread = torch.where(model.movable, model.calibration(spread, model.layout, steps), 0.0)
    return mean[0], spread[0, :, model.layout.delta_slices["position"]].norm(dim=-1)


class LiveWorld:
    """MuJoCo's simulation of a scene, and a model's prediction under the same controls.

    Args:
        seed: seed of the start states and random controls.
    """

    def __init__(self, scene: Scene, model: Model | None = None, *, seed: int = 0) -> None:
        self.scene, self.simulator = scene, Simulator(scene, 1)
        self.forecast = None if model is None else Forecast(model)
        self._rng, self._drawn = np.random.default_rng(checked_seed(seed)), np.empty((0, scene.num_actions))
        self.moment: Moment
        self.reset()

    def reset(self) -> None:
        """Draw a start state."""
        self.start(sample_start_states(self.scene, 1, self._rng)[0])

    def start(self, physics: np.ndarray) -> None:
        """Start from a full MuJoCo state ``[S]``."""
        self._drawn = self._drawn[:0]
        state = self.simulator.observe(physics[None])[0]
        if self.forecast is not None:
            self.forecast.restart(state)
        self.moment = self._moment(float(physics[0]), state, physics, None)

    def random_action(self) -> np.ndarray:
        """Draw the next of smooth random controls ``[A]``."""
        if not len(self._drawn):
            physics = self._physics()[None]
            self._drawn = random_controls(self.simulator, physics, _RANDOM_STEPS, self._rng)[0]
        action, self._drawn = self._drawn[0], self._drawn[1:]
        return action

    def step(self, action: np.ndarray, every: int = 0) -> bool:
        """See :class:`World`; False if the simulation became unstable, which keeps the last moment."""
        before = self.moment
        after = self.simulator.rollout(self._physics(), torch.from_numpy(action)[None])
        if not bool(after["stable"]):
            return False
        if self.forecast is not None:
            if every and self.forecast.ahead >= every:
                self.forecast.restart(before.state)
            self.forecast.step(torch.from_numpy(action))
        state, physics = cast(Tensor, after["state"]), cast(Tensor, after["physics"])
        self.moment = self._moment(before.time + self.scene.timestep, state[-1], physics[-1].numpy(), action)
        return True

    def _physics(self) -> np.ndarray:
        assert self.moment.physics is not None
        return self.moment.physics

    def _moment(self, time: float, state: Tensor, physics: np.ndarray, action: np.ndarray | None) -> Moment:
        if self.forecast is None:
            return Moment(time, state, physics, action)
        return Moment(time, state, physics, action, *self.forecast.read(), self.forecast.ahead)


class Playback:
    """A recorded trajectory, and a model's prediction from its start under the recorded actions.

    Args:
        trajectory: ``state`` ``[T + 1, N, C]``, ``action`` ``[T, A]``, and ``physics`` ``[T + 1, S]`` if known.
    """

    def __init__(self, scene: Scene, trajectory: TensorDictBase, model: Model | None = None) -> None:
        self.scene, self.model = scene, model
        self.states = cast(Tensor, trajectory["state"]).double()
        self.actions = cast(Tensor, trajectory["action"]).double()
        self.physics: Tensor | None = trajectory.get("physics", None)
        self._predicted: dict[int, list[tuple[Tensor | None, Tensor | None]]] = {}  # by steps of a piece
        self.at(0, 0)

    def __len__(self) -> int:
        """Number of steps ``T``."""
        return len(self.actions)

    def reset(self) -> None:
        """Go back to the start."""
        self.at(0, 0)

    def step(self, action: np.ndarray | None = None, every: int = 0) -> bool:
        """See :class:`World`; the action is the recorded one."""
        if self.index >= len(self):
            return False
        self.at(self.index + 1, every)
        return True

    def at(self, index: int, every: int) -> None:
        """Go to a state; its prediction starts at most ``every`` steps earlier, or at step 0 if ``every`` is 0."""
        self.index = index
        time = index * self.scene.timestep
        physics: Any = None if self.physics is None else self.physics[index].numpy()
        action: Any = self.actions[index - 1].numpy() if index else None
        self.moment = Moment(time, self.states[index], physics, action)
        if self.model is not None and len(self):
            piece = every or len(self)
            ahead = (index - 1) % piece + 1 if index else 0
            self.moment = Moment(time, self.states[index], physics, action, *self._prediction(index, piece), ahead)

    def _prediction(self, index: int, piece: int) -> tuple[Tensor | None, Tensor | None]:
        if piece not in self._predicted:
            self._predicted = {piece: self._predict(piece)}
        return self._predicted[piece][index]

    @torch.no_grad()
    def _predict(self, piece: int) -> list[tuple[Tensor | None, Tensor | None]]:
        """Predict all states, in pieces that begin with a true one."""
        model, found = self.model, []
        assert model is not None
        for begin in range(0, len(self), piece):
            actions = self.actions[begin : begin + piece]
            first = 0 if begin == 0 else 1
            if isinstance(model, BoundEnsemble):
                members = model.rollout(self.states[begin], actions)
                found += [summary(model, members[:, step, None], [step]) for step in range(first, members.shape[1])]
                continue
            states = model.rollout(self.states[begin], actions)[0]
            good = model.in_range(states, _FARTHEST).long().cumprod(0)
            found += [(states[step] if good[step] else None, None) for step in range(first, len(states))]
        return found


def pose_error(scene: Scene, truth: Tensor, predicted: Tensor) -> tuple[float, float]:
    """Return the mean distance [m] and angle [rad] between predicted and true poses ``[N, C]`` of the moving nodes."""
    moving = torch.as_tensor(scene.predicted)
    truth, predicted = truth[moving, :7], predicted[moving, :7]
    distance = (predicted[:, :3] - truth[:, :3]).norm(dim=-1).mean()
    return float(distance), float(quaternion.angle(predicted[:, 3:], truth[:, 3:]).mean())


def trajectory_of(state: Tensor, action: Tensor) -> TensorDict:
    """Return a trajectory for :class:`Playback` of states ``[T + 1, N, C]`` and actions ``[T, A]``."""
    return TensorDict({"state": state, "action": action}, batch_size=[])

"""Options of the short-horizon actor-critic, checked before anything is played."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from torchrl_gn.actor_critic.trajectories import WINDOW
from torchrl_gn.checks import check_count
from torchrl_gn.policies.state_features import check_hidden

PolicyKind = Literal["mlp", "graph"]


@dataclass(frozen=True, kw_only=True)
class FirstTrajectories:
    """Random control before the first round. ValueError if an option is out of range."""

    trajectories: int = 25  # number of trajectories
    length: int = 100  # control steps of each, at least 50
    steps: int = 1000  # training steps of the model on them

    def __post_init__(self) -> None:
        for name in ("trajectories", "steps"):
            check_count(f"first.{name}", getattr(self, name), 1)
        check_count("first.length", self.length, WINDOW)


@dataclass(frozen=True, kw_only=True)
class EvaluationEpisodes:
    """Evaluation episodes: no exploration, same starts every round. ValueError if an option is out of range."""

    episodes: int = 5  # number of episodes
    steps: int | None = None  # control steps of each; None: a whole episode of the suite, elsewhere 500

    def __post_init__(self) -> None:
        check_count("evaluate.episodes", self.episodes, 1)
        if self.steps is not None:
            check_count("evaluate.steps", self.steps, 1)


@dataclass(frozen=True, kw_only=True)
class ActorCriticOptions:
    """Options of :class:`ActorCritic` and its tasks; the defaults learn the suite's cheetah run in 25 rounds.

    Raises:
        ValueError: an option is out of range; the message names it.

    Example:
        >>> ActorCriticOptions(horizon=8).steps
        200
        >>> ActorCriticOptions(steps=70)
        Traceback (most recent call last):
        ...
        ValueError: steps=70 must be a multiple of 50.
    """

    first: FirstTrajectories = field(default_factory=FirstTrajectories)  # random control before the first round
    episodes: int = 5  # episodes per task and round, with exploration
    steps: int = 200  # control steps of each, a multiple of 50
    noise_color: float = 1.0  # spectral exponent of the exploration noise: 0 white, 1 pink, 2 red, see colored_noise
    novelty_rounds: int = 10  # number of first rounds in which one episode follows random controls to novel states
    planned_episodes: int = 0  # number of episodes per round in which a planner acts, which improves on the policy
    evaluate: EvaluationEpisodes = field(default_factory=EvaluationEpisodes)  # episodes that evaluate the policy
    action_repeat: int = 2  # suite tasks: frames per control step
    per_frame: bool = True  # suite tasks: the model predicts one frame; False: one control step

    horizon: int = 5  # imagined control steps per trajectory
    policy_lmbda: float = 0.6  # lambda of the policy's returns; 1: gradients pass through all imagined steps
    outlier: float = 3.0  # clip a trajectory's gradient at this many times the median norm of the batch
    discount: float = 0.99  # discount per control step
    lmbda: float = 0.95  # lambda of the value's TD(lambda) targets
    updates: int = 100  # updates of policy and value per round
    value_steps: int = 6  # further steps of the value per update
    batch_size: int = 128  # imagined trajectories per update; half start from states of the last round
    pessimism: float = 0.0  # standard deviations of the members' returns to subtract from their mean
    policy_lr: float = 1e-3  # learning rate of the policy
    value_lr: float = 1e-3  # learning rate of the value
    alpha_lr: float = 5e-3  # learning rate of the entropy weight
    average: int = 10  # last rounds whose policies are averaged for evaluation, at most an eighth of all

    policy: PolicyKind = "mlp"  # "mlp", or "graph": a graph network, for several scenes
    hidden: Sequence[int] = (128, 128)  # hidden sizes of value, learned reward and a policy of kind "mlp"
    graph: Mapping[str, Any] = field(
        default_factory=lambda: {"hidden": [32, 32], "latent": 32}
    )  # options of a policy of kind "graph", see GraphStatePolicy
    model: Mapping[str, Any] = field(
        default_factory=lambda: {"hidden": 64, "latent": 64}
    )  # options of ForwardModel.for_scene
    members: int = 1  # models of the ensemble; each imagines its share of the batch

    model_steps: int = 300  # training steps per model and round, on all trajectories
    model_lr: float = 3e-3  # peak learning rate of the model after the first round
    reward_steps: int = 300  # training steps of a learned reward per round; three times as many in the first

    seed: int = 0  # seed of random control and of model and reward batches; the rest uses torch's generator
    device: str = "cpu"  # device of the networks, or "cuda"; MuJoCo runs on the CPU

    def __post_init__(self) -> None:
        counts = ("episodes", "steps", "action_repeat", "horizon", "updates", "average", "members")
        for name in (*counts, "model_steps", "reward_steps"):
            check_count(name, getattr(self, name), 1)
        for name in ("seed", "value_steps", "novelty_rounds", "planned_episodes"):
            check_count(name, getattr(self, name), 0)
        check_count("batch_size", self.batch_size, self.members)
        if self.planned_episodes > self.episodes:
            raise ValueError(f"planned_episodes={self.planned_episodes} must be at most episodes={self.episodes}.")
        if self.steps % WINDOW:
            raise ValueError(f"steps={self.steps} must be a multiple of {WINDOW}.")
        for name in ("policy_lr", "value_lr", "alpha_lr", "model_lr"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}={getattr(self, name)} must be positive and finite.")
        if not 0 < self.discount <= 1:
            raise ValueError(f"discount={self.discount} must be above 0 and at most 1.")
        for name in ("lmbda", "policy_lmbda"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}={getattr(self, name)} must be from 0 to 1.")
        if not 0 <= self.noise_color <= 2:
            raise ValueError(f"noise_color={self.noise_color} must be from 0 to 2.")
        if not self.outlier > 0:
            raise ValueError(f"outlier={self.outlier} must be above 0.")
        if not math.isfinite(self.pessimism):
            raise ValueError(f"pessimism={self.pessimism} must be finite.")
        if self.pessimism and self.members == 1:
            raise ValueError(f"pessimism={self.pessimism} needs an ensemble: pass members=3, say.")
        if self.policy not in get_args(PolicyKind):
            raise ValueError(f"policy={self.policy} must be {' or '.join(get_args(PolicyKind))}.")
        if not isinstance(self.hidden, Sequence):
            raise ValueError(f"hidden={self.hidden} must be a list of sizes.")
        # Copies that no caller changes; lists and tuples are equal.
        object.__setattr__(self, "hidden", tuple(check_hidden(self.hidden)))
        for name in ("graph", "model"):
            object.__setattr__(self, name, dict(getattr(self, name)))

"""Rewards of the paper's tasks, and rewards by name, from options or of the control suite."""

from __future__ import annotations

import inspect
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.maths import quaternion
from torchrl_gn.rewards.bodies import Bodies
from torchrl_gn.rewards.distance import REACHED, Distance, Near
from torchrl_gn.rewards.imitate_pose import ImitatePose
from torchrl_gn.rewards.reward import Reward, WeightedSum
from torchrl_gn.rewards.suite import Run, RunUpright, suite_reward
from torchrl_gn.scenes.articulation import require_bodies
from torchrl_gn.scenes.load import as_scene
from torchrl_gn.scenes.scene import Scene

Axis = Literal["x", "y", "z"]


class Balance(Reward):
    """Negative angle between bodies and their balanced orientation, radians: ``-sum_i angle(q_i', target_i)``.

    Paper, SM "Planning configuration", Pendulum Balance. The gradient is finite everywhere, and zero at 0 and pi.

    Args:
        target: ``[4]`` or ``[len(bodies), 4]``, w-first, world frame, any non-zero norm; default: the identity, upright
            for the suite's poles, acrobot and walker (upside down: ``[0, 0, 1, 0]``).
    """

    target: Tensor

    def __init__(self, scene: Scene, bodies: Sequence[str], *, target: np.ndarray | Tensor | None = None):
        super().__init__()
        self.bodies = Bodies(scene, bodies)
        self.shown = {"scene": scene.name, "bodies": tuple(bodies)}
        quat = torch.as_tensor([1.0, 0.0, 0.0, 0.0] if target is None else target, dtype=torch.float64)
        if quat.shape not in {(4,), (len(bodies), 4)}:
            raise ValueError(f"target must be [4] or [{len(bodies)}, 4], got {list(quat.shape)}")
        norm = quat.norm(dim=-1, keepdim=True)
        if not bool((norm > 0).all() and quat.isfinite().all()):
            raise ValueError(f"target must hold finite quaternions of non-zero norm, got {quat.tolist()}")
        # `forward` casts the float64 buffer to the states' dtype.
        self.register_buffer("target", (quat / norm).expand(len(bodies), 4).clone())

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        angle = quaternion.angle(self.bodies.orientation(next_state), self.target.to(next_state.dtype))
        return -angle.sum(-1, keepdim=True)


class Upright(Reward):
    """Cosine of the angle between a body's z axis and the vertical after the step: 1 upright, -1 upside down.

    Unlike :class:`Balance`, it does not depend on the yaw.
    """

    def __init__(self, scene: Scene, body: str):
        super().__init__()
        self.bodies = Bodies(scene, [body])
        self.shown = {"scene": scene.name, "body": body}

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return quaternion.to_matrix(self.bodies.orientation(next_state))[..., 8]


class Reach(Reward):
    r"""Progress of a body towards a target in the horizontal plane, metres.

    .. math:: r = d \cdot u - c\, (d \cdot u_\perp)^2

    with :math:`d` the body's displacement in this step, :math:`u` the horizontal unit vector to the target when
    planning started, and :math:`c` the ``shaping``, 1/m (paper, SM "Planning configuration", Swimmer "Move towards
    target"). The target is a location ``[3]``, metres, world frame, height ignored; the task is :math:`u`, ``[3]``,
    zero within a nanometre of the target.
    """

    target_shape = (3,)

    def __init__(self, scene: Scene, body: str, *, shaping: float = 0.01):
        super().__init__()
        if not 0 <= shaping < math.inf:
            raise ValueError(f"shaping must be a finite number from 0, got {shaping}")
        self.bodies, self.shaping = Bodies(scene, [body]), float(shaping)
        self.shown = {"scene": scene.name, "body": body, "shaping": self.shaping}

    def task_of(self, state: Tensor, target: Tensor) -> Tensor:
        """Return the horizontal direction ``[*B, 3]`` from the body in ``state`` to the target ``[*B, 3]``."""
        location = super().task_of(state, target).to(state.dtype)
        to_target = (location - self.bodies.position(state).squeeze(-2))[..., :2]
        # Divide by the largest entry first, so that squares neither overflow nor vanish.
        largest = to_target.abs().amax(-1, keepdim=True)
        reached = largest < REACHED
        scaled = torch.where(reached, 1.0, to_target) / torch.where(reached, 1.0, largest)
        return pad(torch.where(reached, 0.0, scaled / scaled.norm(dim=-1, keepdim=True)), (0, 1))

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        x, y, _ = self.require_task(task, next_state).split(1, dim=-1)
        displacement = (self.bodies.position(next_state) - self.bodies.position(state)).squeeze(-2)
        dx, dy, _ = displacement.split(1, dim=-1)
        return dx * x + dy * y - self.shaping * (dy * x - dx * y).square()


class Velocity(Reward):
    """Velocity of a body's frame along an axis after the step, m/s, raised to ``power``.

    Paper, SM "Planning configuration": Cheetah and Walker2d "forward", Cheetah "vertical speed" (``power=2``).

    Args:
        power: whole number of at least 1.
        own: take the axis of the body's frame instead of the world's, so that the yaw does not matter.
        goal: velocity to keep, m/s; the reward is then the negative distance from it, raised to ``power``.
    """

    def __init__(
        self, scene: Scene, body: str, axis: Axis, *, power: int = 1, own: bool = False, goal: float | None = None
    ):
        super().__init__()
        if isinstance(power, bool) or not isinstance(power, int) or power < 1:
            raise ValueError(f"power must be a whole number from 1, got {power!r}")
        if goal is not None and not math.isfinite(goal):
            raise ValueError(f"goal must be a finite velocity, got {goal!r}")
        self.bodies, self.axis, self.power, self.own, self.goal = Bodies(scene, [body]), axis, power, own, goal
        self.shown = {"scene": scene.name, "body": body, "axis": axis, "power": power, "own": own, "goal": goal}
        self.component = _component(axis)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        velocity = self.bodies.linear_velocity(next_state)
        if self.own:
            axis = quaternion.to_matrix(self.bodies.orientation(next_state))[..., self.component :: 3]
            along = (axis * velocity).sum(-1)
        else:
            along = velocity[..., self.component]
        return along**self.power if self.goal is None else -((along - self.goal).abs() ** self.power)


class Position(Reward):
    """Position of a body along a world axis after the step, metres (paper: height of the torso)."""

    def __init__(self, scene: Scene, body: str, axis: Axis):
        super().__init__()
        self.bodies, self.axis = Bodies(scene, [body]), axis
        self.shown = {"scene": scene.name, "body": body, "axis": axis}
        self.component = _component(axis)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return self.bodies.position(next_state)[..., self.component]


class Effort(Reward):
    """Negative mean square of the controls, without mocap poses, each divided by its larger absolute bound.

    Controls beyond their bounds count as given, although physics clamps them: the gradient then leads back.
    """

    scale: Tensor

    def __init__(self, scene: Scene):
        super().__init__()
        count = len(getattr(scene, "actuator_names", scene.action_low))
        bounds = np.maximum(np.abs(scene.action_low), np.abs(scene.action_high))[:count]
        if not len(bounds):
            raise ValueError(f"Effort needs controls; scene {scene.name!r} has none.")
        if not (np.isfinite(bounds).all() and (bounds > 0).all()):
            raise ValueError(
                f"Effort needs bounded controls; scene {scene.name!r} has bounds {bounds.tolist()}: give its"
                " actuators a ctrlrange, or load it with action_bounds=."
            )
        self.shown = {"scene": scene.name}
        self.register_buffer("scale", torch.from_numpy(bounds))

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        controls = action[..., : len(self.scale)]
        return -(controls / self.scale.to(action.dtype)).square().mean(-1, keepdim=True).to(next_state.dtype)


class AngularSpeed(Reward):
    """Squared angular speed of a body after the step, rad^2/s^2 (paper: Cheetah "Squared angular speed")."""

    def __init__(self, scene: Scene, body: str):
        super().__init__()
        self.bodies = Bodies(scene, [body])
        self.shown = {"scene": scene.name, "body": body}

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return self.bodies.angular_velocity(next_state).square().sum(-1)


class VerticalDistance(Reward):
    """Sum of squared vertical distances to a reference body after the step, m^2 (paper: "Feet to head height")."""

    def __init__(self, scene: Scene, bodies: Sequence[str], reference: str):
        super().__init__()
        self.bodies, self.reference = Bodies(scene, bodies), Bodies(scene, [reference])
        self.shown = {"scene": scene.name, "bodies": tuple(bodies), "reference": reference}

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        height = self.bodies.position(next_state)[..., 2]
        return (height - self.reference.position(next_state)[..., 2]).square().sum(-1, keepdim=True)


def _component(axis: str) -> int:
    if axis not in get_args(Axis):
        raise ValueError(f"axis must be one of {', '.join(get_args(Axis))}, got {axis!r}")
    return get_args(Axis).index(axis)


_WALKER_UPRIGHT = ("torso", "right_thigh", "left_thigh", "right_leg", "left_leg")
_WALKER_FEET = ("right_foot", "left_foot")

# (system, task) -> builder of the reward; one line per row of the paper's table, and the suite's `run` and `near`.
_REWARDS: dict[tuple[str, str], Callable[[Scene], Reward]] = {
    ("pendulum", "balance"): lambda scene: Balance(scene, ["pole"]),
    ("cartpole", "balance"): lambda scene: Balance(scene, ["pole_1"]),
    ("acrobot", "swing_up"): lambda scene: Balance(scene, ["upper_arm", "lower_arm"]),
    ("swimmerN", "reach"): lambda scene: Reach(scene, "head"),
    ("swimmerN", "near"): lambda scene: Near(scene, "head", target=(0.0, 0.0, 0.05), offset=(0.0, -0.06, 0.0)),
    ("cheetah", "forward"): lambda scene: Velocity(scene, "torso", "x"),
    ("cheetah", "height"): lambda scene: Position(scene, "torso", "z"),
    ("cheetah", "vertical_speed"): lambda scene: Velocity(scene, "torso", "z", power=2),
    ("cheetah", "run"): lambda scene: Run(scene, "torso"),
    ("cheetah", "spin"): lambda scene: AngularSpeed(scene, "torso"),
    ("walker2d", "forward"): lambda scene: Velocity(scene, "torso", "x"),
    ("walker2d", "run"): lambda scene: RunUpright(scene, "torso"),
    ("walker2d", "height"): lambda scene: Position(scene, "torso", "z"),
    ("walker2d", "inverse_verticality"): lambda scene: Balance(scene, _WALKER_UPRIGHT),
    ("walker2d", "feet_to_head"): lambda scene: VerticalDistance(scene, _WALKER_FEET, "torso"),
    ("jaco", "palm_pose"): lambda scene: ImitatePose(scene, ["jaco_hand/hand"]),
    # Paper: "13 variables x 9 bodies": the moving nodes.
    ("jaco", "full_pose"): lambda scene: ImitatePose(scene, scene.node_names[1:]),
}


REWARD_TYPES: dict[str, type[Reward]] = {
    kind.__name__: kind
    for kind in (
        AngularSpeed,
        Balance,
        Distance,
        Effort,
        ImitatePose,
        Near,
        Position,
        Reach,
        Run,
        RunUpright,
        Upright,
        Velocity,
        VerticalDistance,
    )
}
"""Reward classes by their ``type`` in options."""


def available_rewards() -> tuple[tuple[str, str], ...]:
    """Return every ``(system, task)`` of :func:`make_reward`; ``"swimmerN"`` stands for any number of links."""
    return tuple(_REWARDS)


def make_reward(task: str | Sequence[Mapping[str, Any]] | None, scene: Scene | str | os.PathLike) -> Reward:
    """Build a reward by the name of a paper task, a weighted sum from options, or the reward of a suite scene.

    Walker2d's ``"inverse_verticality"`` is largest for a standing walker, as in the paper's text. For a walker on its
    head use ``Balance(scene, bodies, target=torch.tensor([0.0, 0.0, 1.0, 0.0]))``.

    Args:
        task: a task's name, such as ``"balance"``, for a system's scene or variant; or the terms of a sum, such as
            ``[{"type": "Velocity", "body": "torso", "axis": "x"}, {"type": "Effort", "weight": 0.1}]``
            (:data:`REWARD_TYPES`); or None for dm_control's reward of a suite scene
            (:func:`~torchrl_gn.rewards.suite_reward`).
        scene: the scene, its name or path.

    Raises:
        ValueError: for an unknown task (the message lists all), type or argument.
        TypeError: for a robot known by its joints alone, or a task that is not a name, list of terms or None.
    """
    scene = require_bodies(as_scene(scene), "A reward")
    if task is None:
        return suite_reward(scene)
    if not isinstance(task, str):
        return rewards_from_options(task, scene, REWARD_TYPES)
    system = re.sub(r"^swimmer\d+$", "swimmerN", scene.origin.get("system", scene.name))
    builder = _REWARDS.get((system, task))
    if builder is None:
        known = ", ".join(f"{name} ({scene_name})" for scene_name, name in _REWARDS)
        raise ValueError(
            f"no reward {task!r} for scene {scene.name!r}; there are: {known}. For another robot give a list of terms"
            f" of the types {', '.join(REWARD_TYPES)}."
        )
    return builder(scene)


def rewards_from_options(options: Sequence[Mapping[str, Any]], scene: Scene, kinds: Mapping[str, type]) -> Reward:
    """Build a weighted sum from ``[{type: Velocity, weight: 1, body: torso, axis: x}, ...]``.

    Args:
        options: for each term, its ``type``, its ``weight`` (default 1) and the arguments of its class.
        kinds: classes by type.

    Raises:
        ValueError: for an unknown type, or arguments that its class does not take; the message names both.
    """
    if isinstance(options, Mapping) or not isinstance(options, Iterable):
        got = f"one term, {dict(options)}" if isinstance(options, Mapping) else repr(options)
        raise TypeError(f"A reward's options must be a list of terms, such as [{{'type': 'Upright', ...}}]; got {got}.")
    terms = []
    for option in options:
        if not isinstance(option, Mapping):
            raise TypeError(
                f"A term of a reward must be a dictionary, such as {{'type': 'Upright', ...}}; got {option!r}."
            )
        arguments = dict(option)
        name, weight = arguments.pop("type", None), arguments.pop("weight", 1.0)
        if name not in kinds:
            raise ValueError(f"Reward type {name!r} is not known; use one of {sorted(kinds)}.")
        parameters = list(inspect.signature(kinds[name]).parameters.values())[1:]  # without the scene
        known = [each.name for each in parameters]
        if unknown := [key for key in arguments if key not in known]:
            raise ValueError(f"{name} takes no {unknown}; it takes {known}.")
        if missing := [p.name for p in parameters if p.default is p.empty and p.name not in arguments]:
            raise ValueError(f"{name} needs {missing}; it takes {known}.")
        try:
            terms.append((float(weight), kinds[name](scene, **arguments)))
        except TypeError as error:
            raise ValueError(f"{name} of scene {scene.name!r}: {error}") from error
    return WeightedSum(terms)

"""Rewards of the paper's tasks by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from types import MappingProxyType

from torchrl_gn.rewards.balance import Balance
from torchrl_gn.rewards.bodies import require_bodies
from torchrl_gn.rewards.imitate_pose import ImitatePose
from torchrl_gn.rewards.motion import AngularSpeed, Position, Velocity, VerticalDistance
from torchrl_gn.rewards.reach import Reach
from torchrl_gn.rewards.reward import Reward
from torchrl_gn.scenes.scene import Scene

_WALKER_UPRIGHT = ("torso", "right_thigh", "left_thigh", "right_leg", "left_leg")
_WALKER_FEET = ("right_foot", "left_foot")

# (system, task) -> builder of the reward; one line per row of the paper's table.
_REWARDS: MappingProxyType[tuple[str, str], Callable[[Scene], Reward]] = MappingProxyType(
    {
        ("pendulum", "balance"): lambda scene: Balance(scene, ["pole"]),
        ("cartpole", "balance"): lambda scene: Balance(scene, ["pole_1"]),
        ("acrobot", "swing_up"): lambda scene: Balance(scene, ["upper_arm", "lower_arm"]),
        ("swimmerN", "reach"): lambda scene: Reach(scene, "head"),
        ("cheetah", "forward"): lambda scene: Velocity(scene, "torso", "x"),
        ("cheetah", "height"): lambda scene: Position(scene, "torso", "z"),
        ("cheetah", "vertical_speed"): lambda scene: Velocity(scene, "torso", "z", power=2),
        ("cheetah", "spin"): lambda scene: AngularSpeed(scene, "torso"),
        ("walker2d", "forward"): lambda scene: Velocity(scene, "torso", "x"),
        ("walker2d", "height"): lambda scene: Position(scene, "torso", "z"),
        ("walker2d", "inverse_verticality"): lambda scene: Balance(scene, _WALKER_UPRIGHT),
        ("walker2d", "feet_to_head"): lambda scene: VerticalDistance(scene, _WALKER_FEET, "torso"),
        ("jaco", "palm_pose"): lambda scene: ImitatePose(scene, ["jaco_hand/hand"]),
        # Paper: "13 variables x 9 bodies": the moving nodes.
        ("jaco", "full_pose"): lambda scene: ImitatePose(scene, scene.node_names[1:]),
    }
)


def available_rewards() -> tuple[tuple[str, str], ...]:
    """Every ``(system, task)`` of :func:`make_reward`; ``"swimmerN"`` stands for any number of links."""
    return tuple(_REWARDS)


def make_reward(task: str, scene: Scene) -> Reward:
    """Build a reward of the paper by its task's name, such as ``"balance"``, for a system's scene or variant.

    Paper: Walker2d's ``"inverse_verticality"`` is largest for a standing walker, as in the paper's text. For a walker
    on its head use ``Balance(scene, bodies, target=torch.tensor([0.0, 0.0, 1.0, 0.0]))``.

    Raises ValueError for an unknown task (the message lists all), TypeError for a robot known by its joints alone.
    """
    require_bodies(scene)
    system = re.sub(r"^swimmer\d+$", "swimmerN", scene.origin.get("system", scene.name))
    builder = _REWARDS.get((system, task))
    if builder is None:
        known = ", ".join(f"{name} ({of})" for of, name in _REWARDS)
        raise ValueError(f"no reward {task!r} for scene {scene.name!r}; there are: {known}")
    return builder(scene)

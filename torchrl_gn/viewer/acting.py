"""A trained policy at work in a live world."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.policies import BoundedPolicy
from torchrl_gn.rewards import Reward, make_reward
from torchrl_gn.scenes import Scene
from torchrl_gn.scenes.articulation import require_same_nodes
from torchrl_gn.scenes.suite_tasks import episode_target, load_suite_task
from torchrl_gn.viewer.planning import SUITE_TASK, step_reward, tasks_of


class LivePolicy:
    """A policy that chooses the controls of a live world.

    A policy with longer control steps than the world's, such as two frames of the suite, holds each action.

    Args:
        policy: a policy over the states of ``scene``.
        seed: seed of the targets, in tasks of the suite that have one.

    Raises:
        ValueError: the policy is of another scene, reads a target that the scene does not have, or its control step is
            no multiple of the scene's.
    """

    def __init__(self, scene: Scene, policy: BoundedPolicy, *, seed: int = 0) -> None:
        ratio = policy.scene.timestep / scene.timestep
        self.hold = round(ratio)
        if self.hold < 1 or abs(ratio - self.hold) > 1e-6:
            raise ValueError(
                f"The policy acts every {1e3 * policy.scene.timestep:g} ms, no multiple of the control step of scene"
                f" {scene.name!r}, {1e3 * scene.timestep:g} ms."
            )
        self.policy = policy.for_scene(scene if self.hold == 1 else policy.scene)
        require_same_nodes(scene, self.policy.scene, "The policy")
        self.policy.require_actions(scene)
        self.scene = scene
        self._episodes = None
        if policy.targeted:
            if "suite" not in scene.origin:
                raise ValueError(
                    f"The policy reads a target, which scene {scene.name!r} does not have: only tasks of the suite do."
                    " Load one, such as 'suite:reacher/easy'."
                )
            domain, task = scene.origin["suite"].split("/")
            self._episodes = load_suite_task(domain, task, seed)
        self.reward: Reward | None = make_reward(None, scene) if tasks_of(scene) == (SUITE_TASK,) else None
        self.target: Tensor | None = None
        self._steps, self._action = 0, np.empty(0)

    def begin(self, state: Tensor) -> None:
        """Begin an episode from ``state`` ``[N, C]``; draw its target if the task has one."""
        self._steps = 0
        if self._episodes is not None:
            self._episodes.reset()
            self.target = torch.from_numpy(episode_target(self._episodes))

    @torch.no_grad()
    def act(self, state: Tensor, *, anew: bool = False) -> np.ndarray:
        """Return the action ``[A]`` for the next step of the world; with ``anew``, repeat no earlier action."""
        self._steps = 0 if anew else self._steps
        if self._steps % self.hold == 0:
            target = None if self.target is None else self.target[None]
            self._action = self.policy.act(state[None], target)[0].double().numpy()
        self._steps += 1
        return self._action

    def reward_of(self, state: Tensor, action: np.ndarray, after: Tensor) -> float | None:
        """Return the suite's reward of a step between states ``[N, C]``; None if it is not known."""
        return None if self.reward is None else step_reward(self.reward, self.target, state, action, after)

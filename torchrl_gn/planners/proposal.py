"""Action sequences that a policy proposes to a planner."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from torchrl_gn.finite import require_finite
from torchrl_gn.scenes.articulation import Articulation, require_same_nodes, require_timestep

_CONSTANT = ("task", "target")  # entries that a policy may read besides the environment's


def check_every_step(proposal: TensorDictModuleBase | None, every_step: bool) -> None:
    """Raise ValueError if ``propose_every_step`` is set without a proposal."""
    if every_step and proposal is None:
        raise ValueError("propose_every_step=True needs a policy: pass proposal= too")


def check_proposal(proposal: TensorDictModuleBase | None, env: EnvBase) -> None:
    """Raise TypeError unless a policy writes ``action``; ValueError if it is unfitted or does not fit ``env``.

    A policy fits if ``env`` has its inputs and, if it says its ``scene``, the bodies, joints and control step of that.
    """
    if proposal is None:
        return
    if "action" not in getattr(proposal, "out_keys", ()):
        raise TypeError(f"proposal= must be a TensorDict module that writes 'action', got {type(proposal).__name__}")
    elif not getattr(proposal, "fitted", True):
        raise ValueError(f"{type(proposal).__name__} has learned no policy yet: call fit_policy on it, or load one")
    else:
        proposal_scene, scene = getattr(proposal, "scene", None), getattr(env, "scene", None)
        if isinstance(proposal_scene, Articulation) and isinstance(scene, Articulation):
            require_same_nodes(scene, proposal_scene, f"{type(proposal).__name__}")
            require_timestep(scene, proposal_scene.timestep, f"{type(proposal).__name__}")
        known = {*env.observation_spec.keys(True), *env.state_spec.keys(True), *_CONSTANT}
        if unknown := [key for key in proposal.in_keys if key not in known]:
            raise ValueError(
                f"the policy of proposal= reads {unknown}, which {env} does not predict: put a module before it that"
                " computes them from 'state'"
            )


@torch.no_grad()
def propose(
    proposal: TensorDictModuleBase,
    env: EnvBase,
    starts: TensorDictBase,
    horizon: int,
    explores: Tensor | None = None,
) -> Tensor:
    """Follow a policy from ``starts`` ``[B]`` in ``env``; return its actions ``[B, H, A]``.

    ValueError if an action is misshapen or not finite.

    Args:
        explores: mask ``[B]`` of the samples in which the policy explores. Default: none.
    """
    actions: list[Tensor] = []
    now, shape = starts.copy(), (*starts.shape, *env.action_spec.shape)

    def act(kind: ExplorationType) -> Tensor:
        with set_exploration_type(kind):
            action = cast(Tensor, proposal(now)["action"])
        if action.shape != shape:
            raise ValueError(f"the policy of proposal= must write actions {list(shape)}, got {list(action.shape)}")
        require_finite(action, "the policy of proposal=: 'action'")
        return env.action_spec.project(action)

    for _ in range(horizon):
        action = act(cast(Any, ExplorationType.DETERMINISTIC))
        if explores is not None:
            action = torch.where(explores.unsqueeze(-1), act(cast(Any, ExplorationType.RANDOM)), action)
        actions.append(action)
        now = step_mdp(env.step(now.set("action", action)), keep_other=True, exclude_done=True)
    return torch.stack(actions, dim=-2)

"""Trajectories of the true physics under a policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_gn.checks import checked_seed
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.finite import require_finite

Policy = Callable[[TensorDictBase], Any]
"""Policy: reads ``state`` ``[n, N, 13]`` and other entries of a SceneEnv; writes or returns ``action`` ``[n, A]``."""


def policy_rollout(
    simulator: Simulator, physics: np.ndarray, steps: int, policy: Policy, variant: np.ndarray, seed: int
) -> TensorDict:
    """Simulate a policy with exploration, from all start states at once.

    The policy reads a TensorDict ``[n]`` of ``state`` (in the dtype and on the device of the policy's parameters),
    ``physics``, ``is_init`` ``[n, 1]`` and, with several scenes, ``variant`` ``[n, 1]``. Entries that it writes, also
    under ``next``, are inputs of the next step. Actions are clamped to their bounds.

    Args:
        simulator: simulator of the scenes.
        physics: start states ``[n, S]``.
        steps: number of control steps.
        policy: the policy.
        variant: index ``[n]`` of each start's scene.
        seed: seed of torch during the call.

    Returns:
        TensorDict ``[n]`` like that of :meth:`~torchrl_gn.data.Simulator.rollout`, with ``action`` ``[n, T, A]``. Steps
        after an unstable one are meaningless.

    Raises:
        ValueError: an action is not finite or of another shape.
    """
    scene, n = simulator.scene, len(physics)
    low, high = torch.from_numpy(scene.action_low), torch.from_numpy(scene.action_high)
    parameter = next(policy.parameters(), None) if isinstance(policy, nn.Module) else None
    device, dtype = ("cpu", torch.float64) if parameter is None else (parameter.device, parameter.dtype)
    on_cpu: dict[str, Any] = {"dtype": torch.float64, "device": "cpu"}
    state = torch.empty(n, steps + 1, scene.num_nodes, scene.state_size, **on_cpu)
    recorded = torch.empty(n, steps + 1, scene.physics_size, **on_cpu)
    actions = torch.empty(n, steps, scene.num_actions, **on_cpu)
    stable = torch.ones(n, dtype=torch.bool, device="cpu")
    state[:, 0], recorded[:, 0] = simulator.observe(physics, variant), torch.from_numpy(physics)
    entries = TensorDict(batch_size=[n], device=device)
    if len(simulator.scenes) > 1:
        entries["variant"] = torch.from_numpy(variant)[:, None]
    cuda = [device] if torch.device(device).type == "cuda" else []
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM), torch.random.fork_rng(cuda):
        torch.manual_seed(checked_seed(seed))
        for step in range(steps):
            entries["state"], entries["physics"] = state[:, step].to(dtype), recorded[:, step]
            entries["is_init"] = torch.full((n, 1), step == 0)
            action, entries = _act(policy, entries)
            if action.shape != (n, scene.num_actions):
                raise ValueError(f"The policy's action must be [{n}, {scene.num_actions}], got {list(action.shape)}.")
            require_finite(action, f"the policy's action at step {step}")
            actions[:, step] = torch.clamp(action.cpu().double(), low, high)
            moved = simulator.rollout(recorded[:, step], actions[:, step : step + 1], variant)
            good = moved["stable"]
            state[:, step + 1] = torch.where(good[:, None, None], moved["state"][:, 1], state[:, step])
            recorded[:, step + 1] = torch.where(good[:, None], moved["physics"][:, 1], recorded[:, step])
            stable &= good
    return TensorDict({"state": state, "physics": recorded, "stable": stable, "action": actions}, batch_size=[n])


def _act(policy: Policy, entries: TensorDict) -> tuple[Tensor, TensorDictBase]:
    """Return a policy's action, and the entries for its next step."""
    out = policy(entries)
    if isinstance(out, Tensor):
        return out, entries
    out = entries if out is None else out
    if not isinstance(out, TensorDictBase) or "action" not in out:
        received = sorted(map(str, out.keys())) if isinstance(out, TensorDictBase) else type(out).__name__
        raise ValueError(f"The policy must write 'action' or return it as a tensor; it gave {received}.")
    action, ahead = out["action"], out.get("next", None)
    carried = entries.update(out.exclude("next"))
    return action, carried if ahead is None else carried.exclude("next").update(ahead)

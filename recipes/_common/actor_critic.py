"""A short-horizon actor-critic round by round: the networks' optimiser, and what the policy plays."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from torchrl_gn.envs import SceneEnv
from torchrl_gn.envs.starts import for_learning
from torchrl_gn.objectives import SHACLoss
from torchrl_gn.planners import StatePolicy
from torchrl_gn.training.optimizers import clip_gradients

WINDOW = 50  # control steps of a trajectory that the model learns from
_BETAS = (0.7, 0.95)  # SHAC's: gradients change fast with the policy
_KEPT = {"reward": "imagined_reward", "loss_value": "loss_value", "entropy": "entropy"}


class ActorCriticOptimizer:
    """Updates policy, value and the entropy's weight by Adam, each with its own rate and clipped gradient."""

    def __init__(self, loss: SHACLoss, *, policy_lr: float, value_lr: float, alpha_lr: float) -> None:
        self.loss = loss
        self.groups = [list(loss.policy.parameters()), list(loss.value.parameters()), [loss.log_alpha]]
        rates = zip(self.groups, (policy_lr, value_lr, alpha_lr), strict=True)
        self.optimizer = torch.optim.Adam([{"params": of, "lr": rate} for of, rate in rates], betas=_BETAS, fused=True)

    def learn(self, states: Tensor, recent: Tensor, *, updates: int, batch_size: int, desc: str) -> dict[str, float]:
        """Update from batches of played states ``[M, N, 13]``, half of them ``recent``; means of the last quarter."""
        kept: dict[str, list[Tensor]] = {name: [] for name in _KEPT}
        shares = (states, batch_size - batch_size // 2), (recent, batch_size // 2)
        with tqdm(total=updates, desc=desc, unit=" updates", leave=False) as bar:
            for update in range(updates):
                rows = [of[torch.randint(len(of), (size,))] for of, size in shares]
                out = self.loss(TensorDict({"state": torch.cat(rows)}, [batch_size]))
                self.optimizer.zero_grad()
                (out["loss_actor"] + out["loss_value"] + out["loss_alpha"]).backward()
                for group in self.groups:
                    clip_gradients(group, 1.0, f"update {update}")
                self.optimizer.step()
                if update >= 3 * updates // 4:
                    for name, values in kept.items():
                        values.append(out[name].detach())
                bar.update()
        return {_KEPT[name]: float(torch.stack(values).mean()) for name, values in kept.items()}

    def state_dict(self) -> dict[str, Any]:
        return {"adam": self.optimizer.state_dict(), "log_alpha": self.loss.log_alpha.detach()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.optimizer.load_state_dict(state["adam"])
        with torch.no_grad():
            self.loss.log_alpha.copy_(state["log_alpha"])


def play(env: SceneEnv, policy: StatePolicy, *, episodes: int, steps: int, explore: bool) -> TensorDict:
    """Episodes ``[M, T]`` in MuJoCo, from new starts."""
    kind = ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC
    with torch.no_grad(), set_exploration_type(kind):
        env = cast(SceneEnv, for_learning(env))
        start = env.reset(TensorDict(batch_size=[episodes]))
        return env.rollout(steps, policy, tensordict=start, auto_reset=False, break_when_any_done=False)


def windows(state: Tensor, action: Tensor) -> TensorDict:
    """Cut ``state`` ``[K, T + 1, N, 13]`` and ``action`` ``[K, T, A]`` into trajectories of :data:`WINDOW` steps."""
    first = range(0, action.shape[1] - WINDOW + 1, WINDOW)
    parts = {
        "state": torch.cat([state[:, at : at + WINDOW + 1] for at in first]),
        "action": torch.cat([action[:, at : at + WINDOW].float() for at in first]),
    }
    return TensorDict(parts, [len(parts["action"])])


def played_windows(played: TensorDict) -> TensorDict:
    """Trajectories of :func:`play`, without the episodes whose simulation became unstable."""
    alive = ~cast(Tensor, played["next", "terminated"]).flatten(1).any(1)
    state = torch.cat((played["state"], played["next", "state"][:, -1:]), 1)
    return windows(state[alive], played["action"][alive])

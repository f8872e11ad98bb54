"""Experience of a policy: transition collectors, and states of episodes and replay buffers for checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType

from torchrl_gn.scenes import ObservationGraph
from torchrl_gn.training.nested_state import require_like

_EPISODE = "_extra_state"  # torch's key for a module's state beside tensors


def make_collector(
    env: EnvBase | Sequence[Callable[[], EnvBase]], policy: TensorDictModuleBase, *, seed: int | None, **options: Any
) -> BaseCollector:
    """Make a collector that explores.

    Args:
        env: environments, or functions that make some, each in a Ray actor of its own.
        policy: its weights may be on another device than the environments.
        seed: seed of the environments; None keeps theirs.
        **options: further options of ``torchrl.collectors.Collector``.
    """
    options |= {"exploration_type": ExplorationType.RANDOM}
    collector_kwargs: dict[str, Any] = {"track_traj_ids": False, "auto_register_policy_transforms": False}
    if isinstance(env, EnvBase):
        if seed is not None:
            env.set_seed(seed)
        if (device := device_of(policy)) not in (None, env.device):
            options |= {"policy_device": device, "env_device": env.device}
        return Collector(env, policy, **options, **collector_kwargs)
    makers = list(env)
    if seed is not None:
        makers = [partial(_seeded, make, seed + index) for index, make in enumerate(makers)]
    backend_options = {"collector_kwargs": collector_kwargs, "remote_configs": {"num_cpus": 1, "num_gpus": 0}}
    collector = Collector(makers, policy, backend="ray", sync=True, backend_options=backend_options, **options)
    collector.update_policy_weights_(policy)
    return collector


def device_of(policy: TensorDictModuleBase) -> torch.device | None:
    """Return the device of a policy's weights; None without weights."""
    weight = next(policy.parameters(), None)
    return None if weight is None else weight.device


def _seeded(make: Callable[[], EnvBase], seed: int) -> EnvBase:
    env = make()
    env.set_seed(seed)
    return env


def episode_state(env: EnvBase) -> dict[str, Any]:
    """Return running episodes by environment name, omitting closed environments and those that cannot resume."""
    serial = _without_transforms(env)
    return {} if serial.is_closed else _episodes(serial)


def load_episode_state(env: EnvBase, state: dict[str, Any]) -> None:
    """Make the next reset continue the episodes of :func:`episode_state`; ValueError if they do not fit ``env``."""
    serial = _without_transforms(env)
    names = _episodes(serial)
    require_like(dict.fromkeys(names, {}), state, "training.episodes")
    if names:
        serial.load_state_dict({name: {_EPISODE: state[name]} for name in names})


def _episodes(env: EnvBase) -> dict[str, Any]:
    if not isinstance(env, SerialEnv):
        return {}
    return {name: state[_EPISODE] for name, state in env.state_dict().items() if _EPISODE in state}


def _without_transforms(env: EnvBase) -> EnvBase:
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def buffer_state(buffer: TensorDictReplayBuffer) -> dict[str, torch.Tensor]:
    """Return the transitions of a replay buffer by dotted key, oldest first, each ``[size, ...]``."""
    filled = buffer.storage[: len(buffer)] if len(buffer) else TensorDict()
    oldest = int(buffer.writer.state_dict()["_cursor"]) % max(1, len(buffer))
    return {str(key): cast(torch.Tensor, value).roll(-oldest, 0) for key, value in filled.flatten_keys(".").items()}


def load_buffer_state(
    buffer: TensorDictReplayBuffer, state: dict[str, torch.Tensor], capacity: int, graph: ObservationGraph
) -> None:
    """Extend a replay buffer with the last ``capacity`` transitions of :func:`buffer_state`.

    Raises:
        ValueError: they are not transitions of the body that ``graph`` describes.
    """
    if state:
        count, seen = len(state["action"]), graph.num_observations
        like = {"observation": torch.zeros(count, seen), "action": torch.zeros(count, graph.num_actions)}
        like |= {"next.observation": like["observation"], "next.reward": torch.zeros(count, 1)}
        like |= {f"next.{name}": torch.zeros(count, 1, dtype=torch.bool) for name in ("done", "terminated")}
        require_like(like, state, "training.buffer")
        state = {name: state[name] for name in like}
        flat = TensorDict(state)
        flat.auto_batch_size_(1)
        buffer.extend(flat.unflatten_keys(".")[-capacity:])

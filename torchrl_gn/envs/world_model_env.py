"""TorchRL's environment of a world model, with the specs of a scene."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Composite
from torchrl.envs import EnvBase
from torchrl.envs.model_based import WorldModelEnv
from torchrl.modules import WorldModel

from torchrl_gn.envs.partial_steps import step_some
from torchrl_gn.envs.starts import batched
from torchrl_gn.envs.transform_checks import refuse_transforms


class _Dreams(WorldModelEnv):
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        refuse_transforms(self, tensordict)
        stepped = step_some(tensordict, super()._step, fixed=True)
        for key in self.reward_keys:  # a reward head has its network's dtype
            stepped.set(key, stepped.get(key).to(self.full_reward_spec[key].dtype))
        return stepped


def world_model_env(
    world_model: WorldModel,
    env: EnvBase,
    *batch_size: int,
    latent_key: NestedKey = "state",
    observation_spec: Composite | None = None,
) -> WorldModelEnv:
    """Make TorchRL's ``WorldModelEnv`` with the specs of a :class:`SceneEnv` or :class:`ModelEnv`.

    The environment has ``batch_size`` imagined episodes. ``WorldModelEnv`` of TorchRL 0.14 alone gives action and
    reward the batch's shape, instead of one action and reward per episode.

    Args:
        latent_key: entry of the state that the world model steps.
        observation_spec: spec of the imagined observations; default: the spec of ``env`` at ``latent_key``.
    """
    many = batched(env, *batch_size)
    if observation_spec is None:
        observation_spec = Composite({latent_key: many.observation_spec[latent_key]}, shape=many.batch_size)
    shared = {"latent_key": latent_key, "observation_spec": observation_spec}
    dreams = _Dreams(world_model, env, batch_size=many.batch_size, **shared)
    dreams._batch_locked = True  # it steps only this batch size, also if some episodes have ended
    # Transforms pass these entries on when they reset.
    dreams.state_spec = Composite({latent_key: dreams.observation_spec[latent_key].clone()}, shape=many.batch_size)
    dreams.action_spec, dreams.reward_spec = many.action_spec.clone(), many.reward_spec.clone()
    return dreams

"""Scenes and a small model that the environment tests share."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.maths import quaternion
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import Scene, load_scene


class Spinner(TensorDictModuleBase):
    """Stand-in for a learned model: the pole turns at ``gain * action + drift`` about y."""

    def __init__(self, scene: Scene):
        super().__init__()
        self.in_keys = ["state", "action"]
        self.out_keys = [("next", "state")]
        self.scene = scene
        self.gain = nn.Parameter(torch.full((), 0.2))
        self.drift = nn.Parameter(torch.zeros(()))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, action = tensordict["state"], tensordict["action"]
        turn = (self.gain * action + self.drift).to(state.dtype)
        rotation = quaternion.exp(torch.cat((0 * turn, turn, 0 * turn), -1))
        pole = state[..., 1, :]
        turned = quaternion.product(rotation, pole[..., 3:7])
        pole = torch.cat((pole[..., :3], turned, pole[..., 7:]), -1)
        return tensordict.set(("next", "state"), torch.stack((state[..., 0, :], pole), -2))


@pytest.fixture(scope="session")
def pendulum() -> Scene:
    return load_scene("pendulum")


@pytest.fixture(scope="session")
def swimmer() -> Scene:
    return load_scene("swimmer6")


@pytest.fixture
def scene_env(pendulum) -> SceneEnv:
    return SceneEnv(pendulum, make_reward("balance", pendulum), seed=0)


@pytest.fixture
def model_env(pendulum) -> ModelEnv:
    return ModelEnv(Spinner(pendulum), make_reward("balance", pendulum), seed=0)


@pytest.fixture(params=["scene_env", "model_env"])
def env(request):
    """Return one of the two environments."""
    return request.getfixturevalue(request.param)

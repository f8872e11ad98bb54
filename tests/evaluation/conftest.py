from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import ForwardModel, Predictor
from torchrl_gn.dynamics.bound import update_dynamic_normalizers, update_parameter_normalizers
from torchrl_gn.maths import quaternion
from torchrl_gn.scenes import load_scene

from ..sizes import SMALL

SYSTEMS = ("pendulum", "swimmer6", "cheetah")


@pytest.fixture(scope="session")
def scenes():
    return {name: load_scene(name) for name in SYSTEMS}


def random_states(scene, *shape: int, seed: int = 0) -> torch.Tensor:
    """``[*shape, N, 13]`` states that differ in movable components only; fixed nodes stay at the origin."""
    generator = torch.Generator().manual_seed(seed)
    movable = torch.as_tensor(scene.movable, dtype=torch.float64)
    noise = torch.randn(*shape, scene.num_nodes, 12, generator=generator, dtype=torch.float64) * movable
    turn = quaternion.exp(noise[..., 3:6])
    return torch.cat((noise[..., :3], turn, noise[..., 6:]), dim=-1)


def random_trajectories(scene, number: int, steps: int, seed: int = 0):
    action = torch.randn(number, steps, scene.num_actions, dtype=torch.float64)
    state = random_states(scene, number, steps + 1, seed=seed)
    return TensorDict({"state": state, "action": action}, batch_size=[number])


def as_model(function, scene) -> TensorDictModule:
    """A bound model out of a function ``(state, action) -> next state``."""
    model = TensorDictModule(function, in_keys=["state", "action"], out_keys=[("next", "state")])
    model.scene = scene
    return model


def moving_states(scene, steps: int) -> torch.Tensor:
    """``[steps + 1, N, 13]`` a smooth made-up motion."""
    time = torch.linspace(0, 1, steps + 1, dtype=torch.float64)[:, None, None]
    movable = torch.as_tensor(scene.movable, dtype=torch.float64)
    position = movable[:, :3] * torch.cat((time, 0.1 * time, 0.5 + 0 * time), dim=-1)
    position = position + movable[:, :3] * 0.2 * torch.arange(scene.num_nodes, dtype=torch.float64)[:, None]
    turn = quaternion.exp(movable[:, 3:6] * torch.sin(2 * math.pi * time))
    return torch.cat((position, turn, movable[:, 6:] * time), dim=-1)


@pytest.fixture(scope="session")
def simulated(scenes) -> TensorDict:
    """Six trajectories of the swimmer, 60 steps each."""
    return collect_trajectories(scenes["swimmer6"], 6, 60, seed=0)


@pytest.fixture
def swimmer(scenes, simulated) -> Predictor:
    """A small untrained model of the swimmer that knows how its states vary."""
    torch.manual_seed(0)
    bound = ForwardModel.for_scene(scenes["swimmer6"], **SMALL).double().bind(scenes["swimmer6"])
    update_parameter_normalizers(bound)
    state = simulated["state"]
    update_dynamic_normalizers(bound, state[:, :-1], simulated["action"], state[:, 1:])
    return bound

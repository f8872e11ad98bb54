"""The device of these tests, and models and data there and on the CPU."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import TypeVar

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

import torchrl_gn as gn
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.scenes import Scene

from . import device

M = TypeVar("M", bound=nn.Module)
SYSTEMS = ("swimmer6", "cheetah", "jaco")


@pytest.fixture(scope="session")
def gpu() -> torch.device:
    return device.register()


@pytest.fixture(scope="session")
def systems() -> dict[str, Scene]:
    return {name: gn.load_scene(name) for name in SYSTEMS}


@pytest.fixture(scope="session")
def data(systems) -> dict[str, TensorDict]:
    """A few random trajectories of each, on the CPU."""
    return {name: gn.collect_trajectories(scene, 4, steps=24, seed=0) for name, scene in systems.items()}


@pytest.fixture
def pair(gpu, make_model) -> Callable[..., tuple[ForwardModel, ForwardModel]]:
    """A small float64 model of a scene, and its copy on the device."""

    def make(scene: Scene, **options) -> tuple[ForwardModel, ForwardModel]:
        model = make_model(scene, **options).double()
        return model, copy.deepcopy(model).to(gpu)

    return make


def close(found: Tensor, wanted: Tensor, *, tolerance: float = 1e-9) -> None:
    """The same numbers, up to the order of sums, on the device and on the CPU."""
    assert found.device.type == device.NAME and wanted.is_cpu
    torch.testing.assert_close(found.detach().cpu(), wanted.detach(), rtol=tolerance, atol=tolerance)


def task(state: Tensor, action: Tensor, next_state: Tensor, task=None) -> Tensor:
    """A reward without constants: the first body shall go to the origin."""
    return -next_state[..., 1, :2].square().sum(-1, keepdim=True)

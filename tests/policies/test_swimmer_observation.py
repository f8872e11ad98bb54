"""Observations computed from body states equal dm_control's."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import Simulator
from torchrl_gn.envs import suite_env
from torchrl_gn.policies import SwimmerObservation
from torchrl_gn.scenes import load_scene


@pytest.mark.parametrize("links", [3, 6])
def test_equals_what_the_suite_observes(links: int) -> None:
    scene = load_scene(f"swimmer{links}")
    env = suite_env("swimmer", f"swimmer{links}", timestep=scene.timestep)
    observe, simulator = SwimmerObservation(scene), Simulator(scene)
    torch.manual_seed(0)
    now = env.reset()
    inner = env.base_env._envs[0].physics  # pyright: ignore
    for _ in range(20):
        physics = np.concatenate(([inner.data.time], inner.data.qpos, inner.data.qvel))
        assert len(physics) == scene.physics_size
        target = torch.from_numpy(inner.named.data.geom_xpos["target"].copy())
        seen = observe.observe(simulator.observe(physics), target)
        torch.testing.assert_close(seen, now["observation"][0], atol=1e-5, rtol=1e-5)
        now = env.step(env.rand_action(now))["next"]


def test_refuses_other_scenes() -> None:
    with pytest.raises(ValueError, match="'pendulum' is not a swimmer"):
        SwimmerObservation(load_scene("pendulum"))


def test_a_missing_entry_is_named() -> None:
    observe = SwimmerObservation(load_scene("swimmer3"))
    with pytest.raises(KeyError, match='"target" not found'):
        observe(TensorDict({"state": torch.zeros(2, 4, 13)}, [2]))

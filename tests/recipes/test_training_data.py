"""Trajectories of one's own as data of the main job."""

from __future__ import annotations

import torch

from _common.training_data import extra_trajectories
from torchrl_gn.data import collect_trajectories
from torchrl_gn.scenes import load_scene


def test_trajectories_of_a_policy_are_extra_data(tmp_path):
    swung = collect_trajectories(
        load_scene("pendulum"), 3, 100, policy=lambda entries: entries["state"][:, 1, 11:12].sign()
    )
    swung.memmap(tmp_path / "swung")
    extra = extra_trajectories(str(tmp_path / "swung"), 100)
    assert torch.equal(extra["state"], swung["state"]) and torch.equal(extra["action"], swung["action"])

"""The swimmer that swims on purpose, for data unlike random control's."""

from __future__ import annotations

import numpy as np
from omegaconf import OmegaConf

from torchrl_gn.scenes import load_scene


def test_the_gait_that_is_found_carries_the_swimmer(load):
    recipe = load("data_shift")
    scene, rng = load_scene("swimmer6"), np.random.default_rng(0)
    cfg = OmegaConf.create({"search": {"generations": 3, "population": 16, "starts": 1, "steps": 200}})
    gait, _ = recipe.find_gait(scene, cfg, rng)
    assert (gait >= recipe.LOW).all() and (gait <= recipe.HIGH).all()
    swimming = recipe.swim(scene, gait, 6, 200, rng)
    assert swimming["state"].shape == (6, 201, scene.num_nodes, 13) and swimming["action"].shape == (6, 200, 5)
    assert (np.abs(swimming["action"].numpy()) <= scene.action_high).all()
    # Joints that move all at once carry it nowhere.
    still = recipe.swim(scene, np.array([gait[0], gait[1], 0.0]), 6, 200, np.random.default_rng(1))
    assert recipe.distance(swimming["state"]).mean() > 5 * recipe.distance(still["state"]).mean()

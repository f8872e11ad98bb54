"""Options that may be lists."""

from __future__ import annotations

import pytest

from _common.options import as_list, scene_options

omegaconf = pytest.importorskip("omegaconf")


def test_one_of_a_list_may_stand_alone():
    assert as_list("swimmer6") == ["swimmer6"] and as_list(0) == [0] and as_list(None) == []
    assert as_list(omegaconf.OmegaConf.create(["swimmer6", {"seed": 1}])) == ["swimmer6", {"seed": 1}]


@pytest.mark.parametrize("recipe", ["forward_model", "mpc", "plan_and_learn"])
def test_options_of_a_scene(compose, recipe):
    assert scene_options(compose(recipe)) == {"timestep": None, "action_bounds": None, "wide_starts": 0.5}
    given = compose(recipe, "action_bounds={free: [-1, 2]}", "wide_starts=0", "timestep=0.02")
    assert scene_options(given) == {"timestep": 0.02, "action_bounds": {"free": [-1, 2]}, "wide_starts": 0}

"""Configurations as plain values."""

from __future__ import annotations

import pytest

from torchrl_gn.training import plain_config

omegaconf = pytest.importorskip("omegaconf")


def test_a_configuration_becomes_plain_with_its_references_resolved():
    config = omegaconf.OmegaConf.create({"size": 3, "model": {"hidden": ["${size}", 4], "name": "gn"}, "none": None})
    plain = plain_config(config)
    assert plain == {"size": 3, "model": {"hidden": [3, 4], "name": "gn"}, "none": None}
    assert type(plain["model"]) is dict and type(plain["model"]["hidden"]) is list
    assert plain_config(plain) == plain

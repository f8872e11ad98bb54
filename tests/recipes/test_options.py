"""Options that may be lists."""

from __future__ import annotations

import pytest

from _common.options import as_list

omegaconf = pytest.importorskip("omegaconf")


def test_one_of_a_list_may_stand_alone():
    assert as_list("swimmer6") == ["swimmer6"] and as_list(0) == [0] and as_list(None) == []
    assert as_list(omegaconf.OmegaConf.create(["swimmer6", {"seed": 1}])) == ["swimmer6", {"seed": 1}]

"""Speeds of matrix products are timed once and kept; without a measurement, they decide nothing."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable

import pytest
import torch

from torchrl_gn import processor
from torchrl_gn.dynamics import specialize
from torchrl_gn.maths import precision
from torchrl_gn.maths.precision import fast_matmul
from torchrl_gn.processor import ProductSpeeds, SlowDtypeWarning, product_speeds

SPEEDS = ProductSpeeds(float64=50.0, float32=100.0, onednn=160.0, bfloat16=300.0, float16=7.0, onednn_error=2e-7)


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """An empty cache, on disk and in memory."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    product_speeds.cache_clear()
    yield tmp_path / "torchrl_gn"
    product_speeds.cache_clear()


@pytest.fixture
def measured(fresh) -> Callable[[ProductSpeeds], None]:
    """Let speeds be those that an earlier process measured."""
    product_speeds()
    (file,) = fresh.iterdir()

    def measured(speeds: ProductSpeeds) -> None:
        file.write_text(json.dumps(dataclasses.asdict(speeds)))
        product_speeds.cache_clear()

    return measured


def test_speeds_are_measured_once_and_kept(fresh, measured):
    threads = torch.get_num_threads()
    first = product_speeds()
    assert all(value > 0 for name, value in dataclasses.asdict(first).items() if name not in ("onednn", "onednn_error"))
    assert torch.get_num_threads() == threads
    (file,) = fresh.iterdir()
    assert json.loads(file.read_text()) == dataclasses.asdict(first)
    measured(SPEEDS)
    assert product_speeds() == SPEEDS


def test_other_instruction_sets_are_measured_anew(fresh, monkeypatch):
    product_speeds()
    product_speeds.cache_clear()
    monkeypatch.setenv("ATEN_CPU_CAPABILITY", "default")
    product_speeds()
    assert len(list(fresh.iterdir())) == 2


def test_a_damaged_file_is_measured_anew(fresh):
    product_speeds()
    (file,) = fresh.iterdir()
    for content in ("", "{", "[]", '{"float32": 1.0}'):
        file.write_text(content)
        product_speeds.cache_clear()
        assert json.loads(json.dumps(dataclasses.asdict(product_speeds()))) == json.loads(file.read_text())


def test_a_cache_that_cannot_be_written_is_done_without(fresh):
    fresh.write_text("a file where the folder would be")
    assert product_speeds().float32 > 0


def test_onednn_pays_where_it_is_faster_with_the_same_digits():
    assert SPEEDS.onednn_pays
    assert not dataclasses.replace(SPEEDS, onednn=105.0).onednn_pays
    assert not dataclasses.replace(SPEEDS, onednn_error=1e-3).onednn_pays


def test_slowdowns_are_against_the_faster_float32():
    assert SPEEDS.slowdown(torch.bfloat16) == pytest.approx(160 / 300)
    assert SPEEDS.slowdown(torch.float16) == pytest.approx(160 / 7)
    assert dataclasses.replace(SPEEDS, onednn_error=1e-3).slowdown(torch.bfloat16) == pytest.approx(100 / 300)
    assert SPEEDS.slowdown(torch.float64) == 1


@pytest.mark.skipif(processor.onednn_precision() is None, reason="this torch cannot choose oneDNN")
@pytest.mark.parametrize(("speeds", "chosen"), [(SPEEDS, True), (dataclasses.replace(SPEEDS, onednn=90.0), False)])
def test_products_go_through_onednn_where_it_pays(measured, speeds, chosen):
    measured(speeds)
    settings = processor.onednn_precision()
    before = settings.fp32_precision
    with fast_matmul():
        assert (settings.fp32_precision == "bf16") == chosen
    assert settings.fp32_precision == before


def test_a_torch_without_the_setting_multiplies_as_ever(monkeypatch):
    monkeypatch.setattr(precision, "onednn_precision", lambda: None)
    with fast_matmul(rounding=True):
        assert (torch.ones(2, 2) @ torch.ones(2, 2) == 2).all()


def test_slow_dtypes_warn_and_say_what_to_do(measured):
    from torchrl_gn.training import load_pretrained

    loaded = load_pretrained("pendulum")
    bound = loaded.model.bind(loaded.scene())
    measured(dataclasses.replace(SPEEDS, bfloat16=8.0))
    with pytest.warns(
        SlowDtypeWarning, match="multiplies bfloat16 20.0 times more slowly than float32: leave out dtype"
    ):
        specialize(bound, dtype=torch.bfloat16)
    specialize(bound, dtype=torch.float64)
    measured(SPEEDS)
    specialize(bound, dtype=torch.bfloat16)

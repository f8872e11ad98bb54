"""Feature statistics against numpy in float64, and the exactness that rollouts need."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_gn.maths import Normalizer

maths = settings(max_examples=25, deadline=None, derandomize=True, database=None)


def samples(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.as_tensor(np.random.default_rng(seed).normal(size=shape))


def fitted(*batches: torch.Tensor, floor: float = 0.0) -> Normalizer:
    normalizer = Normalizer(batches[0].shape[-1], floor=floor)
    for batch in batches:
        normalizer.update(batch)
    return normalizer


def assert_same_statistics(a: Normalizer, b: Normalizer, rtol: float = 1e-12) -> None:
    for name in ("count", "mean", "std", "inverse_std"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=rtol, atol=rtol * 1e-3)


@pytest.mark.parametrize("mean", [0.0, 1.0, 1e6, -1e9])
def test_statistics_are_numpys(mean):
    scale = torch.tensor([1e-2, 1.0, 300.0], dtype=torch.float64)
    batches = [mean + scale * samples(7, 5, 3, seed=seed) for seed in range(20)]
    normalizer = fitted(*batches, floor=0.0)
    data = torch.stack(batches).reshape(-1, 3).numpy()
    exact = [np.longdouble(data).mean(0), np.longdouble(data).std(0)]
    np.testing.assert_array_equal(normalizer.count, 20 * 7 * 5)
    np.testing.assert_allclose(normalizer.mean, exact[0].astype(float), rtol=1e-13, atol=1e-13)
    # A spread below 1e-7 of the mean is rounding noise, by contract.
    varies = np.array([1e-2, 1.0, 300.0]) > 1e-7 * abs(mean)
    np.testing.assert_array_equal(~normalizer.constant, varies)
    np.testing.assert_allclose(normalizer.std[varies], exact[1].astype(float)[varies], rtol=1e-7)


def test_normalised_samples_have_mean_zero_and_variance_one():
    data = 5 + 3 * samples(1000, 4)
    normalized = fitted(data)(data)
    torch.testing.assert_close(normalized.mean(0), torch.zeros(4).double(), rtol=0, atol=1e-14)
    torch.testing.assert_close(normalized.var(0, correction=0), torch.ones(4).double(), rtol=1e-13, atol=0)


@pytest.mark.slow
@maths
@given(st.lists(st.integers(1, 30), min_size=1, max_size=6), st.floats(-1e4, 1e4))
def test_merged_shards_equal_the_whole(sizes, mean):
    shards = [mean + samples(size, 3, seed=index) for index, size in enumerate(sizes)]
    whole = fitted(torch.cat(shards))
    merged = Normalizer(3)
    for shard in shards:
        merged.merge(fitted(shard))
    one_by_one = fitted(*torch.cat(shards)[:, None])
    assert_same_statistics(merged, whole, rtol=1e-11)
    assert_same_statistics(one_by_one, whole, rtol=1e-11)


def test_merging_nothing_changes_nothing():
    normalizer = fitted(samples(10, 2))
    before = copy.deepcopy(normalizer)
    normalizer.merge(Normalizer(2))
    normalizer.update(torch.zeros(0, 2))
    assert_same_statistics(normalizer, before, rtol=0)
    empty = Normalizer(2)
    empty.merge(normalizer)
    assert_same_statistics(empty, before, rtol=1e-15)


def test_a_billion_samples_lose_no_digits():
    """1000 samples merged with themselves 20 times over: a count of 1e9, the same mean and spread."""
    data = 1e6 + samples(1000, 2)
    normalizer = fitted(data)
    small = copy.deepcopy(normalizer)
    for _ in range(20):
        normalizer.merge(copy.deepcopy(normalizer))
    assert normalizer.count.tolist() == [1000 * 2**20] * 2
    torch.testing.assert_close(normalizer.mean, small.mean, rtol=1e-15, atol=0)
    torch.testing.assert_close(normalizer.std, small.std, rtol=1e-12, atol=0)
    # One more small batch, far away, still counts for what it is.
    normalizer.update(data + 1e3)
    share = 1 / (2**20 + 1)
    torch.testing.assert_close(normalizer.mean - small.mean, torch.full((2,), 1e3 * share).double(), rtol=1e-5, atol=0)


@pytest.mark.parametrize("value", [0.0, 0.1, -9.81, 1e10, 1e-30])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_constant_feature_maps_to_exactly_zero_and_back(value, dtype):
    normalizer = fitted(*torch.full((10, 37, 1), value, dtype=torch.float64))
    assert normalizer.constant.all()
    seen = torch.full((5, 1), value, dtype=dtype)
    assert torch.equal(normalizer(seen), torch.zeros_like(seen))
    # Never x / eps, even for a value that was not seen.
    assert torch.equal(normalizer(seen + 1), torch.zeros_like(seen))
    back = normalizer.inverse(torch.ones(5, 1, dtype=dtype))
    torch.testing.assert_close(back, seen, rtol=4 * torch.finfo(dtype).eps, atol=0)


def test_what_was_never_seen_maps_to_zero_and_back_to_zero():
    normalizer = Normalizer(3)
    assert torch.equal(normalizer(samples(4, 3)), torch.zeros(4, 3).double())
    assert torch.equal(normalizer.inverse(samples(4, 3)), torch.zeros(4, 3).double())


def test_rounding_noise_below_the_floor_is_constant():
    data = samples(100, 2) * torch.tensor([1e-11, 1e-7], dtype=torch.float64)
    assert fitted(data, floor=1e-9).constant.tolist() == [True, False]
    assert fitted(data).constant.tolist() == [False, False]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_inverse_undoes_forward(dtype):
    data = (100 + 0.1 * samples(50, 4)).to(dtype)
    normalizer = fitted(data)
    # The mean is subtracted before scaling: all digits that the input has above its mean survive.
    torch.testing.assert_close(normalizer.inverse(normalizer(data)), data, rtol=2 * torch.finfo(dtype).eps, atol=0)
    assert normalizer(data).dtype == normalizer.inverse(data).dtype == dtype
    assert normalizer(data, torch.float32).dtype == torch.float32


def test_float64_input_keeps_its_digits_in_a_float32_output():
    """Means far above the spread: subtracted in float64, only the result is float32."""
    data = 1e5 + 0.1 * samples(200, 1)
    normalizer = fitted(data)
    exact = (data - data.mean(0)) / data.std(0, correction=0)
    assert (normalizer(data, torch.float32).double() - exact).abs().max() < 1e-6


def test_masked_entries_do_not_count():
    data, mask = samples(40, 6, 3), samples(40, 6, 3, seed=1) > 0
    normalizer = Normalizer(3)
    normalizer.update(torch.where(mask, data, torch.nan), mask)
    for feature in range(3):
        seen = data[..., feature][mask[..., feature]].numpy()
        assert normalizer.count[feature] == len(seen)
        np.testing.assert_allclose(normalizer.mean[feature], seen.mean(), rtol=1e-12)
        np.testing.assert_allclose(normalizer.std[feature], seen.std(), rtol=1e-12)


def test_masks_broadcast_over_the_batch():
    data = samples(10, 4, 2)
    mask = torch.tensor([[True, False]] * 2 + [[False, False]] * 2)
    normalizer = Normalizer(2)
    normalizer.update(data, mask)
    assert normalizer.count.tolist() == [20, 0]
    torch.testing.assert_close(normalizer.mean[0], data[:, :2, 0].mean())


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_values_that_are_not_finite_are_refused_by_feature(bad):
    normalizer = fitted(samples(10, 4))
    before = copy.deepcopy(normalizer)
    data = samples(10, 4)
    data[3, 2] = bad
    with pytest.raises(ValueError, match=r"NaN or Inf in features \[2\]"):
        normalizer.update(data)
    assert_same_statistics(normalizer, before, rtol=0)


def test_sizes_that_differ_are_refused():
    with pytest.raises(ValueError, match=r"Normalizer of 3 features got 4 in \(5, 4\)"):
        Normalizer(3).update(torch.zeros(5, 4))
    with pytest.raises(ValueError, match="normaliser of 2 features into one of 3"):
        Normalizer(3).merge(Normalizer(2))


@pytest.mark.parametrize("copied", ["state_dict", "deepcopy", "pickle"])
def test_copies_normalise_alike_and_go_on_alike(copied):
    normalizer = fitted(1e5 + samples(50, 3))
    if copied == "state_dict":
        again = Normalizer(3)
        again.load_state_dict(normalizer.state_dict())
    elif copied == "deepcopy":
        again = copy.deepcopy(normalizer)
    else:
        again = pickle.loads(pickle.dumps(normalizer))
    assert set(normalizer.state_dict()) == {"count", "mean", "m2"}
    for one in (normalizer, again):
        one.update(samples(5, 3, seed=7))
    data = samples(4, 3)
    assert torch.equal(again(data), normalizer(data))
    assert torch.equal(again.inverse(data), normalizer.inverse(data))
    again.update(samples(5, 3))
    assert not torch.equal(again.mean, normalizer.mean)  # nothing is shared


@pytest.mark.parametrize("cast", [lambda m: m.float(), lambda m: m.half(), lambda m: m.to(torch.bfloat16)])
def test_statistics_stay_float64_whatever_the_network_becomes(cast):
    network = torch.nn.Sequential(fitted(1e6 + samples(50, 3)), torch.nn.Linear(3, 3))
    before = copy.deepcopy(network[0])
    normalizer = cast(network)[0]
    assert network[1].weight.dtype != torch.float64
    for name, buffer in normalizer.named_buffers():
        assert buffer.dtype == torch.float64, name
        assert torch.equal(buffer, getattr(before, name)), name


def test_statistics_follow_shared_memory_and_meta_devices():
    normalizer = fitted(samples(5, 3))
    assert all(buffer.is_shared() for buffer in copy.deepcopy(normalizer).share_memory().buffers())
    with torch.device("meta"):
        empty = Normalizer(3)
    empty = empty.to_empty(device="cpu")
    empty.load_state_dict(normalizer.state_dict())
    assert_same_statistics(empty, normalizer, rtol=0)


def test_limit_cuts_off_what_is_far_outside():
    normalizer = Normalizer(1, limit=3.0)
    normalizer.update(torch.tensor([[-1.0], [1.0]]))
    got = normalizer(torch.tensor([[-1e9], [0.5], [1e9], [float("nan")]])).flatten()
    assert got[:3].tolist() == [-3, 0.5, 3]
    assert got[3].isnan()
    with pytest.raises(ValueError, match="limit=0"):
        Normalizer(1, limit=0)


def test_statistics_stay_the_tensors_that_they_were():
    """TorchRL's losses hold on to the buffers of a module."""
    normalizer, other = Normalizer(3), fitted(samples(9, 3))
    held = dict(normalizer.named_buffers())
    normalizer.update(samples(9, 3))
    normalizer.merge(fitted(samples(5, 3, seed=1)))
    normalizer.load_state_dict(other.state_dict())
    for name, buffer in normalizer.named_buffers():
        assert buffer is held[name] and torch.equal(buffer, getattr(other, name))


def test_a_least_deviation_holds_for_what_varies_less():
    normalizer = Normalizer(3, floor=1e-9, least=[0.5, 0.5, 0.5])
    data = torch.randn(1000, 3, dtype=torch.float64) * torch.tensor([1e-4, 2.0, 0.0]) + 1.0
    normalizer.update(data)
    assert normalizer.std[0] == 0.5 and normalizer.std[2] == 0  # a constant one stays constant
    torch.testing.assert_close(normalizer.std[1], data[:, 1].std(correction=0))
    torch.testing.assert_close(normalizer(data + 1e-3)[:, 0], (data[:, 0] + 1e-3 - data[:, 0].mean()) / 0.5)
    torch.testing.assert_close(normalizer.inverse(normalizer(data))[:, :2], data[:, :2])
    again = Normalizer(3, floor=1e-9, least=[0.5, 0.5, 0.5])
    again.load_state_dict(normalizer.state_dict())
    assert torch.equal(again.std, normalizer.std) and "least" not in normalizer.state_dict()
    with pytest.raises(ValueError, match="least must have 3 numbers, one a feature, not 1"):
        Normalizer(3, least=[1.0])


def test_numbers_whose_squares_overflow_are_refused():
    normalizer = Normalizer(2)
    with pytest.raises(ValueError, match=r"numbers up to 2e\+160 in features \[1\]: too large"):
        normalizer.update(torch.tensor([[1.0, 1e160], [2.0, -2e160]], dtype=torch.float64))
    assert not normalizer.fitted


def test_a_deviation_without_inverse_in_single_precision_is_constant():
    values = 1e-42 * torch.tensor([[1.0], [-1.0], [3.0]], dtype=torch.float64)
    normalizer = Normalizer(1)
    normalizer.update(values)
    assert normalizer.constant.tolist() == [True] and normalizer(values.float()).tolist() == [[0.0]] * 3

"""Muon: its updates are the nearest orthogonal matrices and equal torch's own, in full precision."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_gn.dynamics.executors.native import build
from torchrl_gn.training import muon
from torchrl_gn.training.muon import Muon, orthogonalize

SHAPES = [(8, 8), (8, 20), (20, 8), (8, 11), (1, 5), (12, 128), (128, 782)]


def matrices(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_singular_values_become_about_one_and_their_vectors_stay(shape):
    given = matrices(3, *shape, dtype=torch.float64)
    out = orthogonalize(given)
    assert out.shape == given.shape
    left, _, right = torch.linalg.svd(given, full_matrices=False)
    values = left.mT @ out @ right.mT
    diagonal = values.diagonal(dim1=-2, dim2=-1)
    assert (values - torch.diag_embed(diagonal)).abs().max() < 1e-9
    assert diagonal.min() > 0.6 and diagonal.max() < 1.4


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_float32_keeps_its_digits_at_any_scale(shape, scale):
    given = scale * matrices(2, *shape)
    exact = orthogonalize(given.double())
    # The polynomials are steep: near the largest singular value by some thousand times, 6e-8 becomes 3e-4.
    assert (orthogonalize(given) - exact).norm() < 2e-3 * exact.norm()


def test_matrices_without_full_rank_or_of_zeros_stay_finite():
    thin = matrices(2, 16, 2) @ matrices(2, 2, 64)
    out = orthogonalize(thin)
    values = torch.linalg.svdvals(out)
    assert values[:, :2].min() > 0.6 and values[:, :2].max() < 1.4 and values[:, 2:].max() < 0.05
    assert torch.equal(orthogonalize(torch.zeros(2, 4, 9)), torch.zeros(2, 4, 9))


@pytest.mark.skipif(not hasattr(torch.optim, "Muon"), reason="this torch has no Muon to compare with")
def test_updates_point_where_torchs_do():
    """Torch multiplies in bfloat16 by other polynomials; both leave singular values between 0.68 and 1.32."""
    torch.manual_seed(0)
    modules = [nn.ModuleList([nn.Linear(30, 12), nn.Linear(12, 30), nn.Linear(12, 12)]) for _ in range(2)]
    modules[1].load_state_dict(modules[0].state_dict())
    ours = Muon([p for p in modules[0].parameters() if p.ndim == 2], lr=0.1)
    theirs = torch.optim.Muon([p for p in modules[1].parameters() if p.ndim == 2], lr=0.1, weight_decay=0.0)
    for step in range(4):
        generator = torch.Generator().manual_seed(step)
        before = [[p.detach().clone() for p in module.parameters()] for module in modules]
        for mine, other in zip(*(module.parameters() for module in modules), strict=True):
            mine.grad = torch.randn(mine.shape, generator=generator)
            other.grad = mine.grad.clone()
        ours.step()
        theirs.step()
        updates = [
            [new.detach() - old for new, old in zip(module.parameters(), olds, strict=True) if new.ndim == 2]
            for module, olds in zip(modules, before, strict=True)
        ]
        for mine, other in zip(*updates, strict=True):
            assert torch.cosine_similarity(mine.flatten(), other.flatten(), dim=0) > 0.9
            assert 0.7 < mine.norm() / other.norm() < 1.5


def updated(shapes: list, dtype: torch.dtype, steps: int = 3, *, transposed: bool = False) -> list[torch.Tensor]:
    """Parameters after some steps on random gradients."""
    generator = torch.Generator().manual_seed(1)
    parameters = []
    for shape in shapes:
        values = torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)
        parameters.append(nn.Parameter(values.T.contiguous().T if transposed else values))
    optimizer = Muon(parameters, lr=0.1)
    for _ in range(steps):
        for parameter in parameters:
            gradient = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter.grad = torch.empty_like(parameter).copy_(gradient)
        optimizer.step()
    return [parameter.detach() for parameter in parameters]


NATIVE_SHAPES = [*SHAPES, (5, 1), (1, 1), (33, 17), (17, 33), (128, 128), (300, 70), (600, 530)]


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_cpp_updates_as_torch_operations_do(dtype):
    """Which update matrices that do not lie in rows."""
    compiled, expected = (updated(NATIVE_SHAPES, dtype, transposed=transposed) for transposed in (False, True))
    digits = 1e-8 if dtype == torch.float64 else 2e-3  # of the update: the polynomials are steep
    start = updated(NATIVE_SHAPES, dtype, steps=0)
    for ours, torchs, before in zip(compiled, expected, start, strict=True):
        assert (ours - torchs).norm() < digits * (torchs - before).norm(), list(ours.shape)


@pytest.mark.skipif(build.find_compiler() is None, reason="needs a C++ compiler")
def test_cpp_gives_the_same_bits_on_any_number_of_threads():
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            results.append(updated(NATIVE_SHAPES, torch.float32))
    finally:
        torch.set_num_threads(threads)
    assert all(map(torch.equal, *results))


def test_matrices_that_do_not_lie_in_rows_are_updated_too():
    for ours, expected in zip(
        updated(SHAPES, torch.float64, transposed=True), updated(SHAPES, torch.float64), strict=True
    ):
        torch.testing.assert_close(ours, expected, rtol=1e-8, atol=1e-10)


def test_an_update_in_cpp_counts_as_a_change_for_autograd():
    weight = nn.Parameter(torch.ones(3, 3))
    loss = (weight * weight).sum()
    weight.grad = torch.eye(3)
    Muon([weight]).step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_a_batch_gives_what_each_matrix_alone_gives():
    given = [matrices(1, 16, 16)[0] * (index + 1) for index in range(3)] + [matrices(1, 16, 40)[0]]
    together = [nn.Parameter(torch.zeros_like(matrix)) for matrix in given]
    alone = [nn.Parameter(torch.zeros_like(matrix)) for matrix in given]
    for parameters in (together, alone):
        for parameter, matrix in zip(parameters, given, strict=True):
            parameter.grad = matrix.clone()
    Muon(together, lr=0.1).step()
    for parameter in alone:
        Muon([parameter], lr=0.1).step()
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-6)


def test_float64_stays_float64_and_halves_are_multiplied_in_float32():
    for dtype, digits in ((torch.float64, 1e-12), (torch.bfloat16, 1e-2)):
        parameter = nn.Parameter(torch.zeros(6, 9, dtype=dtype))
        parameter.grad = matrices(6, 9, dtype=dtype)
        Muon([parameter], lr=1.0, momentum=0.0).step()
        exact = -orthogonalize(parameter.grad.double()[None])[0]
        assert parameter.dtype == dtype
        assert (parameter.detach().double() - exact).norm() < digits * exact.norm()


def test_closures_frozen_weights_and_saved_moments():
    torch.manual_seed(0)
    layer, idle = nn.Linear(4, 4, bias=False), nn.Linear(4, 4, bias=False)
    optimizer = Muon([layer.weight, idle.weight], lr=0.01)
    before = idle.weight.clone()

    def closure() -> float:
        optimizer.zero_grad()
        loss = layer(torch.ones(1, 4)).square().sum()
        loss.backward()
        return loss.item()

    losses = [optimizer.step(closure) for _ in range(20)]
    assert losses[-1] < losses[0]
    assert torch.equal(idle.weight, before)
    again = Muon([layer.weight, idle.weight], lr=0.5)
    again.load_state_dict(optimizer.state_dict())
    assert again.param_groups[0]["lr"] == 0.01
    buffers = [one.state[layer.weight]["momentum_buffer"] for one in (again, optimizer)]
    assert torch.equal(*buffers)


def test_what_is_no_matrix_and_bad_rates_are_named():
    with pytest.raises(ValueError, match=r"matrices, not a parameter of shape \[3\]"):
        Muon([nn.Parameter(torch.zeros(3))])
    matrix = [nn.Parameter(torch.zeros(3, 3))]
    with pytest.raises(ValueError, match="lr=-1 must be finite and not negative"):
        Muon(matrix, lr=-1)
    with pytest.raises(ValueError, match="momentum=1 must be from 0 to below 1"):
        Muon(matrix, momentum=1)


@pytest.mark.skipif(build.find_compiler() is None, reason="needs a C++ compiler")
def test_matrices_in_the_memory_of_others_are_refused():
    update, rest = muon.load_operators().muon_, (0.9, 0.1, [3.0, -4.0, 2.0], 1)
    whole, grads, moments = torch.ones(7), [torch.ones(2, 3), torch.ones(2, 2)], [torch.ones(2, 3), torch.ones(2, 2)]
    apart, behind = torch.ones(2, 3), torch.ones(2, 2)
    for given in (
        ([whole[:6].view(2, 3), whole[3:].view(2, 2)], grads, moments),
        ([apart, behind], [grads[0], behind], moments),
        ([apart, behind], grads, [apart, moments[1]]),
        ([apart, apart], [grads[0]] * 2, [moments[0], torch.ones(2, 3)]),
    ):
        with pytest.raises(ValueError, match="share memory"):
            update(*given, *rest)
    with pytest.raises(RuntimeError, match="no_grad"):
        update([apart.clone().requires_grad_()], grads[:1], moments[:1], *rest)
    one = [torch.ones(2, 3) for _ in range(2)]
    update(one, [grads[0]] * 2, [torch.ones(2, 3) for _ in range(2)], *rest)  # one gradient, which is only read
    assert torch.equal(*one) and (one[0] != 1).any()

"""The fake device: operations fail or work as on CUDA, with the CPU's numbers."""

from __future__ import annotations

import copy
import io
import pickle

import numpy as np
import pytest
import torch
from torch import nn

from .device import NAME, waits, without_waits


@pytest.fixture
def both(gpu) -> tuple[torch.Tensor, torch.Tensor]:
    """A tensor on the CPU and the same there."""
    here = torch.randn(3, 4, generator=torch.Generator().manual_seed(0))
    return here, here.to(gpu)


MIXED = {
    "add": lambda here, there: there + here,
    "product": lambda here, there: there @ here.mT,
    "linear": lambda here, there: nn.functional.linear(there, here),
    "cat": lambda here, there: torch.cat((there, here)),
    "stack": lambda here, there: torch.stack((there[0, 0], torch.tensor(1.0))),
    "where": lambda here, there: torch.where(here > 0, there, there),
    "index_select": lambda here, there: there.index_select(0, torch.tensor([0])),
    "gather": lambda here, there: there.gather(0, torch.zeros(1, 4, dtype=torch.long)),
    "index_put": lambda here, there: there.clone().index_put_((torch.tensor([0]),), here[:1]),
    "addcmul": lambda here, there: torch.addcmul(there, there, torch.tensor(1.0)),
    "into the CPU": lambda here, there: here.clone().add_(there),
    "out": lambda here, there: torch.add(there, there, out=here.clone()),
    "another device": lambda here, there: there + here.to(f"{NAME}:1"),
    "generator": lambda here, there: torch.rand(3, device=there.device, generator=torch.Generator()),
    "permutation": lambda here, there: torch.randperm(3, device=there.device, generator=torch.Generator()),
}


@pytest.mark.parametrize("name", MIXED)
def test_devices_do_not_mix(both, name):
    with pytest.raises(RuntimeError, match="Expected"):
        MIXED[name](*both)


@pytest.mark.parametrize("read", [lambda x: x.numpy(), np.asarray, np.sqrt])
def test_numpy_needs_a_copy(both, read):
    with pytest.raises(TypeError, match="can't convert fakegpu"):
        read(both[1])
    assert np.array_equal(both[1].numpy(force=True), both[0].numpy())


def test_numbers_and_indices_of_the_cpu_are_taken(both):
    here, there = both
    number, index = torch.tensor(2.0), torch.tensor([0, 2])
    assert torch.equal((there * number).cpu(), here * number)
    assert torch.equal(there[index].cpu(), here[index])
    assert torch.equal(torch.where(there > 0, there, number).cpu(), torch.where(here > 0, here, number))
    assert torch.equal(there.masked_fill(there > 0, number).cpu(), here.masked_fill(here > 0, number))


def test_gradients_and_views(both):
    here, there = (each.clone().requires_grad_() for each in both)
    for each in (here, there):
        (each.T.reshape(2, 6)[:, ::2].unfold(1, 2, 1) ** 3).sum().backward()
    assert torch.equal(there.grad.cpu(), here.grad)
    with pytest.raises(RuntimeError, match="device"):
        there.backward(torch.ones(3, 4))


def test_seeds_give_the_numbers_of_the_cpu(gpu):
    draws = [torch.Generator(device).manual_seed(0) for device in ("cpu", gpu)]
    for _ in range(2):  # and the generator moves on
        here, there = (torch.randn(5, generator=each, device=each.device) for each in draws)
        assert torch.equal(there.cpu(), here)


def test_gru_cells(gpu):
    torch.manual_seed(0)
    for bias in (True, False):
        cell = nn.GRUCell(3, 4, bias=bias).double()
        found = []
        for each in (cell, copy.deepcopy(cell).to(gpu)):
            inputs = [
                torch.linspace(-1, 1, 5 * n, dtype=torch.float64).view(5, n).to(each.weight_ih.device) for n in (3, 4)
            ]
            leaves = [*(given.requires_grad_() for given in inputs), *each.parameters()]
            after = each(*inputs)
            found.append([each.cpu() for each in (after, *torch.autograd.grad(after.square().sum(), leaves))])
        torch.testing.assert_close(found[1], found[0], rtol=1e-12, atol=1e-12)


def test_copies_pickles_and_files(both):
    here, there = both
    file = io.BytesIO()
    torch.save(there, file)
    for kept in (copy.deepcopy(there), pickle.loads(pickle.dumps(there)), torch.load(io.BytesIO(file.getvalue()))):
        assert kept.device == there.device and torch.equal(kept.cpu(), here)
    assert torch.equal(torch.load(io.BytesIO(file.getvalue()), map_location="cpu"), here)


WAITING = {
    "item": lambda here, there: there[0, 0].item(),
    "bool": lambda here, there: bool((there > 0).any()),
    "from it": lambda here, there: there.cpu(),
    "to it": lambda here, there: here.to(there.device),
    "constant": lambda here, there: torch.tensor([1.0], device=there.device),
    "nonzero": lambda here, there: there.nonzero(),
    "mask": lambda here, there: there[there > 0],
    "list": lambda here, there: there[[0, 1]],
    "allclose": lambda here, there: torch.allclose(there, there),
    "errors of a system": lambda here, there: torch.linalg.solve(there @ there.mT, there),
}


@pytest.mark.parametrize("name", WAITING)
def test_waits_are_seen(both, name):
    before = waits()
    WAITING[name](*both)
    assert waits() > before
    with without_waits(), pytest.raises(RuntimeError, match="The host waits for the device"):
        WAITING[name](*both)


def test_what_stays_on_the_device_does_not_wait(both):
    there, before = both[1].clone().requires_grad_(), waits()
    with without_waits():
        torch.arange(3, device=there.device), torch.full((2,), 1.0, device=there.device)
        (
            there.clamp(min=0)[1:, :2] * 2 + there[torch.zeros(2, dtype=torch.long, device=there.device), :2]
        ).sum().backward()
        nn.utils.clip_grad_norm_([there], 1.0)
        torch.optim.Adam([there], fused=True).step()
    assert waits() == before


def test_operators_without_a_kernel_there_are_missing(both):
    from torchrl_gn.dynamics.executors.native import load_operators

    with pytest.raises(NotImplementedError):
        load_operators().pack(both[1].flatten(), [3, 4], True)

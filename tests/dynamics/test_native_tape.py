"""Scalar expressions, their gradients, traces of torch functions and the tapes made of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchrl_gn.dynamics.executors.native import expressions as ex
from torchrl_gn.dynamics.executors.native.expressions import Expressions, Scalar, gradient
from torchrl_gn.dynamics.executors.native.tape import CODES, Tape, assemble
from torchrl_gn.dynamics.executors.native.trace import UntraceableError, trace
from torchrl_gn.maths import quaternion

NAMES = {code: name for name, code in CODES.items()}
OPERATIONS = {
    "constant": lambda k, *_: k,
    "add_c": lambda k, a, *_: a + k,
    "sub_c": lambda k, a, *_: k - a,
    "mul_c": lambda k, a, *_: a * k,
    "div_c": lambda k, a, *_: k / a,
    "sqrt": lambda k, a, *_: np.sqrt(a),
    "sin": lambda k, a, *_: np.sin(a),
    "cos": lambda k, a, *_: np.cos(a),
    "abs": lambda k, a, *_: abs(a),
    "max_c": lambda k, a, *_: np.maximum(a, k),
    "min_c": lambda k, a, *_: np.minimum(a, k),
    "less_c": lambda k, a, *_: float(a < k),
    "greater_c": lambda k, a, *_: float(a > k),
    "equal_c": lambda k, a, *_: float(a == k),
    "floor": lambda k, a, *_: np.floor(a),
    "add": lambda k, a, b, *_: a + b,
    "sub": lambda k, a, b, *_: a - b,
    "mul": lambda k, a, b, *_: a * b,
    "div": lambda k, a, b, *_: a / b,
    "atan2": lambda k, a, b, *_: np.arctan2(a, b),
    "max": lambda k, a, b, *_: np.maximum(a, b),
    "min": lambda k, a, b, *_: np.minimum(a, b),
    "less": lambda k, a, b, *_: float(a < b),
    "madd_c": lambda k, a, b, *_: a * k + b,
    "where": lambda k, a, b, c: b if a else c,
    "madd": lambda k, a, b, c: a * b + c,
    "nmadd": lambda k, a, b, c: c - a * b,
}


def run(tape: Tape, *groups: np.ndarray) -> list[np.ndarray]:
    """Outputs of all phases of a tape, by numpy; a group of inputs each before phase 0."""
    registers = np.full(tape.registers, np.nan)
    for places, values in zip(tape.inputs, groups, strict=True):
        kept = places >= 0
        registers[places[kept]] = values[kept]
    found, start = [], 0
    for end, outputs in zip(tape.phases, tape.outputs, strict=True):
        for code, out, a, b, c, _, k in tape.instructions[start:end].tolist():
            operands = (registers[each] for each in (a, b, c))
            if NAMES[code] == "look_up":
                table = tape.constants[k + 1 : k + 1 + int(tape.constants[k])]
                registers[out] = table[int(np.clip(next(operands), 0, len(table) - 1))]
            else:
                registers[out] = OPERATIONS[NAMES[code]](tape.constants[k], *operands)
        found.append(registers[outputs])
        start = end
    return found


def symbols(graph: Expressions, values: torch.Tensor, varying: torch.Tensor) -> tuple[np.ndarray, list[Scalar]]:
    """Values with new inputs in place of the varying ones, and the inputs."""
    array = np.array(values.tolist(), dtype=object)
    inputs = graph.inputs(0, int(varying.sum()))
    array[varying.numpy()] = inputs
    return array, inputs


def test_every_operation_is_known_here():
    assert set(OPERATIONS) | {"input", "look_up"} == set(CODES)


def test_constants_vanish():
    graph = Expressions()
    (x, y) = graph.inputs(0, 2)
    for made, expected in ((x + 0, x), (0 + x, x), (x * 1, x), (x / 1.0, x), (x - 0, x), (ex.where(True, x, y), x)):
        assert made.index == expected.index
    for zero in (x * 0, 0 * x, x - x, 0 / x):
        assert zero == 0.0 and not isinstance(zero, Scalar)
    assert (x + y).index == (y + x).index and (x * y).index == (y * x).index
    assert ((x * 2.0) * 3.0).index == (x * 6.0).index
    assert (-1 * (-x)).index == x.index
    assert ex.maximum(x, -math.inf) is x and ex.minimum(x, math.inf) is x
    assert ex.where(x < 0, y, y).index == y.index
    assert isinstance(ex.zero_times(x), Scalar) and ex.zero_times(2.0) == 0.0
    with pytest.raises(NotImplementedError, match="a branch on a varying number"):
        bool(x < 1)


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_numbers_are_computed_as_by_torch(value):
    one = torch.tensor(value, dtype=torch.float64)
    pairs = [
        (ex.divide(1.0, value), 1 / one),
        (ex.divide(value, 0.0), one / 0),
        *((getattr(ex, name)(value), getattr(torch, name)(one)) for name in ("sqrt", "sin", "cos")),
        (ex.maximum(value, 0.5), torch.maximum(one, torch.tensor(0.5, dtype=torch.float64))),
        (ex.minimum(0.5, value), torch.minimum(one, torch.tensor(0.5, dtype=torch.float64))),
    ]
    for found, expected in pairs:
        np.testing.assert_allclose(found, expected.item(), rtol=1e-15, atol=1e-15)


def mixture(x: torch.Tensor) -> torch.Tensor:
    """A function ``[6] -> [10]`` with every operation that has a gradient."""
    a, b, c, d, e, f = x.unbind(-1)
    parts = [
        a + b * c - 2 * d,
        (3 - a) / (b * b + 1) + 2 / (c * c + 1),
        (a * a + b * b + 1).sqrt() * a.sin() + d.cos() * e.abs(),
        torch.atan2(a, b) + torch.where(c < d, c * d, e.square()) + torch.where(f > 0.25, f, f * f),
        torch.maximum(a, b) * torch.minimum(c, d) + e.clamp(-0.5, 0.5) + f.clamp(min=0.1),
        torch.stack((a, b, c)).norm() + torch.stack((d, e, f)).amax() + torch.stack((d, e, f)).mean(),
        a.pow(3) + b.reciprocal() + (-c),
        torch.where(x[5] == 7.0, a, b) * f,
        (x[:4].view(2, 2) @ x[2:].view(2, 2)).sum(),
        torch.linalg.cross(x[:3], x[3:]).sum() + quaternion.product(x[:4], x[2:]).sum(),
    ]
    return torch.stack(parts)


@pytest.mark.parametrize("value", [0.3, 1.7, 2.0, -0.4, 5.5])
def test_numbers_of_a_table_are_looked_up(value):
    """Look-up by an index that depends on the state, such as the cell of a height field; equal tables are one."""
    table = torch.tensor([4.0, -1, 2, 7], dtype=torch.float64)

    def chosen(x: torch.Tensor) -> torch.Tensor:
        place = torch.minimum(x.floor().clamp(min=0), torch.tensor(3.0)).long()
        return torch.stack((x * table[place], table.clone()[place]))

    graph = Expressions()
    inputs = graph.inputs(0, 1)
    (found,) = trace(lambda x: (chosen(x[0]),), np.array(inputs, dtype=object))
    slope = gradient(graph, found.tolist(), [1.0, 1.0], inputs)
    tape = assemble(graph, [inputs], [found.tolist(), slope])
    x = torch.tensor(value, dtype=torch.float64)
    values, slopes = run(tape, x.numpy().reshape(1))
    assert values.tolist() == chosen(x).tolist() and slopes.tolist() == chosen(x)[1:].tolist()
    assert len(graph.tables) == 1


def test_a_varying_place_in_what_varies_has_no_scalar_form():
    array = np.array(Expressions().inputs(0, 2), dtype=object)
    with pytest.raises(UntraceableError, match="varying indices of anything but a list of constants"):
        trace(lambda x: (x[x[:1].floor().long()],), array)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("constants", [0, 3])
def test_tapes_and_their_gradients_are_those_of_torch(seed, constants):
    x = torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    varying = torch.arange(6) >= constants
    graph = Expressions()
    array, inputs = symbols(graph, x, varying)
    outputs = trace(lambda x: (mixture(x),), array)[0].tolist()
    seeds = graph.inputs(1, len(outputs))
    tape = assemble(graph, [inputs, seeds], [outputs, gradient(graph, outputs, seeds, inputs)])
    weights = torch.arange(1.0, 11, dtype=torch.float64)
    values, gradients = run(tape, x[varying].numpy(), weights.numpy())
    leaf = x.clone().requires_grad_()
    expected = mixture(leaf)
    np.testing.assert_allclose(values, expected.detach(), rtol=1e-12, atol=1e-12)
    wanted = torch.autograd.grad((expected * weights).sum(), leaf)[0][varying]
    np.testing.assert_allclose(gradients, wanted, rtol=1e-11, atol=1e-11)


def test_the_gradient_of_abs_at_zero_is_zero():
    graph = Expressions()
    (x,) = graph.inputs(0, 1)
    tape = assemble(graph, [[x]], [gradient(graph, [ex.absolute(x)], [1.0], [x])])
    assert [run(tape, np.array([value]))[0][0] for value in (-2.0, 0.0, 2.0)] == [-1, 0, 1]


def test_outputs_of_one_phase_outlive_the_next_phases_registers():
    graph = Expressions()
    inputs, late = graph.inputs(0, 5), graph.inputs(1, 2)
    first = [a * b for a in inputs for b in inputs] + [inputs[0], 3.0, first_twice := inputs[1] + 1, first_twice]
    second = [late[0] * first[3] + first[7], first[3] - late[1] * first[7], inputs[2]]
    tape = assemble(graph, [inputs, late], [first, second])
    x, y = np.arange(1.0, 6), np.array([0.5, 0.25])
    found = run(tape, x, y)
    assert found[0].tolist() == [*np.outer(x, x).ravel(), 1.0, 3.0, 3.0, 3.0]
    assert found[1].tolist() == [0.5 * 4 + 6, 4 - 0.25 * 6, 3.0]
    assert len(tape.instructions) < 15 + 4 + 4 and tape.registers < 40


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x: x.erf(), "erf"),
        (lambda x: torch.linalg.svd(x.view(2, 3))[1], "svd"),
        (lambda x: x * x[0].item(), "_local_scalar_dense"),
        (lambda x: x if x[0] > 0 else -x, "has no scalar form"),
        (lambda x: x * x.tolist()[0], "tolist"),
        (lambda x: x * float(x.numpy()[0]), "numpy"),
        (lambda x: x.norm(p=3), "norm of order 3"),
        (lambda x: x.pow(0.3), "exponent 0.3"),
        (lambda x: x * (x[:3] == x[3:]).all(), "equality of two varying numbers"),
        (lambda x: x + torch.rand_like(x), "rand"),
    ],
)
def test_what_has_no_scalar_form_is_named(function, message):
    array = np.array(Expressions().inputs(0, 6), dtype=object)
    with pytest.raises(UntraceableError, match=message):
        trace(lambda x: (function(x),), array)


@pytest.mark.parametrize("shapes", [((3, 3), (3, 2)), ((3, 3), (3,)), ((2, 3, 3), (2, 3)), ((3, 3), (4, 3, 1))])
def test_symmetric_systems_of_any_batch_are_solved(shapes):
    generator = torch.Generator().manual_seed(0)
    left, right = (torch.randn(shape, dtype=torch.float64, generator=generator) for shape in shapes)
    left = left @ left.mT + torch.eye(3, dtype=torch.float64)
    graph = Expressions()
    array, inputs = symbols(graph, right, torch.ones_like(right, dtype=torch.bool))
    found = trace(lambda x: (torch.linalg.solve(left, x),), array)[0]
    tape = assemble(graph, [inputs], [found.ravel().tolist()])
    expected = torch.linalg.solve(left, right)
    assert found.shape == expected.shape
    np.testing.assert_allclose(run(tape, right.flatten().numpy())[0], expected.flatten(), rtol=1e-12)

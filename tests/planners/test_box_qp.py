"""The box QP against brute force and a general optimiser."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from torchrl_gn.planners.ddp import solve_box_qp


def problems(count: int, num: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((count, num, num))
    hessian = factor @ factor.swapaxes(1, 2) + 0.05 * np.eye(num)
    lower = -rng.uniform(0, 1, (count, num))
    return hessian, 2 * rng.standard_normal((count, num)), lower, lower + rng.uniform(0, 2, (count, num))


def brute_force(hessian: np.ndarray, gradient: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The best solution over all choices of active bounds."""
    best, best_cost = lower, np.inf
    for choice in itertools.product((-1, 0, 1), repeat=len(gradient)):
        where = np.array(choice)
        x = np.where(where < 0, lower, upper)
        free = where == 0
        if free.any():
            rest = gradient[free] + hessian[np.ix_(free, ~free)] @ x[~free]
            x[free] = np.linalg.solve(hessian[np.ix_(free, free)], -rest)
        if (x < lower).any() or (x > upper).any():
            continue
        cost = 0.5 * x @ hessian @ x + gradient @ x
        if cost < best_cost:
            best, best_cost = x, cost
    return best


@pytest.mark.parametrize("num", [1, 2, 4])
def test_equals_brute_force(num):
    given = problems(40, num)
    found, free = solve_box_qp(*given)
    wanted = np.stack([brute_force(*row) for row in zip(*given, strict=True)])
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    inside = (wanted > given[2]) & (wanted < given[3])
    assert (free == inside).all()
    assert inside.any() and not inside.all()


def test_equals_a_general_optimiser():
    hessian, gradient, lower, upper = problems(20, 12, seed=1)
    found, _ = solve_box_qp(hessian, gradient, lower, upper)
    for row in range(20):
        factor = np.linalg.cholesky(hessian[row])
        wanted = lsq_linear(factor.T, -np.linalg.solve(factor, gradient[row]), (lower[row], upper[row]), tol=1e-14)
        np.testing.assert_allclose(found[row], wanted.x, atol=1e-6)


def test_start_and_scale_do_not_matter():
    hessian, gradient, lower, upper = problems(30, 5, seed=2)
    wanted, free = solve_box_qp(hessian, gradient, lower, upper)
    start = np.random.default_rng(0).uniform(-3, 3, gradient.shape)
    for scale in (1e-12, 1.0, 1e12):
        found, same = solve_box_qp(scale * hessian, scale * gradient, lower, upper, start)
        np.testing.assert_allclose(found, wanted, atol=1e-9)
        assert (same == free).all()


def test_rows_are_solved_by_themselves():
    given = problems(10, 3, seed=3)
    together, _ = solve_box_qp(*given)
    for row in range(10):
        alone, _ = solve_box_qp(*(part[row : row + 1] for part in given))
        np.testing.assert_allclose(together[row], alone[0], atol=1e-9)


def test_no_gradient_stays_at_zero_and_no_room_clamps():
    hessian = np.eye(2)[None]
    found, free = solve_box_qp(hessian, np.zeros((1, 2)), -np.ones(2), np.ones(2))
    assert (found == 0).all() and free.all()
    found, free = solve_box_qp(hessian, np.ones((1, 2)), np.array([0.0, -3.0]), np.array([0.0, 3.0]))
    np.testing.assert_allclose(found, [[0.0, -1.0]])
    assert free.tolist() == [[False, True]]

"""The backward pass where the problem leaves a choice."""

from __future__ import annotations

import numpy as np

from torchrl_gn.planners.ddp import QuadraticModel, backward_pass


def test_controls_that_do_the_same_share_the_work():
    # One state, pushed by two controls alike, without any cost of them.
    dynamics = np.tile(np.array([[1.0, 1.0, 1.0]]), (3, 1, 1))
    by_all = np.ones((3, 3))
    model = QuadraticModel(dynamics, np.ones((3, 3)), np.tile(by_all, (3, 1, 1)), -np.ones((3, 2)), np.ones((3, 2)))
    changes, gains = backward_pass(model, np.array([0.0, 1e-20]), np.zeros(2))
    assert np.isfinite(changes).all() and np.isfinite(gains).all()
    np.testing.assert_allclose(changes[..., 0], changes[..., 1], atol=1e-6)
    np.testing.assert_allclose(changes.sum(-1), -1, atol=1e-6)
    np.testing.assert_allclose(gains.sum(-2), -1, atol=1e-6)


def test_damping_keeps_controls_and_the_states_after_them_near():
    """One step that ends in ``x + b u``, of cost ``u^2 / 2 + g u``, and states that cost nothing."""
    push, slope = 3.0, 2.0
    dynamics = np.array([[[1.0, push]]])
    gradient, hessian = np.array([[0.0, slope]]), np.array([[[0.0, 0.0], [0.0, 1.0]]])
    model = QuadraticModel(dynamics, gradient, hessian, -9 * np.ones((1, 1)), 9 * np.ones((1, 1)))
    by_controls, by_states = np.array([0.0, 4.0, 0.0]), np.array([0.0, 0.0, 0.5])
    changes, gains = backward_pass(model, by_controls, by_states)
    total = 1 + by_controls + by_states * push**2
    np.testing.assert_allclose(changes[0, :, 0], -slope / total, rtol=1e-9)
    np.testing.assert_allclose(gains[0, :, 0, 0], -by_states * push / total, rtol=1e-9, atol=1e-12)

"""Quaternion maths against rotation matrices, series limits and finite differences."""

from __future__ import annotations

import importlib.util
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch._subclasses import FakeTensorMode

from torchrl_gn.maths import quaternion

maths = settings(max_examples=30, deadline=None, derandomize=True, database=None)

ANGLES = (0.0, 1e-300, 1e-12, 1e-8, 1e-4, 1.9e-4, 2.1e-4, 0.3, 3.0, math.pi - 1e-4, math.pi - 1e-8)


def rotations(*shape: int, seed: int = 0) -> Tensor:
    """Unit quaternions spread over all rotations, both signs."""
    q = torch.randn(*shape, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return q / q.norm(dim=-1, keepdim=True)


def axes(number: int, seed: int = 1) -> Tensor:
    v = torch.randn(number, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return v / v.norm(dim=-1, keepdim=True)


def matrix(q: Tensor) -> Tensor:
    return quaternion.to_matrix(q).unflatten(-1, (3, 3))


def skew(v: Tensor) -> Tensor:
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))


def test_product_is_the_matrix_product():
    a, b = rotations(50), rotations(50, seed=1)
    torch.testing.assert_close(matrix(quaternion.product(a, b)), matrix(a) @ matrix(b), rtol=0, atol=1e-14)
    # Broadcasting, and associativity of the algebra itself, unit norm or not.
    p, q, r = 3 * a[:, None], b[None], 0.1 * rotations(50, 1, seed=2)
    left = quaternion.product(quaternion.product(p, q), r)
    assert left.shape == (50, 50, 4)
    torch.testing.assert_close(left, quaternion.product(p, quaternion.product(q, r)), rtol=0, atol=1e-14)


def test_matrices_are_rotations():
    r = matrix(rotations(50))
    torch.testing.assert_close(r @ r.mT, torch.eye(3, dtype=r.dtype).expand_as(r), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(r), torch.ones(50, dtype=r.dtype), rtol=0, atol=1e-14)


def test_matrix_is_blind_to_the_sign():
    q = rotations(50)
    assert torch.equal(quaternion.to_matrix(q), quaternion.to_matrix(-q))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_few_and_many_are_computed_alike(dtype):
    """Few go through one matrix product, many entry by entry: values and gradients."""
    exact = torch.finfo(dtype).eps * 8
    q, p = (torch.randn(5000, 4, generator=torch.Generator().manual_seed(k)).to(dtype) for k in (0, 1))
    q[0] = 0
    for function in (quaternion.to_matrix, lambda q: quaternion.product(q, p[: len(q)])):
        leaves = [q.clone().requires_grad_(), q[:100].clone().requires_grad_()]
        many, few = (function(leaf) for leaf in leaves)
        torch.testing.assert_close(many[:100], few, rtol=exact, atol=exact)
        gradients = [
            torch.autograd.grad(out.square().sum(), leaf)[0] for out, leaf in zip((many, few), leaves, strict=True)
        ]
        torch.testing.assert_close(gradients[0][:100], gradients[1], rtol=20 * exact, atol=20 * exact)


def test_conjugate_is_the_inverse():
    q = rotations(50)
    identity = torch.tensor([1.0, 0, 0, 0], dtype=q.dtype).expand_as(q)
    torch.testing.assert_close(quaternion.product(quaternion.conjugate(q), q), identity, rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle):
    v = angle * axes(8)
    torch.testing.assert_close(matrix(quaternion.exp(v)), torch.matrix_exp(skew(v)), rtol=0, atol=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp_to_full_relative_precision(angle):
    v = angle * axes(8)
    q = quaternion.exp(v)
    torch.testing.assert_close(q.norm(dim=-1), torch.ones(8, dtype=q.dtype), rtol=0, atol=1e-15)
    for sign in (1, -1):
        error = (quaternion.log(sign * q) - v).norm(dim=-1)
        assert (error <= 1e-14 * angle).all()


def test_log_at_half_a_turn_is_one_of_the_two_rotations():
    v = math.pi * axes(8)
    back = quaternion.log(quaternion.exp(v))
    torch.testing.assert_close(back.norm(dim=-1), v.norm(dim=-1), rtol=1e-14, atol=0)
    # v and -v are the same rotation at half a turn.
    assert (torch.minimum((back - v).norm(dim=-1), (back + v).norm(dim=-1)) < 1e-14).all()


def test_exp_undoes_log_everywhere():
    q = rotations(200)
    v = quaternion.log(q)
    assert (v.norm(dim=-1) <= math.pi).all()
    back = quaternion.exp(v)
    torch.testing.assert_close(back * torch.sign((back * q).sum(-1, keepdim=True)), q, rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", [1e-30, 1e-12, 1e-7, 1e-6, 1e-4, 1e-3])
def test_tiny_rotations_keep_their_digits_in_float32(angle):
    v = (angle * axes(64)).float()
    back = quaternion.log(quaternion.exp(v))
    error = (back.double() - v.double()).norm(dim=-1) / v.double().norm(dim=-1)
    assert error.max() < 1e-6


@maths
@given(st.floats(0, math.pi), st.integers(0, 1000))
def test_angle_is_that_of_the_rotation_between_whatever_the_signs(size, seed):
    b = rotations(1, seed=seed)[0]
    a = quaternion.product(b, quaternion.exp(size * axes(1, seed=seed)[0]))
    for first, second in ((a, b), (-a, b), (a, -b), (-a, -b)):
        assert abs(quaternion.angle(first, second).item() - size) < 1e-14
    # Its tiny angles are right too, where acos((a . b)) has no digit left.
    tiny = quaternion.exp(1e-9 * size * axes(1, seed=seed)[0])
    identity = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    assert quaternion.angle(tiny, identity).item() == pytest.approx(1e-9 * size, rel=1e-12, abs=1e-100)


def test_angle_is_a_metric():
    a, b, c = rotations(100), rotations(100, seed=1), rotations(100, seed=2)
    assert torch.allclose(quaternion.angle(a, b), quaternion.angle(b, a), atol=1e-14)
    assert (quaternion.angle(a, c) <= quaternion.angle(a, b) + quaternion.angle(b, c) + 1e-14).all()
    torch.testing.assert_close(quaternion.angle(a, a), torch.zeros(100, dtype=a.dtype), rtol=0, atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 0.5, 3.0, math.pi])
def test_gradients_are_finite_and_right(size):
    v = (size * axes(4)).requires_grad_()
    assert torch.autograd.gradcheck(quaternion.exp, (v,))
    # Log and the angle are defined on unit quaternions: checked along exp, away from the cut.
    assert torch.autograd.gradcheck(lambda v: quaternion.to_matrix(quaternion.exp(v)), (v,))
    if size < math.pi:
        assert torch.autograd.gradcheck(lambda v: quaternion.log(quaternion.exp(v)), (v,))
    other = rotations(4)
    if 1e-6 < size < math.pi:
        turned = lambda v: quaternion.angle(quaternion.product(quaternion.exp(v), other), other)  # noqa: E731
        assert torch.autograd.gradcheck(turned, (v,))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("q", [(1.0, 0, 0, 0), (-1.0, 0, 0, 0), (0, 0, 1.0, 0), (0, 0.6, 0, -0.8)])
def test_gradients_are_finite_at_no_rotation_and_half_a_turn(q, dtype):
    identity = torch.tensor([1.0, 0, 0, 0], dtype=dtype)
    for function in (quaternion.log, quaternion.normalize, lambda q: quaternion.angle(q, identity)):
        leaf = torch.tensor(q, dtype=dtype, requires_grad=True)
        function(leaf).sum().backward()
        assert leaf.grad.isfinite().all()


def test_the_angles_gradient_vanishes_where_rotations_agree():
    q = rotations(1)[0].requires_grad_()
    identity = torch.tensor([1.0, 0, 0, 0], dtype=q.dtype, requires_grad=True)
    quaternion.angle(identity, identity.detach()).backward()
    assert torch.equal(identity.grad, torch.zeros_like(identity))
    quaternion.angle(q, q.detach()).backward()
    assert q.grad.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_normalize_keeps_the_direction_at_any_scale(dtype):
    q = rotations(20).to(dtype)
    limits = torch.finfo(dtype)
    for scale in (limits.tiny, limits.tiny**0.5, 1e-3, 7.0, limits.max**0.5 * 10, limits.max / 2):
        torch.testing.assert_close(quaternion.normalize(scale * q), q, rtol=0, atol=4 * limits.eps)


def test_normalize_of_zero_is_no_rotation():
    q = torch.zeros(2, 4, dtype=torch.float64, requires_grad=True)
    unit = quaternion.normalize(q)
    assert torch.equal(unit.detach(), torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=torch.float64))
    unit.sum().backward()
    assert q.grad.isfinite().all()


def test_normalize_has_the_gradient_of_the_projection():
    q = (3 * rotations(5)).requires_grad_()
    assert torch.autograd.gradcheck(quaternion.normalize, (q,))


def test_matrices_of_quaternions_of_any_length():
    generator = torch.Generator().manual_seed(0)
    q = quaternion.normalize(torch.randn(50, 4, generator=generator, dtype=torch.float64))
    for length in (1e-6, 0.5, 3.0, 1e6):
        torch.testing.assert_close(quaternion.to_matrix(length * q), quaternion.to_matrix(q), rtol=0, atol=1e-14)
    zero = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    matrix = quaternion.to_matrix(zero)
    assert torch.equal(matrix.detach(), torch.eye(3, dtype=torch.float64).flatten())
    (gradient,) = torch.autograd.grad(matrix.sum(), zero)
    assert torch.isfinite(gradient).all()


def test_multiplying_from_the_right_is_a_matrix():
    generator = torch.Generator().manual_seed(0)
    p, q = torch.randn(2, 5, 4, generator=generator, dtype=torch.float64)
    moved = (quaternion.right_matrix(q) @ p.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(moved, quaternion.product(p, q))


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-5, 1e-3, 1.0, 3.0])
def test_rotating_by_a_rotation_vector(scale):
    generator = torch.Generator().manual_seed(0)
    vector, v = torch.randn(2, 5, 3, generator=generator, dtype=torch.float64)
    vector = (scale * vector).requires_grad_()
    expected = quaternion.rotate(quaternion.exp(vector), v)
    turned = quaternion.rotate_by(vector, v)
    torch.testing.assert_close(turned, expected, rtol=0, atol=1e-14)
    gradients = [torch.autograd.grad(out.square().sum() + out[..., 0].sum(), vector)[0] for out in (turned, expected)]
    torch.testing.assert_close(*gradients, rtol=0, atol=1e-12)


@pytest.mark.parametrize("first", ["hessian", "vmap", "fake", "inference"])
def test_constants_outlive_what_asked_first(first):
    """Constants are made outside transforms of torch.func and modes, which would keep them."""
    spec = importlib.util.find_spec(quaternion.__name__)
    fresh = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fresh)
    q, v = rotations(3), axes(3)

    def rotated(q: Tensor) -> Tensor:
        return fresh.rotate(fresh.product(q, q), v).sum()

    if first == "hessian":
        torch.func.hessian(rotated)(q)
    elif first == "vmap":
        torch.func.vmap(torch.func.jacfwd(lambda q: fresh.rotate(q, v)))(q)
    elif first == "inference":
        with torch.inference_mode():
            rotated(q)
    else:
        with FakeTensorMode(allow_non_fake_inputs=True):
            rotated(q)
    grown = q.clone().requires_grad_()
    rotated(grown).backward()
    expected = q.clone().requires_grad_()
    quaternion.rotate(quaternion.product(expected, expected), v).sum().backward()
    torch.testing.assert_close(grown.grad, expected.grad)
    torch.testing.assert_close(torch.func.hessian(rotated)(q), torch.func.hessian(rotated)(q))

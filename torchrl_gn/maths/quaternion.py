"""Unit quaternions as tensors ``[..., 4]``, w first, and rotation vectors ``[..., 3]`` in radians.

Every function has finite gradients on unit quaternions, including the zero rotation and the half turn.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor

# Hamilton products and rotation matrices are sums of the 16 products of two quaternions' entries. Up to _FEW
# quaternions, one multiplication and one matrix product with a table of signs replace dozens of entrywise operations.
# For more, the entrywise operations are faster, since they need less memory; a compiler fuses them.
_FEW = 4096
_PRODUCT = ("+00 -11 -22 -33", "+01 +10 +23 -32", "+02 -13 +20 +31", "+03 +12 -21 +30")
_MATRIX = (
    *("-22 -33", "+12 -03", "+13 +02", "+12 +03", "-11 -33", "+23 -01", "+13 -02", "+23 +01", "-11 -22"),
    "+00 +11 +22 +33",
)


def _cached(make: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Cache a function's tensors, except those of ``torch.func`` or a tensor mode, which must not outlive it."""
    made: dict[tuple, Tensor] = {}

    @functools.wraps(make)
    def get(*key) -> Tensor:
        tensor = made.get(key)
        if tensor is None:
            with torch.inference_mode(False):  # the cached tensor must also serve autograd
                tensor = make(*key)
            if type(tensor) is Tensor and not is_functorch_wrapped_tensor(tensor):
                made[key] = tensor
        return tensor

    return get


@_cached
def _table(columns: tuple[str, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the signs ``[16, len(columns)]`` of the products of entries in each column's sum."""
    rows = [[0.0] * len(columns) for _ in range(16)]
    for column, terms in enumerate(columns):
        for sign, first, second in terms.split():
            rows[4 * int(first) + int(second)][column] = 1.0 if sign == "+" else -1.0
    return torch.tensor(rows, dtype=dtype, device=device)


@_cached
def _identity(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.eye(3, dtype=dtype, device=device).flatten()


def _is_small(q: Tensor) -> bool:
    return not torch.compiler.is_compiling() and q.numel() <= 4 * _FEW


def _sums(a: Tensor, b: Tensor, columns: tuple[str, ...]) -> Tensor:
    """Return sums ``[..., len(columns)]`` of products of entries of ``[..., 4]`` and ``[..., 4]``."""
    return (a.unsqueeze(-1) * b.unsqueeze(-2)).flatten(-2) @ _table(columns, a.dtype, a.device)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton product ``a * b`` of ``[..., 4]``, broadcast: a rotation by ``b``, then by ``a``."""
    if _is_small(a) and _is_small(b):
        return _sums(a, b, _PRODUCT)
    a, b = torch.broadcast_tensors(a, b)
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    w = aw * bw - (av * bv).sum(-1, keepdim=True)
    return torch.cat((w, aw * bv + bw * av + torch.linalg.cross(av, bv)), dim=-1)


def right_matrix(q: Tensor) -> Tensor:
    """Return the matrices ``[..., 4, 4]`` of right multiplication by quaternions ``[..., 4]``: ``M(q) p = p * q``."""
    w, x, y, z = q.unbind(-1)
    rows = ((w, -x, -y, -z), (x, w, z, -y), (y, -z, w, x), (z, y, -x, w))
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def conjugate(q: Tensor) -> Tensor:
    """Return the inverse rotation of unit quaternions ``[..., 4]``."""
    return torch.cat((q[..., :1], -q[..., 1:]), dim=-1)


def normalize(q: Tensor) -> Tensor:
    """Scale quaternions ``[..., 4]`` to unit norm; zero becomes the identity instead of NaN."""
    # Dividing by the largest entry first keeps the squares from overflowing or vanishing.
    largest = q.abs().amax(dim=-1, keepdim=True)
    zero = largest == 0
    scaled = q / torch.where(zero, torch.ones_like(largest), largest)
    identity = torch.zeros_like(q)
    identity[..., 0] = 1
    scaled = torch.where(zero, identity, scaled)
    return scaled / scaled.norm(dim=-1, keepdim=True)


def exp(rotation_vector: Tensor) -> Tensor:
    """Return unit quaternions ``[..., 4]`` of rotation vectors ``[..., 3]``: ``(cos(a / 2), sin(a / 2) * axis)``."""
    half = 0.5 * rotation_vector
    square = half.square().sum(-1, keepdim=True)
    small = square < 1e-8
    # The square root's gradient is infinite at zero: feed it a harmless value there.
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    w = torch.where(small, 1 - square / 2, angle.cos())
    sinc = torch.where(small, 1 - square / 6, angle.sin() / angle)
    return torch.cat((w, sinc * half), dim=-1)


def log(q: Tensor) -> Tensor:
    """Return rotation vectors ``[..., 3]``, angles in ``[0, pi]``, of quaternions ``[..., 4]``; equal for q and -q."""
    w, v = q[..., :1], q[..., 1:]
    sign = torch.where(w < 0, -torch.ones_like(w), torch.ones_like(w))
    w, v = w * sign, v * sign
    square = v.square().sum(-1, keepdim=True)
    small = square < 1e-8
    norm = torch.where(small, torch.ones_like(square), square).sqrt()
    # For small |v|: angle / |v| = 2 atan(|v| / w) / |v| = 2 / w (1 - (|v| / w)^2 / 3).
    # w is then near 1 for unit quaternions; the clamp only protects the unused branch.
    safe_w = w.clamp(min=1e-3)
    series = 2 / safe_w * (1 - square / (3 * safe_w.square()))
    return torch.where(small, series, 2 * torch.atan2(norm, w) / norm) * v


def angle(a: Tensor, b: Tensor) -> Tensor:
    """Return the angle ``[...]`` in ``[0, pi]`` between unit quaternions ``[..., 4]`` of any sign.

    It is ``2 atan2(|v|, |w|)`` of ``conj(b) * a``, which is accurate for tiny angles, where ``acos`` loses half the
    digits. The gradient is finite everywhere, and zero where the rotations agree.
    """
    difference = product(conjugate(b), a)
    w, v = difference[..., 0], difference[..., 1:]
    square = v.square().sum(-1)
    zero = square == 0
    norm = torch.where(zero, torch.ones_like(square), square).sqrt()
    norm = torch.where(zero, torch.zeros_like(norm), norm)
    return 2 * torch.atan2(norm, w.abs())


def to_matrix(q: Tensor) -> Tensor:
    """Return row-major rotation matrices ``[..., 9]`` of quaternions ``[..., 4]`` of any norm; identity for zero."""
    if _is_small(q):
        sums = _sums(q, q, _MATRIX)
        scale = 2 / torch.where(sums[..., 9:] > 0, sums[..., 9:], 1)
        return torch.addcmul(_identity(q.dtype, q.device), scale, sums[..., :9])
    square = q.square().sum(-1)
    # 1 for zero: all products below vanish and leave the identity.
    scale = 2 / torch.where(square > 0, square, 1)
    w, x, y, z = q.unbind(-1)
    _, sx, sy, sz = (scale.unsqueeze(-1) * q).unbind(-1)
    first = 1 - (y * sy + z * sz), x * sy - w * sz, x * sz + w * sy
    second = x * sy + w * sz, 1 - (x * sx + z * sz), y * sz - w * sx
    third = x * sz - w * sy, y * sz + w * sx, 1 - (x * sx + y * sy)
    return torch.stack((*first, *second, *third), dim=-1)


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors ``[..., 3]`` by quaternions ``[..., 4]``, broadcast."""
    return turned_by(to_matrix(q).unflatten(-1, (3, 3)), v)


def turned_by(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors ``[*B, 3]`` by matrices ``[*B, 3, 3]``."""
    return (matrices @ vectors.unsqueeze(-1)).squeeze(-1)


def rotate_by(rotation_vector: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors ``[..., 3]`` by rotation vectors (Rodrigues' formula): ``rotate(exp(rotation_vector), v)``."""
    square = rotation_vector.square().sum(-1, keepdim=True)
    small = square < 1e-8
    # As in exp: avoid dividing by zero even in the unused branch, for its gradient.
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    half = (0.5 * angle).sin() / angle
    sinc = torch.where(small, 1 - square / 6, angle.sin() / angle)
    versine = torch.where(small, 0.5 - square / 24, 2 * half.square())
    across = torch.linalg.cross(rotation_vector.expand_as(v), v)
    return v + sinc * across + versine * torch.linalg.cross(rotation_vector.expand_as(v), across)

"""State changes: round trips, updates of each kind, encodings for the network."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_gn.maths import BODY_STATE, Component, StateLayout, quaternion

maths = settings(max_examples=40, deadline=None, derandomize=True, database=None)

JOINT_STATE = StateLayout((Component("angle", 2, "circle", rate="velocity"), Component("velocity", 1)))

seeds = st.integers(0, 2**32)
scales = st.sampled_from([0.0, 1e-12, 1e-6, 1e-3, 0.5])


def random_state(layout: StateLayout, *shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    state = torch.randn(*shape, layout.size, generator=generator, dtype=torch.float64)
    for component in layout.components:
        if component.kind != "add":
            part = state[..., layout.slices[component.name]]
            part /= part.norm(dim=-1, keepdim=True).clone()
    return state


def random_delta(layout: StateLayout, scale: float, *shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed + 1)
    return scale * torch.rand(*shape, layout.delta_size, generator=generator, dtype=torch.float64)


def same_rotations(a: Tensor, b: Tensor) -> Tensor:
    """``a`` with its body quaternion's sign chosen as in ``b``."""
    where = BODY_STATE.slices["orientation"]
    a = a.clone()
    a[..., where] *= torch.sign((a[..., where] * b[..., where]).sum(-1, keepdim=True))
    return a


def test_body_state_is_the_papers():
    assert (BODY_STATE.size, BODY_STATE.delta_size) == (13, 12)
    assert BODY_STATE.names == ("position", "orientation", "linear_velocity", "angular_velocity")
    assert [(s.start, s.stop) for s in BODY_STATE.slices.values()] == [(0, 3), (3, 7), (7, 10), (10, 13)]
    assert [(s.start, s.stop) for s in BODY_STATE.delta_slices.values()] == [(0, 3), (3, 6), (6, 9), (9, 12)]


@maths
@given(seeds, scales)
def test_delta_undoes_apply(seed, scale):
    for layout in (BODY_STATE, JOINT_STATE):
        state = random_state(layout, 5, seed=seed)
        delta = random_delta(layout, scale, 5, seed=seed)
        # Rounding of the state, not of the change, is the limit.
        torch.testing.assert_close(layout.delta(state, layout.apply(state, delta)), delta, rtol=0, atol=4e-15)


@maths
@given(seeds)
def test_apply_undoes_delta(seed):
    state, after = random_state(BODY_STATE, 5, seed=seed), random_state(BODY_STATE, 5, seed=seed + 1)
    back = BODY_STATE.apply(state, BODY_STATE.delta(state, after))
    torch.testing.assert_close(same_rotations(back, after), after, rtol=0, atol=1e-14)
    state, after = random_state(JOINT_STATE, 5, seed=seed), random_state(JOINT_STATE, 5, seed=seed + 1)
    torch.testing.assert_close(JOINT_STATE.apply(state, JOINT_STATE.delta(state, after)), after, rtol=0, atol=1e-14)


@maths
@given(seeds)
def test_delta_takes_the_shorter_way_whatever_the_signs(seed):
    state, after = random_state(BODY_STATE, 3, seed=seed), random_state(BODY_STATE, 3, seed=seed + 1)
    delta = BODY_STATE.delta(state, after)
    turn = delta[..., BODY_STATE.delta_slices["orientation"]]
    where = BODY_STATE.slices["orientation"]
    torch.testing.assert_close(turn.norm(dim=-1), quaternion.angle(after[..., where], state[..., where]))
    after[..., where] *= -1
    torch.testing.assert_close(BODY_STATE.delta(state, after), delta, rtol=0, atol=0)


def test_rotation_changes_are_world_frame():
    # A body that lies on its side and turns about the world's z axis has a z rotation vector.
    side = quaternion.exp(torch.tensor([0.5 * math.pi, 0, 0], dtype=torch.float64))
    about_z = quaternion.exp(torch.tensor([0, 0, 0.1], dtype=torch.float64))
    state = torch.cat((torch.zeros(3), side, torch.zeros(6)))
    after = torch.cat((torch.zeros(3), quaternion.product(about_z, side), torch.zeros(6)))
    expected = torch.zeros(12, dtype=torch.float64)
    expected[5] = 0.1
    torch.testing.assert_close(BODY_STATE.delta(state, after), expected, rtol=0, atol=1e-15)


def test_no_change_is_exactly_zero_and_leaves_the_state():
    state = random_state(BODY_STATE, 200)
    delta = BODY_STATE.delta(state, state)
    add = [BODY_STATE.delta_slices[name] for name in ("position", "linear_velocity", "angular_velocity")]
    assert all((delta[..., where] == 0).all() for where in add)
    assert delta.abs().max() < 1e-15
    after = BODY_STATE.apply(state, torch.zeros(12, dtype=torch.float64))
    torch.testing.assert_close(after, state, rtol=0, atol=1e-15)


def test_rotations_keep_unit_norm_over_many_steps():
    state = random_state(BODY_STATE, 10).float()
    for step in range(500):
        state = BODY_STATE.apply(state, random_delta(BODY_STATE, 0.3, 10, seed=step).float())
    norm = state[..., BODY_STATE.slices["orientation"]].norm(dim=-1)
    torch.testing.assert_close(norm, torch.ones(10), rtol=0, atol=3e-7)


def test_circles_turn_by_an_angle():
    angle = torch.linspace(-3, 3, 7, dtype=torch.float64)
    state = torch.stack((angle.cos(), angle.sin(), 0 * angle), dim=-1)
    delta = torch.tensor([0.7, 2.0], dtype=torch.float64).expand(7, 2)
    turned = JOINT_STATE.apply(state, delta)
    expected = torch.stack(((angle + 0.7).cos(), (angle + 0.7).sin(), 0 * angle + 2), dim=-1)
    torch.testing.assert_close(turned, expected, rtol=0, atol=1e-15)
    # Across the branch cut the change stays the short one.
    torch.testing.assert_close(JOINT_STATE.delta(state, turned), delta, rtol=0, atol=1e-15)


@maths
@given(seeds, scales, st.floats(0, 0.1))
def test_residual_undoes_integrate(seed, scale, timestep):
    for layout in (BODY_STATE, JOINT_STATE):
        state = random_state(layout, 5, seed=seed)
        delta = random_delta(layout, scale, 5, seed=seed)
        full = layout.integrate(state, delta, timestep)
        torch.testing.assert_close(layout.residual(state, full, timestep), delta, rtol=0, atol=1e-15)
        torch.testing.assert_close(layout.integrate(state, layout.residual(state, delta, timestep), timestep), delta)


def test_constant_acceleration_and_steady_spin_leave_no_residual():
    """The trapezoidal rule is exact for ``x = v t + a t^2 / 2`` and for a turn at a steady rate."""
    timestep, velocity = 0.02, torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    acceleration, spin = (
        torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64),
        torch.tensor([3.0, 1.0, 2.0]).double(),
    )
    orientation = random_state(BODY_STATE)[BODY_STATE.slices["orientation"]]
    state = torch.cat((torch.zeros(3), orientation, velocity, spin))
    after = torch.cat(
        (
            velocity * timestep + 0.5 * acceleration * timestep**2,
            quaternion.product(quaternion.exp(timestep * spin), orientation),
            velocity + timestep * acceleration,
            spin,
        )
    )
    residual = BODY_STATE.residual(state, BODY_STATE.delta(state, after), timestep)
    torch.testing.assert_close(residual[:6], torch.zeros(6, dtype=torch.float64), rtol=0, atol=1e-15)
    torch.testing.assert_close(residual[6:9], timestep * acceleration)


@pytest.mark.parametrize("layout", [BODY_STATE, JOINT_STATE])
def test_means_are_where_changes_to_all_cancel(layout):
    """Changes cancel to second order: the mean of rotations minimises chords, not rotation vectors."""
    start = random_state(layout, 4)
    changes = 0.05 * torch.randn(6, 4, layout.delta_size, generator=torch.Generator().manual_seed(1)).double()
    states = layout.apply(start.expand(6, -1, -1), changes)
    if layout is BODY_STATE:
        states[::2, :, layout.slices["orientation"]] *= -1  # q and -q
    known = torch.ones(6, 4, 1, dtype=torch.bool)
    mean = layout.mean(states, states[0], known)
    assert layout.delta(mean, states).mean(0).abs().max() < 1e-4 < changes.mean(0).abs().max()
    for component in layout.components:
        if not component.adds:
            size = mean[..., layout.slices[component.name]].norm(dim=-1)
            torch.testing.assert_close(size, torch.ones_like(size))
    known[1:3, 0], states[1:3, 0] = False, torch.nan
    some = layout.mean(states, states[0], known)
    torch.testing.assert_close(some[1:], mean[1:])
    torch.testing.assert_close(some[0], layout.mean(states[[0, 3, 4, 5]], states[0], known[[0, 3, 4, 5]])[0])


def test_gradients_of_delta_apply_and_integrate():
    state = random_state(BODY_STATE, 3).requires_grad_()
    after = BODY_STATE.apply(state.detach(), random_delta(BODY_STATE, 0.3, 3)).requires_grad_()
    delta = random_delta(BODY_STATE, 0.3, 3).requires_grad_()
    assert torch.autograd.gradcheck(BODY_STATE.apply, (state, delta))
    assert torch.autograd.gradcheck(lambda d: BODY_STATE.integrate(state, d, 0.02), (delta,))
    # The change is a function of unit quaternions: moved along the sphere.
    assert torch.autograd.gradcheck(lambda d: BODY_STATE.delta(state, BODY_STATE.apply(after, d)), (delta,))


def test_the_encoding_is_the_matrix_and_blind_to_the_sign():
    state = random_state(BODY_STATE, 5)
    flipped = state.clone()
    flipped[..., BODY_STATE.slices["orientation"]] *= -1
    encoded = BODY_STATE.encode(state, "matrix")
    assert encoded.shape[-1] == BODY_STATE.encoded_size("matrix") == 18
    assert torch.equal(encoded, BODY_STATE.encode(flipped, "matrix"))
    assert torch.equal(encoded[..., 3:12], quaternion.to_matrix(state[..., 3:7]))
    for encoding in ("matrix", "quaternion"):
        where = BODY_STATE.encoded_slices(encoding)["linear_velocity"]
        assert torch.equal(BODY_STATE.encode(state, encoding)[..., where], state[..., 7:10])
    assert torch.equal(encoded[..., [0, 1, 2, *range(12, 18)]], state[..., [0, 1, 2, *range(7, 13)]])


def test_the_papers_encoding_is_the_state():
    state = random_state(BODY_STATE, 5)
    assert torch.equal(BODY_STATE.encode(state, "quaternion"), state)
    assert BODY_STATE.encoded_size("quaternion") == 13
    assert JOINT_STATE.encoded_size("matrix") == 3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Component("turn", 3, "rotation"), "'turn' of kind 'rotation' needs 4 channels, not 3"),
        (lambda: Component("angle", 3, "circle"), "'angle' of kind 'circle' needs 2 channels, not 3"),
        (lambda: Component("x", 3, "sub"), "'x' has kind 'sub'; use one of"),
        (lambda: StateLayout((Component("x", 3), Component("x", 1))), "must differ"),
        (lambda: StateLayout((Component("x", 3, rate="v"),)), "'x' has rate 'v', not one of"),
        (
            lambda: StateLayout((Component("x", 3, rate="v"), Component("v", 2))),
            "'x' and its rate 'v' differ",
        ),
        (lambda: StateLayout((Component("x", 3, rate="x"),)), "'x' of 'x' must have kind 'add' and no rate"),
        (
            lambda: StateLayout((Component("x", 1, rate="v"), Component("v", 1, rate="a"), Component("a", 1))),
            "'v' of 'x' must have kind 'add' and no rate itself",
        ),
        (
            lambda: StateLayout((Component("x", 1, rate="c"), Component("c", 2, "circle"))),
            "'c' of 'x' must have kind 'add'",
        ),
    ],
)
def test_layouts_that_make_no_sense_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_where_channels_lie_is_known_from_the_start():
    """The compiler cannot trace the first use of a cached property."""
    layout = StateLayout((Component("angle", 2, "circle"),))
    assert {"size", "delta_size", "slices", "delta_slices"} <= layout.__dict__.keys()

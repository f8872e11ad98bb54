"""Measurements of a simulated log recover its properties."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.signal import savgol_filter

from torchrl_gn.data import RobotLog, channel_weights, inspect_log, log_trajectories
from torchrl_gn.data.logs.log_noise import smoothed

STEP = 0.01


def driven_log(delays=(3, 0), episodes: int = 4, rows: int = 1000, *, noise: float = 0.0, seed: int = 0) -> RobotLog:
    """Damped joints, each driven by the command of the next one after its delay; commands fight the velocities."""
    rng = np.random.default_rng(seed)
    angle, velocity, command = (np.zeros((episodes, rows, len(delays))) for _ in range(3))
    for t in range(rows):
        drift = 0.9 * command[:, t - 1] if t else 0
        command[:, t] = drift - 0.03 * velocity[:, t, ::-1] + rng.normal(size=(episodes, len(delays)))
        if t + 1 == rows:
            break
        for joint, delay in enumerate(delays):
            acting = command[:, t - delay, 1 - joint] if t >= delay else 0
            push = 30 * acting - 4 * velocity[:, t, joint] - 20 * angle[:, t, joint]
            velocity[:, t + 1, joint] = velocity[:, t, joint] + STEP * push
            angle[:, t + 1, joint] = angle[:, t, joint] + STEP * velocity[:, t + 1, joint]
    angle = angle + noise * rng.normal(size=angle.shape)
    length = np.full(episodes, rows)
    angle, velocity, command = (values.reshape(-1, len(delays)) for values in (angle, velocity, command))
    return RobotLog(angle, velocity, command, length, STEP)


@pytest.mark.parametrize("delays", [(3, 0), (1, 7), (0, 0)])
def test_delays_are_found_in_spite_of_feedback(delays):
    inspected = inspect_log(driven_log(delays))
    assert tuple(delay.onset for delay in inspected.delays if delay) == delays
    assert [delay.command for delay in inspected.delays if delay] == [1, 0]
    assert inspected.lag == min(delays)
    late = log_trajectories(driven_log(delays), 50, lag=min(delays))[0]
    assert late["action"].shape[1] == 50


def test_without_an_effect_there_is_no_delay():
    log = driven_log()
    log.command[:] = np.random.default_rng(1).normal(size=log.command.shape)  # of another robot
    inspected = inspect_log(log)
    assert inspected.delays == (None, None) and inspected.lag == 0
    still = dataclasses.replace(log, command=np.zeros((len(log.angle), 0)))
    assert inspect_log(still).delays == (None, None)
    constant = dataclasses.replace(log, command=np.ones_like(log.command))
    assert inspect_log(constant).delays == (None, None)


def swinging_log(noise: float = 0.0, quantum: float = 0.0, rows: int = 4000, **changes) -> RobotLog:
    time = np.arange(rows) * STEP
    frequency = np.array([2.0, 5.0])
    angle, velocity = np.sin(time[:, None] * frequency), frequency * np.cos(time[:, None] * frequency)
    angle = angle + noise * np.random.default_rng(0).normal(size=angle.shape)
    angle = np.round(angle / quantum) * quantum if quantum else angle
    velocity = velocity + 20 * noise * np.random.default_rng(1).normal(size=angle.shape)
    log = RobotLog(angle, velocity, np.zeros((rows, 1)), np.array([rows]), STEP)
    return dataclasses.replace(log, **changes)


def test_noise_and_quantisation_are_measured():
    inspected = inspect_log(swinging_log(noise=1e-3))
    np.testing.assert_allclose(inspected.noise["angle"], 1e-3, rtol=0.05)
    np.testing.assert_allclose(inspected.noise["velocity"], 2e-2, rtol=0.05)
    assert (inspected.quantum["angle"] == 0).all()
    clean = inspect_log(swinging_log())
    assert (clean.noise["angle"] < 1e-6).all() and set(clean.half_widths.values()) == {0}
    coarse = inspect_log(swinging_log(noise=1e-3, quantum=4e-3))
    np.testing.assert_allclose(coarse.quantum["angle"], 4e-3)
    np.testing.assert_allclose(coarse.noise["angle"], np.hypot(1e-3, 4e-3 / np.sqrt(12)), rtol=0.1)


def test_units_and_kind_of_velocities():
    log = swinging_log()
    backward = np.zeros_like(log.velocity)
    backward[1:] = np.diff(log.angle, axis=0) / STEP
    inspected = inspect_log(dataclasses.replace(log, velocity=backward / 10))
    np.testing.assert_allclose(inspected.velocity_gain, 0.1)
    assert inspected.velocity_kind == "backward" and (inspected.velocity_error > 0.5).all()
    assert inspect_log(log).velocity_kind == "central"


def test_rate_jitter_and_missing_rows():
    time = np.arange(4000) * STEP
    jittered = time + np.random.default_rng(0).uniform(-0.1, 0.1, 4000) * STEP
    kept = np.delete(np.arange(4000), [100, 200, 201, 202])
    log = swinging_log()
    log = RobotLog(
        log.angle[kept], log.velocity[kept], log.command[kept], np.array([len(kept)]), STEP, time=jittered[kept]
    )
    inspected = inspect_log(log)
    assert inspected.missing == 4 and inspected.jitter == pytest.approx(np.sqrt(2 / 12) * 0.2, rel=0.1)
    text = str(inspected)
    assert text.startswith("100 Hz, a row every 10 ms, jitter 8") and "4 rows missing" in text
    assert len(text.splitlines()) == 5
    assert "no time stamps" in str(inspect_log(swinging_log()))


def test_nothing_to_measure_is_no_error():
    inspected = inspect_log(swinging_log(rows=3))
    assert inspected.delays == (None, None) and np.isnan(inspected.noise["angle"]).all() and str(inspected)


@pytest.mark.parametrize("uneven", [False, True])
def test_smoothing_keeps_parabolas_and_quiets_noise(uneven):
    rng = np.random.default_rng(0)
    at = np.arange(300.0) + (rng.uniform(-0.3, 0.3, 300) if uneven else 0)
    parabola = np.stack((1 + 2 * at - 0.01 * at**2, -at), 1)
    np.testing.assert_allclose(smoothed(at, parabola, 5)[0], parabola, rtol=1e-9, atol=1e-7)
    noise = rng.normal(size=(300, 2))
    calm, own = smoothed(at, noise, 5)
    assert calm[5:-5].var() < 0.3 * noise.var()
    np.testing.assert_allclose(smoothed(at, np.eye(300), 5)[0].diagonal(), own)
    if not uneven:
        np.testing.assert_allclose(calm, np.asarray(savgol_filter(noise, 11, 2, axis=0)), atol=1e-9)
    assert np.array_equal(smoothed(at[:2], noise[:2], 5)[0], noise[:2])


@pytest.mark.slow
def test_the_width_follows_the_noise():
    widths = [inspect_log(swinging_log(noise)).half_widths["angle"] for noise in (0.0, 1e-5, 1e-3)]
    assert widths[0] < widths[1] < widths[2]
    log, truth = swinging_log(1e-3), swinging_log()
    half = inspect_log(log).half_widths["angle"]
    errors = {rows: np.abs(smoothed(log.at, log.angle, rows)[0] - truth.angle).mean() for rows in (0, 2, half, 50)}
    assert min(errors, key=lambda rows: errors[rows]) == half


def test_noisy_channels_weigh_less():
    log = swinging_log(1e-3)
    weights = channel_weights(inspect_log(log).noise, log_trajectories(log, 100)[0])
    assert weights.shape == (3, 2) and (weights[0] == 1).all()
    change = np.diff(log.velocity, axis=0).var(0)
    np.testing.assert_allclose(weights[1:, 1], 1 - 2 * 0.02**2 / change, rtol=0.1)
    assert (weights[1:, 0] > 0.98).all() and weights[1, 1] < 0.6 < weights[2, 1] < 0.98
    log = dataclasses.replace(log, extra={"load": np.random.default_rng(0).normal(size=log.angle.shape)})
    weights = channel_weights(inspect_log(log).noise, log_trajectories(log, 100)[0])
    assert torch.all(weights[1:, 2] < 0.2)

"""The smoother of tracks beside filterpy's, and its standard deviations against the errors that it makes."""

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import KalmanFilter
from scipy.linalg import expm

from gnss_sem_map.dynamics import constant_acceleration
from gnss_sem_map.dynamics.constant_acceleration import smooth


def noisy(seed, stddev=0.1, count=60, velocity=(6.0, -3.0)):
    rng = np.random.default_rng(seed)
    stamps = np.sort(rng.uniform(0.0, 6.0, count))
    return stamps, stamps[:, None] * velocity + rng.normal(0.0, stddev, (count, 2))


def test_one_axis_is_smoothed_as_filterpy_does() -> None:
    stamps, positions = noisy(1)
    z, r, density = positions[:, 0].copy(), np.linspace(0.01, 0.2, 60), 0.7
    out = np.empty((60, 4))
    constant_acceleration._smooth(stamps, z, r, density, out)
    theirs = KalmanFilter(3, 1)
    theirs.x, theirs.P = np.array([[z[0]], [0.0], [0.0]]), np.diag([1e4, 45.0**2, 3.0**2])
    theirs.H = np.array([[1.0, 0.0, 0.0]])
    states, covariances, Fs, Qs = [], [], [], []
    for k, dt in enumerate(np.diff(stamps, prepend=stamps[0])):
        F = expm(dt * np.eye(3, k=1))
        Q = Q_continuous_white_noise(3, dt, density)
        if k:
            theirs.predict(F=F, Q=Q)
        theirs.update(z[k], R=r[k])
        states.append(theirs.x.copy())
        covariances.append(theirs.P.copy())
        Fs.append(F)
        Qs.append(Q)
    x, P, _, _ = theirs.rts_smoother(np.array(states), np.array(covariances), Fs, Qs)
    np.testing.assert_allclose(out[:, :2], x[:, :2, 0], atol=1e-6)
    np.testing.assert_allclose(out[:, 2:], P[:, [0, 1], [0, 1]], rtol=1e-5, atol=1e-9)


def test_a_planted_velocity_is_found_within_its_standard_deviation() -> None:
    """That of a motion without any acceleration may be smaller than stated, not larger."""
    for seed in range(100):
        found = smooth(*noisy(seed), np.full((60, 2), 0.1**2))
        off = (found.velocities - (6.0, -3.0)) / np.sqrt(found.velocity_variances)
        assert np.abs(off[30]).max() < 3.5


@pytest.mark.parametrize("density", [0.01, 0.1, 1.0])
def test_standard_deviations_are_those_of_the_errors_where_motion_is_as_assumed(density) -> None:
    off, rng, step = [], np.random.default_rng(7), 0.1
    root, F = np.linalg.cholesky(Q_continuous_white_noise(3, step, density)), expm(step * np.eye(3, k=1))
    for _ in range(150):
        states = [
            np.array([[0.0, 0.0], [5.0, 1.0], [0.0, 0.0]])
        ]  # position, velocity, acceleration of two axes
        for _ in range(59):
            states.append(F @ states[-1] + root @ rng.standard_normal((3, 2)))
        true = np.array(states)
        seen = true[:, 0] + rng.normal(0.0, 0.1, (60, 2))
        found = smooth(step * np.arange(60), seen, np.full((60, 2), 0.1**2))
        off.append((found.velocities - true[:, 1]) / np.sqrt(found.velocity_variances))
    assert 0.8 < np.std(off) < 1.2


def test_positions_that_are_far_off_hardly_count() -> None:
    stamps, positions = noisy(3)
    positions[[10, 11, 40]] += 3.0
    found = smooth(stamps, positions, np.full((60, 2), 0.1**2))
    np.testing.assert_allclose(found.velocities[20:30], [(6.0, -3.0)] * 10, atol=0.3)


def test_what_scatters_more_than_stated_is_known_less() -> None:
    stated = np.full((60, 2), 0.05**2)
    calm, wild = smooth(*noisy(4, 0.05), stated), smooth(*noisy(4, 0.2), stated)
    assert wild.position_variances[30] == pytest.approx(
        8 * calm.position_variances[30], rel=0.5
    )  # 16 ** 0.75


def test_who_brakes_is_followed() -> None:
    stamps = np.arange(0.0, 6.0, 0.1)
    speed = np.clip(8.0 - 2.0 * np.maximum(stamps - 1.0, 0.0), 0.0, None)
    way = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)])
    positions = np.column_stack([way, np.zeros(60)]) + np.random.default_rng(0).normal(0.0, 0.05, (60, 2))
    found = smooth(stamps, positions, np.full((60, 2), 0.05**2))
    assert np.sqrt(np.mean((found.velocities[:, 0] - speed) ** 2)) < 0.2

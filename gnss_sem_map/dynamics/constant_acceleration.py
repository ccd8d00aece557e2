"""Velocity of a track: a smoother of nearly constant acceleration, robust against positions that are far off.

White noise of jerk on either axis, a Kalman filter forwards and a smoother of Bryson and Frazier backwards (Bierman,
1973), which inverts no matrix. How much the acceleration of an object changes is not known: tracks of several densities
of the jerk are mixed by their probability. Weights of positions are those of Student's t; what the positions scatter
more than stated, all of them are known less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import softmax

Array = NDArray[np.float64]

JERKS = (0.01, 0.1, 1.0)
"""Spectral densities of the jerk, m2/s5: from what keeps its speed to city traffic."""
FASTEST_M_S, HARDEST_M_S2 = 45.0, 3.0
"""Standard deviations of velocity and acceleration before the first position."""
DEGREES = 4.0
"""Of freedom of the scatter of positions."""
ROUNDS = 5
MEDIAN_OF_TWO = 1.386
"""Median of the square of a deviation on two axes, in variances."""
WIDEST = 5.0
"""Positions scatter at most so many times more than stated, and not less."""


@dataclass(frozen=True, eq=False)
class SmoothedTrack:
    """Positions and velocities (k, 2) m, m/s of a track, and their variances (k, 2) on either axis."""

    positions: Array
    velocities: Array
    position_variances: Array
    velocity_variances: Array


def smooth(stamps: Array, positions: Array, variances: Array) -> SmoothedTrack:
    """Smooth positions (k, 2) m with variances (k, 2) m2 at increasing or equal stamps (k,) s."""
    known = np.ones(len(stamps))
    scale = 1.0
    for _ in range(ROUNDS):
        given = variances * scale / known[:, None]
        track = _mixed([_both(stamps, positions, given, jerk) for jerk in JERKS])
        off = ((positions - track.positions) ** 2 / (variances + track.position_variances)).sum(axis=1)
        scale = float(np.clip(np.median(off) / MEDIAN_OF_TWO, 1.0, WIDEST**2))
        known = (DEGREES + 2) / (DEGREES + off / scale)
    return track


def _mixed(found: Sequence[tuple[Array, float]]) -> SmoothedTrack:
    """The mean of smoothed states, each weighed by its probability, and variances that hold their differences."""
    states = np.array([one for one, _ in found])
    weights = softmax([log_probability for _, log_probability in found])
    means = np.tensordot(weights, states[..., :2], 1)
    variances = np.tensordot(weights, states[..., 2:] + (states[..., :2] - means) ** 2, 1)
    return SmoothedTrack(means[..., 0], means[..., 1], variances[..., 0], variances[..., 1])


def _both(stamps: Array, positions: Array, variances: Array, density: float) -> tuple[Array, float]:
    """Smoothed states of both axes (k, 2, 4), and the logarithm of their probability."""
    states = np.empty((len(stamps), 2, 4))
    probable = sum(
        _smooth(stamps, positions[:, axis].copy(), variances[:, axis].copy(), density, states[:, axis])
        for axis in range(2)
    )
    return states, float(probable)


@njit(cache=True, nogil=True)
def _smooth(stamps, z, r, density, out):
    """Smooth one axis: `out` (k, 4) is position and velocity, and their variances."""
    count, log_probable = len(stamps), 0.0
    states, covariances = np.zeros((count, 3)), np.zeros((count, 3, 3))
    offs, totals = np.empty(count), np.empty(count)
    F, Q = np.zeros((3, 3)), np.empty((3, 3))
    for k in range(count):
        x, P = states[k], covariances[k]
        if k == 0:
            x[0], P[0, 0], P[1, 1], P[2, 2] = z[0], 1e4, FASTEST_M_S**2, HARDEST_M_S2**2
        else:
            _motion(stamps[k] - stamps[k - 1], density, F, Q)
            _transform(F, covariances[k - 1], P)
            for i in range(3):
                for j in range(3):
                    x[i] += F[i, j] * states[k - 1, j]
                    P[i, j] += Q[i, j]
        offs[k], totals[k] = z[k] - x[0], P[0, 0] + r[k]
        log_probable -= 0.5 * (np.log(totals[k]) + offs[k] ** 2 / totals[k])
        for i in range(2, -1, -1):  # backwards: the first row and column are needed to the end
            gain = P[i, 0] / totals[k]
            x[i] += gain * offs[k]
            for j in range(2, -1, -1):
                P[i, j] -= gain * P[0, j]
    # of the logarithm of the probability of all later positions, by the state: slope g, and curvature, negative, G
    g, G, A, S = np.zeros(3), np.zeros((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(count - 1, -1, -1):
        x, P = states[k], covariances[k]
        _transform(P, G, S)
        for i in range(2):
            out[k, i] = x[i] + P[i, 0] * g[0] + P[i, 1] * g[1] + P[i, 2] * g[2]
            out[k, 2 + i] = P[i, i] - S[i, i]
        if k == 0:
            break
        _motion(stamps[k] - stamps[k - 1], density, F, Q)
        for i in range(3):
            for j in range(3):  # from the state before to this one, and what the position here leaves of it
                A[j, i] = F[i, j] - P[i, 0] / r[k] * F[0, j]
        _transform(A, G, S)
        for i in range(3):
            x[i] = g[
                i
            ]  # as a slice, it is compiled for two seconds: numba writes an error for unequal shapes
        for i in range(3):
            g[i] = F[0, i] * offs[k] / totals[k]
            for j in range(3):
                g[i] += A[i, j] * x[j]
                G[i, j] = S[i, j] + F[0, i] * F[0, j] / totals[k]
    return log_probable


@njit(cache=True, nogil=True)
def _motion(dt, density, F, Q):
    """Fill the transition of position, velocity and acceleration (3, 3), and the covariance of the noise."""
    F[0, 1], F[0, 2], F[1, 2] = dt, dt * dt / 2, dt
    for i in range(3):
        F[i, i] = 1.0
        for j in range(3):
            Q[i, j] = (
                density * dt ** (5 - i - j) / ((2 if i == 0 else 1) * (2 if j == 0 else 1) * (5 - i - j))
            )


@njit(cache=True, nogil=True)
def _transform(A, B, out):
    """Fill `out` with A B A^T, all (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
            for k in range(3):
                out[i, j] += A[i, k] * (B[k, 0] * A[j, 0] + B[k, 1] * A[j, 1] + B[k, 2] * A[j, 2])

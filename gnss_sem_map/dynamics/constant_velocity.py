"""Velocity of a track: a smoother of nearly constant velocity, robust against positions that are far off.

White noise of acceleration on either axis, a Kalman filter forwards and a Rauch-Tung-Striebel smoother backwards
(Rauch, Tung and Striebel, 1965). How much an object accelerates is what its positions make most
probable, out of a few. Weights are those of Student's t; what the positions scatter more than stated, all of them are
known less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.compiling import njit

Array = NDArray[np.float64]

ACCELERATIONS = (0.01, 0.1, 1.0, 4.0)
"""Spectral densities of the acceleration, m2/s3."""
FASTEST_M_S = 45.0
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
        found, _ = max((_both(stamps, positions, given, q) for q in ACCELERATIONS), key=lambda one: one[1])
        off = ((positions - found[:, :, 0]) ** 2 / (variances + found[:, :, 2])).sum(axis=1)
        scale = float(np.clip(np.median(off) / MEDIAN_OF_TWO, 1.0, WIDEST**2))
        known = (DEGREES + 2) / (DEGREES + off / scale)
    return SmoothedTrack(*(found[:, :, column] for column in (0, 1, 2, 4)))


def _both(stamps: Array, positions: Array, variances: Array, density: float) -> tuple[Array, float]:
    """Smoothed states of both axes (k, 2, 5), and the logarithm of their probability."""
    states = np.empty((len(stamps), 2, 5))
    probable = sum(
        _smooth(stamps, positions[:, axis].copy(), variances[:, axis].copy(), density, states[:, axis])
        for axis in range(2)
    )
    return states, float(probable)


@njit(cache=True, nogil=True)
def _smooth(stamps, z, r, density, out):
    """Smooth one axis: `out` (k, 5) is position, velocity, and the variances pp, pv, vv."""
    count, log_probable = len(stamps), 0.0
    predicted = np.empty((count, 5))
    for k in range(count):
        if k == 0:
            p, v, pp, pv, vv = z[0], 0.0, 1e4, 0.0, FASTEST_M_S**2
        else:
            dt = stamps[k] - stamps[k - 1]
            p, v = out[k - 1, 0] + dt * out[k - 1, 1], out[k - 1, 1]
            pp, pv, vv = out[k - 1, 2], out[k - 1, 3], out[k - 1, 4]
            pp += dt * (2 * pv + dt * vv) + density * dt**3 / 3
            pv += dt * vv + density * dt**2 / 2
            vv += density * dt
        predicted[k, 0], predicted[k, 1] = p, v  # one by one: a row takes five times as long to compile
        predicted[k, 2], predicted[k, 3], predicted[k, 4] = pp, pv, vv
        total, off = pp + r[k], z[k] - p
        log_probable -= 0.5 * (np.log(total) + off * off / total)
        gain_p, gain_v = pp / total, pv / total
        out[k, 0], out[k, 1] = p + gain_p * off, v + gain_v * off
        out[k, 2], out[k, 3], out[k, 4] = (1 - gain_p) * pp, (1 - gain_p) * pv, vv - gain_v * pv
    for k in range(count - 2, -1, -1):
        dt = stamps[k + 1] - stamps[k]
        p, v, pp, pv, vv = out[k, 0], out[k, 1], out[k, 2], out[k, 3], out[k, 4]
        a, b, c = predicted[k + 1, 2], predicted[k + 1, 3], predicted[k + 1, 4]
        whole = a * c - b * b
        # P F' of the filtered state, times the inverse of the predicted covariance
        f00, f01, f10, f11 = pp + dt * pv, pv, pv + dt * vv, vv
        g00, g01 = (f00 * c - f01 * b) / whole, (f01 * a - f00 * b) / whole
        g10, g11 = (f10 * c - f11 * b) / whole, (f11 * a - f10 * b) / whole
        dp, dv = out[k + 1, 0] - predicted[k + 1, 0], out[k + 1, 1] - predicted[k + 1, 1]
        da, db, dc = out[k + 1, 2] - a, out[k + 1, 3] - b, out[k + 1, 4] - c
        out[k, 0], out[k, 1] = p + g00 * dp + g01 * dv, v + g10 * dp + g11 * dv
        out[k, 2] = pp + g00 * (da * g00 + db * g01) + g01 * (db * g00 + dc * g01)
        out[k, 3] = pv + g00 * (da * g10 + db * g11) + g01 * (db * g10 + dc * g11)
        out[k, 4] = vv + g10 * (da * g10 + db * g11) + g11 * (db * g10 + dc * g11)
    return log_probable

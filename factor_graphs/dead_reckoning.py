"""Positions of the fixes against dead reckoning of the IMU, window by window.

In a window the fixes are a slope in time, a parabola (tilt, bias), and the twice integrated force turned by a first
heading. The last one is compared, so neither attitude nor velocity need be known; and it is late where the clock is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.measurements import GnssFixes, ImuSamples

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Long enough that a turn or a stop stands out from metres of noise, short enough that a consumer gyroscope holds.
WINDOW_S = 20.0
LEAST_FIXES = 7
MOST_WINDOWS, MOST_FIXES = 30, 40


def integral(stamps: Array, values: Array) -> Array:
    """Of (n,) or (n, k) values over time, by trapezoids, from zero."""
    step = np.diff(stamps).reshape(-1, *[1] * (values.ndim - 1))
    parts = (values[1:] + values[:-1]) / 2 * step
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(parts, axis=0)])


def way_of(imu: ImuSamples, lever: complex = 0j, *, mirrored: bool = False) -> NDArray[np.complex128]:
    """The way of a point at `lever` m (ahead + i left) of an IMU with z up: (n,) m, up to a line and a parabola.

    East + i north up to a first heading: the accelerometer integrated twice along the gyroscope's heading.
    `mirrored`: left is taken as right.
    """
    x, y = imu.specific_force[:, 0], imu.specific_force[:, 1] * (-1.0 if mirrored else 1.0)
    heading = np.exp(1j * integral(imu.stamps, imu.angular_rate[:, 2]))
    ahead = (x + 1j * y) * heading
    twice = integral(imu.stamps, integral(imu.stamps, np.column_stack([ahead.real, ahead.imag])))
    arm = np.conj(lever) if mirrored else lever
    return np.asarray(twice[:, 0] + 1j * twice[:, 1] + arm * heading)


@dataclass(frozen=True, eq=False)
class Windows:
    """Fixes by window: `stamps` (w, k) s, `places` (w, k) m, `basis` (w, k, 3) orthonormal in the fixes that count."""

    stamps: Array
    places: Complex
    counts: Array
    """(w, k) 1 for a fix, 0 for none."""
    basis: Array


def windows_of(fixes: GnssFixes, start: float, end: float) -> Windows | None:
    """Overlapping windows between two stamps, s; None when none holds enough fixes."""
    length = min(WINDOW_S, end - start)
    number = min(MOST_WINDOWS, max(1, int(2 * (end - start) / length) - 1)) if length > 0 else 0
    chosen = []
    for first in np.linspace(start, end - length, number):
        rows = np.flatnonzero((fixes.stamps >= first) & (fixes.stamps <= first + length))
        if len(rows) >= LEAST_FIXES:
            chosen.append(rows[np.unique(np.linspace(0, len(rows) - 1, MOST_FIXES).astype(int))])
    if not chosen:
        return None
    width = max(map(len, chosen))
    index = np.array([np.pad(rows, (0, width - len(rows)), mode="edge") for rows in chosen])
    counts = np.array([np.arange(width) < len(rows) for rows in chosen]).astype(float)
    stamps, positions = fixes.stamps[index], fixes.positions[index]
    middle = stamps.mean(axis=1, keepdims=True)
    u = (stamps - middle) / max(length / 2, 1e-6)
    basis, _ = np.linalg.qr(np.stack([np.ones_like(u), u, u**2], axis=-1) * counts[..., None])
    places = (positions[..., 0] + 1j * positions[..., 1]) * counts
    return Windows(stamps, places, counts, basis)


@dataclass(frozen=True)
class Agreement:
    """What the IMU's way leaves unexplained: a sum of squares, m², of so many independent errors."""

    rest: float
    independent: float


def agreement(windows: Windows, stamps: Array, way: Complex, lag_s: float = 0.0) -> Agreement:
    """The fixes, taken `lag_s` later than stamped, against a way (n,) m at its stamps, turned and scaled to fit."""
    x = _beside_parabola(windows, _at(windows, stamps, way, lag_s))
    y = _beside_parabola(windows, windows.places)
    power = np.sum(np.abs(x) ** 2, axis=1)
    scales = np.sum(np.conj(x) * y, axis=1) / np.maximum(power, 1e-12)
    errors = y - scales[:, None] * x
    return Agreement(float(np.sum(np.abs(errors) ** 2)), _independent_errors(windows, errors))


def _independent_errors(windows: Windows, errors: Complex) -> float:
    """How many independent errors (w, k) are, by how alike neighbours are; windows overlap by a half."""
    rest = float(np.sum(np.abs(errors) ** 2))
    alike = float(np.sum(errors[:, 1:] * np.conj(errors[:, :-1])).real) / max(rest, 1e-12)
    alike = min(max(alike, 0.0), 0.99)
    # a parabola, a scale and a heading were taken off each window
    free = max(float(windows.counts.sum()) - 4.0 * len(errors), 1.0) * (1.0 - alike) / (1.0 + alike)
    return free / (2.0 if len(errors) > 1 else 1.0)


def _at(windows: Windows, stamps: Array, way: Complex, lag_s: float) -> Complex:
    """A way (n,) at the stamps of the fixes, (w, k), zero where there is none."""
    wanted = (windows.stamps + lag_s).ravel()
    went = np.interp(wanted, stamps, way.real) + 1j * np.interp(wanted, stamps, way.imag)
    return np.asarray(went.reshape(windows.stamps.shape) * windows.counts)


def _beside_parabola(windows: Windows, values: Complex) -> Complex:
    """What is left of (w, k) values when each window's best parabola is taken off."""
    parts = np.einsum("wkp,wk->wp", windows.basis, values)
    return np.asarray(values - np.einsum("wkp,wp->wk", windows.basis, parts))

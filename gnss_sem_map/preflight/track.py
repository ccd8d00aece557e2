"""Velocities of the fixes: slopes of lines through neighbouring fixes, over windows as short as the noise allows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.measurements import GnssFixes

Array = NDArray[np.float64]

# Third differences of white noise of stddev s have stddev s √20; 1.4826 median absolute deviations are one stddev.
THIRD_DIFFERENCE = np.sqrt(20.0)
MAD = 1.4826
# Lines are made longer, up to the last of these, s, until they give the velocity to this, m/s: a walker's pace is told.
WIDTHS_S = (0.5, 1.0, 2.0, 4.0)
WANTED_STDDEV_MPS = 0.15
# Lines that share more than most of their fixes say the same.
KNOTS_PER_LINE = 5
# What is slower than this, m/s, or than so many of its standard deviations, has no course.
MIN_COURSE_SPEED_MPS, MIN_COURSE_STDDEVS = 0.8, 4.0


@dataclass(frozen=True, eq=False)
class Track:
    """Velocities at `stamps` (m,) s: `velocities` (m, 3) m/s, each over `width_s`, with one standard deviation."""

    stamps: Array
    velocities: Array
    stddev_mps: float
    width_s: float

    @property
    def speeds(self) -> Array:
        """Horizontal, (m,) m/s."""
        return np.hypot(self.velocities[:, 0], self.velocities[:, 1])

    @property
    def courses(self) -> Array:
        """(m,) rad, 0 towards east, counter-clockwise; of no meaning where the vehicle stands."""
        return np.arctan2(self.velocities[:, 1], self.velocities[:, 0])

    @property
    def is_moving(self) -> NDArray[np.bool_]:
        """Where there is a course, (m,)."""
        return self.speeds > max(MIN_COURSE_SPEED_MPS, MIN_COURSE_STDDEVS * self.stddev_mps)


def track_of(fixes: GnssFixes) -> Track:
    """The track of at least four fixes; empty when gaps leave nothing."""
    step = float(np.median(np.diff(fixes.stamps)))
    scatter = scatter_of(fixes.positions[:, :2])
    for width in WIDTHS_S:
        count = max(3, 2 * round(width / step / 2) + 1)
        span = (count - 1) * step
        stddev = scatter * np.sqrt(12.0 / count) / span
        if stddev <= WANTED_STDDEV_MPS or span >= WIDTHS_S[-1]:
            break
    every = max(1, count // KNOTS_PER_LINE)
    stamps, velocities = (a[::every] for a in _slopes(fixes, min(count, len(fixes)), 1.5 * span))
    return Track(stamps, velocities, float(stddev), float(span))


def scatter_of(positions: Array) -> float:
    """White noise of positions (n,) or (n, k), m per axis; motion between neighbours counts with it."""
    third = np.diff(positions, n=3, axis=0)
    return float(MAD * np.median(np.abs(third)) / THIRD_DIFFERENCE) if len(third) else 0.0


def _slopes(fixes: GnssFixes, count: int, longest_s: float) -> tuple[Array, Array]:
    """Lines through `count` fixes in a row, where these are not longer than `longest_s`."""
    t = np.lib.stride_tricks.sliding_window_view(fixes.stamps, count)
    p = np.lib.stride_tricks.sliding_window_view(fixes.positions, count, axis=0)
    whole = t[:, -1] - t[:, 0] <= longest_s
    t, p = t[whole], p[whole]
    middle = t.mean(axis=1)
    off = t - middle[:, None]
    slopes = np.einsum("mk,mak->ma", off, p) / np.sum(off**2, axis=1)[:, None]
    return middle, slopes

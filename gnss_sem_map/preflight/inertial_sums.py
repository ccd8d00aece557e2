"""Running integrals of an IMU: means over any window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.dead_reckoning import integral

Array = NDArray[np.float64]

# A line through fixes averages the velocity with a parabola as wide as the line; so wide is the box of the same spread.
BOX_PER_LINE = float(np.sqrt(12.0 / 20.0))


@dataclass(frozen=True, eq=False)
class SmoothedIntegral:
    """The integral of something over time, averaged over a box."""

    stamps: Array
    twice: Array
    """The integral's integral, (n,) or (n, k)."""

    @staticmethod
    def of(stamps: Array, values: Array) -> SmoothedIntegral:
        """From (n,) or (n, k) values at their stamps."""
        return SmoothedIntegral(stamps, integral(stamps, integral(stamps, values)))

    def at(self, stamps: Array, line_s: float) -> Array:
        """As a line through fixes over `line_s` sees it, (m,) or (m, k)."""
        half = max(BOX_PER_LINE * line_s, 1e-3) / 2
        first, last = self.stamps[0], self.stamps[-1]
        middle = np.clip(stamps, first + half, max(last - half, first + half))
        low, high = np.clip(middle - half, first, last), np.clip(middle + half, first, last)
        difference = _interpolated(high, self.stamps, self.twice) - _interpolated(
            low, self.stamps, self.twice
        )
        return np.asarray(difference / np.maximum(high - low, 1e-6).reshape(-1, *[1] * (self.twice.ndim - 1)))


def _interpolated(wanted: Array, stamps: Array, values: Array) -> Array:
    if values.ndim == 1:
        return np.interp(wanted, stamps, values)
    return np.column_stack([np.interp(wanted, stamps, column) for column in values.T])

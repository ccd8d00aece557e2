"""When a sweep meets what: its LiDAR turns once in 0.1 s, and a car at 50 km/h goes 1.4 m meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DIRECTIONS = 72
EVERY = 61
"""Every 61st point tells the time of its direction: of a file by columns of 16 to 128 rings, those of all rings."""


@dataclass(frozen=True, eq=False)
class SweepDelays:
    """Mean time of the points of a scan in every direction, after the stamp of the scan."""

    seconds: NDArray[np.float32]
    """(DIRECTIONS,) s, by the angle from east over north, from -180 degrees on."""

    @classmethod
    def none(cls) -> SweepDelays:
        """All points are of the stamp of the scan, or nothing is known of their time."""
        return cls(np.zeros(DIRECTIONS, np.float32))

    @classmethod
    def of(
        cls,
        p_lidar: NDArray[np.float32],
        stamps: NDArray[np.float64],
        usable: NDArray[np.bool_],
        R_map_lidar: NDArray[np.float64],
        stamp: float,
    ) -> SweepDelays:
        """From the usable points (n, 3) m of a scan and their stamps (n,) s; `R_map_lidar` (3, 3)."""
        some = np.flatnonzero(usable[::EVERY]) * EVERY
        where = _direction(p_lidar[some].astype(np.float64) @ R_map_lidar[:2].T)
        count = np.bincount(where, minlength=DIRECTIONS)
        sums = np.bincount(where, stamps[some] - stamp, DIRECTIONS)
        return cls((sums / np.maximum(count, 1)).astype(np.float32))


def delays_towards(
    ways: NDArray[np.float64], of_scans: Sequence[SweepDelays], counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Delays (p,) s in directions (p, 2), of which so many (k,) are of each scan, one after the other."""
    seconds = np.array([one.seconds for one in of_scans])
    return seconds[np.repeat(np.arange(len(counts)), counts), _direction(ways)].astype(np.float64)


def _direction(ways: NDArray[np.float64]) -> NDArray[np.intp]:
    turn = np.arctan2(ways[:, 1], ways[:, 0]) / (2 * np.pi) + 0.5
    return np.minimum((turn * DIRECTIONS).astype(np.intp), DIRECTIONS - 1)

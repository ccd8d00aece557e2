"""Rows of range images: the elevations at which a LiDAR measures, found in its scans.

A cell of elevation that holds returns has a row of its own, and so have narrow gaps beside it. A wider gap lies between
two rings of the LiDAR and has no row: what both rings say of a place in it counts. So an image is no larger than the
LiDAR has rings, even or uneven, and a pattern without rings is one without gaps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.scans.own_vehicle import returns_of

CELL_DEG = 0.42
"""Height of a cell: a little finer than the 64 beams of an HDL-64E."""
CELLS, LOWEST_DEG = 430, -215 * CELL_DEG
"""From straight down to straight up."""
FINE, COARSE = (155, 225), 4
"""The cells from -25.2 to 4.2 degrees, where what moves is seen, are rows; elsewhere a row is so many cells, so that
128 rings have 80 rows."""
HORIZON = 215
"""The first cell above it."""
WIDEST_GAP = 1
"""More empty cells than these, side by side, are a gap between rings."""
BEYOND = 3
"""Cells with rows above the highest ring and below the lowest: deskewing moves near returns by a degree."""
LEAST_SHARE, NEAR = 0.05, 5
"""A cell with fewer returns than this share of the fullest one, so many cells up and down, lies between rings."""


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of the range images of one LiDAR, numbered from 1 upwards: row 0 of an image is empty."""

    seen: NDArray[np.bool_]
    """(CELLS,) which cells of elevation hold returns."""

    @classmethod
    def of(cls, scans: Sequence[NDArray[np.floating]]) -> Rows:
        """The rows of a LiDAR, by the points (n, 3) m of some of its scans, in its own axes, as they were measured."""
        counts = np.zeros(CELLS, np.int64)
        for points in scans:
            x, y, z = returns_of(points).T
            cells = (np.degrees(np.arctan2(z, np.hypot(x, y))) - LOWEST_DEG) / CELL_DEG
            counts += np.bincount(cells.astype(np.int64), minlength=CELLS)
        around = np.lib.stride_tricks.sliding_window_view(np.pad(counts, NEAR), 2 * NEAR + 1)
        return cls((counts > 0) & (counts >= LEAST_SHARE * around.max(axis=1)))

    @cached_property
    def bounds(self) -> NDArray[np.int64]:
        """(rows, 2) the first cell of every row, and the first one above it."""
        seen = np.flatnonzero(self.seen)
        if not len(seen):
            return np.empty((0, 2), np.int64)
        held = np.zeros(CELLS, np.bool_)
        held[max(seen[0] - BEYOND, 0) : seen[0]] = held[seen[-1] : seen[-1] + BEYOND + 1] = True
        for below, above in pairwise(seen):
            held[below : above if above - below <= WIDEST_GAP + 1 else below + 1] = True
        cells = np.flatnonzero(held)
        fine = np.clip(cells, *FINE)
        starts = np.flatnonzero(np.diff(fine + (cells - fine) // COARSE, prepend=-CELLS))
        return np.stack([cells[starts], cells[np.append(starts[1:], 0) - 1] + 1], axis=1)

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.bounds)

    @cached_property
    def elevations_rad(self) -> NDArray[np.float64]:
        """(rows + 1,) the middle of every row of an image; the first one is empty."""
        return np.radians(LOWEST_DEG + CELL_DEG * np.append(0.0, self.bounds.mean(axis=1)))

    @cached_property
    def gaps_rad(self) -> NDArray[np.float64]:
        """(CELLS,) angle between the rings below and above each cell; 0 where rows adjoin."""
        gaps = np.zeros(CELLS)
        for (first, low), (high, end) in pairwise(self.bounds):
            if low < high:
                gaps[first:end] = np.maximum(gaps[first:end], np.radians((high - low + 1) * CELL_DEG))
        return gaps

    @cached_property
    def gap_on_ground_deg(self) -> float:
        """The usual gap between rings that meet the ground around the vehicle."""
        ground = slice(FINE[0], HORIZON)
        gaps = self.gaps_rad[ground][self.of_return[ground] > 0]
        return float(np.degrees(np.median(gaps))) if len(gaps) else 0.0

    @cached_property
    def of_return(self) -> NDArray[np.int32]:
        """(CELLS,) the row of a return: in a gap that of the nearest ring, 0 outside of the view."""
        of_cell = np.zeros(CELLS, np.int32)
        for row, (first, end) in enumerate(self.bounds, 1):
            of_cell[first:end] = row
        for row, ((_, low), (high, _)) in enumerate(pairwise(self.bounds), 1):
            of_cell[low:high] = row
            of_cell[(low + high) // 2 : high] = row + 1
        return of_cell

    @cached_property
    def around(self) -> NDArray[np.int32]:
        """(CELLS, 3) the rows below, at and above a place, 0 for none: in a gap those of both rings, and none at it."""
        of_cell = np.zeros((CELLS, 3), np.int32)
        for row, (first, end) in enumerate(self.bounds, 1):
            of_cell[first:end, 1] = row
        for row, ((first, low), (high, end)) in enumerate(pairwise(self.bounds), 1):
            of_cell[low:end, 0], of_cell[first:high, 2] = row, row + 1
            if low < high:  # a gap
                of_cell[high:end, 0], of_cell[first:low, 2] = 0, 0
        return of_cell

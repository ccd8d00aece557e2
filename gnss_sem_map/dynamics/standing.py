"""What stands beside a mover: a segment that has moved may hold a part of something that stands alone in other scans.

A car that creeps past a parked one is one segment with it for some scans. The parked car is a segment of its own in
others, and what was never seen through and belongs to it stays.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

LARGEST_MISSES_PER_HIT = 0.05
"""What stands is seen through at most so often: parked cars reach 0.03 with sharp poses."""


def is_occupied(hits: ArrayLike, misses: ArrayLike) -> NDArray[np.bool_]:
    """Whether other scans hit something (n,) and hardly ever saw through it."""
    hits, misses = np.asarray(hits), np.asarray(misses)
    occupied: NDArray[np.bool_] = (hits > 0) & (misses <= LARGEST_MISSES_PER_HIT * hits)
    return occupied


def standing(
    places: Sequence[NDArray[np.int32]],
    counts: Iterable[NDArray[np.int32]],
    moved: Iterable[NDArray[np.bool_]],
    stood: Iterable[NDArray[np.integer]],
) -> Iterator[NDArray[np.bool_]]:
    """For each scan, the voxels (v,) that stand, whatever the rest of their segment did.

    `places` (v,) number the voxels of each scan, the same in all scans; `counts` (2, v) are their hits and misses.
    `moved` (v,) tells which of them are in a segment that moved; `stood` (v,) is 2 for those in a whole one that
    stands, 1 for others that do. A place stands if these add up to more than the scans in which it moved.
    """
    number = 1 + max((int(place.max(initial=-1)) for place in places), default=-1)
    times_moved, times_stood = np.zeros((2, number), np.int32)
    for place, is_moved, is_stood in zip(places, moved, stood, strict=True):
        times_moved[place] += is_moved
        times_stood[place] += is_stood
    stands = times_stood > times_moved
    return (stands[place] & is_occupied(*counted) for place, counted in zip(places, counts, strict=True))

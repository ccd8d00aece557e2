"""A mover that tracking has lost and found again: two tracks of one object, of which but one is seen to move.

A car that creeps for a metre covers most of the place where it stood. The track before may end when something hides the
car, and tells nothing of its motion then. But it is where the other track moved, and it is seen through more often than
what stands: both are one object.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.clusters import Segments
from gnss_sem_map.dynamics.motion_state import Motion, TrackedObject

MOVED_SHARE = 0.6
"""So many of its points are where something moved in another scan, and"""
MISSES_PER_HIT = 0.15
"""it has more misses per hit than this, the most that what stands has."""


def joined_to_movers(
    objects: Sequence[TrackedObject],
    segments: Sequence[Segments],
    places: Sequence[NDArray[np.int32]],
    moved: Iterable[NDArray[np.bool_]],
    hits: NDArray[np.float64],
    misses: NDArray[np.float64],
) -> list[TrackedObject]:
    """The objects, with those as moving that are parts of others that moved.

    `segments` are those of each scan; `places` (v,) number its voxels, the same in all scans, and `moved` (v,) tells
    which of them are of an object that moved. `hits` and `misses` (s,) are those of the segments of all scans.
    """
    moved_there = np.zeros(1 + max((int(place.max(initial=-1)) for place in places), default=-1), np.int32)
    for place, is_moved in zip(places, moved, strict=True):
        moved_there[place[is_moved]] = 1
    there = np.concatenate(
        [
            of_scan.sums_of(moved_there[place][None])[0]
            for of_scan, place in zip(segments, places, strict=True)
        ]
    )

    def is_part(one: TrackedObject) -> bool:
        members = list(one.segments)
        return bool(
            one.motion is Motion.PARKED
            and len(members) > 1
            and there[members].sum() >= MOVED_SHARE * one.points
            and misses[members].sum() > MISSES_PER_HIT * hits[members].sum()
        )

    return [
        replace(one, motion=Motion.MOVING, reason=f"part of something that moved, {one.reason}")
        if is_part(one)
        else one
        for one in objects
    ]

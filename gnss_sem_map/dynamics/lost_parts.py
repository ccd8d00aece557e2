"""A mover that tracking has lost and found again: two tracks of one object.

A car that creeps for a metre covers most of the place where it stood: only one of its tracks is seen to move. The track
before may end when something hides the car, and tells nothing of its motion then. But it is where the other track
moved, and it is seen through more often than what stands: both are one object.

Where a scan suddenly shows the side of a car, after its rear, the mean of its points jumps farther than the gate of the
tracking, and its track ends. The next one begins where the car goes on: both are one object, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnss_sem_map.dynamics.clusters import Segments
from gnss_sem_map.dynamics.motion_state import GONE, Motion, TrackedObject
from gnss_sem_map.dynamics.object_track import VELOCITY_SCANS, velocities
from gnss_sem_map.dynamics.tracking import LONGEST_GAP, LONGEST_GAP_S, Segment

MOVED_SHARE = 0.6
"""So many of its points are where something moved in another scan, and"""
MISSES_PER_HIT = 0.15
"""it has more misses per hit than this, the most that what stands has."""
LEAST_SCANS = 5
"""Tracks of fewer scans tell no velocity."""
SLOWER_SHARE, SLOWER_M_S = 0.5, 1.0
"""Velocities of parts of one object differ by no more than this share of the greater, and this."""


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


def with_next_parts(
    objects: Sequence[TrackedObject], listed: Sequence[Segment], reach_m: float
) -> list[TrackedObject]:
    """The objects, of which those that moved are one with what goes on where they end.

    `listed` are the segments of all scans. An object goes on in one that begins in the next scans, closer than
    `reach_m` to where the first one has moved on to, and that moves as it does.
    """
    result = dict(enumerate(objects))
    moved = [n for n, one in enumerate(objects) if one.motion in GONE and len(one.segments) >= LEAST_SCANS]
    begun: list[int] = []
    for n in sorted(moved, key=lambda n: listed[objects[n].segments[0]].scan):
        before = [m for m in begun if _goes_on(result[m], objects[n], listed, reach_m)]
        if len(before) == 1:  # of several nobody knows which
            result[before[0]] = _joined(result[before[0]], result.pop(n))
        else:
            begun.append(n)
    return list(result.values())


def _goes_on(one: TrackedObject, after: TrackedObject, listed: Sequence[Segment], reach_m: float) -> bool:
    """Whether an object may be seen as another one afterwards."""
    last, first = listed[one.segments[-1]], listed[after.segments[0]]
    late = first.stamp - last.stamp
    if not (0 < first.scan - last.scan <= LONGEST_GAP + 1 and late <= LONGEST_GAP_S):
        return False
    old, new = _velocity(one, listed, -1), _velocity(after, listed, 0)
    speed = max(np.linalg.norm(old), np.linalg.norm(new))
    way = late * (old + new) / 2
    if np.linalg.norm(old - new) > SLOWER_SHARE * speed + SLOWER_M_S:
        return False
    nearest, _ = cKDTree(last.outline() + way).query(first.outline(), distance_upper_bound=reach_m)
    return bool(np.isfinite(nearest).any())


def _velocity(one: TrackedObject, listed: Sequence[Segment], end: int) -> NDArray[np.float64]:
    """Velocity (2,) m/s of an object at its first segment, 0, or at its last one, -1."""
    some = slice(0, VELOCITY_SCANS + 1) if end == 0 else slice(-VELOCITY_SCANS - 1, None)
    stamps = np.array([listed[n].stamp for n in one.segments[some]])
    found: NDArray[np.float64] = velocities(stamps, one.path[some])[end]
    return found


def _joined(one: TrackedObject, after: TrackedObject) -> TrackedObject:
    main = max(one, after, key=lambda part: part.points)
    return replace(
        main,
        probability=max(one.probability, after.probability),
        displaced=one.displaced or after.displaced,
        segments=one.segments + after.segments,
        points=one.points + after.points,
        first_stamp=one.first_stamp,
        last_stamp=after.last_stamp,
        path=np.concatenate([one.path, after.path]),
    )

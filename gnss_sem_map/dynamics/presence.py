"""What is there only while a mover is: a walker close to a wall is found now as himself, now as a part of the wall.

A track tells where its object is in scans that show no segment of it, and a little before and after all of them. What
stands there is found there at other times too; what is found only while the object is there, though other scans looked,
is of the object.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.clusters import Segments
from gnss_sem_map.dynamics.ground_grid import closer_than
from gnss_sem_map.dynamics.motion_state import GONE, SIZE_MARGIN_M, SIZE_RATIO, TrackedObject
from gnss_sem_map.dynamics.object_track import velocities
from gnss_sem_map.dynamics.seen_through import PERSON_M
from gnss_sem_map.dynamics.standing import is_occupied
from gnss_sem_map.dynamics.tracking import Segment

Array = NDArray[np.float64]
Masks = list[NDArray[np.bool_]]
Prediction = tuple[int, int, Array]
"""A segment, by its scan and its number there, and how far its object went since then, (3,) m."""

PREDICTED_S = 1.0
"""A track tells where its object is so long before and after each of its segments: a walker is then known to 0.2 m."""
PERSON_S, PERSON_REACH_M = 2.0, 0.5
"""The same for the track of a person, who is slow, and how far parts of a person are from each other: of one who walks
along a wall the segments are but the half that is farther from it."""
LEAST_SCANS = 3
"""A track of fewer scans tells no velocity."""
WITH_MOVER_SHARE = 0.9
"""A place is of a mover if one is near in so large a share of the scans that find something there, and no fewer scans
looked there while none was near."""
LEAST_HITS = 10
"""What so many scans hit without a mover stands: one that comes to a stop is within the margin of a hit before."""
LEAST_FOUND = 3
"""A place that so many scans find, and more without a mover than with one, stands."""


def presence(
    places: Sequence[NDArray[np.int32]], counts: NDArray[np.int32], near: Sequence[NDArray[np.bool_]]
) -> tuple[Masks, Masks, Masks]:
    """For each scan, the voxels (v,) that are there only with a mover, that are there mostly without one, and that
    scans hit also without one and hardly ever see through.

    `places` (v,) number the voxels of each scan, the same in all scans; `counts` (2, p) are the hits and misses of
    all places; `near` (v,) tells which voxels have a mover near them.
    """
    found, with_mover, first, last = np.zeros((4, counts.shape[1]), np.int32)
    first[:] = len(places)
    for scan, (place, is_near) in enumerate(zip(places, near, strict=True)):
        found[place] += 1
        with_mover[place] += is_near
        near_one = place[is_near]
        first[near_one] = np.minimum(first[near_one], scan)
        last[near_one] = scan
    with_one = last - first + 1
    looks_without = counts.sum(axis=0) - with_one
    comes_and_goes = (with_mover >= WITH_MOVER_SHARE * found) & (looks_without >= found)
    stands = (found >= LEAST_FOUND) & (2 * with_mover < found)
    of_mover = [comes_and_goes[place] & is_near for place, is_near in zip(places, near, strict=True)]
    hits_without = counts[0] - with_one
    occupied = is_occupied(*counts) & (hits_without >= LEAST_HITS)
    return of_mover, [stands[place] for place in places], [occupied[place] for place in places]


def unusually_large(objects: Sequence[TrackedObject], listed: Sequence[Segment]) -> NDArray[np.bool_]:
    """Which of all segments (s,) are so much larger than most of their track that they hold something else, too."""
    is_large = np.zeros(len(listed), np.bool_)
    for one in objects:
        if one.motion in GONE and len(one.segments) >= LEAST_SCANS:
            size = np.array([np.linalg.norm(np.ptp(listed[n].outline(), axis=0)) for n in one.segments])
            points = np.array([listed[n].points for n in one.segments])
            is_large[list(one.segments)] = size > SIZE_RATIO * _median(size, points) + SIZE_MARGIN_M
    return is_large


def _median(values: Array, weights: NDArray[np.int64]) -> float:
    """The weighted median: from afar a long vehicle shows a part of itself, with few points, in many scans."""
    order = np.argsort(values)
    share = np.cumsum(weights[order]) / weights.sum()
    return float(values[order[np.searchsorted(share, 0.5)]])


def near_movers(
    objects: Sequence[TrackedObject],
    listed: Sequence[Segment],
    segments: Sequence[Segments],
    stamps: Array,
    reach_m: float,
) -> Masks:
    """For each scan, the voxels (v,) closer than `reach_m`, or a person's reach, to where a track puts its object.

    `listed` are the segments of all scans, in the order of the scans; `stamps` (k,) s are those of the scans.
    """
    gone = [one for one in objects if one.motion in GONE and len(one.segments) >= LEAST_SCANS]
    is_person = [_is_person([listed[n] for n in one.segments]) for one in gone]
    first = np.append(0, np.cumsum([len(of_scan.truncated) for of_scan in segments]))
    near = [np.zeros(len(of_scan.keys), np.bool_) for of_scan in segments]
    for kind, seconds, reach in ((False, PREDICTED_S, reach_m), (True, PERSON_S, PERSON_REACH_M)):
        predicted: list[list[Prediction]] = [[] for _ in segments]
        for one in (one for one, person in zip(gone, is_person, strict=True) if person == kind):
            scans = np.array([listed[n].scan for n in one.segments])
            numbers = np.array(one.segments) - first[scans]
            for scan, k, way in _course(stamps, scans, one.path, seconds):
                predicted[scan].append((scans[k], numbers[k], way))
        for is_near, of_scan, there in zip(near, segments, predicted, strict=True):
            is_near |= _closer(
                of_scan, [segments[scan].means(number) + way for scan, number, way in there], reach
            )
    return near


def _is_person(segments: Sequence[Segment]) -> bool:
    """Whether the segments of a track are, usually, as short as a person and higher than long."""
    length = np.median([np.linalg.norm(np.ptp(one.outline(), axis=0)) for one in segments])
    height = np.median([one.levels[1] - one.levels[0] for one in segments])
    return bool(length < min(PERSON_M, height))


def _course(
    stamps: Array, scans: NDArray[np.int64], centroids: Array, seconds: float
) -> Iterator[tuple[int, int, Array]]:
    """Scans; for each, which segment of a track is the nearest in time, and the way (3,) m of the object since then.

    `scans` (s,) and `centroids` (s, 2) m are those of its segments, which tell so many `seconds` before and after.
    """
    seen = stamps[scans]
    speed = velocities(seen, centroids)
    start, end = np.searchsorted(stamps, (seen[0] - seconds, seen[-1] + seconds)).tolist()
    nearest = np.searchsorted((seen[1:] + seen[:-1]) / 2, stamps[start:end])
    late = stamps[start:end] - seen[nearest]
    for scan in np.flatnonzero(abs(late) <= seconds).tolist():
        k = int(nearest[scan])
        yield start + scan, k, late[scan] * np.append(speed[k], 0.0)


def _closer(of_scan: Segments, predicted: Sequence[Array], reach_m: float) -> NDArray[np.bool_]:
    """Which voxels (v,) of a scan are closer than `reach_m` to predicted points."""
    if not predicted:
        return np.zeros(len(of_scan.keys), np.bool_)
    means = of_scan.parts.sums / of_scan.parts.points[:, None]
    points = np.concatenate([*predicted, means])
    is_voxel = np.arange(len(points)) >= len(points) - len(means)
    return closer_than(points, ~is_voxel, is_voxel, reach_m)[is_voxel]

"""Search for moving objects: a segment of one scan has moved if other scans see through its volume.

Scans are observed one by one (`observation.py`). `decide` tracks the segments of consecutive scans, counts hits and
misses of their voxels in all of them, and tells which have moved. `moved_points` are the points that this means.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.dynamics.clusters import Segments, split_segments
from gnss_sem_map.dynamics.covered_parts import with_cover
from gnss_sem_map.dynamics.ground_grid import closer_than
from gnss_sem_map.dynamics.lost_parts import joined_to_movers, with_next_parts
from gnss_sem_map.dynamics.motion_state import GONE, MotionSettings, TrackedObject, classify_motion
from gnss_sem_map.dynamics.object_track import track_of
from gnss_sem_map.dynamics.observation import BODY_HEIGHT_M, NearPoints, Observation
from gnss_sem_map.dynamics.pose_sharpness import are_sharp, stand_still
from gnss_sem_map.dynamics.presence import near_movers, presence, unusually_large
from gnss_sem_map.dynamics.seen_through import free_groups, with_free_groups
from gnss_sem_map.dynamics.standing import is_occupied, standing
from gnss_sem_map.dynamics.tracking import Segment
from gnss_sem_map.dynamics.visibility import (
    SCANS_PER_PART,
    SHARP_RATIO,
    WIDE_RATIO,
    Keyframes,
    KeyframeScans,
    hits_and_misses,
    spatial_order,
)
from gnss_sem_map.errors import DataError
from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.voxels.hash_unique import distinct

Array = NDArray[np.float64]

FOOT_REACH_M = 0.2
ASKED_SCANS = 20
"""So many scans, of those in which an object is elsewhere, tell whether its place was free."""


@dataclass(frozen=True, eq=False)
class Decision:
    """What has moved in consecutive scans."""

    moved: list[NDArray[np.bool_]]
    """For each scan, which of the voxels (v,) of its points above ground."""
    stands: list[NDArray[np.bool_]]
    """For each scan, the voxels (v,) that do not belong to something that moved beside them."""
    objects: tuple[TrackedObject, ...]
    """Those that are first seen in one of these scans."""
    is_sharp: bool
    """The poses blur what stands so little that rays tell what is free."""


def decide(
    observations: Sequence[Observation],
    count: int,
    before: Keyframes | None,
    settings: MotionSettings,
) -> Decision:
    """Decide what moved in the first `count` of the observations, in time order, by the evidence of all.

    The scans `before` count as evidence too, if there are some. Raises DataError when the stamps do not increase.
    """
    _check_order(observations)
    if not observations:
        return Decision([], [], (), False)
    places = _places(observations)
    of_places, is_sharp = _told_by_others(observations, places, before, settings)

    def counts() -> Iterator[NDArray[np.int32]]:  # those of all scans side by side take 50 MB
        for place in places:
            release_memory()  # what one scan after another has used lies among what lasts: 90 MB
            yield of_places.take(place, axis=1)

    parted = (
        _parted(seen.segments, counted[0], counted[1], settings, is_sharp)
        for seen, counted in zip(observations, counts(), strict=True)
    )
    segments, free = map(list, zip(*parted, strict=True))
    hits, misses = np.concatenate(
        [of_scan.sums_of(counted) for of_scan, counted in zip(segments, counts(), strict=True)], axis=1
    )
    listed = _all_segments(observations, segments)
    counted_in = partial(_counted_in, observations, listed, segments, settings) if is_sharp else None
    objects = classify_motion(listed, hits, misses, settings, is_sharp, counted_in)
    gone = _gone(objects, len(listed))
    if is_sharp:
        objects = joined_to_movers(objects, segments, places, _of_voxels(gone, segments), hits, misses)
        gone = _gone(objects, len(listed))
    is_whole = np.array([not one.truncated for one in listed], np.bool_)
    stood_of = _stood_of(is_whole & ~gone & is_occupied(hits, misses), segments, counts())
    moved_of = _either(_of_voxels(gone, segments), free)
    del free  # masks of all scans take 10 MB here, at the peak of memory: others are made one by one
    stays = standing(places, counts(), moved_of, stood_of)
    moved = [is_gone & ~stay for is_gone, stay in zip(moved_of, stays, strict=True)]
    if is_sharp:
        stamps = np.array([seen.stamp for seen in observations])
        near = _either(near_movers(objects, listed, segments, stamps, settings.grow_m), moved_of)
        of_mover, without, occupied = presence(places, of_places, near)
        is_large = _of_voxels(unusually_large(objects, listed), segments)
        moved = [
            gone & ~(large & stays) | comes
            for gone, large, stays, comes in zip(moved, is_large, occupied, of_mover, strict=True)
        ]
        stands = _either((is_occupied(*counted) for counted in counts()), without)
    else:
        stands = [of_scan.number >= 0 for of_scan in segments]
    listed = with_cover(listed, segments, [seen.seen for seen in observations], _of_voxels(gone, segments))
    objects = with_next_parts(objects, listed, settings.segment_eps_m)
    first_seen_here = tuple(
        _with_track(one, listed) for one in objects if listed[one.segments[0]].scan < count
    )
    return Decision(moved[:count], stands[:count], first_seen_here, is_sharp)


def _told_by_others(
    observations: Sequence[Observation],
    places: Sequence[NDArray[np.int32]],
    before: Keyframes | None,
    settings: MotionSettings,
) -> tuple[NDArray[np.int32], bool]:
    """Hits and misses of every place (2, p), with a margin as wide as the poses need; whether these are sharp."""
    counts = _observations_by_others(observations, places, before, settings, SHARP_RATIO)
    of_segments = np.concatenate(
        [
            seen.segments.sums_of(counts.take(place, axis=1))
            for seen, place in zip(observations, places, strict=True)
        ],
        axis=1,
    )
    if are_sharp(counts, places) or stand_still(of_segments):
        return counts, True
    return _observations_by_others(observations, places, before, settings, WIDE_RATIO), False


def _stood_of(
    stood: NDArray[np.bool_], segments: Sequence[Segments], counts: Iterable[NDArray[np.int32]]
) -> Iterator[NDArray[np.integer]]:
    """For each scan, for its voxels (v,): 2 in a segment that `stood` (s,), 1 for others that stand; see `standing`."""
    return (
        np.int8(2) * whole + ((of_scan.number < 0) & is_occupied(*counted))
        for whole, of_scan, counted in zip(_of_voxels(stood, segments), segments, counts, strict=True)
    )


def _gone(objects: Sequence[TrackedObject], count: int) -> NDArray[np.bool_]:
    """Which of so many segments (s,) are of objects that moved."""
    gone = np.zeros(count, np.bool_)
    for one in objects:
        gone[list(one.segments)] = one.motion in GONE
    return gone


def _parted(
    segments: Segments,
    hits: NDArray[np.int32],
    misses: NDArray[np.int32],
    settings: MotionSettings,
    is_sharp: bool,
) -> tuple[Segments, NDArray[np.bool_]]:
    """The segments of a scan, taken apart by hits and misses of their voxels (v,), and which voxels moved (v,)."""
    eps_m = settings.segment_eps_m
    parted = split_segments(segments, hits, misses, eps_m, settings.displaced_misses_per_hit)
    if not is_sharp:
        return parted, np.zeros(len(segments.keys), np.bool_)
    groups = free_groups(parted, hits, misses, eps_m)
    return with_free_groups(parted, groups), groups >= 0


def _counted_in(
    observations: Sequence[Observation],
    listed: Sequence[Segment],
    segments: Sequence[Segments],
    settings: MotionSettings,
    number: int,
    scans: Sequence[int],
) -> tuple[float, float]:
    """Hits and misses of the points of a segment in some of these scans."""
    scan = listed[number].scan
    first = sum(len(of_scan.truncated) for of_scan in segments[:scan])
    mine = np.flatnonzero(segments[scan].number == number - first)
    points = segments[scan].parts.points[mine]
    some = [observations[k].seen for k in scans[:: len(scans) // ASKED_SCANS + 1]]
    if not some:
        return 0.0, 0.0
    means = segments[scan].parts.sums[mine] / points[:, None]
    hits, misses = hits_and_misses(means, KeyframeScans.of(some), settings.farthest_m, SHARP_RATIO) @ points
    return float(hits), float(misses)


def _with_track(one: TrackedObject, listed: Sequence[Segment]) -> TrackedObject:
    """An object that moved, with its track."""
    if one.motion not in GONE:
        return one
    return replace(one, track=track_of([listed[n] for n in one.segments], BODY_HEIGHT_M))


def _either(
    some: Iterable[NDArray[np.bool_]], others: Iterable[NDArray[np.bool_]]
) -> list[NDArray[np.bool_]]:
    """For each scan, the voxels (v,) that are in one of two sets."""
    return [one | other for one, other in zip(some, others, strict=True)]


def _of_voxels(of_segments: NDArray[np.bool_], segments: Sequence[Segments]) -> Iterator[NDArray[np.bool_]]:
    """For each scan, for its voxels (v,) what is true of their segments (s,), which are those of all scans."""
    ends = np.cumsum([len(of_scan.truncated) for of_scan in segments])[:-1]
    parts = zip(np.split(of_segments, ends), segments, strict=True)
    return (np.append(part, False)[of_scan.number] for part, of_scan in parts)


def _check_order(observations: Sequence[Observation]) -> None:
    for one, after in pairwise(observations):
        if after.stamp <= one.stamp:
            raise DataError(
                f"scan {after.number} at {after.stamp:.3f} s follows one at {one.stamp:.3f} s;"
                " give scans in time order, each once"
            )


def _places(observations: Sequence[Observation]) -> list[NDArray[np.int32]]:
    """For each scan the numbers of its voxels (v,), the same in all scans."""
    keys = [seen.segments.keys for seen in observations]
    _, place = distinct(np.concatenate(keys))
    return np.split(place, np.cumsum([len(of_scan) for of_scan in keys])[:-1])


def _observations_by_others(
    observations: Sequence[Observation],
    places: Sequence[NDArray[np.int32]],
    before: Keyframes | None,
    settings: MotionSettings,
    margin_ratio: float,
) -> NDArray[np.int32]:
    """Hits and misses of every place (2, p) by the scans other than the one that found it.

    A place that no scan is near is told by those that are as far from it as objects are sought.
    """
    count = 1 + max(int(place.max(initial=-1)) for place in places)
    points, centroids = np.zeros(count), np.zeros((count, 3))
    for seen, place in zip(observations, places, strict=True):  # side by side, all of a chunk take 60 MB
        _add(seen.segments.parts.points, seen.segments.parts.sums, place, points, centroids)
    centroids /= points[:, None]
    order = spatial_order(centroids)
    centroids, counts = centroids[order], np.zeros((2, count), np.int32)
    for farthest_m in (settings.farthest_m, settings.farthest_object_m):
        found = np.zeros((2, len(order)), np.int32)
        for some in chain(() if before is None else before.parts(), _parts(observations)):
            found += hits_and_misses(centroids, some, farthest_m, margin_ratio)
        counts[:, order] = found
        unseen = ~found.any(axis=0)
        order, centroids = order[unseen], centroids[unseen]
    counts[0] = np.maximum(counts[0] - 1, 0)  # less the scan that found it
    return counts


@njit(cache=True, nogil=True)
def _add(
    points: NDArray[np.int32], sums: Array, row: NDArray[np.int32], all_points: Array, all_sums: Array
) -> None:
    for i in range(len(row)):
        all_points[row[i]] += points[i]
        for axis in range(3):
            all_sums[row[i], axis] += sums[i, axis]


def _parts(observations: Sequence[Observation]) -> Iterator[KeyframeScans]:
    """The scans, some at a time: side by side, all images of a chunk would add 75 MB to the peak of a run."""
    for start in range(0, len(observations), SCANS_PER_PART):
        yield KeyframeScans.of([one.seen for one in observations[start : start + SCANS_PER_PART]])


def _all_segments(observations: Sequence[Observation], segments: list[Segments]) -> list[Segment]:
    """The segments of all scans in time order."""
    listed: list[Segment] = []
    for scan, (seen, of_scan) in enumerate(zip(observations, segments, strict=True)):
        whole = of_scan.whole
        centroids = whole.sums[:, :2] / whole.points[:, None]
        levels = of_scan.levels()
        seen_from = np.asarray(np.linalg.inv(seen.seen.T_lidar_map)[:2, 3], np.float64)
        for number, truncated in enumerate(of_scan.truncated.tolist()):
            listed.append(
                Segment(
                    scan=scan,
                    stamp=seen.stamp,
                    centroid=centroids[number],
                    points=int(whole.points[number]),
                    shown=bool(whole.labelled[number]),
                    truncated=truncated,
                    outline=partial(of_scan.outline, number),
                    seen_from=seen_from,
                    levels=levels[number],
                    labelled=int(whole.labelled[number]),
                    delays=seen.delays,
                )
            )
    return listed


def moved_points(
    near: NearPoints, moved: NDArray[np.bool_], stands: NDArray[np.bool_], reach_m: float
) -> NDArray[np.bool_]:
    """Which of the points (h,) have moved: those of `moved` voxels (v,), body points near them, foot points below.

    Points of voxels that stand (v,) are not taken for those of what moves near them.
    """
    gone = np.append(moved, False).take(near.voxel)
    if not gone.any() or reach_m == 0:
        return gone
    beside = near.is_body & ~(gone | np.append(stands, False).take(near.voxel))
    grown = gone | closer_than(near.p_near, gone, beside, reach_m)
    return grown | closer_than(near.p_near[:, :2], grown, ~near.is_body, FOOT_REACH_M)

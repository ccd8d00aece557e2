"""Motion state of tracked objects: parked, moving, stopped and left, or unknown, with its probability and reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial import cKDTree
from scipy.special import betaincc

from gnss_sem_map.dynamics.object_track import ObjectTrack
from gnss_sem_map.dynamics.own_motion import OwnMotion, motion_of
from gnss_sem_map.dynamics.range_images import FARTHEST_M
from gnss_sem_map.dynamics.seen_through import PERSON_M
from gnss_sem_map.dynamics.standing import LARGEST_MISSES_PER_HIT, is_occupied
from gnss_sem_map.dynamics.tracking import Segment, track

LEAST_TRACKED_POINTS = 5
"""Smaller segments are not tracked; each is classified on its own."""
MISSES_OF_ONE_SEGMENT = 20
"""A segment with more misses than this, and twice as many misses as hits, has moved, whatever its track says."""
LENGTH_M = 5.0
"""Length of a car: what is seen of an object may be shorter."""
FARTHEST_APART_M = 1.5
"""Places of a track that are farther from its median position than this are elsewhere, or than a quarter of its way."""
STANDING_MISSES_PER_HIT = 0.15
"""What stands has at most so many misses per hit."""
STANDING_SHARE, STANDING_MARGIN = 0.8, 3.0
"""With blurred poses, what stands has at most so many times the misses per hit that this share of the tracks that go
nowhere have at most: the rest may be of what moves."""
WIDEST_M = 3.5
"""Wider than a vehicle, across its course: several things that stand, of which scans see now these and now those."""
ASKED_PLACES = 8
"""So many segments at either end of a track tell whether it was free while the object was elsewhere."""
SIZE_RATIO, SIZE_MARGIN_M, FREE_SHARE = 1.5, 0.5, 0.2
"""A segment that is larger than SIZE_RATIO times the usual size of its track, and SIZE_MARGIN_M, is not of the person
alone. A track is of a person if at least FREE_SHARE of its segments are mostly seen through, and most of these are no
longer than PERSON_M: a car that waits shows its side."""


class Motion(StrEnum):
    """Motion state of an object."""

    PARKED = "parked"
    MOVING = "moving"
    STOPPED_AND_LEFT = "stopped and left"
    UNKNOWN = "unknown"
    UNSUPPORTED = "unsupported"
    """Not a vehicle: its voxels take their second-best class."""


GONE = (Motion.MOVING, Motion.STOPPED_AND_LEFT)

CountedIn = Callable[[int, list[int]], tuple[float, float]]
"""Hits and misses of the points of a segment, by its number, in some scans."""


class MotionSettings(BaseModel):
    """Thresholds of the search for moving objects."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enabled: bool = Field(
        default=True, description="Whether moving objects are sought and left out of the map."
    )
    segment_eps_m: float = Field(default=0.7, gt=0, le=3, description="DBSCAN distance of segments, m.")
    gate_m: float = Field(
        default=1.5, gt=0, description="Tracking gate: largest distance to the prediction, m."
    )
    misses_per_hit: float = Field(
        default=1.0,
        gt=0,
        description="An object has moved if its points have more misses per hit than this,",
    )
    sharp_misses_per_hit: float = Field(
        default=0.3,
        gt=0,
        description="or than this, if the scans show that poses blur static objects little.",
    )
    displaced_misses_per_hit: float = Field(
        default=0.25,
        ge=0,
        description="An object that went elsewhere has moved if its points there have more misses per hit than this.",
    )
    farthest_m: float = Field(
        default=40.0,
        gt=0,
        le=FARTHEST_M,
        description="Scans farther than this are evidence only where no nearer one looks, m.",
    )
    window_scans: int = Field(
        default=150,
        ge=1,
        description="A scan is decided with so many scans before and after it; two such windows are mapped, and"
        " saved for --resume, at a time.",
    )
    farthest_object_m: float = Field(
        default=80.0, gt=0, le=FARTHEST_M, description="Largest range of objects, m."
    )
    grow_m: float = Field(
        default=0.35, ge=0, description="Points above ground this close to a moving segment belong to it, m."
    )


@dataclass(frozen=True, eq=False)
class TrackedObject:
    """One object over time, with its motion state."""

    motion: Motion
    probability: float
    """Probability that it moved."""
    displaced: bool
    """Its displacement was measured."""
    reason: str
    segments: tuple[int, ...]
    """Indices in the list of all segments."""
    points: int
    first_stamp: float
    last_stamp: float
    path: NDArray[np.float64]
    """(s, 2) m: the centroids of its segments, in time order."""
    track: ObjectTrack | None = None
    """Where its middle was, if it moved and was seen in some scans."""
    lidar: str = ""
    """Name of the LiDAR; empty where the drive has but one."""
    chunk: int = 0
    """Number of the chunk of scans in which it was found."""


@dataclass(frozen=True)
class _Free:
    """Misses per hit of what is free."""

    misses_per_hit: float
    """The least, of all places of an object."""
    of_displaced: float
    """The least, of a place that it left or came into, wholly."""
    of_standing: float
    """The most that what stands has."""


def classify_motion(
    segments: list[Segment],
    hits: NDArray[np.float64],
    misses: NDArray[np.float64],
    settings: MotionSettings,
    is_sharp: bool = False,
    counted_in: CountedIn | None = None,
) -> list[TrackedObject]:
    """Track the segments and give every object its motion state.

    `hits` and `misses` (s,) count how often other scans hit the points of a segment and how often they saw through
    them. `is_sharp`: the poses blur static objects little. Then what stands has 0.00 to 0.15 misses per hit, labels
    or not, a car that creeps for a third of its length 0.4, and what drives on more than 1 (three simulated drives,
    KITTI 0005); without sharp poses parked cars reach more than 1, and what no image shows must have gone elsewhere.
    `counted_in` tells, with sharp poses, whether the place of an object was free while the object was elsewhere.

    This takes the place of eq. 13, which calls long and dense clusters of the map moving vehicles.
    """
    misses_per_hit = settings.sharp_misses_per_hit if is_sharp else settings.misses_per_hit
    large = [n for n, segment in enumerate(segments) if segment.points >= LEAST_TRACKED_POINTS]
    alone = [n for n, segment in enumerate(segments) if segment.points < LEAST_TRACKED_POINTS]
    objects = []
    mostly_free = (misses > settings.misses_per_hit * hits)[large]
    tracks = track([segments[n] for n in large], settings.gate_m, mostly_free)
    listed = [[large[place] for place in one.segments] for one in tracks]
    own = [motion_of([segments[n] for n in members]) for members in listed]
    stands = LARGEST_MISSES_PER_HIT if is_sharp else _of_what_stands(listed, own, hits, misses)
    displaced = settings.displaced_misses_per_hit * misses_per_hit
    free = _Free(misses_per_hit, displaced, min(stands, misses_per_hit))
    of_shown = free if is_sharp else replace(free, of_standing=0.0)
    for members, moved in zip(listed, own, strict=True):
        is_shown = any(segments[n].shown for n in members)
        whole = _motion_of_track(
            members, segments, hits, misses, moved, of_shown if is_shown else free, counted_in
        )
        if not (is_shown or is_sharp or whole.displaced):
            continue
        beside = _beside(members, segments, hits, misses)
        if not whole.displaced:  # else it may have come to stand there
            beside = sorted({*beside, *(n for n in members if is_occupied(hits[n], misses[n]))})
        if whole.motion in GONE and beside:
            objects.append(
                _tracked_object(beside, segments, Motion.PARKED, 0.0, "beside something that moved")
            )
            members = [n for n in members if n not in beside]
            whole = _tracked_object(
                members, segments, whole.motion, whole.probability, whole.reason, whole.displaced
            )
        gone = [n for n in members if misses[n] > max(2 * hits[n], MISSES_OF_ONE_SEGMENT)]
        if whole.motion in GONE or not gone:
            if whole.motion in GONE or is_shown:
                objects.append(whole)
            continue
        alone += gone
        if rest := [n for n in members if n not in set(gone)]:
            objects.append(_tracked_object(rest, segments, whole.motion, whole.probability, whole.reason))
    return [*objects, *(_motion_of_segment(n, segments, hits, misses) for n in alone)]


def _of_what_stands(
    tracks: Sequence[list[int]],
    own: Sequence[OwnMotion | None],
    hits: NDArray[np.float64],
    misses: NDArray[np.float64],
) -> float:
    """Misses per hit that what stands has at most, by the tracks that go nowhere: blurred poses see through it, too."""
    stay = [members for members, moved in zip(tracks, own, strict=True) if moved and not moved.is_moving]
    if not stay:
        return np.inf
    ratios = [misses[members].sum() / max(hits[members].sum(), 1.0) for members in stay]
    return STANDING_MARGIN * float(np.quantile(ratios, STANDING_SHARE))


def _motion_of_segment(
    n: int, segments: list[Segment], hits: NDArray[np.float64], misses: NDArray[np.float64]
) -> TrackedObject:
    """Motion state of a segment by itself, without a track."""
    probability = _probability(misses[n], hits[n])
    motion = Motion.MOVING if probability > 0.5 else Motion.UNKNOWN
    reason = f"one scan only: seen through {misses[n]:,.0f} times, hit {hits[n]:,.0f} times"
    return _tracked_object([n], segments, motion, probability, reason)


def _motion_of_track(
    members: list[int],
    segments: list[Segment],
    hits: NDArray[np.float64],
    misses: NDArray[np.float64],
    moved: OwnMotion | None,
    free: _Free,
    counted_in: CountedIn | None,
) -> TrackedObject:
    """Motion state of a track: it went elsewhere, or its volume was free at other times."""
    hit, missed = float(hits[members].sum()), float(misses[members].sum())
    vanished = _probability(missed, free.misses_per_hit * hit)
    displaced = False
    if moved and moved.is_moving:
        # the volume that it left or came into is free at other times, as far as it did not cover it itself
        share = min(1.0, moved.shift_m / max(LENGTH_M, moved.length_m))
        least = max(free.of_displaced * share, free.of_standing)
        displaced = _free_elsewhere(members, segments, hits, misses, moved.shift_m, least)
        displaced &= not bool(is_occupied(hit, missed))
        if not displaced and counted_in is not None and moved.width_m <= WIDEST_M:
            displaced = _free_without(members, segments, moved.shift_m, share, counted_in)
    reason = f"seen through {missed:,.0f} times, hit {hit:,.0f} times"
    if moved and displaced:
        motion = Motion.MOVING
        reason = f"went at least {moved.shift_m:.1f} m, known to {moved.stddev_m:.1f} m, {reason}"
    elif vanished > 0.5:
        stood = moved is not None and not moved.is_moving and hit > 0
        motion = Motion.STOPPED_AND_LEFT if stood else Motion.MOVING
    else:
        motion = Motion.PARKED if hit > 0 else Motion.UNKNOWN
    return _tracked_object(members, segments, motion, max(vanished, float(displaced)), reason, displaced)


def _beside(
    members: list[int], segments: list[Segment], hits: NDArray[np.float64], misses: NDArray[np.float64]
) -> list[int]:
    """Segments of a person's track that are too large: both the person and what is close to it are one cluster."""
    free = [n for n in members if misses[n] > hits[n]]
    if not free or len(free) < FREE_SHARE * len(members):
        return []
    extents = {n: float(np.linalg.norm(np.ptp(segments[n].outline(), axis=0))) for n in members}
    usual = float(np.median([extents[n] for n in free]))
    if usual > PERSON_M:
        return []
    return [n for n in members if misses[n] <= hits[n] and extents[n] > SIZE_RATIO * usual + SIZE_MARGIN_M]


def _free_elsewhere(
    members: list[int],
    segments: list[Segment],
    hits: NDArray[np.float64],
    misses: NDArray[np.float64],
    shift_m: float,
    least: float,
) -> bool:
    """Whether the places of a track away from its median position have more misses per hit than `least`.

    All together, and most of them: where something that moves passes a parked car, both are one segment in some scans.
    Each place counts once, however long the object stood there.
    """
    reach_m = min(shift_m / 4, FARTHEST_APART_M)
    centroids = np.array([segments[n].centroid for n in members])
    away = np.linalg.norm(centroids - np.median(centroids, axis=0), axis=1) > reach_m
    once = 1 / cKDTree(centroids).query_ball_point(centroids[away], reach_m, return_length=True)
    of_track = np.array(members)[away]
    free = misses[of_track] - least * hits[of_track]
    return bool(once @ free > 0 and 2 * once @ (free > 0) > once.sum())


def _free_without(
    members: list[int], segments: list[Segment], shift_m: float, share: float, counted_in: CountedIn
) -> bool:
    """Whether the two places of a track that are farthest apart were free while the object was elsewhere.

    One that comes closer for a short way, and waits, hides the place that it left, and is hit for long where it is. It
    covers all but a `share` of its place also before.
    """
    centroids = np.array([segments[n].centroid for n in members])
    first = np.linalg.norm(centroids - centroids[0], axis=1).argmax()
    last = np.linalg.norm(centroids - centroids[first], axis=1).argmax()
    total = np.zeros(2)
    for end in (first, last):
        off = np.linalg.norm(centroids - centroids[end], axis=1)
        away = [segments[members[k]].scan for k in np.flatnonzero(off > shift_m / 2)]
        near = np.flatnonzero(off < shift_m / 4)
        counted = [counted_in(members[k], away) for k in near[:: len(near) // ASKED_PLACES + 1]]
        total += np.median(counted, axis=0)  # in a few something else is in its segment, too
    hit, missed = total
    return bool(missed > STANDING_MISSES_PER_HIT * hit)


def _probability(misses: float, hits: float) -> float:
    """Probability that a volume is free rather than occupied, after so many misses and hits.

    The share of misses has the posterior Beta(1 + misses, 1 + hits); n observations of one object are correlated and
    count as the square root of n.
    """
    observations = misses + hits
    if observations == 0:
        return 0.0
    discount = observations**-0.5
    return float(betaincc(1 + misses * discount, 1 + hits * discount, 0.5))


def _tracked_object(
    members: list[int],
    segments: list[Segment],
    motion: Motion,
    probability: float,
    reason: str,
    displaced: bool = False,
) -> TrackedObject:
    parts = [segments[n] for n in members]
    return TrackedObject(
        motion=motion,
        probability=probability,
        displaced=displaced,
        reason=reason,
        segments=tuple(members),
        points=sum(part.points for part in parts),
        first_stamp=parts[0].stamp,
        last_stamp=parts[-1].stamp,
        path=np.array([part.centroid for part in parts]),
    )

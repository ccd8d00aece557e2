"""What became of an object: parked, moving, stopped and left, or unknown; how sure, and why."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import betaincc, ndtr

from gnss_sem_map.dynamics.tracking import Segment, displacement_of, track
from gnss_sem_map.dynamics.visibility import VisibilitySettings

LEAST_TRACKED_POINTS = 5
"""Smaller segments are judged on their own."""
SEEN_THROUGH_ALONE = 20
"""A segment seen through more than this, and twice as often as hit, is gone whatever its track says."""
LENGTH_M = 5.0
"""Of a car."""
SHIFT_STDDEV_M = 0.5
"""How well the shift of an object's ends is known."""


class Motion(StrEnum):
    """What became of an object."""

    PARKED = "parked"
    MOVING = "moving"
    STOPPED_AND_LEFT = "stopped and left"
    UNKNOWN = "unknown"
    UNSUPPORTED = "unsupported"
    """No vehicle at all: its voxels fall back to their second-best class."""


GONE = (Motion.MOVING, Motion.STOPPED_AND_LEFT)


class MotionSettings(VisibilitySettings):
    """What speaks for motion, and how much of it is enough."""

    enabled: bool = Field(default=True, description="Whether moving objects are sought before mapping.")
    segment_eps_m: float = Field(default=0.7, gt=0, le=3, description="Points of a segment are this near, m.")
    gate_m: float = Field(default=1.5, gt=0, description="A track goes on this near to its prediction, m.")
    through_per_hit: float = Field(
        default=1.0,
        gt=0,
        description="An object moved when seen through more often than this times hit,",
    )
    matched_through_per_hit: float = Field(
        default=0.4,
        gt=0,
        description="or than this, where scans were matched, so that poses do not blur what stands.",
    )
    least_shift_m: float = Field(default=1.5, gt=0, description="Both ends of a mover went this far, m,")
    least_speed_m_s: float = Field(default=1.0, gt=0, description="and at least this fast, m/s,")
    least_through_per_hit: float = Field(
        default=0.25, ge=0, description="and its track was seen through at least this often, per hit."
    )
    window_scans: int = Field(
        default=150, ge=10, description="A scan is judged when so many later ones were seen, or at the end."
    )
    farthest_object_m: float = Field(default=60.0, gt=0, description="No objects are sought farther away, m.")
    grow_m: float = Field(
        default=0.5, ge=0, description="Points above ground this near to a moving segment are part of it, m."
    )


@dataclass(frozen=True, eq=False)
class TrackedObject:
    """One object through time, and what became of it."""

    motion: Motion
    probability: float
    """That it moved."""
    displaced: bool
    """It was seen to go elsewhere."""
    reason: str
    segments: tuple[int, ...]
    """Places in the list of all segments."""
    points: int
    first_stamp: float
    last_stamp: float
    path: NDArray[np.float64]
    """(s, 2) m: the centroids of its segments, in time order."""


def judge(
    segments: list[Segment],
    hits: NDArray[np.float64],
    throughs: NDArray[np.float64],
    settings: MotionSettings,
    matched: bool = False,
) -> list[TrackedObject]:
    """Every segment as part of an object with a verdict: its track's, or its own where that is plainer.

    `hits` and `throughs` (s,): how often other scans hit the points of a segment, or saw through them. A car ahead that
    creeps on by 0.4 of its length while it is seen is seen through 0.4 times as often as hit, by 0.8 of its length as
    often (measured in the street of the tests). Parked cars reach 0.3 where poses were `matched` by their scans, and
    more than 1 where they were not (six simulated drives, KITTI 0005).
    """
    through_per_hit = settings.matched_through_per_hit if matched else settings.through_per_hit
    large = [n for n, segment in enumerate(segments) if segment.points >= LEAST_TRACKED_POINTS]
    alone = [n for n, segment in enumerate(segments) if segment.points < LEAST_TRACKED_POINTS]
    objects = []
    fleeting = (throughs > settings.through_per_hit * hits)[large]
    for one in track([segments[n] for n in large], settings.gate_m, fleeting):
        members = [large[place] for place in one.segments]
        if not any(segments[n].shown for n in members):
            objects += _nameless(members, segments, hits, throughs, settings)
            continue
        whole = _verdict(members, segments, hits, throughs, settings, through_per_hit)
        gone = [n for n in members if throughs[n] > max(2 * hits[n], SEEN_THROUGH_ALONE)]
        if whole.motion in GONE or not gone:
            objects.append(whole)
            continue
        alone += gone
        if rest := [n for n in members if n not in set(gone)]:
            objects.append(_describe(rest, segments, whole.motion, whole.probability, whole.reason))
    for n in alone:
        probability = _probability(throughs[n], hits[n])
        motion = Motion.MOVING if probability > 0.5 else Motion.UNKNOWN
        reason = f"one scan only: seen through {throughs[n]:.0f} times, hit {hits[n]:.0f} times"
        objects.append(_describe([n], segments, motion, probability, reason))
    return objects


def _verdict(
    members: list[int],
    segments: list[Segment],
    hits: NDArray[np.float64],
    throughs: NDArray[np.float64],
    settings: MotionSettings,
    through_per_hit: float,
) -> TrackedObject:
    """What became of a track: it went elsewhere, or the places where it was were empty at other times."""
    hit, through = float(hits[members].sum()), float(throughs[members].sum())
    vanished = _probability(through, through_per_hit * hit)
    moved = displacement_of([segments[n] for n in members])
    displaced = 0.0
    if moved and moved.speed_m_s > settings.least_speed_m_s and moved.shift_m > 0:
        away = _away(members, segments, settings.least_shift_m)
        # on less than its length it covers its own places: they must be the more often empty
        least = settings.least_through_per_hit * max(1.0, LENGTH_M / moved.shift_m)
        if throughs[away].sum() > least * hits[away].sum():
            displaced = float(ndtr((moved.shift_m - settings.least_shift_m) / SHIFT_STDDEV_M))
    reason = f"seen through {through:.0f} times, hit {hit:.0f} times"
    if moved and displaced > 0.5:
        motion = Motion.MOVING
        reason = f"both ends went {moved.shift_m:.1f} m at {moved.speed_m_s:.1f} m/s, {reason}"
    elif vanished > 0.5:
        stood = moved is not None and moved.speed_m_s < settings.least_speed_m_s and hit > 0
        motion = Motion.STOPPED_AND_LEFT if stood else Motion.MOVING
    else:
        motion = Motion.PARKED if hit > 0 else Motion.UNKNOWN
    return _describe(members, segments, motion, max(vanished, displaced), reason, displaced > 0.5)


def _away(members: list[int], segments: list[Segment], reach_m: float) -> list[int]:
    """The segments of a track that are not where it was most of the time: a mover may have stood there for long."""
    centroids = np.array([segments[n].centroid for n in members])
    distances = np.linalg.norm(centroids - np.median(centroids, axis=0), axis=1)
    return [n for n, distance in zip(members, distances, strict=True) if distance > reach_m]


def _nameless(
    members: list[int],
    segments: list[Segment],
    hits: NDArray[np.float64],
    throughs: NDArray[np.float64],
    settings: MotionSettings,
) -> list[TrackedObject]:
    """A track that no image ever showed: it must have gone elsewhere, and its places been empty at other times."""
    away = _away(members, segments, settings.least_shift_m)
    if throughs[away].sum() <= settings.through_per_hit * hits[away].sum():
        return []
    whole = _verdict(members, segments, hits, throughs, settings, settings.through_per_hit)
    return [whole] if whole.displaced else []


def _probability(through: float, hit: float) -> float:
    """Probability that a place is rather seen through than hit, after so many looks of each kind.

    The share of looks that pass is Beta(1 + t, 1 + h); n looks at one object repeat each other and count as the
    square root of n.
    """
    looks = through + hit
    if looks == 0:
        return 0.0
    discount = looks**-0.5
    return float(betaincc(1 + through * discount, 1 + hit * discount, 0.5))


def _describe(
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

"""Motion state of tracked objects: parked, moving, stopped and left, or unknown, with its probability and reason."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial import cKDTree
from scipy.special import betaincc, ndtr

from gnss_sem_map.dynamics.tracking import Segment, displacement_of, track

LEAST_TRACKED_POINTS = 5
"""Smaller segments are not tracked; each is classified on its own."""
MISSES_OF_ONE_SEGMENT = 20
"""A segment with more misses than this, and twice as many misses as hits, has moved, whatever its track says."""
LENGTH_M = 5.0
"""Length of a car."""
SHIFT_STDDEV_M = 0.5
"""Standard deviation of the measured shift of an object's ends."""


class Motion(StrEnum):
    """Motion state of an object."""

    PARKED = "parked"
    MOVING = "moving"
    STOPPED_AND_LEFT = "stopped and left"
    UNKNOWN = "unknown"
    UNSUPPORTED = "unsupported"
    """Not a vehicle: its voxels take their second-best class."""


GONE = (Motion.MOVING, Motion.STOPPED_AND_LEFT)


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
    lidar_odometry_misses_per_hit: float = Field(
        default=0.4,
        gt=0,
        description="or than this, if the poses come from LiDAR odometry (they blur static objects less).",
    )
    least_shift_m: float = Field(default=1.5, gt=0, description="Displacement: both ends moved this far, m,")
    least_speed_m_s: float = Field(default=1.0, gt=0, description="and at least this fast, m/s,")
    displaced_misses_per_hit: float = Field(
        default=0.25, ge=0, description="and the points of the track have at least so many misses per hit."
    )
    farthest_m: float = Field(default=40.0, gt=0, description="Scans farther than this are no evidence, m.")
    window_scans: int = Field(
        default=150,
        ge=1,
        description="A scan is decided with so many scans before and after it; two such windows are mapped, and"
        " saved for --resume, at a time.",
    )
    farthest_object_m: float = Field(default=60.0, gt=0, description="Largest range of objects, m.")
    grow_m: float = Field(
        default=0.5, ge=0, description="Points above ground this close to a moving segment belong to it, m."
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


def classify_motion(
    segments: list[Segment],
    hits: NDArray[np.float64],
    misses: NDArray[np.float64],
    settings: MotionSettings,
    from_lidar_odometry: bool = False,
) -> list[TrackedObject]:
    """Track the segments and give every object its motion state.

    `hits` and `misses` (s,) count how often other scans hit the points of a segment and how often they saw through
    them. `from_lidar_odometry`: the poses come from LiDAR odometry. A car ahead that moves by 0.4 of its length while
    observed has 0.4 misses per hit, by 0.8 of its length 1.0 (measured in the simulated street of the tests). Parked
    cars reach 0.3 misses per hit with poses from LiDAR odometry, and more than 1 without (six simulated drives, KITTI
    0005).

    This takes the place of eq. 13, which calls long and dense clusters of the map moving vehicles.
    """
    misses_per_hit = (
        settings.lidar_odometry_misses_per_hit if from_lidar_odometry else settings.misses_per_hit
    )
    large = [n for n, segment in enumerate(segments) if segment.points >= LEAST_TRACKED_POINTS]
    alone = [n for n, segment in enumerate(segments) if segment.points < LEAST_TRACKED_POINTS]
    objects = []
    mostly_free = (misses > settings.misses_per_hit * hits)[large]
    for one in track([segments[n] for n in large], settings.gate_m, mostly_free):
        members = [large[place] for place in one.segments]
        if not any(segments[n].shown for n in members):
            objects += _motion_without_labels(members, segments, hits, misses, settings)
            continue
        whole = _motion_of_track(members, segments, hits, misses, settings, misses_per_hit)
        gone = [n for n in members if misses[n] > max(2 * hits[n], MISSES_OF_ONE_SEGMENT)]
        if whole.motion in GONE or not gone:
            objects.append(whole)
            continue
        alone += gone
        if rest := [n for n in members if n not in set(gone)]:
            objects.append(_tracked_object(rest, segments, whole.motion, whole.probability, whole.reason))
    for n in alone:
        probability = _probability(misses[n], hits[n])
        motion = Motion.MOVING if probability > 0.5 else Motion.UNKNOWN
        reason = f"one scan only: seen through {misses[n]:.0f} times, hit {hits[n]:.0f} times"
        objects.append(_tracked_object([n], segments, motion, probability, reason))
    return objects


def _motion_of_track(
    members: list[int],
    segments: list[Segment],
    hits: NDArray[np.float64],
    misses: NDArray[np.float64],
    settings: MotionSettings,
    misses_per_hit: float,
) -> TrackedObject:
    """Motion state of a track: it was displaced, or its volume was free at other times."""
    hit, missed = float(hits[members].sum()), float(misses[members].sum())
    vanished = _probability(missed, misses_per_hit * hit)
    moved = displacement_of([segments[n] for n in members])
    displaced = 0.0
    if moved and moved.speed_m_s > settings.least_speed_m_s and moved.shift_m > 0:
        hit_elsewhere, missed_elsewhere = _elsewhere(members, segments, hits, misses, settings.least_shift_m)
        # an object that moved less than its length hides the volume where it was: it must be free more often
        least = settings.displaced_misses_per_hit * max(1.0, LENGTH_M / moved.shift_m)
        if missed_elsewhere > least * hit_elsewhere:
            displaced = float(ndtr((moved.shift_m - settings.least_shift_m) / SHIFT_STDDEV_M))
    reason = f"seen through {missed:.0f} times, hit {hit:.0f} times"
    if moved and displaced > 0.5:
        motion = Motion.MOVING
        reason = f"both ends moved {moved.shift_m:.1f} m at {moved.speed_m_s:.1f} m/s, {reason}"
    elif vanished > 0.5:
        stood = moved is not None and moved.speed_m_s < settings.least_speed_m_s and hit > 0
        motion = Motion.STOPPED_AND_LEFT if stood else Motion.MOVING
    else:
        motion = Motion.PARKED if hit > 0 else Motion.UNKNOWN
    return _tracked_object(members, segments, motion, max(vanished, displaced), reason, displaced > 0.5)


def _elsewhere(
    members: list[int],
    segments: list[Segment],
    hits: NDArray[np.float64],
    misses: NDArray[np.float64],
    reach_m: float,
) -> tuple[float, float]:
    """Hits and misses of a track away from its median position, each place once however long the object stood there."""
    centroids = np.array([segments[n].centroid for n in members])
    away = np.linalg.norm(centroids - np.median(centroids, axis=0), axis=1) > reach_m
    tree = cKDTree(centroids)
    once = 1 / tree.query_ball_point(centroids[away], reach_m, return_length=True)
    of_track = np.array(members)[away]
    return float(once @ hits[of_track]), float(once @ misses[of_track])


def _motion_without_labels(
    members: list[int],
    segments: list[Segment],
    hits: NDArray[np.float64],
    misses: NDArray[np.float64],
    settings: MotionSettings,
) -> list[TrackedObject]:
    """Motion state of a track without vehicle labels: it must be displaced, and its volume free at other times."""
    hit, missed = _elsewhere(members, segments, hits, misses, settings.least_shift_m)
    if missed <= settings.misses_per_hit * hit:
        return []
    whole = _motion_of_track(members, segments, hits, misses, settings, settings.misses_per_hit)
    return [whole] if whole.displaced else []


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

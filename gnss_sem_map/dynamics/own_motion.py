"""Own motion of a track: how far the object went, tested against the hypothesis that it stands.

What a scan sees of an object is a part of it. The part changes with the view: a parked car that is passed shows its
rear, then its side, then its front. The end that faces the LiDAR is exact as long as the LiDAR stays on that side, so
an object is placed by its near end and by its length, which is the greatest extent of the track. Where the near end
changes, an object that shows too little of itself may seem to move by what its length is unknown by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from gnss_sem_map.dynamics.object_track import CAR_M, EDGE_STDDEV_M, EDGE_STDDEV_RATIO, by_near_side
from gnss_sem_map.dynamics.tracking import Segment

SIGNIFICANT = 5.0
"""A shift of so many standard deviations is no chance, in thousands of tracks."""
LEAST_SCANS, LEAST_SHIFT_M = 4, 0.5
SMOOTHED = 5
"""Scans in the running median of positions."""
STEADY_SHARE = 0.6
"""What moves goes on: its shift is at least this share of its way, to and fro."""
HIDDEN_SHARE = 0.1
"""What is abeam, and hidden by more than this share of its length at each end, has no place."""
LARGEST_STEP_SHARE = 0.6
GROWTH_SHARE = 0.5
"""A step from one scan to the next that is a larger share of the shift is an error of the clusters. So is one over as
many scans as are smoothed, in which the extent changes by more than GROWTH_SHARE of it: a cluster that grows by what
stands beside it."""


@dataclass(frozen=True, eq=False)
class OwnMotion:
    """How an object moved along its course."""

    shift_m: float
    """Distance between the two places that are farthest apart, less what may be a change of the view."""
    stddev_m: float
    """Its standard deviation."""
    is_steady: bool
    """It went on in one direction, and not at one jump."""
    length_m: float
    """The greatest extent of the object along its course."""
    width_m: float = 0.0
    """What it usually shows across its course."""

    @property
    def is_moving(self) -> bool:
        """Whether the hypothesis that it stands is refuted."""
        return self.is_steady and self.shift_m > max(LEAST_SHIFT_M, SIGNIFICANT * self.stddev_m)


def own_motion(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    lidar: NDArray[np.float64],
    ranges: NDArray[np.float64],
) -> OwnMotion | None:
    """Motion of a track along its course; None for one of few scans.

    `low`, `high` and `lidar` (k,) m are the ends of what was seen of the object, and the LiDAR, along the course;
    `ranges` (k,) m the distance between them.
    """
    if len(low) < LEAST_SCANS:
        return None
    noise = scatter((low + high) / 2)
    low, high = (median_filter(side, SMOOTHED, mode="nearest") for side in (low, high))
    length = float(np.quantile(high - low, 0.9))
    centre, side, hidden = by_near_side(low, high, lidar, length)
    placed = np.flatnonzero((side != 0) | (hidden < HIDDEN_SHARE * length))
    if len(placed) < LEAST_SCANS:
        return None
    centre, side, hidden, ranges = centre[placed], side[placed], hidden[placed], ranges[placed]
    start, end = np.sort([centre.argmin(), centre.argmax()])
    shift = centre[end] - centre[start]
    # a vehicle that showed less of its length may be as long as a car
    unknown = max(CAR_M - length, 0.0) / 2 * abs(side[start] - side[end])
    unknown += sum(hidden[k] for k in (start, end) if side[k] == 0)
    known = np.maximum(EDGE_STDDEV_M + EDGE_STDDEV_RATIO * ranges[[start, end]], noise)
    stddev = float(np.hypot(*known))
    steps = np.diff(centre[start : end + 1])
    way, largest = abs(steps).sum(), abs(steps).max(initial=0.0)
    largest = max(largest, _growth(centre[start : end + 1], (high - low)[placed][start : end + 1]))
    is_steady = bool(abs(shift) > STEADY_SHARE * way and largest < LARGEST_STEP_SHARE * abs(shift))
    return OwnMotion(max(abs(float(shift)) - float(unknown), 0.0), stddev, is_steady, length)


def _growth(centre: NDArray[np.float64], extent: NDArray[np.float64]) -> float:
    """The largest change of centres (k,) m over some scans in which the extents (k,) m change by as much."""
    if len(centre) <= SMOOTHED:
        return 0.0
    steps, grown = (abs(values[SMOOTHED:] - values[:-SMOOTHED]) for values in (centre, extent))
    return float(np.where(grown > GROWTH_SHARE * steps, steps, 0.0).max())


def scatter(values: NDArray[np.float64]) -> float:
    """Standard deviation of values (k,) about their running median, by the median of the deviations."""
    return float(1.4826 * np.median(abs(values - median_filter(values, SMOOTHED, mode="nearest"))))


def motion_of(segments: Sequence[Segment]) -> OwnMotion | None:
    """Motion of a track, along the line between the two places where its centroids are farthest apart.

    What the edge of the view cuts off, or something nearer hides in part, is left out.
    """
    whole = [one for one in segments if not one.truncated]
    if len(whole) < LEAST_SCANS:
        return None
    centroids = median_filter(np.array([one.centroid for one in whole]), (SMOOTHED, 1), mode="nearest")
    way = centroids - centroids[0]
    far = centroids[np.linalg.norm(way, axis=1).argmax()]
    way = centroids - far
    along = way[np.linalg.norm(way, axis=1).argmax()]
    length = float(np.linalg.norm(along))
    along = -along / length if length else np.array([1.0, 0.0])
    across = np.array([-along[1], along[0]])
    outlines = [one.outline() for one in whole]
    ends = np.array([(values.min(), values.max()) for seen in outlines for values in [seen @ along]])
    width = float(np.median([np.ptp(seen @ across) for seen in outlines]))
    lidar = np.array([one.seen_from @ along for one in whole])
    ranges = np.array([np.linalg.norm(one.centroid - one.seen_from) for one in whole])
    found = own_motion(ends[:, 0], ends[:, 1], lidar, ranges)
    return None if found is None else replace(found, width_m=width)

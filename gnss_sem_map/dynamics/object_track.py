"""Track of an object: where its middle was, scan by scan, how well that is known, and its size.

A scan sees a part of an object, and the part changes with the view, so the mean of its points moves along the object.
The side that faces the LiDAR is seen well: along and across its course, an object is placed by that side and by its
size, which is the greatest extent of its track. What is hidden in part, or cut off by the edge of an image, is known
to what is missing of the size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from gnss_sem_map.dynamics.sweep_delays import SweepDelays, delays_towards
from gnss_sem_map.dynamics.tracking import Segment

Array = NDArray[np.float64]

EDGE_STDDEV_M, EDGE_STDDEV_RATIO = 0.08, 0.005
"""A side of an object is known to this, plus this share of the range: spacing of the beams, and poses."""
HIDDEN_STDDEV_M = 0.3
"""What is hidden in part or cut off may end this much farther, beside what is missing of its size."""
SMALL_M, CAR_M, LORRY_M = 2.3, 4.5, 12.0
"""Smaller objects, people and cyclists, have no sides that are seen well: the mean of what is seen is their place. A
larger one that is hidden in part may be as long as a car, and one that was never seen whole as long as a lorry."""
LOW_M = 1.0
"""People and cyclists are higher: what is as small as they are, and lower, is part of something larger."""
WHOLE_SCANS = 3
"""Scans in which an object is seen whole, that tell its size."""
VELOCITY_SCANS = 5
"""Scans before and after that tell how an object moves while a sweep meets it."""
CUT_SCANS = 5
"""Scans before and after one in which it is hidden or cut off, which may show less than they seem to."""
SAME_VIEW_SCANS = 10
"""What is not seen of an object is the same in so many scans, so they are no better than one."""
GRANULE_M = 0.05
"""So much farther than the outermost mean of the points of a voxel of 0.2 m an object goes on, on average."""
COURSE_M, COURSE_SCANS = 3.0, (2, 5, 10, 20, 50)
"""A course is that of the fewest scans before and after within which an object goes so far."""
SIZE_QUANTILE = 0.9
FEWEST = 5
"""Scans of a track."""


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """Where an object was."""

    stamps: Array
    """(k,) s: when it was seen, which is within the sweeps."""
    positions: Array
    """(k, 3) m: its middle, east and north, and the lowest of what was seen of it."""
    variances: Array
    """(k, 2) m2 of east and north."""
    size_m: tuple[float, float, float]
    """Length along its course, width, and height over the ground."""
    labelled: float
    """Share of its points that an image labels as movable."""
    points: NDArray[np.int64]
    """(k,) points of each scan."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON; `from_dict` reads it back."""
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in vars(self).items()
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> ObjectTrack:
        """What `as_dict` says."""
        arrays = {name: np.array(content[name], np.float64) for name in ("stamps", "positions", "variances")}
        points = np.array(content["points"], np.int64)
        return cls(**{**content, **arrays, "size_m": tuple(content["size_m"]), "points": points})


def track_of(segments: Sequence[Segment], foot_m: float = 0.0) -> ObjectTrack | None:
    """The track of an object by its segments, at most one per scan, in time order; None for one of few scans.

    The lowest that is seen of an object is so high over the ground: `foot_m`.
    """
    if len(segments) < FEWEST:
        return None
    centroids = np.array([one.centroid for one in segments], np.float64)
    scans = np.array([one.stamp for one in segments])
    outline = _Outline.of(segments)
    stamps = scans + outline.delay
    outline = outline.at_one_moment(velocities(scans, centroids))
    along = courses(centroids)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    lidar = np.array([one.seen_from for one in segments]) - centroids
    ranges = np.linalg.norm(lidar, axis=1)
    is_cut = np.array([one.truncated or one.is_covered for one in segments], np.bool_)
    edge = EDGE_STDDEV_M + EDGE_STDDEV_RATIO * ranges
    middle, variances = centroids.copy(), np.zeros_like(centroids)
    ends = [outline.extents(centroids, axis) for axis in (along, across)]
    size = [_size(high - low, is_cut) for low, high in ends]
    levels = np.array([one.levels for one in segments])
    height = foot_m + _height(levels, is_cut) + GRANULE_M
    is_cut |= size[0] < SMALL_M and size[1] < SMALL_M / 2 and height < LOW_M
    may_be_cut = binary_dilation(is_cut, iterations=CUT_SCANS)  # what hides it comes and goes by and by
    for axis, (low, high), extent in zip((along, across), ends, size, strict=True):
        shift, stddev = _middle(low, high, (lidar * axis).sum(axis=1), may_be_cut, edge, extent)
        if max(size) > SMALL_M:
            middle += shift[:, None] * axis
        variances += stddev[:, None] ** 2 * axis**2
    points = np.array([one.points for one in segments], np.int64)
    return ObjectTrack(
        stamps,
        np.column_stack([middle, levels[:, 0] - foot_m]),
        variances,
        (size[0], size[1], height),
        sum(one.labelled for one in segments) / int(points.sum()),
        points,
    )


def courses(places: Array) -> Array:
    """Unit vectors (k, 2) along the way of places (k, 2) m, each of as few scans as show one."""
    k = np.arange(len(places))
    found = np.tile(_longest_way(places), (len(places), 1))
    is_open = np.ones(len(places), np.bool_)
    for scans in COURSE_SCANS:
        way = places[np.minimum(k + scans, k[-1])] - places[np.maximum(k - scans, 0)]
        far = is_open & (np.linalg.norm(way, axis=1) > COURSE_M)
        found[far] = way[far]
        is_open &= ~far
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _longest_way(places: Array) -> Array:
    """From the earlier to the later of two places that are far apart."""
    far = np.linalg.norm(places - places[0], axis=1).argmax()
    other = np.linalg.norm(places - places[far], axis=1).argmax()
    way: Array = places[max(far, other)] - places[min(far, other)]
    return way if way.any() else np.array([1.0, 0.0])


def velocities(stamps: Array, places: Array) -> Array:
    """Velocities (k, 2) m/s of places (k, 2) m over some scans before and after."""
    k = np.arange(len(stamps))
    after, before = np.minimum(k + VELOCITY_SCANS, k[-1]), np.maximum(k - VELOCITY_SCANS, 0)
    return np.asarray((places[after] - places[before]) / (stamps[after] - stamps[before])[:, None])


@dataclass(frozen=True, eq=False)
class _Outline:
    """What all scans show of an object: points (p, 2) m, scan after scan."""

    points: Array
    counts: NDArray[np.int64]
    """(k,) points of each scan."""
    delays: Array
    """(p,) s: when the sweep met each, after the stamp."""

    @classmethod
    def of(cls, segments: Sequence[Segment]) -> _Outline:
        outlines = [one.outline() for one in segments]
        points, counts = np.concatenate(outlines).astype(np.float64), np.array(list(map(len, outlines)))
        ways = points - np.repeat([one.seen_from for one in segments], counts, axis=0)
        none = SweepDelays.none()
        profiles = [one.delays or none for one in segments]
        return cls(points, counts, delays_towards(ways, profiles, counts))

    @property
    def delay(self) -> Array:
        """(k,) s: that of an object, the mean of its points."""
        return np.asarray(np.add.reduceat(self.delays, self._starts) / self.counts)

    def at_one_moment(self, velocities: Array) -> _Outline:
        """The points of an object that moves so (k, 2) m/s, where they were at its mean time."""
        late = self.delays - np.repeat(self.delay, self.counts)
        return replace(self, points=self.points - late[:, None] * np.repeat(velocities, self.counts, axis=0))

    def extents(self, origins: Array, axis: Array) -> tuple[Array, Array]:
        """Where an object begins and ends (k,) m along its axis (k, 2), from its origin (k, 2)."""
        off = self.points - np.repeat(origins, self.counts, axis=0)
        at = (off * np.repeat(axis, self.counts, axis=0)).sum(axis=1)
        return (
            np.asarray(np.minimum.reduceat(at, self._starts) - GRANULE_M),
            np.asarray(np.maximum.reduceat(at, self._starts) + GRANULE_M),
        )

    @property
    def _starts(self) -> NDArray[np.int64]:
        return np.asarray(np.cumsum(self.counts) - self.counts)


def _size(seen: Array, is_cut: NDArray[np.bool_]) -> float:
    """Extent of an object of which so much is seen, (k,) m, in some scans not all: then it is no less."""
    whole = seen[~is_cut] if not is_cut.all() else seen
    return float(max(np.quantile(whole, SIZE_QUANTILE), np.quantile(seen, SIZE_QUANTILE)))


def _height(levels: Array, is_cut: NDArray[np.bool_]) -> float:
    """Of an object between these levels (k, 2) m: it is seen best where it is not cut off."""
    whole = levels[~is_cut] if not is_cut.all() else levels
    return float(np.quantile(whole[:, 1] - whole[:, 0], SIZE_QUANTILE))


def by_near_side(
    low: Array, high: Array, lidar: Array, extent: float
) -> tuple[Array, NDArray[np.int64], Array]:
    """Middle (k,) m of an object of this extent along an axis, by its side that faces the LiDAR, and how it is found.

    `low`, `high` and `lidar` (k,) m are the ends of what is seen, and the LiDAR. Beside the middle: which side is seen
    (k,), 1 the lower one, -1 the higher one, 0 neither, and half of what is hidden (k,) m.
    """
    hidden = np.maximum(extent - (high - low), 0.0) / 2
    side = np.where(lidar < low, 1, np.where(lidar > high, -1, 0))
    return (low + high) / 2 + side * hidden, side, hidden


def _middle(
    low: Array, high: Array, lidar: Array, is_cut: NDArray[np.bool_], edge: Array, extent: float
) -> tuple[Array, Array]:
    """Middle of an object along an axis (k,), and its standard deviation (k,).

    `low` and `high` (k,) m are the ends of what is seen, `lidar` (k,) m where the LiDAR is.
    """
    seen = high - low
    middle, _, hidden = by_near_side(low, high, lidar, extent)
    vehicle = CAR_M if (~is_cut).sum() >= WHOLE_SCANS else LORRY_M
    possible = max(extent, vehicle) if extent > SMALL_M / 2 else extent
    of_cut = np.maximum(possible - seen, 0.0) / 2 + HIDDEN_STDDEV_M
    is_abeam = (lidar > high - extent) & (lidar < low + extent)  # what is not seen may be on either side
    unknown = np.where(is_cut, of_cut, np.where(is_abeam, hidden, 0.0))
    alike = min(max(int((unknown > edge).sum()), 1), SAME_VIEW_SCANS)
    return middle, np.hypot(edge, np.sqrt(alike) * unknown)

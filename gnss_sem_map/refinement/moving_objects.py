"""Moving objects by evidence: a segment of one scan that other scans look through was not there to stay.

Every scan is observed once, in time order; its range image and the points of its segments are kept. `settle` and
`decide` then follow the segments through time, look at their places in all scans, and say which of the points belong
to something that moved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnss_sem_map.errors import DataError
from gnss_sem_map.refinement import range_images
from gnss_sem_map.refinement.segments import VOXEL_M, find_segments, height_over_ground, near, take_apart
from gnss_sem_map.refinement.tracks import Segment
from gnss_sem_map.refinement.vehicles import groups
from gnss_sem_map.refinement.verdicts import GONE, MotionSettings, TrackedObject, judge
from gnss_sem_map.voxel_map import keys_of

FOOT_M, BODY_M = 0.05, 0.2
"""An object's body begins this high over the lowest ground around; its foot is what lies between, right under it."""
FOOT_REACH_M = 0.2
HIDING_M = 0.5
"""What is nearer by this hides the side of an object."""


@dataclass(frozen=True, eq=False)
class MovingObjects:
    """Which points of every scan belong to something that moved, and the objects that were judged."""

    points: Mapping[int, NDArray[np.int64]]
    """Frame number -> places of those points among the points that were observed."""
    objects: tuple[TrackedObject, ...]


@dataclass(frozen=True, eq=False)
class _Observation:
    """What is kept of one scan: h of its points, in or beside a segment."""

    number: int
    stamp: float
    T_lidar_map: NDArray[np.float64]
    image: NDArray[np.uint16]
    places: NDArray[np.int64]
    """(h,) where these points are in the scan."""
    p_map: NDArray[np.float64]
    """(h, 3) m."""
    is_object: NDArray[np.bool_]
    """(h,) whether the image calls it a vehicle."""
    is_body: NDArray[np.bool_]
    """(h,) whether it is higher than the foot of an object."""
    segments: NDArray[np.int32]
    """(h,) segment of the scan; -1 for points that only stand beside one."""
    cut: NDArray[np.bool_]
    """(s,) segments that the edge of the view or something nearer cuts."""


class MovingObjectDetector:
    """Collects scans in time order; memory: two windows of scans, a range image and some points of each."""

    def __init__(self, settings: MotionSettings | None = None) -> None:
        self._settings = settings or MotionSettings()
        self._observations: list[_Observation] = []
        self._past: list[tuple[NDArray[np.uint16], NDArray[np.float64]]] = []
        """Range images and poses of settled scans, which still testify."""
        self._last_stamp = -np.inf

    def observe(
        self,
        number: int,
        stamp: float,
        p_map: NDArray[np.float64],
        T_map_lidar: NDArray[np.float64],
        is_object: NDArray[np.bool_],
        is_known: NDArray[np.bool_] | None = None,
    ) -> None:
        """Take in one scan.

        `p_map` (n, 3) m are its deskewed points, `T_map_lidar` (4, 4) its pose at `stamp`; `is_object` (n,) says
        which points are called vehicle, `is_known` (n,) which have been called anything (default: all). Raises
        DataError when the stamps do not increase.
        """
        if stamp <= self._last_stamp:
            raise DataError(
                f"scan {number} at {stamp:.3f} s follows one at {self._last_stamp:.3f} s;"
                " give scans in time order, each once"
            )
        self._last_stamp = stamp
        known = np.ones(len(p_map), np.bool_) if is_known is None else is_known
        self._observations.append(
            _observe(number, stamp, p_map, T_map_lidar, is_object, known, self._settings)
        )

    def settle(self) -> MovingObjects:
        """Decide about the scans that a whole window of later ones has testified on: often none."""
        window = self._settings.window_scans
        return self._decide(window) if len(self._observations) >= 2 * window else MovingObjects({}, ())

    def decide(self) -> MovingObjects:
        """Decide about all scans that are not settled yet."""
        return self._decide(len(self._observations))

    def _decide(self, count: int) -> MovingObjects:
        """Decide about the oldest scans, by the testimony of all, and let go of their points."""
        if count == 0:
            return MovingObjects({}, ())
        hits, throughs = self._testimony()
        of_point = _apart(self._observations, hits, throughs, self._settings)
        segments = _all_segments(self._observations, of_point)
        numbers = np.concatenate(of_point)
        hit, through = (_sums(numbers, looks, len(segments)) for looks in (hits, throughs))
        objects = judge(segments, hit, through, self._settings)
        gone = np.zeros(len(segments) + 1, np.bool_)  # the last one: points of no segment
        for one in objects:
            gone[list(one.segments)] = one.motion in GONE
        settled, self._observations = self._observations[:count], self._observations[count:]
        points = {
            seen.number: seen.places[_grown(seen, gone[numbers], self._settings.grow_m)]
            for seen, numbers in zip(settled, of_point, strict=False)
        }
        self._past += [(seen.image, seen.T_lidar_map) for seen in settled]
        del self._past[: -self._settings.window_scans]
        begun = tuple(one for one in objects if segments[one.segments[0]].scan < count)
        return MovingObjects(points, begun)

    def _testimony(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """How often the place of every kept point in a segment was hit and seen through by other scans: (n,) each."""
        settings, observations = self._settings, self._observations
        inside = np.concatenate([seen.segments for seen in observations]) >= 0
        p_map = np.concatenate([seen.p_map for seen in observations])[inside]
        voxel = np.unique(keys_of(p_map, VOXEL_M), return_inverse=True)[1]
        points = np.bincount(voxel)
        centroids = np.stack([np.bincount(voxel, p_map[:, axis]) / points for axis in range(3)], axis=1)
        hits, throughs = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
        witnesses = self._past + [(seen.image, seen.T_lidar_map) for seen in observations]
        images, poses = zip(*witnesses, strict=True)
        range_images.look_at(
            centroids,
            np.stack(images),
            np.stack(poses),
            settings.nearest_m, settings.farthest_m, settings.margin_m, settings.margin_ratio,
            hits, throughs,
        )  # fmt: skip
        of_point = np.zeros((2, len(inside)), np.int32)
        of_point[:, inside] = np.maximum(hits - 1, 0)[voxel], throughs[voxel]  # less the scan that found it
        return of_point[0], of_point[1]


def _sums(numbers: NDArray[np.int64], looks: NDArray[np.int32], count: int) -> NDArray[np.float64]:
    """What the points of every segment sum up to: (s,)."""
    inside = numbers >= 0
    return np.asarray(np.bincount(numbers[inside], looks[inside], count), np.float64)


def _apart(
    observations: list[_Observation],
    hits: NDArray[np.int32],
    throughs: NDArray[np.int32],
    settings: MotionSettings,
) -> list[NDArray[np.int64]]:
    """Segment of every kept point of each scan, -1 for none, counted over all scans.

    A mover beside something that stands may have been found as one segment with it.
    """
    of_point, start, count = [], 0, 0
    for seen in observations:
        looks = slice(start, start := start + len(seen.segments))
        numbers = take_apart(
            seen.p_map, seen.segments, hits[looks], throughs[looks],
            settings.segment_eps_m, settings.least_through_per_hit,
        )  # fmt: skip
        of_point.append(np.where(numbers >= 0, numbers + np.int64(count), -1))
        count += int(numbers.max(initial=-1)) + 1
    return of_point


def _observe(
    number: int,
    stamp: float,
    p_map: NDArray[np.float64],
    T_map_lidar: NDArray[np.float64],
    is_object: NDArray[np.bool_],
    is_known: NDArray[np.bool_],
    settings: MotionSettings,
) -> _Observation:
    T_lidar_map = np.asarray(np.linalg.inv(T_map_lidar), np.float64)
    image = range_images.empty_image()
    range_images.draw(p_map, T_lidar_map, image)
    heights = height_over_ground(p_map)
    above = np.flatnonzero((heights > FOOT_M) & _within(p_map, T_map_lidar, settings.farthest_object_m))
    points, named = p_map[above], is_object[above]
    body = np.flatnonzero(heights[above] > BODY_M)
    # nobody testifies on what is farther away, so that only a name makes it an object
    known = is_known[above[body]] | ~_within(points[body], T_map_lidar, settings.farthest_m)
    segments = np.full(len(above), -1, np.int32)
    segments[body], cut = find_segments(points[body], named[body], known, settings.segment_eps_m)
    cut |= range_images.hidden_sides(points, segments, T_lidar_map, image, len(cut), HIDING_M)
    keep = near(points, segments >= 0, settings.grow_m)
    return _Observation(
        number=number,
        stamp=stamp,
        T_lidar_map=T_lidar_map,
        image=image,
        places=above[keep],
        p_map=points[keep],
        is_object=named[keep],
        is_body=heights[above[keep]] > BODY_M,
        segments=segments[keep],
        cut=cut,
    )


def _within(
    p_map: NDArray[np.float64], T_map_lidar: NDArray[np.float64], reach_m: float
) -> NDArray[np.bool_]:
    east, north = p_map[:, 0] - T_map_lidar[0, 3], p_map[:, 1] - T_map_lidar[1, 3]
    return np.asarray(east * east + north * north <= reach_m**2)


def _all_segments(observations: list[_Observation], of_point: list[NDArray[np.int64]]) -> list[Segment]:
    """The segments of all scans in time order."""
    segments: list[Segment] = []
    for scan, (seen, numbers) in enumerate(zip(observations, of_point, strict=True)):
        for part in groups(np.where(numbers >= 0, numbers - len(segments), -1)):
            xy = seen.p_map[part, :2]
            segments.append(
                Segment(
                    scan=scan,
                    stamp=seen.stamp,
                    centroid=xy.mean(axis=0),
                    lowest=xy.min(axis=0),
                    highest=xy.max(axis=0),
                    points=len(part),
                    shown=bool(seen.is_object[part].any()),
                    cut=bool(seen.cut[seen.segments[part[0]]]),
                )
            )
    return segments


def _grown(seen: _Observation, gone: NDArray[np.bool_], reach_m: float) -> NDArray[np.bool_]:
    """The points of segments that are gone, the bodies beside them and their feet: (h,)."""
    grown = gone.copy()
    if not gone.any() or reach_m == 0:
        return grown
    rest = np.flatnonzero((seen.segments < 0) & seen.is_body)
    distances = cKDTree(seen.p_map[gone]).query(seen.p_map[rest], distance_upper_bound=reach_m)[0]
    grown[rest[np.isfinite(distances)]] = True
    feet = np.flatnonzero(~seen.is_body)
    above = cKDTree(seen.p_map[grown, :2])
    distances = above.query(seen.p_map[feet, :2], distance_upper_bound=FOOT_REACH_M)[0]
    grown[feet[np.isfinite(distances)]] = True
    return grown

"""Moving objects by evidence: a segment of one scan that other scans look through was not there to stay.

Every scan is observed once, in time order; its range image and the points of its segments are kept. `settle` and
`decide` then follow the segments through time, look at their places in all scans, and say which of the points belong
to something that moved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnss_sem_map.errors import DataError
from gnss_sem_map.refinement import range_images
from gnss_sem_map.refinement.distinct import distinct
from gnss_sem_map.refinement.scan_grid import height_over_ground, near
from gnss_sem_map.refinement.segments import Segments, find_segments, take_apart
from gnss_sem_map.refinement.tracks import Segment
from gnss_sem_map.refinement.verdicts import GONE, MotionSettings, TrackedObject, judge

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
    is_body: NDArray[np.bool_]
    """(h,) whether it is higher than the foot of an object."""
    segments: Segments
    """Of these points; some only stand beside one."""


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
        looks = self._testimony()
        segments = [
            take_apart(
                seen.segments, *of_scan, self._settings.segment_eps_m, self._settings.least_through_per_hit
            )
            for seen, of_scan in zip(self._observations, looks, strict=True)
        ]
        ends = np.cumsum([len(of_scan.cut) for of_scan in segments])
        listed = _all_segments(self._observations, segments)
        hits, throughs = (
            np.concatenate([s.sums_of(of_scan[which]) for s, of_scan in zip(segments, looks, strict=True)])
            for which in (0, 1)
        )
        objects = judge(listed, hits, throughs, self._settings)
        gone = np.zeros(len(listed), np.bool_)
        for one in objects:
            gone[list(one.segments)] = one.motion in GONE
        settled, self._observations = self._observations[:count], self._observations[count:]
        points = {
            seen.number: seen.places[_grown(seen, of_scan.points_of(which), self._settings.grow_m)]
            for seen, of_scan, which in zip(settled, segments, np.split(gone, ends), strict=False)
        }
        self._past += [(seen.image, seen.T_lidar_map) for seen in settled]
        del self._past[: -self._settings.window_scans]
        begun = tuple(one for one in objects if listed[one.segments[0]].scan < count)
        return MovingObjects(points, begun)

    def _testimony(self) -> list[tuple[NDArray[np.int32], NDArray[np.int32]]]:
        """How often every voxel of each scan's segments was hit and seen through by other scans: (v,) each."""
        settings, observations = self._settings, self._observations
        parts = [seen.segments.parts for seen in observations]
        keys, place = distinct(np.concatenate([seen.segments.keys for seen in observations]))
        points = np.bincount(place, np.concatenate([part.points for part in parts]))
        sums = np.concatenate([part.sums for part in parts])
        centroids = np.stack([np.bincount(place, sums[:, axis]) / points for axis in range(3)], axis=1)
        hits, throughs = np.zeros(len(keys), np.int32), np.zeros(len(keys), np.int32)
        witnesses = self._past + [(seen.image, seen.T_lidar_map) for seen in observations]
        images, poses = zip(*witnesses, strict=True)
        range_images.look_at(
            centroids,
            np.stack(images),
            np.stack(poses),
            settings.nearest_m, settings.farthest_m, settings.margin_m, settings.margin_ratio,
            hits, throughs,
        )  # fmt: skip
        hits = np.maximum(hits - 1, 0)  # less the scan that found it
        ends = np.cumsum([len(part.points) for part in parts])[:-1]
        return list(zip(np.split(hits[place], ends), np.split(throughs[place], ends), strict=True))


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
    points, named, is_body = p_map[above], is_object[above], heights[above] > BODY_M
    # nobody testifies on what is farther away, so that only a name makes it an object
    known = is_known[above] | ~_within(points, T_map_lidar, settings.farthest_m)
    segments = find_segments(points, named, known, is_body, settings.segment_eps_m)
    of_points = segments.of_points
    hidden = range_images.hidden_sides(points, of_points, T_lidar_map, image, len(segments.cut), HIDING_M)
    keep = near(points, of_points >= 0, settings.grow_m)
    return _Observation(
        number=number,
        stamp=stamp,
        T_lidar_map=T_lidar_map,
        image=image,
        places=above[keep],
        p_map=points[keep],
        is_body=is_body[keep],
        segments=replace(segments, voxel=segments.voxel[keep], cut=segments.cut | hidden),
    )


def _within(
    p_map: NDArray[np.float64], T_map_lidar: NDArray[np.float64], reach_m: float
) -> NDArray[np.bool_]:
    east, north = p_map[:, 0] - T_map_lidar[0, 3], p_map[:, 1] - T_map_lidar[1, 3]
    return np.asarray(east * east + north * north <= reach_m**2)


def _all_segments(observations: list[_Observation], segments: list[Segments]) -> list[Segment]:
    """The segments of all scans in time order."""
    listed: list[Segment] = []
    for scan, (seen, of_scan) in enumerate(zip(observations, segments, strict=True)):
        whole = of_scan.whole
        centroids = whole.sums[:, :2] / whole.points[:, None]
        for number, cut in enumerate(of_scan.cut.tolist()):
            listed.append(
                Segment(
                    scan=scan,
                    stamp=seen.stamp,
                    centroid=centroids[number],
                    lowest=whole.lowest[number, :2],
                    highest=whole.highest[number, :2],
                    points=int(whole.points[number]),
                    shown=bool(whole.named[number]),
                    cut=cut,
                )
            )
    return listed


def _grown(seen: _Observation, gone: NDArray[np.bool_], reach_m: float) -> NDArray[np.bool_]:
    """The points of segments that are gone, the bodies beside them and their feet: (h,)."""
    grown = gone.copy()
    if not gone.any() or reach_m == 0:
        return grown
    beside = near(seen.p_map, gone, reach_m) & (seen.segments.voxel < 0)
    rest = np.flatnonzero(beside & seen.is_body)
    distances = cKDTree(seen.p_map[gone]).query(seen.p_map[rest], distance_upper_bound=reach_m)[0]
    grown[rest[np.isfinite(distances)]] = True
    feet = np.flatnonzero(near(seen.p_map, grown, FOOT_REACH_M) & ~seen.is_body)
    above = cKDTree(seen.p_map[grown, :2])
    distances = above.query(seen.p_map[feet, :2], distance_upper_bound=FOOT_REACH_M)[0]
    grown[feet[np.isfinite(distances)]] = True
    return grown

"""Search for moving objects: a segment of one scan has moved if other scans see through its volume.

`observe` segments one scan and draws its range image. The detector collects these in time order. `settle` and `decide`
track the segments, count hits and misses of their voxels in all scans, and return the points of moving objects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics import range_images
from gnss_sem_map.dynamics.clusters import Segments, find_segments, split_segments
from gnss_sem_map.dynamics.ground_grid import closer_than, height_over_ground, in_cells_near, within_radius
from gnss_sem_map.dynamics.motion_state import GONE, MotionSettings, TrackedObject, classify_motion
from gnss_sem_map.dynamics.tracking import Segment
from gnss_sem_map.dynamics.visibility import THREADS, KeyframeScans, hits_and_misses
from gnss_sem_map.errors import DataError
from gnss_sem_map.scans.prefetch import prefetch
from gnss_sem_map.voxels.hash_unique import distinct

FOOT_HEIGHT_M, BODY_HEIGHT_M = 0.05, 0.2
"""Heights over the lowest ground around: the body of an object begins at BODY_HEIGHT_M, its foot at FOOT_HEIGHT_M."""
FOOT_REACH_M = 0.2
HIDING_M = 0.5
"""Something nearer by this hides the side of an object."""
WINDOWS_HELD = 3
"""Windows of undecided scans in memory: with more, fewer scans are processed twice, and more memory is needed."""


@dataclass(frozen=True, eq=False)
class MovingObjects:
    """The points of moving objects in every scan, and the tracked objects with their motion states."""

    points: Mapping[int, NDArray[np.int64]]
    """Frame number -> indices of the moving points in the array given to `observe`."""
    objects: tuple[TrackedObject, ...]
    keyframes: KeyframeScans | None = None
    """Scans from the whole drive, for free-space evidence; None if they were not collected."""


@dataclass(frozen=True, eq=False)
class Observation:
    """One scan as the detector keeps it: h of its points, those in or near a segment."""

    number: int
    stamp: float
    T_lidar_map: NDArray[np.float64]
    image: NDArray[np.uint16]
    indices: NDArray[np.int32]
    """(h,) indices of these points in the scan."""
    p_near: NDArray[np.float32]
    """(h, 3) m, relative to the LiDAR, along the axes of the map."""
    is_body: NDArray[np.bool_]
    """(h,) whether the point is higher than the foot of an object."""
    segments: Segments
    """Segments of these points; some points are only near one."""


class MovingObjectDetector:
    """Collects scans in time order. Memory: a few windows of scans, with the range image and some points of each."""

    def __init__(self, settings: MotionSettings | None = None, from_lidar_odometry: bool = False) -> None:
        """`from_lidar_odometry`: the poses come from LiDAR odometry, so that static objects are not blurred."""
        self._settings, self._from_lidar_odometry = settings or MotionSettings(), from_lidar_odometry
        self._observations: list[Observation] = []
        self._past: list[tuple[NDArray[np.uint16], NDArray[np.float64]]] = []
        """Range images and poses of decided scans, which still count as evidence."""
        self._last_stamp = -np.inf

    def add(self, seen: Observation) -> None:
        """Add one scan; raises DataError when the stamps do not increase."""
        if seen.stamp <= self._last_stamp:
            raise DataError(
                f"scan {seen.number} at {seen.stamp:.3f} s follows one at {self._last_stamp:.3f} s;"
                " give scans in time order, each once"
            )
        self._last_stamp = seen.stamp
        self._observations.append(seen)

    def settle(self) -> MovingObjects:
        """Decide the scans that have a whole window of later scans: on most calls none, then many at once.

        Undecided scans are processed again on the next call.
        """
        window, count = self._settings.window_scans, len(self._observations)
        return self._decide(count - window) if count >= WINDOWS_HELD * window else MovingObjects({}, ())

    def decide(self) -> MovingObjects:
        """Decide all remaining scans."""
        return self._decide(len(self._observations))

    def _decide(self, count: int) -> MovingObjects:
        """Decide the oldest `count` scans by the evidence of all, and drop their points."""
        if count == 0:
            return MovingObjects({}, ())
        settings = self._settings
        counts = self._observations_by_others()
        segments = [
            split_segments(
                seen.segments,
                counted[0],
                counted[1],
                settings.segment_eps_m,
                settings.displaced_misses_per_hit,
            )
            for seen, counted in zip(self._observations, counts, strict=True)
        ]
        hits, misses = np.concatenate(
            [of_scan.sums_of(counted) for of_scan, counted in zip(segments, counts, strict=True)], axis=1
        )
        listed = _all_segments(self._observations, segments)
        objects = classify_motion(listed, hits, misses, settings, self._from_lidar_odometry)
        gone = np.zeros(len(listed), np.bool_)
        for one in objects:
            gone[list(one.segments)] = one.motion in GONE
        gone_of = np.split(gone, np.cumsum([len(of_scan.truncated) for of_scan in segments]))
        settled, self._observations = self._observations[:count], self._observations[count:]

        def moved(scan: int) -> NDArray[np.int64]:
            seen, of_gone = settled[scan], segments[scan].points_of(gone_of[scan])
            return seen.indices[_with_points_around(seen, of_gone, settings.grow_m)].astype(np.int64)

        points = {settled[scan].number: indices for scan, indices in prefetch(moved, range(count), THREADS)}
        self._past += [(seen.image, seen.T_lidar_map) for seen in settled]
        del self._past[: -self._settings.window_scans]
        begun = tuple(one for one in objects if listed[one.segments[0]].scan < count)
        return MovingObjects(points, begun)

    def _observations_by_others(self) -> list[NDArray[np.int32]]:
        """For each scan, hits and misses of every voxel of its segments by the other scans: (2, v)."""
        observations = self._observations
        parts = [seen.segments.parts for seen in observations]
        _, row = distinct(np.concatenate([seen.segments.keys for seen in observations]))
        points = np.bincount(row, np.concatenate([part.points for part in parts]))
        sums = np.concatenate([part.sums for part in parts])
        centroids = np.stack([np.bincount(row, sums[:, axis]) / points for axis in range(3)], axis=1)
        here = [(seen.image, seen.T_lidar_map) for seen in observations]
        counts = hits_and_misses(centroids, KeyframeScans.of(self._past + here), self._settings.farthest_m)
        counts[0] = np.maximum(counts[0] - 1, 0)  # less the scan that found it
        return np.split(counts[:, row], np.cumsum([len(part.points) for part in parts])[:-1], axis=1)


def observe(
    number: int,
    stamp: float,
    p_map: NDArray[np.float64],
    T_map_lidar: NDArray[np.float64],
    is_object: NDArray[np.bool_],
    is_known: NDArray[np.bool_],
    settings: MotionSettings,
) -> Observation:
    """Segments and range image of one scan, for `MovingObjectDetector.add`.

    `p_map` (n, 3) m are its deskewed points, `T_map_lidar` (4, 4) its pose at `stamp`; `is_object` (n,) marks the
    points that the image labels as movable, `is_known` (n,) those with any label.
    """
    T_lidar_map = np.asarray(np.linalg.inv(T_map_lidar), np.float64)
    image = range_images.empty_image()
    range_images.draw(p_map, T_lidar_map, image)
    heights, centre = height_over_ground(p_map), T_map_lidar[:2, 3]
    above = (heights > FOOT_HEIGHT_M) & within_radius(p_map, centre, settings.farthest_object_m)
    is_body = heights > BODY_HEIGHT_M
    # beyond this range there is no evidence: only labelled points become candidates there
    unknown = ~is_known & within_radius(p_map, centre, settings.farthest_m)
    candidates = np.flatnonzero(above & is_body & (is_object | unknown))
    points = p_map.take(candidates, axis=0)
    segments = find_segments(points, is_object.take(candidates), settings.segment_eps_m)
    hidden = range_images.hidden_sides(
        points, segments.of_points, T_lidar_map, image, len(segments.truncated), HIDING_M
    )
    voxel = np.full(len(p_map), -1, np.int32)
    voxel[candidates] = segments.voxel
    keep = np.flatnonzero(above & in_cells_near(p_map, voxel >= 0, settings.grow_m))
    return Observation(
        number=number,
        stamp=stamp,
        T_lidar_map=T_lidar_map,
        image=image,
        indices=keep.astype(np.int32),
        p_near=(p_map.take(keep, axis=0) - T_map_lidar[:3, 3]).astype(np.float32),
        is_body=is_body.take(keep),
        segments=replace(segments, voxel=voxel.take(keep), truncated=segments.truncated | hidden),
    )


def _all_segments(observations: list[Observation], segments: list[Segments]) -> list[Segment]:
    """The segments of all scans in time order."""
    listed: list[Segment] = []
    for scan, (seen, of_scan) in enumerate(zip(observations, segments, strict=True)):
        whole = of_scan.whole
        centroids = whole.sums[:, :2] / whole.points[:, None]
        for number, truncated in enumerate(of_scan.truncated.tolist()):
            listed.append(
                Segment(
                    scan=scan,
                    stamp=seen.stamp,
                    centroid=centroids[number],
                    lowest=whole.lowest[number, :2],
                    highest=whole.highest[number, :2],
                    points=int(whole.points[number]),
                    shown=bool(whole.labelled[number]),
                    truncated=truncated,
                )
            )
    return listed


def _with_points_around(seen: Observation, gone: NDArray[np.bool_], reach_m: float) -> NDArray[np.bool_]:
    """Mask (h,) of the points of moved segments, of the body points near them, and of the foot points below."""
    grown = gone.copy()
    if not gone.any() or reach_m == 0:
        return grown
    beside = seen.is_body & (seen.segments.voxel < 0)
    grown |= closer_than(seen.p_near, gone, beside, reach_m)
    return grown | closer_than(seen.p_near[:, :2], grown, ~seen.is_body, FOOT_REACH_M)

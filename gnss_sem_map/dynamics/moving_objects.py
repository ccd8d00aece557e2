"""Moving objects by evidence: a segment of one scan that other scans look through was not there to stay.

Every scan is observed by itself; its range image and the points of its segments are kept, in time order. `settle` and
`decide` then follow the segments through time, look at their places in all scans, and say which of the points belong
to something that moved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics import range_images
from gnss_sem_map.dynamics.clusters import Segments, find_segments, take_apart
from gnss_sem_map.dynamics.ground_grid import height_over_ground, near, reached, within
from gnss_sem_map.dynamics.motion_state import GONE, MotionSettings, TrackedObject, judge
from gnss_sem_map.dynamics.tracking import Segment
from gnss_sem_map.dynamics.visibility import THREADS, Witnesses, testify
from gnss_sem_map.errors import DataError
from gnss_sem_map.scans.prefetch import ahead
from gnss_sem_map.voxels.hash_unique import distinct

FOOT_M, BODY_M = 0.05, 0.2
"""An object's body begins this high over the lowest ground around; its foot is what lies between, right under it."""
FOOT_REACH_M = 0.2
HIDING_M = 0.5
"""What is nearer by this hides the side of an object."""
WINDOWS_HELD = 3
"""Of scans that are not decided: with more, fewer are looked at twice, and more memory is taken."""


@dataclass(frozen=True, eq=False)
class MovingObjects:
    """Which points of every scan belong to something that moved, and the objects that were judged."""

    points: Mapping[int, NDArray[np.int64]]
    """Frame number -> places of those points among the points that were observed."""
    objects: tuple[TrackedObject, ...]
    witnesses: Witnesses | None = None
    """Scans from all along the drive; None: nobody was asked to keep any."""


@dataclass(frozen=True, eq=False)
class Observation:
    """What is kept of one scan: h of its points, in or beside a segment."""

    number: int
    stamp: float
    T_lidar_map: NDArray[np.float64]
    image: NDArray[np.uint16]
    places: NDArray[np.int32]
    """(h,) where these points are in the scan."""
    p_near: NDArray[np.float32]
    """(h, 3) m, along the axes of the map, from where the scan was made."""
    is_body: NDArray[np.bool_]
    """(h,) whether it is higher than the foot of an object."""
    segments: Segments
    """Of these points; some only stand beside one."""


class MovingObjectDetector:
    """Collects scans in time order; memory: some windows of scans, a range image and some points of each."""

    def __init__(self, settings: MotionSettings | None = None, matched: bool = False) -> None:
        """`matched`: the poses of the scans come from matching them, so that what stands, stands still."""
        self._settings, self._matched = settings or MotionSettings(), matched
        self._observations: list[Observation] = []
        self._past: list[tuple[NDArray[np.uint16], NDArray[np.float64]]] = []
        """Range images and poses of settled scans, which still testify."""
        self._last_stamp = -np.inf

    def add(self, seen: Observation) -> None:
        """Take in one scan; raises DataError when the stamps do not increase."""
        if seen.stamp <= self._last_stamp:
            raise DataError(
                f"scan {seen.number} at {seen.stamp:.3f} s follows one at {self._last_stamp:.3f} s;"
                " give scans in time order, each once"
            )
        self._last_stamp = seen.stamp
        self._observations.append(seen)

    def settle(self) -> MovingObjects:
        """Decide about the scans that a whole window of later ones has testified on: mostly none, then many at once.

        For what is not decided is looked at again the next time.
        """
        window, count = self._settings.window_scans, len(self._observations)
        return self._decide(count - window) if count >= WINDOWS_HELD * window else MovingObjects({}, ())

    def decide(self) -> MovingObjects:
        """Decide about all scans that are not settled yet."""
        return self._decide(len(self._observations))

    def _decide(self, count: int) -> MovingObjects:
        """Decide about the oldest scans, by the testimony of all, and let go of their points."""
        if count == 0:
            return MovingObjects({}, ())
        settings = self._settings
        looks = self._testimony()
        segments = [
            take_apart(
                seen.segments, looked[0], looked[1], settings.segment_eps_m, settings.least_through_per_hit
            )
            for seen, looked in zip(self._observations, looks, strict=True)
        ]
        hits, throughs = np.concatenate(
            [of_scan.sums_of(looked) for of_scan, looked in zip(segments, looks, strict=True)], axis=1
        )
        listed = _all_segments(self._observations, segments)
        objects = judge(listed, hits, throughs, settings, self._matched)
        gone = np.zeros(len(listed), np.bool_)
        for one in objects:
            gone[list(one.segments)] = one.motion in GONE
        gone_of = np.split(gone, np.cumsum([len(of_scan.cut) for of_scan in segments]))
        settled, self._observations = self._observations[:count], self._observations[count:]

        def moved(scan: int) -> NDArray[np.int64]:
            seen, of_gone = settled[scan], segments[scan].points_of(gone_of[scan])
            return seen.places[_grown(seen, of_gone, settings.grow_m)].astype(np.int64)

        points = {settled[scan].number: places for scan, places in ahead(moved, range(count), THREADS)}
        self._past += [(seen.image, seen.T_lidar_map) for seen in settled]
        del self._past[: -self._settings.window_scans]
        begun = tuple(one for one in objects if listed[one.segments[0]].scan < count)
        return MovingObjects(points, begun)

    def _testimony(self) -> list[NDArray[np.int32]]:
        """For each scan, how often every voxel of its segments was hit and seen through by other scans: (2, v)."""
        observations = self._observations
        parts = [seen.segments.parts for seen in observations]
        _, place = distinct(np.concatenate([seen.segments.keys for seen in observations]))
        points = np.bincount(place, np.concatenate([part.points for part in parts]))
        sums = np.concatenate([part.sums for part in parts])
        centroids = np.stack([np.bincount(place, sums[:, axis]) / points for axis in range(3)], axis=1)
        here = [(seen.image, seen.T_lidar_map) for seen in observations]
        looks = testify(centroids, Witnesses.of(self._past + here), self._settings)
        looks[0] = np.maximum(looks[0] - 1, 0)  # less the scan that found it
        return np.split(looks[:, place], np.cumsum([len(part.points) for part in parts])[:-1], axis=1)


def observe(
    number: int,
    stamp: float,
    p_map: NDArray[np.float64],
    T_map_lidar: NDArray[np.float64],
    is_object: NDArray[np.bool_],
    is_known: NDArray[np.bool_],
    settings: MotionSettings,
) -> Observation:
    """What a scan alone can say of moving objects.

    `p_map` (n, 3) m are its deskewed points, `T_map_lidar` (4, 4) its pose at `stamp`; `is_object` (n,) says which
    points are called vehicle, `is_known` (n,) which have been called anything.
    """
    T_lidar_map = np.asarray(np.linalg.inv(T_map_lidar), np.float64)
    image = range_images.empty_image()
    range_images.draw(p_map, T_lidar_map, image)
    heights, centre = height_over_ground(p_map), T_map_lidar[:2, 3]
    above = (heights > FOOT_M) & within(p_map, centre, settings.farthest_object_m)
    is_body = heights > BODY_M
    # nobody testifies on what is farther away, so that only a name makes it an object
    unknown = ~is_known & within(p_map, centre, settings.farthest_m)
    candidates = np.flatnonzero(above & is_body & (is_object | unknown))
    points = p_map.take(candidates, axis=0)
    segments = find_segments(points, is_object.take(candidates), settings.segment_eps_m)
    hidden = range_images.hidden_sides(
        points, segments.of_points, T_lidar_map, image, len(segments.cut), HIDING_M
    )
    voxel = np.full(len(p_map), -1, np.int32)
    voxel[candidates] = segments.voxel
    keep = np.flatnonzero(above & near(p_map, voxel >= 0, settings.grow_m))
    return Observation(
        number=number,
        stamp=stamp,
        T_lidar_map=T_lidar_map,
        image=image,
        places=keep.astype(np.int32),
        p_near=(p_map.take(keep, axis=0) - T_map_lidar[:3, 3]).astype(np.float32),
        is_body=is_body.take(keep),
        segments=replace(segments, voxel=voxel.take(keep), cut=segments.cut | hidden),
    )


def _all_segments(observations: list[Observation], segments: list[Segments]) -> list[Segment]:
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


def _grown(seen: Observation, gone: NDArray[np.bool_], reach_m: float) -> NDArray[np.bool_]:
    """The points of segments that are gone, the bodies beside them and their feet: (h,)."""
    grown = gone.copy()
    if not gone.any() or reach_m == 0:
        return grown
    beside = seen.is_body & (seen.segments.voxel < 0)
    grown |= reached(seen.p_near, gone, beside, reach_m)
    return grown | reached(seen.p_near[:, :2], grown, ~seen.is_body, FOOT_REACH_M)

"""One scan as evidence for motion: its range image, its segments, and the points that may turn out to have moved."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.dynamics import range_images
from gnss_sem_map.dynamics.clusters import Segments, find_segments
from gnss_sem_map.dynamics.covered_parts import HIDING_M
from gnss_sem_map.dynamics.ground_grid import GROUND_CELL_M, height_over_ground, in_cells_near, within_radius
from gnss_sem_map.dynamics.image_rows import Rows
from gnss_sem_map.dynamics.motion_state import MotionSettings
from gnss_sem_map.dynamics.sweep_delays import SweepDelays
from gnss_sem_map.dynamics.visibility import RangeImage

FOOT_HEIGHT_M, BODY_HEIGHT_M = 0.05, 0.2
"""Heights over the lowest ground around: the body of an object begins at BODY_HEIGHT_M, its foot at FOOT_HEIGHT_M."""
CELL_M_PER_DEG, LARGEST_CELL_M = 1.0, 2.0
"""Cells of the ground grow with the gap between rings: in one of 1 m the lowest return of 16 rings is often of the
object."""


@dataclass(frozen=True, eq=False)
class Observation:
    """One scan as evidence for motion: its range image and its segments."""

    number: int
    stamp: float
    seen: RangeImage
    segments: Segments
    delays: SweepDelays


@dataclass(frozen=True, eq=False)
class NearPoints:
    """The points of a scan in or near a segment (h of n): those that may turn out to have moved."""

    indices: NDArray[np.int32]
    """(h,) indices of these points in the scan."""
    p_near: NDArray[np.float32]
    """(h, 3) m, relative to the LiDAR, along the axes of the map."""
    is_body: NDArray[np.bool_]
    """(h,) whether the point is higher than the foot of an object."""
    voxel: NDArray[np.int32]
    """(h,) index of its voxel in the segments of the scan, -1 for a point that is only near one."""


def observe(
    number: int,
    stamp: float,
    p_map: NDArray[np.float64],
    T_map_lidar: NDArray[np.float64],
    is_object: NDArray[np.bool_],
    is_known: NDArray[np.bool_],
    settings: MotionSettings,
    rows: Rows,
    delays: SweepDelays | None = None,
) -> tuple[Observation, NearPoints]:
    """Segments and range image of one scan, and its points in or near a segment.

    `p_map` (n, 3) m are its deskewed points, `T_map_lidar` (4, 4) its pose at `stamp`; `is_object` (n,) marks the
    points that the image labels as movable, `is_known` (n,) those with any label. `rows` are those of its LiDAR,
    `delays` tell when the sweep met what.
    """
    seen = RangeImage.of(p_map, T_map_lidar, rows)
    cell_m = float(np.clip(CELL_M_PER_DEG * rows.gap_on_ground_deg, GROUND_CELL_M, LARGEST_CELL_M))
    heights, centre = height_over_ground(p_map, cell_m), T_map_lidar[:2, 3]
    above = np.flatnonzero(
        (heights > FOOT_HEIGHT_M) & within_radius(p_map, centre, settings.farthest_object_m)
    )
    p_above, is_body = p_map.take(above, axis=0), heights.take(above) > BODY_HEIGHT_M
    is_object = is_object.take(above)
    candidates = np.flatnonzero(is_body & (is_object | ~is_known.take(above)))
    points = p_above.take(candidates, axis=0)
    gaps = range_images.gaps_at(points, seen.T_lidar_map, rows)
    segments, voxel_of_candidates = find_segments(
        points, is_object.take(candidates), *gaps, settings.segment_eps_m
    )
    hidden = range_images.hidden_sides(
        points, segments.of_points(voxel_of_candidates), seen.T_lidar_map, rows.of_return, seen.image,
        len(segments.truncated), HIDING_M,
    )  # fmt: skip
    voxel = np.full(len(above), -1, np.int32)
    voxel[candidates] = voxel_of_candidates
    keep = np.flatnonzero(in_cells_near(p_above, voxel >= 0, settings.grow_m))
    indices, p_near = above.take(keep).astype(np.int32), np.empty((len(keep), 3), np.float32)
    _relative(p_map, indices, T_map_lidar[:3, 3], p_near)
    near = NearPoints(
        indices=indices,
        p_near=p_near,
        is_body=is_body.take(keep),
        voxel=voxel.take(keep),
    )
    segments = replace(segments, truncated=segments.truncated | hidden)
    return Observation(number, stamp, seen, segments, delays or SweepDelays.none()), near


@njit(cache=True, nogil=True)
def _relative(
    p_map: NDArray[np.float64],
    chosen: NDArray[np.int32],
    origin: NDArray[np.float64],
    p_near: NDArray[np.float32],
) -> None:
    """Some points (n, 3) m, chosen by their indices, relative to an origin (3,) m; in numpy this takes 0.7 ms more."""
    for i in range(len(chosen)):
        for axis in range(3):
            p_near[i, axis] = p_map[chosen[i], axis] - origin[axis]

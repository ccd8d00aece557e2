"""Registration of one map to another of the same place, which corrects the errors of their georeferences.

The positions of two drives differ by some decimetres, often by more than a voxel. Without registration, every wall is
twice in the merged map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import small_gicp
from numpy.typing import NDArray

from gnss_sem_map.scans import registration
from gnss_sem_map.scans.downsampling import one_per_cube
from gnss_sem_map.scans.local_maps import cloud_of

Array = NDArray[np.float64]

SPACING_M = 0.4
"""Maps are downsampled to one point per cube of this edge (two voxels)."""
NEIGHBOURS = 10
"""Points for the plane at each point: voxel centres are up to half a voxel off their surface."""
REACHES_M = (2.0, 0.5, 0.25)
"""Largest correspondence distance of each registration; one follows the other."""
FARTHEST_M, MOST_TURN_DEG = 3.0, 2.0
"""No georeference has a larger error; such a registration has found another wall."""
LEAST_POINTS = 300
"""Fewer correspondences give no registration."""
DEGENERATE = registration.DegenerateSettings(degenerate_share=0.003)
"""As in LiDAR odometry: a direction that less than this share of the points constrain is not moved."""


@dataclass(frozen=True, eq=False)
class MapMatch:
    """The motion that aligns one map, the source, to another, the target."""

    T_target_source: Array
    """(4, 4)."""
    shift_m: float
    """Of the middle of the source."""
    turn_deg: float


class NoMatch(Exception):
    """One map cannot be registered to another; the message says why."""


def match_maps(target: Array, source: Array) -> MapMatch:
    """Register the surfaces of two maps, (n, 3) and (m, 3) m in frames that nearly agree; raises NoMatch.

    Generalised ICP of `small_gicp`, the widest distance first. A direction that the surfaces do not constrain, such as
    that of a street without corners, is not moved.
    """
    if min(len(target), len(source)) < LEAST_POINTS:
        raise NoMatch(f"one of the maps has less than {LEAST_POINTS} voxels")
    middle = source.mean(axis=0)  # rotations about it do not mix with shifts
    surfaces, points = (
        cloud_of(one_per_cube(places - middle, SPACING_M), NEIGHBOURS) for places in (target, source)
    )
    tree, T = small_gicp.KdTree(surfaces), np.eye(4)
    for reach_m in REACHES_M:
        result = small_gicp.align(
            surfaces, points, tree, T, max_correspondence_distance=reach_m,
            max_iterations=registration.MAX_ITERATIONS, translation_epsilon=1e-4, rotation_epsilon=1e-6,
        )  # fmt: skip
        if result.num_inliers < LEAST_POINTS:
            raise NoMatch(f"only {result.num_inliers} points of one lie within {reach_m:g} m of the other")
        T = registration.rigid(result.T_target_source)
    T, _, _ = registration.remap_solution(np.eye(4), T, result, points, DEGENERATE)
    return _checked(T, middle)


def _checked(T: Array, middle: Array) -> MapMatch:
    shift_m, turn_deg = float(np.linalg.norm(T[:3, 3])), registration.turn_deg(T)
    if shift_m > FARTHEST_M or turn_deg > MOST_TURN_DEG:
        raise NoMatch(
            f"the registration is {shift_m:.2f} m and {turn_deg:.1f}° off the georeference, expected at most"
            f" {FARTHEST_M:g} m and {MOST_TURN_DEG:g}°"
        )
    about_origin = T.copy()
    about_origin[:3, 3] += middle - T[:3, :3] @ middle
    return MapMatch(about_origin, shift_m, turn_deg)

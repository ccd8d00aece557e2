"""The ground of a window of the map, cell by cell: measured where it was seen, interpolated between, and how well it is
known. It is the ground that the refinement uses (see `refinement.surroundings`), at the resolution of the voxels."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gnss_sem_map.export.exported import Exported
from gnss_sem_map.labels.roles import Role
from gnss_sem_map.refinement.height_above_ground import REACH_M, height_over_ground
from gnss_sem_map.refinement.surroundings import OVER_M, over_ground
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import TiledMap

Heights = NDArray[np.float32]
Corner = tuple[int, int]

WAYS = (Role.ROAD, Role.SIDEWALK)
STANDING = (Role.VEHICLE, Role.PERSON, Role.BUILDING, Role.VEGETATION, Role.POLE)
"""Roles of what is no ground, however low it is seen."""
POINT_STDDEV_M, LEAST_STDDEV_M = 0.03, 0.01
"""Of the height of a point on the ground, and of a cell with many: a kerb or a slope lies inside."""
BLOCK, AROUND, RISE, STEP_M = 4, 24, 0.05, 0.25
"""Ground that no class calls so is followed from road and sidewalk, over so many blocks of 4 x 4 columns: where nothing
is seen between, it may rise by this slope. At the edge of what was seen, the lowest of a hedge is not its foot."""
GHOSTS, DEEP_M = 4, 1.0
"""What is so deep under road and sidewalk in the 5 x 5 blocks around, leaving out so many of these, is a reflection."""
GROWTH = 0.05
"""Standard deviation, m, per metre to the nearest cell where the ground was seen."""
WINDOW = 1024
"""Columns of a window that is worked on at once: a smaller one is read with more around it."""


@dataclass(frozen=True, eq=False)
class Ground:
    """The ground in m x n columns of voxels, and what stands there; arrays are (m, n), along x and y.

    Heights are those of the map frame, m, NaN where nothing is known.
    """

    heights: Heights
    """Of the ground."""
    stddevs: Heights
    seen: NDArray[np.bool_]
    """Whether the ground itself was seen."""
    tops: Heights
    """Of the highest voxel that stands; NaN where nothing was seen."""
    standing: SemanticMap
    """The v voxels of these columns that were not removed."""
    columns: NDArray[np.int64]
    """(v,) place of each voxel in the flattened arrays."""
    over: NDArray[np.bool_]
    """(v,) over the ground, and no part of it."""
    above: Heights
    """(v,) height of the points of each over the ground under them."""


def ground_of(exported: Exported, low: tuple[int, int], shape: tuple[int, int]) -> Ground:
    """The ground of `shape` columns from `low` on.

    A column's ground is the mean of the points of its ground voxels. Gaps are filled by pull-push (Gortler et al., The
    Lumigraph, 1996). What is read around the window is enough for the same heights in a window of any size.
    """
    size, farthest_m = exported.map.voxel_size_m, exported.terrain.farthest_m
    levels = max(2, 1 + math.ceil(math.log2(farthest_m / size)))
    first, end = _around(low, shape, 2 << levels, 1 << levels)  # as far as gaps are filled from
    standing = _standing(exported.measured, first, end)
    voxels, surfaces = standing.voxels, standing.voxels.surface_heights
    surfaces = np.where(np.isnan(surfaces), voxels.centres[:, 2], surfaces)
    is_ghost, over, is_ground = _told_apart(exported, standing, surfaces)
    x, y = (voxels.indices[:, :2] - first).astype(np.int64).T
    m, n = (end - first).tolist()
    inside = (x >= 0) & (x < m) & (y >= 0) & (y < n)
    chosen = np.flatnonzero(inside & is_ground)
    columns, hits = x[chosen] * n + y[chosen], voxels.hits[chosen]
    points = np.bincount(columns, hits, m * n).reshape(m, n).astype(np.float32)
    total = np.bincount(columns, hits * surfaces[chosen], m * n).reshape(m, n)
    measured = np.divide(
        total, points, out=np.zeros((m, n), np.float32), where=points > 0, casting="same_kind"
    )
    filled, _ = _filled(measured, (points > 0).astype(np.float32), levels)
    far = cv2.distanceTransform((points == 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    inner = tuple(slice(start, start + length) for start, length in zip(low - first, shape, strict=True))
    heights, points, far_m = filled[inner], points[inner], far[inner] * np.float32(size)
    heights[far_m > farthest_m] = np.nan
    doubt = np.where(points > 0, POINT_STDDEV_M / np.sqrt(np.maximum(points, 1)), GROWTH * far_m)
    x, y = x - inner[0].start, y - inner[1].start
    chosen = np.flatnonzero(~is_ghost & (x >= 0) & (x < shape[0]) & (y >= 0) & (y < shape[1]))
    columns, tops = x[chosen] * shape[1] + y[chosen], np.full(shape, np.nan, np.float32)
    tops.reshape(-1)[columns] = surfaces[chosen]  # in order of height: of a column the highest stays
    return Ground(
        heights, np.hypot(np.float32(LEAST_STDDEV_M), doubt), points > 0, tops, standing[chosen], columns,
        over[chosen], (surfaces[chosen] - heights.reshape(-1)[columns]).astype(np.float32),
    )  # fmt: skip


def _around(
    low: Iterable[int], shape: Iterable[int], margin: int, block: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last but one column of whole blocks that hold a window and a margin around it."""
    low = list(low)
    first = [(start - margin) // block * block for start in low]
    end = [-(-(start + length + margin) // block) * block for start, length in zip(low, shape, strict=True)]
    return np.array(first), np.array(end)


def _standing(tiled_map: TiledMap, first: NDArray[np.int64], end: NDArray[np.int64]) -> SemanticMap:
    """The voxels that were not removed, of columns from `first` to before `end` and as far around as ground is told."""
    size = tiled_map.voxel_size_m
    first, end = _around(
        first.tolist(), (end - first).tolist(), math.ceil(REACH_M / size) + BLOCK * AROUND, BLOCK
    )
    part = tiled_map.inside(((*(first * size), -np.inf), (*(end * size), np.inf)))
    return part[np.flatnonzero(part.states != State.REMOVED)]


def _told_apart(
    exported: Exported, standing: SemanticMap, surfaces: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Which voxels (v,) are reflections from below, which are over the ground, and which are ground."""
    voxels, label_set = standing.voxels, exported.map.label_set
    is_way = np.isin(standing.labels, ways := label_set.having(*WAYS))
    if exported.extent.labels[ways].sum() > exported.extent.inferred:  # images show some
        is_way &= ~standing.inferred
    blocks = voxels.indices[:, :2] // BLOCK
    x, y = (blocks - (blocks.min(axis=0, initial=1 << 30) - 1)).T
    shape = (int(x.max(initial=0)) + 2, int(y.max(initial=0)) + 2)
    ways_m = ndimage.rank_filter(_lowest(x, y, shape, surfaces, is_way), GHOSTS, size=5)
    is_ghost = surfaces < np.where(np.isinf(ways_m), -np.inf, ways_m - np.float32(DEEP_M))[x, y]
    stands, over, heights = np.flatnonzero(~is_ghost), is_ghost.copy(), np.zeros(len(x), np.float32)
    heights[stands] = height_over_ground(voxels.centres[stands])
    over[stands] = over_ground(voxels[stands], heights[stands])
    # of a kerb, the upper edge lies in a voxel over the lower one
    is_ground = (~over | np.isin(standing.labels, ways)) & (np.abs(heights) < OVER_M)
    is_ground &= ~is_ghost & ~np.isin(standing.labels, label_set.having(*STANDING))
    known = is_ground & is_way if exported.extent.labels[ways].any() else is_ground
    lowest = [_lowest(x, y, shape, surfaces, each) for each in (known, is_ground)]
    highest = _followed(lowest[0], lowest[1], exported.map.voxel_size_m)
    is_ground &= surfaces < highest[x, y] + STEP_M
    return is_ghost, over & ~is_ground, is_ground


def _lowest(
    x: NDArray[np.int32], y: NDArray[np.int32], shape: tuple[int, int], surfaces: NDArray[np.float64],
    chosen: NDArray[np.bool_],
) -> Heights:  # fmt: skip
    """The lowest of the chosen surfaces in every block; infinite where none is."""
    lowest = np.full(shape, np.inf, np.float32)
    np.minimum.at(lowest, (x[chosen], y[chosen]), surfaces[chosen])
    return lowest


def _followed(known: Heights, lowest: Heights, size: float) -> Heights:
    """How high the ground of every block may be: from those where it is known, as low as any that is in reach."""
    rise = np.float32(BLOCK * size * RISE)
    for _ in range(AROUND):
        around = cv2.erode(known, np.ones((3, 3), np.uint8)) + rise
        known = np.minimum(known, np.where(lowest < around + np.float32(STEP_M), lowest, around))
    return known


def _filled(values: Heights, weights: Heights, levels: int) -> tuple[Heights, Heights]:
    """Values, those of weight 0 interpolated from means of 2 x 2, 4 x 4 and so on; weight 0 where none is near."""
    if not levels:
        return values, weights
    wide, high = values.shape[::-1]
    pulled = cv2.resize(
        np.dstack([values * weights, weights]), (wide // 2, high // 2), interpolation=cv2.INTER_AREA
    )
    coarse, known = _filled(_ratio(pulled), np.ascontiguousarray(pulled[..., 1]), levels - 1)
    pushed = cv2.resize(np.dstack([coarse * known, known]), (wide, high), interpolation=cv2.INTER_LINEAR)
    is_known = weights > 0
    return np.where(is_known, values, _ratio(pushed)), np.where(
        is_known, weights, np.asarray(pushed[..., 1], np.float32)
    )


def _ratio(weighted: NDArray[Any]) -> Heights:
    return np.asarray(weighted[..., 0] / np.maximum(weighted[..., 1], np.float32(1e-20)), np.float32)

"""The objects of one scan: what the image calls a vehicle, and what stands around the car and is no larger than one."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from gnss_sem_map.refinement.dbscan import dbscan
from gnss_sem_map.voxel_map import keys_of, unpack

VOXEL_M = 0.2
CLOSER = 0.5
"""What may be two vehicles is taken apart at this share of the distance."""
PART_M = 0.2
"""A segment inside the box of another, or this far outside, is a part of it: a far edge of a roof, a mirror."""
GROUND_CELL_M = 1.0
LARGE_M, LONGEST_M, HIGHEST_M, LEAST_HEIGHT_M = 8.0, 12.0, 4.0, 0.6
"""What is longer than the first is perhaps two vehicles. A segment that reaches beyond what the image shows is no
larger than the next two, a lorry or a bus, and one that no image shows no lower than the last."""
LEAST_POINTS = 20
"""A segment that no image shows has at least so many points."""
MIXED_SHARE, LEAST_DENSE_POINTS = 0.2, 200
"""A segment is two objects only when each has at least this share of its points, and so many: fewer are sparse, so
that one object comes apart as well."""


@njit(cache=True, nogil=True)
def _boxes(points, clusters, count):
    """Lowest and highest corner of the points (n, d) of every cluster: (count, d) each."""
    low, high = np.full((count, points.shape[1]), np.inf), np.full((count, points.shape[1]), -np.inf)
    for i in range(len(points)):
        for axis in range(points.shape[1]):
            low[clusters[i], axis] = min(low[clusters[i], axis], points[i, axis])
            high[clusters[i], axis] = max(high[clusters[i], axis], points[i, axis])
    return low, high


@njit(cache=True, nogil=True)
def _whole(low, high):
    """The cluster that each one is part of: its own, or the first of vehicle size whose box (s, 2) holds its box."""
    owners = np.arange(len(low))
    for j in range(len(low)):
        if np.hypot(high[j, 0] - low[j, 0], high[j, 1] - low[j, 1]) > LARGE_M or owners[j] != j:
            continue
        west, south = low[j, 0] - PART_M, low[j, 1] - PART_M
        east, north = high[j, 0] + PART_M, high[j, 1] + PART_M
        for i in range(len(low)):
            if west <= low[i, 0] and south <= low[i, 1] and high[i, 0] <= east and high[i, 1] <= north:
                owners[i] = j if owners[i] == i else owners[i]
    for i in range(len(low)):  # an owner may itself have been found to be a part
        while owners[owners[i]] != owners[i]:
            owners[i] = owners[owners[i]]
    return np.searchsorted(np.unique(owners), owners)


@njit(cache=True, nogil=True)
def _cells(p_map, size_m):
    """Cell in x and y of every point (n, 3), from 0, and how many cells there are."""
    cells = np.empty((len(p_map), 2), np.int64)
    for i in range(len(p_map)):
        cells[i, 0], cells[i, 1] = np.floor(p_map[i, 0] / size_m), np.floor(p_map[i, 1] / size_m)
    for axis in range(2):
        cells[:, axis] -= cells[:, axis].min()
    return cells, (cells[:, 0].max() + 1, cells[:, 1].max() + 1)


@njit(cache=True, nogil=True)
def _lowest(cells, z, ground):
    for i in range(len(z)):
        ground[cells[i, 0], cells[i, 1]] = min(ground[cells[i, 0], cells[i, 1]], z[i])


def height_over_ground(p_map: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of every point of one scan (n, 3) over the lowest of its 1 m cell and the eight around it: (n,) m."""
    if len(p_map) == 0:
        return np.zeros(0)
    cells, shape = _cells(p_map, GROUND_CELL_M)
    ground = np.full(shape, np.inf)
    _lowest(cells, p_map[:, 2], ground)
    ground = ndimage.minimum_filter(ground, size=3, mode="constant", cval=np.inf)
    return np.asarray(p_map[:, 2] - ground[cells[:, 0], cells[:, 1]])


def find_segments(
    p_map: NDArray[np.float64], is_object: NDArray[np.bool_], is_known: NDArray[np.bool_], eps_m: float
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Segment of every point above ground (n, 3), -1 for none; and which segments (s,) the edge of the view cuts.

    `is_object` says which points the image calls a vehicle, `is_known` which it shows at all. A vehicle at the edge
    of the view goes on in the points around it, if the whole is no larger than a vehicle; else its shown part is a
    segment, marked as cut. Where nothing is known, whatever has a vehicle's size is a segment.
    """
    segments = np.full(len(p_map), -1, np.int32)
    candidates = np.flatnonzero(is_object | ~is_known)
    if len(candidates) == 0:
        return segments, np.zeros(0, np.bool_)
    clusters = _objects(p_map[candidates], eps_m)
    shown = np.bincount(clusters, is_object[candidates]) > 0
    points = np.bincount(clusters)
    low, high = _boxes(p_map[candidates], clusters, len(points))
    length, height = np.hypot(*(high - low)[:, :2].T), (high - low)[:, 2]
    fits = (length <= LONGEST_M) & (height <= HIGHEST_M)
    fits &= shown | ((height >= LEAST_HEIGHT_M) & (points >= LEAST_POINTS))
    numbers = np.where(fits, np.cumsum(fits) - 1, -1).astype(np.int32)
    segments[candidates] = numbers[clusters]
    rest = candidates[~fits[clusters] & is_object[candidates]]
    parts = _cluster(p_map[rest], eps_m)
    segments[rest] = parts + fits.sum()
    joined = points > np.bincount(clusters, is_object[candidates])  # with points that the image does not show
    cut = np.zeros(parts.max(initial=-1) + 1, np.bool_)
    cut[parts] = joined[clusters[~fits[clusters] & is_object[candidates]]]
    return segments, np.concatenate([np.zeros(fits.sum(), np.bool_), cut])


def _objects(p_map: NDArray[np.float64], eps_m: float) -> NDArray[np.int64]:
    """Cluster of every point (n, 3): what is too large comes apart, and what is a part of another is joined to it."""
    clusters = _cluster(p_map, eps_m).astype(np.int64)
    low, high = _boxes(p_map[:, :2], clusters, clusters.max() + 1)
    large = np.hypot(*(high - low).T)[clusters] > LARGE_M
    clusters[large] = _cluster(p_map[large], CLOSER * eps_m) + clusters.max() + 1
    clusters = np.unique(clusters, return_inverse=True)[1]
    return np.asarray(_whole(*_boxes(p_map[:, :2], clusters, clusters.max() + 1))[clusters])


def take_apart(
    p_map: NDArray[np.float64],
    segments: NDArray[np.int32],
    hits: NDArray[np.int32],
    throughs: NDArray[np.int32],
    eps_m: float,
    least_through_per_hit: float,
) -> NDArray[np.int32]:
    """Segments (n,) of points (n, 3), where what once was empty is apart from what always stood beside it.

    A mover that passes something closely is one segment with it. If a good part of a segment was seen through, by
    `throughs` (n,) and `hits` (n,), and a good part was not, it is clustered again, more closely, and its clusters
    that were seen through become a new segment.
    """
    once_empty = throughs > least_through_per_hit * hits
    counts = np.bincount(segments[segments >= 0])
    emptied = np.bincount(segments[once_empty & (segments >= 0)], minlength=len(counts))
    stood = np.bincount(segments[(hits > 0) & (throughs == 0) & (segments >= 0)], minlength=len(counts))
    least = np.maximum(MIXED_SHARE * counts, LEAST_DENSE_POINTS)
    apart, count = segments.copy(), len(counts)
    for number in np.flatnonzero((emptied >= least) & (stood >= least)):
        part = np.flatnonzero(segments == number)
        clusters = _cluster(p_map[part], CLOSER * eps_m)
        hit, through = np.bincount(clusters, hits[part]), np.bincount(clusters, throughs[part])
        left = (through > least_through_per_hit * hit)[clusters]
        if min(left.sum(), (~left).sum()) >= least[number]:
            apart[part[left]] = count
            count += 1
    return apart


def _cluster(p_map: NDArray[np.float64], eps_m: float) -> NDArray[np.int32]:
    """Cluster of every point (n, 3): those of neighbouring 0.2 m voxels belong together."""
    keys, voxel = np.unique(keys_of(p_map, VOXEL_M), return_inverse=True)
    return dbscan(unpack(keys), eps_m / VOXEL_M, min_samples=1)[voxel]


def near(p_map: NDArray[np.float64], marked: NDArray[np.bool_], reach_m: float) -> NDArray[np.bool_]:
    """Points (n, 3) in a square cell of `reach_m` that holds a marked point, or beside one."""
    if reach_m == 0 or not marked.any():
        return marked
    cells, shape = _cells(p_map, reach_m)
    grid = np.zeros(shape, np.bool_)
    grid[cells[marked, 0], cells[marked, 1]] = True
    grid = ndimage.binary_dilation(grid, np.ones((3, 3), np.bool_))
    return np.asarray(grid[cells[:, 0], cells[:, 1]])

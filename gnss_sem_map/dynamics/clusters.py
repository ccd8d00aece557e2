"""Segments of one scan: candidates for vehicles, found by clustering.

A candidate has points that the image labels as movable, or lies outside of the image and has the size of a vehicle.
Points are grouped into voxels once, and segments are computed from voxels: a scan has ten times as many points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.voxels.dbscan import dbscan
from gnss_sem_map.voxels.hash_unique import distinct
from gnss_sem_map.voxels.voxel_map import keys_of, unpack

VOXEL_M = 0.2
SPLIT_EPS_SHARE = 0.5
"""A segment that may be two vehicles is clustered again with this share of the distance."""
PART_M = 0.2
"""A segment inside the bounding box of another, extended by this, is a part of it: the far edge of a roof, a mirror."""
LARGE_M, LONGEST_M, HIGHEST_M, LEAST_HEIGHT_M = 8.0, 19.0, 4.2, 0.5
"""A segment longer than LARGE_M may be two vehicles. A segment that extends beyond the image has at most LONGEST_M and
HIGHEST_M, the size of a lorry or a bus. One without vehicle labels is at least LEAST_HEIGHT_M high: of a car behind the
LiDAR only the front returns points, not the windscreen."""
LEAST_BEAMS = 20
"""A segment without vehicle labels has at least so many points, or as many as fewer rings show of the same surface."""
MIXED_SHARE, LEAST_DENSE_POINTS = 0.2, 200
"""A segment is split into two objects only when each has at least this share of its points and at least so many points:
a sparse object would be split as well."""


@dataclass(frozen=True, eq=False)
class PointSets:
    """Sets of points of one scan (voxels, clusters or segments), with the statistics of each set."""

    points: NDArray[np.int32]
    """(p,) number of points."""
    labelled: NDArray[np.int32]
    """(p,) number of points that the image labels as movable."""
    sums: NDArray[np.float64]
    """(p, 3) m: sums of the coordinates."""
    lowest: NDArray[np.float64]
    """(p, 3) m: lower corner of the bounding box; (p, 0) without one."""
    highest: NDArray[np.float64]
    """(p, 3) or (p, 0) m: upper corner of the bounding box."""

    @classmethod
    def of(
        cls,
        p_map: NDArray[np.float64],
        is_object: NDArray[np.bool_],
        gaps_m: NDArray[np.float64],
        part: NDArray[np.int32],
        count: int,
    ) -> PointSets:
        """The sets of points (n, 3): `part` (n,) is the set of each point, 0 to `count` - 1, or -1 for none.

        A point stands for half of the gap (n,) m between the rings above and below it.
        """
        sets = cls._empty(count)
        _collect(
            p_map, is_object, gaps_m, part, sets.points, sets.labelled, sets.sums, sets.lowest, sets.highest
        )
        return sets

    @classmethod
    def _empty(cls, count: int, axes: int = 3) -> PointSets:
        """So many sets without points, whose boxes have so many axes."""
        low = np.full((count, axes), np.inf)
        return cls(np.zeros(count, np.int32), np.zeros(count, np.int32), np.zeros((count, 3)), low, -low)

    def merged(self, whole: NDArray[np.integer], count: int) -> PointSets:
        """Unions of these sets: `whole` (p,) is the union of each set, 0 to `count` - 1, or -1 for none."""
        merged = self._empty(count, self.lowest.shape[1])
        _merge(
            self.points, self.labelled, self.sums, self.lowest, self.highest, whole,
            merged.points, merged.labelled, merged.sums, merged.lowest, merged.highest,
        )  # fmt: skip
        return merged

    def without_boxes(self) -> PointSets:
        """The same without boxes, which take half the memory of 450 scans."""
        none = np.empty((len(self.points), 0))
        return replace(self, lowest=none, highest=none)


@njit(cache=True, nogil=True)
def _collect(p_map, is_object, gaps_m, part, points, labelled, sums, lowest, highest):
    for i in range(len(part)):
        p = part[i]
        if p < 0:
            continue
        points[p] += 1
        labelled[p] += is_object[i]
        for axis in range(3):
            half = 0.5 * gaps_m[i] if axis == 2 else 0.0
            sums[p, axis] += p_map[i, axis]
            lowest[p, axis] = min(lowest[p, axis], p_map[i, axis] - half)
            highest[p, axis] = max(highest[p, axis], p_map[i, axis] + half)


@njit(cache=True, nogil=True)
def _merge(
    points, labelled, sums, lowest, highest, whole, all_points, all_named, all_sums, all_lowest, all_highest
):
    for i in range(len(whole)):
        w = whole[i]
        if w < 0:
            continue
        all_points[w] += points[i]
        all_named[w] += labelled[i]
        for axis in range(3):
            all_sums[w, axis] += sums[i, axis]
        for axis in range(lowest.shape[1]):
            all_lowest[w, axis] = min(all_lowest[w, axis], lowest[i, axis])
            all_highest[w, axis] = max(all_highest[w, axis], highest[i, axis])


def boxes_of(
    places: NDArray[np.float64], part: NDArray[np.integer], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest coordinates (p, k) m of sets of places (v, k); `part` as in `PointSets.of`."""
    lowest = np.full((count, places.shape[1]), np.inf)
    highest = -lowest
    _bound(places, part, lowest, highest)
    return lowest, highest


@njit(cache=True, nogil=True)
def _bound(places, part, lowest, highest):
    for i in range(len(part)):
        p = part[i]
        if p < 0:
            continue
        for axis in range(places.shape[1]):
            lowest[p, axis] = min(lowest[p, axis], places[i, axis])
            highest[p, axis] = max(highest[p, axis], places[i, axis])


@dataclass(frozen=True, eq=False)
class Segments:
    """The segments of one scan, stored by voxel."""

    keys: NDArray[np.int64]
    """(v,) keys of the voxels, in ascending order; each voxel belongs to one segment at most."""
    parts: PointSets
    """(v,) the points of each voxel that belong to its segment."""
    number: NDArray[np.int32]
    """(v,) the segment of each voxel, -1 for one in a cluster that is no object: it is too large, or too small."""
    truncated: NDArray[np.bool_]
    """(s,) segments that are cut off by the edge of the image or hidden in part by something nearer."""

    def of_points(self, voxel: NDArray[np.int32]) -> NDArray[np.int32]:
        """Segment of every point (n,), -1 for none; `voxel` (n,) is the index of the voxel of each, -1 for none."""
        return np.append(self.number, np.int32(-1)).take(voxel)

    @property
    def whole(self) -> PointSets:
        """Statistics of every segment (s,)."""
        return self.parts.merged(self.number, len(self.truncated))

    def outline(self, number: int) -> NDArray[np.float32]:
        """The voxels of a segment by the means of their points (v, 2) m."""
        return self.means(number)[:, :2].astype(np.float32)

    def means(self, number: int) -> NDArray[np.float64]:
        """The voxels of a segment by the means of their points (v, 3) m."""
        return np.asarray(_means(self.number, number, self.parts.points, self.parts.sums))

    def levels(self) -> list[tuple[float, float]]:
        """For every segment the lowest and the highest of its voxels, by the means of their points, m."""
        heights = self.parts.sums[:, 2:] / self.parts.points[:, None]
        lowest, highest = boxes_of(heights, self.number, len(self.truncated))
        return list(zip(lowest[:, 0].tolist(), highest[:, 0].tolist(), strict=True))

    def sums_of(self, counts: NDArray[np.int32]) -> NDArray[np.float64]:
        """Sums over the points of every segment (k, s) of k counts per voxel (k, v)."""
        return np.array([self.sums(row * self.parts.points) for row in counts], np.float64)

    def sums(self, values: NDArray[np.generic]) -> NDArray[np.float64]:
        """Sums over the voxels of every segment (s,) of values of all voxels (v,)."""
        return np.asarray(np.bincount(self.number + 1, values, len(self.truncated) + 1)[1:], np.float64)


@njit(cache=True, nogil=True)
def _means(number, wanted, points, sums):
    mine, count = np.empty(len(number), np.int32), 0
    for v in range(len(number)):
        mine[count] = v  # kept only if it counts: no branch
        count += number[v] == wanted
    means = np.empty((count, 3))
    for i in range(count):
        for axis in range(3):
            means[i, axis] = sums[mine[i], axis] / points[mine[i]]
    return means


@njit(cache=True, nogil=True)
def _enclosing_clusters(low, high):
    """For each cluster the cluster that contains it: itself, or the first of vehicle size whose box contains its box.

    `low` and `high` (s, 2 or 3) are the corners of the boxes; only east and north count.
    """
    owners = np.arange(len(low))
    for j in range(len(low)):
        if np.hypot(high[j, 0] - low[j, 0], high[j, 1] - low[j, 1]) > LARGE_M or owners[j] != j:
            continue
        west, south = low[j, 0] - PART_M, low[j, 1] - PART_M
        east, north = high[j, 0] + PART_M, high[j, 1] + PART_M
        for i in range(len(low)):
            if west <= low[i, 0] and south <= low[i, 1] and high[i, 0] <= east and high[i, 1] <= north:
                owners[i] = j if owners[i] == i else owners[i]
    for i in range(len(low)):  # a containing cluster may itself be a part of another
        while owners[owners[i]] != owners[i]:
            owners[i] = owners[owners[i]]
    return owners


def find_segments(
    p_map: NDArray[np.float64],
    is_object: NDArray[np.bool_],
    gaps_m: NDArray[np.float64],
    beams: NDArray[np.float64],
    eps_m: float,
) -> tuple[Segments, NDArray[np.int32]]:
    """Segments of points above ground (n, 3) m by DBSCAN, with those marked that the edge of the image truncates.

    Returns them, and for every point (n,) the index of its voxel, -1 for a point in no segment.
    `is_object` (n,) marks the points that the image labels as movable; the other points lie outside of the image.
    `gaps_m` (n,) lie between the rings above and below each point, 0 where none is wide; `beams` (n,) would
    have hit it if rows of a cell adjoined. A
    vehicle at the edge of the image continues in the points around it, if the whole is no larger than a vehicle; else
    its labelled part is a segment, marked as truncated. Outside of the image, every cluster with the size of a vehicle
    is a segment. Source: the clustering of section 3.3.2 (Ester et al., 1996), here on single scans.
    """
    keys, voxel = distinct(keys_of(p_map, VOXEL_M))
    voxels = PointSets.of(p_map, is_object, gaps_m, voxel, len(keys))
    clusters, count = _object_clusters(keys, voxels, eps_m)
    whole = voxels.merged(clusters, count)
    of_voxels = np.bincount(voxel, beams, len(keys))
    fits = _is_vehicle_sized(whole, np.asarray(np.bincount(clusters, of_voxels, count), np.float64))
    number = np.where(fits, np.cumsum(fits) - 1, -1).astype(np.int32)[clusters]
    # of clusters that are too large or too small, the labelled part
    shown = ~fits[clusters] & (voxels.labelled > 0)
    part = cluster(keys[shown], eps_m)
    number[shown] = part + np.int32(fits.sum())
    truncated = np.zeros(part.max(initial=-1) + 1, np.bool_)
    # those whose cluster has points outside of the image
    truncated[part] = (whole.points > whole.labelled)[clusters[shown]]
    row = np.where(is_object | ~shown.take(voxel), voxel, np.int32(-1))
    parts = voxels.without_boxes()
    _keep_labelled(p_map, is_object, voxel, shown, parts.points, parts.sums)
    all_truncated = np.concatenate([np.zeros(fits.sum(), np.bool_), truncated])
    return Segments(keys, parts, number, all_truncated), row


@njit(cache=True, nogil=True)
def _keep_labelled(p_map, is_object, voxel, shown, points, sums):
    """Count and sum (v,), (v, 3) only the labelled points of the voxels that are `shown` (v,)."""
    for v in np.flatnonzero(shown):
        points[v], sums[v] = 0, 0.0
    for i in range(len(voxel)):
        v = voxel[i]
        if shown[v] and is_object[i]:
            points[v] += 1
            for axis in range(3):
                sums[v, axis] += p_map[i, axis]


def _is_vehicle_sized(whole: PointSets, beams: NDArray[np.float64]) -> NDArray[np.bool_]:
    size = whole.highest - whole.lowest
    length, height = np.hypot(size[:, 0], size[:, 1]), size[:, 2]
    unnamed = (height >= LEAST_HEIGHT_M) & (beams >= LEAST_BEAMS)
    return np.asarray((length <= LONGEST_M) & (height <= HIGHEST_M) & ((whole.labelled > 0) | unnamed))


def _object_clusters(
    keys: NDArray[np.int64], voxels: PointSets, eps_m: float
) -> tuple[NDArray[np.int64], int]:
    """Cluster of every voxel (v,) and the number of clusters.

    Clusters that are too large are split; clusters inside the box of another are merged with it.
    """
    clusters = cluster(keys, eps_m)
    count = int(clusters.max(initial=-1)) + 1
    boxes = voxels.merged(clusters, count)
    size = boxes.highest - boxes.lowest
    large = (np.hypot(size[:, 0], size[:, 1]) > LARGE_M)[clusters]
    clusters[large] = cluster(keys[large], SPLIT_EPS_SHARE * eps_m) + np.int32(count)
    is_used = np.bincount(clusters) > 0
    of_used = (np.cumsum(is_used) - 1)[clusters]
    boxes = voxels.merged(of_used, int(is_used.sum()))
    kept, owners = np.unique(_enclosing_clusters(boxes.lowest, boxes.highest), return_inverse=True)
    return owners[of_used], len(kept)


def split_segments(
    segments: Segments,
    hits: NDArray[np.int32],
    misses: NDArray[np.int32],
    eps_m: float,
    displaced_misses_per_hit: float,
) -> Segments:
    """Split segments that hold both a moving object and something static beside it.

    A moving object that passes something closely is in one segment with it. `hits` and `misses` (v,) count the scans
    that hit each voxel and that saw through it. If a large share of a segment was seen through and a large share was
    not, the segment is clustered again with a smaller distance, and its clusters that were seen through become a new
    segment.
    """
    points, number = segments.parts.points, segments.number
    once_empty = misses > displaced_misses_per_hit * hits
    stood = (hits > 0) & (misses == 0)
    all_of, empty_of, stood_of = (
        segments.sums(points * which) for which in (np.ones_like(stood), once_empty, stood)
    )
    least = np.maximum(MIXED_SHARE * all_of, LEAST_DENSE_POINTS)
    truncated = segments.truncated
    for mixed in np.flatnonzero((empty_of >= least) & (stood_of >= least)):
        part = np.flatnonzero(number == mixed)
        clusters = cluster(segments.keys[part], SPLIT_EPS_SHARE * eps_m)
        hit, missed = (np.bincount(clusters, points[part] * counts[part]) for counts in (hits, misses))
        moved = (missed > displaced_misses_per_hit * hit)[clusters]
        if min(points[part[moved]].sum(), points[part[~moved]].sum()) >= least[mixed]:
            number = number.copy()
            number[part[moved]] = len(truncated)
            truncated = np.append(truncated, truncated[mixed])
    return replace(segments, number=number, truncated=truncated)


def cluster(keys: NDArray[np.int64], eps_m: float) -> NDArray[np.int32]:
    """Cluster of every voxel (v,): voxels nearer than `eps_m` are in one cluster."""
    return dbscan(unpack(keys), eps_m / VOXEL_M, min_samples=1)

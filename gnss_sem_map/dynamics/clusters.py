"""The objects of one scan: what the image calls a vehicle, and what stands around the car and is no larger than one.

Points are gathered into voxels once, and whatever is asked of a segment is asked of those: a scan has ten times as many
points.
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
CLOSER = 0.5
"""What may be two vehicles is taken apart at this share of the distance."""
PART_M = 0.2
"""A segment inside the box of another, or this far outside, is a part of it: a far edge of a roof, a mirror."""
LARGE_M, LONGEST_M, HIGHEST_M, LEAST_HEIGHT_M = 8.0, 12.0, 4.0, 0.5
"""What is longer than the first is perhaps two vehicles. A segment that reaches beyond what the image shows is no
larger than the next two, a lorry or a bus, and one that no image shows no lower than the last: what comes back of a car
behind is its front, without the windscreen."""
LEAST_POINTS = 20
"""A segment that no image shows has at least so many points."""
MIXED_SHARE, LEAST_DENSE_POINTS = 0.2, 200
"""A segment is two objects only when each has at least this share of its points, and so many: fewer are sparse, so
that one object comes apart as well."""


@dataclass(frozen=True, eq=False)
class Parts:
    """Sets of points of one scan, and what is asked of each of them."""

    points: NDArray[np.int64]
    """(p,) how many it has."""
    named: NDArray[np.int64]
    """(p,) how many of them the image calls a vehicle."""
    sums: NDArray[np.float64]
    """(p, 3) m: of their coordinates."""
    lowest: NDArray[np.float64]
    """(p, 3) m: corner of the box around them."""
    highest: NDArray[np.float64]
    """(p, 3) m: the opposite corner."""

    @classmethod
    def of(
        cls, p_map: NDArray[np.float64], is_object: NDArray[np.bool_], part: NDArray[np.int32], count: int
    ) -> Parts:
        """Of points (n, 3): `part` (n,) says to which of `count` parts each belongs, -1 for none."""
        ones = np.ones(len(p_map), np.int64)
        return cls(ones, is_object.astype(np.int64), p_map, p_map, p_map).joined(part, count)

    def joined(self, whole: NDArray[np.integer], count: int) -> Parts:
        """Parts of these parts: `whole` (p,) says to which of `count` each belongs, -1 for none."""
        low = np.full((count, 3), np.inf)
        joined = Parts(np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros((count, 3)), low, -low)
        _join(
            self.points, self.named, self.sums, self.lowest, self.highest, whole,
            joined.points, joined.named, joined.sums, joined.lowest, joined.highest,
        )  # fmt: skip
        return joined


@njit(cache=True, nogil=True)
def _join(
    points, named, sums, lowest, highest, whole, all_points, all_named, all_sums, all_lowest, all_highest
):
    for i in range(len(whole)):
        w = whole[i]
        if w < 0:
            continue
        all_points[w] += points[i]
        all_named[w] += named[i]
        for axis in range(3):
            all_sums[w, axis] += sums[i, axis]
            all_lowest[w, axis] = min(all_lowest[w, axis], lowest[i, axis])
            all_highest[w, axis] = max(all_highest[w, axis], highest[i, axis])


@dataclass(frozen=True, eq=False)
class Segments:
    """The segments of one scan, voxel by voxel."""

    voxel: NDArray[np.int32]
    """(n,) of every point, -1 for one in no segment."""
    keys: NDArray[np.int64]
    """(v,) the voxels, in ascending order; each is of one segment."""
    parts: Parts
    """(v,) what of each voxel belongs to its segment."""
    number: NDArray[np.int32]
    """(v,) its segment."""
    cut: NDArray[np.bool_]
    """(s,) segments that the edge of the view or something nearer cuts."""

    @property
    def of_points(self) -> NDArray[np.int32]:
        """Segment of every point (n,), -1 for none."""
        return np.append(self.number, np.int32(-1)).take(self.voxel)

    @property
    def whole(self) -> Parts:
        """What is asked of every segment (s,)."""
        return self.parts.joined(self.number, len(self.cut))

    def points_of(self, which: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Points (n,) of some of the segments (s,)."""
        return np.append(which[self.number], False).take(self.voxel)

    def sums_of(self, looks: NDArray[np.int32]) -> NDArray[np.float64]:
        """What the points of every segment sum up to (k, s), of k things that are known of every voxel (k, v)."""
        weights, count = looks * self.parts.points, len(self.cut)
        return np.array([np.bincount(self.number, row, count) for row in weights], np.float64)


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


def find_segments(p_map: NDArray[np.float64], is_object: NDArray[np.bool_], eps_m: float) -> Segments:
    """Segments among points above ground (n, 3), and which of them the edge of the view cuts.

    `is_object` says which points the image calls a vehicle; the others it does not show. A vehicle at the edge of the
    view goes on in the points around it, if the whole is no larger than a vehicle; else its shown part is a segment,
    marked as cut. Where the image shows nothing, whatever has a vehicle's size is a segment.
    """
    keys, voxel = distinct(keys_of(p_map, VOXEL_M))
    voxels = Parts.of(p_map, is_object, voxel, len(keys))
    clusters, count = _objects(keys, voxels, eps_m)
    whole = voxels.joined(clusters, count)
    fits = _is_vehicle_sized(whole)
    number = np.where(fits, np.cumsum(fits) - 1, -1).astype(np.int32)[clusters]
    shown = ~fits[clusters] & (voxels.named > 0)  # of what is too large, or too small, the part with a name
    part = _cluster(keys[shown], eps_m)
    number[shown] = part + np.int32(fits.sum())
    cut = np.zeros(part.max(initial=-1) + 1, np.bool_)
    cut[part] = (whole.points > whole.named)[clusters[shown]]  # with points that the image does not show
    kept = number >= 0
    row_of = np.where(kept, np.cumsum(kept, dtype=np.int32) - 1, -1).astype(np.int32)
    row = np.where(is_object | ~shown.take(voxel), row_of.take(voxel), np.int32(-1))
    parts = Parts.of(p_map, is_object, row, int(kept.sum()))
    return Segments(
        row, keys[kept], parts, number[kept], np.concatenate([np.zeros(fits.sum(), np.bool_), cut])
    )


def _is_vehicle_sized(whole: Parts) -> NDArray[np.bool_]:
    size = whole.highest - whole.lowest
    length, height = np.hypot(size[:, 0], size[:, 1]), size[:, 2]
    unnamed = (height >= LEAST_HEIGHT_M) & (whole.points >= LEAST_POINTS)
    return np.asarray((length <= LONGEST_M) & (height <= HIGHEST_M) & ((whole.named > 0) | unnamed))


def _objects(keys: NDArray[np.int64], voxels: Parts, eps_m: float) -> tuple[NDArray[np.int64], int]:
    """Cluster of every voxel (v,) and their number.

    What is too large comes apart, and what is a part of another is joined to it.
    """
    clusters = _cluster(keys, eps_m)
    count = int(clusters.max(initial=-1)) + 1
    boxes = voxels.joined(clusters, count)
    size = boxes.highest - boxes.lowest
    large = (np.hypot(size[:, 0], size[:, 1]) > LARGE_M)[clusters]
    clusters[large] = _cluster(keys[large], CLOSER * eps_m) + np.int32(count)
    used, of_used = np.unique(clusters, return_inverse=True)
    boxes = voxels.joined(of_used, len(used))
    owners = _whole(boxes.lowest, boxes.highest)
    return owners[of_used], int(owners.max(initial=-1)) + 1


def take_apart(
    segments: Segments,
    hits: NDArray[np.int32],
    throughs: NDArray[np.int32],
    eps_m: float,
    least_through_per_hit: float,
) -> Segments:
    """Segments where what once was empty is apart from what always stood beside it.

    A mover that passes something closely is one segment with it. If a good part of a segment was seen through, by
    `throughs` (v,) and `hits` (v,) of its voxels, and a good part was not, it is clustered again, more closely, and its
    clusters that were seen through become a new segment.
    """
    points, number, count = segments.parts.points, segments.number.copy(), len(segments.cut)
    once_empty = throughs > least_through_per_hit * hits
    stood = (hits > 0) & (throughs == 0)
    all_of, empty_of, stood_of = (
        np.bincount(number, points * which, count) for which in (np.ones_like(stood), once_empty, stood)
    )
    least = np.maximum(MIXED_SHARE * all_of, LEAST_DENSE_POINTS)
    cut = segments.cut
    for mixed in np.flatnonzero((empty_of >= least) & (stood_of >= least)):
        part = np.flatnonzero(number == mixed)
        clusters = _cluster(segments.keys[part], CLOSER * eps_m)
        hit, through = (np.bincount(clusters, points[part] * looks[part]) for looks in (hits, throughs))
        left = (through > least_through_per_hit * hit)[clusters]
        if min(points[part[left]].sum(), points[part[~left]].sum()) >= least[mixed]:
            number[part[left]] = len(cut)
            cut = np.append(cut, cut[mixed])
    return replace(segments, number=number, cut=cut)


def _cluster(keys: NDArray[np.int64], eps_m: float) -> NDArray[np.int32]:
    """Cluster of every voxel: neighbouring ones belong together."""
    return dbscan(unpack(keys), eps_m / VOXEL_M, min_samples=1)

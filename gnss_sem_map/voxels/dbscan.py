"""DBSCAN on integer voxels: scikit-learn's result, found with bit masks instead of distances.

A column of voxels is a row of bits. The neighbours of a voxel are then one shift and one popcount per column
of the ball around it, and because voxels and columns are sorted alike, looking up a column is a step of a
merge.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import int64, njit, uint64
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.voxels.kernels import AXIS_OFFSET
from gnss_sem_map.voxels.voxel_map import pack

NOISE = -1
"""Cluster of a voxel that belongs to none."""
LARGEST_EPS_VOXELS = 16
"""A 64-bit word holds a window of +-16 voxels around each of its 32 middle bits."""
TIE = 1e-9
"""Voxels at exactly eps are neighbours even where eps is a rounded quotient: 0.6 / 0.2 is below 3."""
_BLOCK_BITS, _Y_BITS, _MARGIN = 17, 22, 1 << 5
_BLOCK_MASK = (1 << _BLOCK_BITS) - 1
"""A word's key is x, y and z / 32 in one integer, with room on all sides for the stencil."""


def dbscan(indices: NDArray[np.integer], eps_voxels: float, min_samples: int) -> NDArray[np.int32]:
    """Clusters of voxels, as `sklearn.cluster.DBSCAN(eps_voxels, min_samples=min_samples)` numbers them.

    `indices` (v, 3) integers, each voxel once, in any order; returns (v,) cluster numbers from 0, -1 for
    noise. A voxel counts among its own neighbours; a border voxel goes to the first cluster that reaches it.
    Raises ConfigError for a radius that is not positive or fewer than one sample, DataError for repeated or
    far indices. Source: Ester, Kriegel, Sander, Xu, "A density-based algorithm for discovering clusters"
    (1996).
    """
    if not eps_voxels > 0 or min_samples < 1:
        raise ConfigError(
            f"dbscan: found eps {eps_voxels} voxels, {min_samples} samples; expected more than 0, at least 1"
        )
    voxels = np.asarray(indices, np.int64).reshape(-1, 3)
    if len(voxels) == 0:
        return np.empty(0, np.int32)
    if voxels.min() < -AXIS_OFFSET or voxels.max() >= AXIS_OFFSET:
        raise DataError(
            f"dbscan: found indices from {voxels.min()} to {voxels.max()}, expected +-{AXIS_OFFSET}"
        )
    if eps_voxels + TIE >= LARGEST_EPS_VOXELS + 1:
        return _dbscan_by_distance(voxels, eps_voxels, min_samples)
    keys, positions = pack(voxels), np.arange(len(voxels))
    if (np.diff(keys) > 0).all():
        return _dbscan_sorted(voxels, positions, eps_voxels, min_samples)
    order = np.argsort(keys, kind="stable")
    if (np.diff(keys[order]) == 0).any():
        raise DataError("dbscan: found a voxel twice, expected each once; pass unique indices")
    clusters = np.empty(len(voxels), np.int32)
    positions[order] = positions.copy()
    clusters[order] = _dbscan_sorted(voxels[order], positions, eps_voxels, min_samples)
    return clusters


def _dbscan_sorted(
    voxels: NDArray[np.int64], positions: NDArray[np.int64], eps_voxels: float, min_samples: int
) -> NDArray[np.int32]:
    """Clusters of sorted voxels, numbered in the order of `positions`: where the input's voxels now are."""
    x, y, z = np.ascontiguousarray((voxels + AXIS_OFFSET).T)
    columns = ((x + _MARGIN) << _Y_BITS | (y + _MARGIN)) << _BLOCK_BITS
    keys, masks, first, own, bits = _words(columns, z)
    parents, half_heights = np.arange(len(voxels)), _half_heights(eps_voxels)
    if min_samples == 1:  # every voxel is its own sample
        _join_cores(keys, masks, first, own, bits, half_heights, parents)
        return np.asarray(_number(parents, positions))
    stencil = _stencil(eps_voxels)
    core = _count_neighbours(keys, masks, own, bits, stencil) >= min_samples
    around = keys[own]
    keys, masks, first, own, core_bits = _words(columns[core], z[core])
    parents = parents[: core.sum()]
    _join_cores(keys, masks, first, own, core_bits, half_heights, parents)
    rank = np.cumsum(core) - 1
    clusters = np.full(len(voxels), NOISE, np.int32)
    clusters[core] = _number(parents, rank[positions[core[positions]]])
    border = clusters[~core]
    _reach_borders(around[~core], bits[~core], keys, masks, first, stencil, clusters[core], border)
    clusters[~core] = border
    return clusters


def _dbscan_by_distance(voxels: NDArray[np.int64], eps_voxels: float, min_samples: int) -> NDArray[np.int32]:
    from sklearn.cluster import DBSCAN

    return np.asarray(DBSCAN(eps=eps_voxels + TIE, min_samples=min_samples).fit(voxels).labels_, np.int32)


@cache
def _half_heights(eps_voxels: float) -> NDArray[np.int64]:
    """Half height in voxels (r + 1, 2 r + 1) of the ball, r its radius, in each column from x = 0 and y = -r on.

    -1 for a column outside of it.
    """
    reach, limit = int(eps_voxels + TIE), (eps_voxels + TIE) ** 2
    x, y = np.arange(reach + 1)[:, None], np.arange(-reach, reach + 1)
    rest = limit - x * x - y * y
    return np.where(rest >= 0, np.sqrt(np.maximum(rest, 0.0)).astype(np.int64), -1)


@cache
def _stencil(eps_voxels: float) -> NDArray[np.int64]:
    """Columns within the radius: (k, 2) packed offset, ascending, and half height in voxels."""
    half_heights = _half_heights(eps_voxels)
    reach = len(half_heights) - 1
    rows = [
        ((dx << _Y_BITS) + dy << _BLOCK_BITS, int(half_heights[abs(dx), dy + reach]))
        for dx in range(-reach, reach + 1)
        for dy in range(-reach, reach + 1)
        if half_heights[abs(dx), dy + reach] >= 0
    ]
    return np.array(rows, np.int64)


@njit(cache=True, nogil=True, inline="always")
def _popcount(word):
    """Set bits of a 64-bit word: sums of 2, 4, 8 bits, then of bytes; LLVM makes one instruction of it."""
    word -= (word >> uint64(1)) & uint64(0x5555555555555555)
    word = (word & uint64(0x3333333333333333)) + ((word >> uint64(2)) & uint64(0x3333333333333333))
    word = (word + (word >> uint64(4))) & uint64(0x0F0F0F0F0F0F0F0F)
    return int64((word * uint64(0x0101010101010101)) >> uint64(56))


@njit(cache=True, nogil=True, inline="always")
def _lowest_bit(word):
    return _popcount((word & (~word + uint64(1))) - uint64(1))


@njit(cache=True, nogil=True, inline="always")
def _window(mask, bit, half):
    """The bits of a word from `bit - half` to `bit + half`, moved down to bit 0."""
    return (mask >> uint64(bit - half)) & ((uint64(1) << uint64(2 * half + 1)) - uint64(1))


@njit(cache=True, nogil=True)
def _words(columns, z):
    """Overlapping words of the sorted voxels: word k of a column holds z from 32 k - 32 to 32 k + 31.

    Returns packed column and k (w,), masks (w,), the first voxel of each word (w,), and for every voxel the
    word around it and its bit there, 16 to 47.
    """
    n = len(z)
    keys, masks, first = np.empty(2 * n, np.int64), np.zeros(2 * n, np.uint64), np.empty(2 * n, np.int64)
    own, bits = np.empty(n, np.int64), np.empty(n, np.int64)
    count = 0
    for i in range(n):
        low = columns[i] + (z[i] >> 5)
        if count == 0 or keys[count - 1] < low:
            keys[count], first[count] = low, i
            count += 1
        if keys[count - 1] == low:
            keys[count], first[count] = low + 1, i
            count += 1
        within = z[i] & 31
        masks[count - 2] |= uint64(1) << uint64(within + 32)
        masks[count - 1] |= uint64(1) << uint64(within)
        upper = within >= 16
        own[i] = count - 1 if upper else count - 2
        bits[i] = within if upper else within + 32
    return keys[:count], masks[:count], first[:count], own, bits


@njit(cache=True, nogil=True)
def _find_root(parents, i):
    while parents[i] != i:
        parents[i] = parents[parents[i]]
        i = parents[i]
    return i


@njit(cache=True, nogil=True)
def _count_neighbours(keys, masks, own, bits, stencil):
    """Voxels within the radius of each voxel, itself included."""
    counts = np.zeros(len(own), np.int32)
    for s in range(len(stencil)):
        offset, half = stencil[s]
        j = 0
        for i in range(len(own)):
            wanted = keys[own[i]] + offset
            while j < len(keys) and keys[j] < wanted:
                j += 1
            if j < len(keys) and keys[j] == wanted:
                counts[i] += _popcount(_window(masks[j], bits[i], half))
    return counts


@njit(cache=True, nogil=True, inline="always")
def _widened(mask, half):
    """The bits of a word and those up to `half` from one."""
    reach = 0
    while reach < half:
        step = min(2 * reach + 1, half - reach)  # what is within `reach` has no gaps
        mask |= (mask << uint64(step)) | (mask >> uint64(step))
        reach += step
    return mask


@njit(cache=True, nogil=True, inline="always")
def _join(parents, i, j):
    """Union of the sets of i and j: the lower root stays."""
    i, j = _find_root(parents, i), _find_root(parents, j)
    parents[max(i, j)] = min(i, j)


@njit(cache=True, nogil=True)
def _runs(own, bits, column_reach, parents):
    """Join what lies within the radius of the next in its column and word; word and bits of each such run (r,)."""
    n = len(own)
    words, runs, count = np.empty(n, np.int64), np.zeros(n, np.uint64), 0
    for i in range(n):
        if i > 0 and own[i] == own[i - 1] and bits[i] - bits[i - 1] <= column_reach:
            parents[i] = parents[i - 1]
        else:
            words[count] = own[i]
            count += 1
        runs[count - 1] |= uint64(1) << uint64(bits[i])
    return words[:count], runs[:count]


@njit(cache=True, nogil=True)
def _join_cores(keys, masks, first, own, bits, half_heights, parents):
    """Union of all core voxels within the radius of each other; half of the ball around a voxel sees every pair once.

    A run is joined to whatever is near it in a column. Of the columns at one x, those within the radius follow each
    other. Bits that lie within the radius of the bit below are skipped: they are joined to that one within their own
    column.
    """
    reach = len(half_heights) - 1
    column_reach = half_heights[0, reach]
    words, runs = _runs(own, bits, column_reach, parents)
    for dx in range(reach + 1):
        start, lowest = 0, ((dx << _Y_BITS) - reach) << _BLOCK_BITS
        width = (reach if dx == 0 else 2 * reach) << _BLOCK_BITS
        for r in range(len(words)):
            w = words[r]
            while start < len(keys) and keys[start] < keys[w] + lowest:
                start += 1
            j = start
            while j < len(keys) and keys[j] <= keys[w] + lowest + width:
                offset = keys[j] - keys[w] - lowest
                half = half_heights[dx, offset >> _BLOCK_BITS]
                if offset & _BLOCK_MASK == 0 and half >= 0:  # the same part of its column
                    _join_run(runs[r], w, j, half, column_reach, masks, first, parents)
                j += 1


@njit(cache=True, nogil=True, inline="always")
def _join_run(run, w, j, half, column_reach, masks, first, parents):
    """Join a run of word `w` to what lies within `half` of it in word `j`."""
    found = masks[j] & _widened(run, half)
    if found == 0:
        return
    voxel, last = _voxel_of(_lowest_bit(run), masks[w], first[w]), -LARGEST_EPS_VOXELS - 1
    while found != 0:
        bit = _lowest_bit(found)
        found &= found - uint64(1)
        if bit - last > column_reach:
            _join(parents, voxel, _voxel_of(bit, masks[j], first[j]))
        last = bit


@njit(cache=True, nogil=True, inline="always")
def _voxel_of(bit, mask, first):
    """Number of the voxel at a bit of a word, whose first voxel is known."""
    return first + _popcount(mask & ((uint64(1) << uint64(bit)) - uint64(1)))


@njit(cache=True, nogil=True)
def _reach_borders(wanted_keys, bits, keys, masks, first, stencil, core_clusters, clusters):
    """Give every voxel that is no core the lowest cluster among the core voxels within its radius."""
    column_reach = stencil[len(stencil) // 2, 1]
    for s in range(len(stencil)):
        offset, half = stencil[s]
        j = 0
        for i in range(len(wanted_keys)):
            wanted = wanted_keys[i] + offset
            while j < len(keys) and keys[j] < wanted:
                j += 1
            if j == len(keys) or keys[j] != wanted:
                continue
            found = _window(masks[j], bits[i], half)
            while found != 0:
                bit = _lowest_bit(found)
                cluster = core_clusters[_voxel_of(bits[i] - half + bit, masks[j], first[j])]
                if clusters[i] < 0 or cluster < clusters[i]:
                    clusters[i] = cluster
                shift = bit + column_reach + 1
                found = (found >> uint64(shift)) << uint64(shift) if shift < 64 else uint64(0)


@njit(cache=True, nogil=True)
def _number(parents, positions):
    """Cluster of every core voxel; numbers are given in the order of `positions`."""
    clusters = np.full(len(parents), NOISE, np.int32)
    count = 0
    for i in positions:
        root = _find_root(parents, i)
        if clusters[root] < 0:
            clusters[root] = count
            count += 1
        clusters[i] = clusters[root]
    return clusters

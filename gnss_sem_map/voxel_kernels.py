"""The few compiled loops that carry the load: every point of every scan passes through them.

All are module-level (numba caches those only), release the GIL, and are exact: sums are integers, minima do not
depend on order, so any order of scans and any number of threads give the same bits. The readable twin of each is
the numpy oracle in the tests.

A voxel is one row of a hash table: int64 key, c int32 log-likelihood sums, uint32 hits (32 bytes for five classes,
half a cache line), found by open addressing with linear probing. Key 0 marks an empty row.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import int64, njit, types, uint64
from numba.core import cgutils
from numba.extending import intrinsic

AXIS_BITS = 21
AXIS_OFFSET = 1 << 20
"""Voxel indices lie in [-2^20, 2^20): +-209 km at 0.2 m."""
AXIS_MASK = (1 << AXIS_BITS) - 1
UNITS_PER_NAT = 1024
"""Log-likelihoods are sums of round(1024 ln p): exact, and finer than any network is right."""
EVIDENCE_LIMIT = 1 << 30
"""No sum may fall below minus this; at the floor of 1 % that is 200,000 looks at one voxel."""
PREFETCH_AHEAD = 16
FIRST_SUM = 2
"""Column of the first sum in the int32 view of a row (the key fills the two before it)."""


@intrinsic
def _prefetch(typing_context: Any, table: Any, row: Any) -> Any:
    """Ask for a table row before it is needed: a random row of a large map is a cache miss of ~100 ns."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        zero = context.get_constant(types.intp, 0)
        address = cgutils.get_item_pointer(context, builder, signature.args[0], array, [arguments[1], zero])
        byte = builder.bitcast(address, ir.IntType(8).as_pointer())
        i32 = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte.type, i32, i32, i32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [byte, i32(1), i32(3), i32(1)])
        return context.get_dummy_value()

    return types.void(table, types.intp), generate


@njit(cache=True, nogil=True, inline="always")
def _home(key, bits):
    """Row where the search for a key begins: the top bits of a multiplicative hash."""
    h = uint64(key) * uint64(0x9E3779B97F4A7C15)
    h ^= h >> uint64(32)
    h *= uint64(0xD6E8FEB86659FD93)
    return int64(h >> uint64(64 - bits))


@njit(cache=True, nogil=True)
def _find_or_insert(rows, bits, key):
    mask = len(rows) - 1
    slot = _home(key, bits)
    while rows[slot, 0] != key and rows[slot, 0] != 0:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def pack_keys(p_map, voxel_size_m, keys):
    """Voxel key of every point; returns the first point that is NaN or beyond the addressable volume, or -1."""
    for i in range(len(p_map)):
        key = int64(0)
        for axis in range(3):
            index = np.floor(p_map[i, axis] / voxel_size_m)
            if not (-AXIS_OFFSET <= index < AXIS_OFFSET):
                return i
            key = key << AXIS_BITS | (int64(index) + AXIS_OFFSET)
        if key == 0:
            return i
        keys[i] = key
    return -1


@njit(cache=True, nogil=True)
def fuse(rows, ints, bits, count, keys, pixels, classes, log_table, floor_percent):
    """Add one scan to the table (eq. 6, as a sum of logarithms); returns the new number of voxels, or -1 on overflow.

    `pixels[i]` is the row of `classes` (p, c + 1; uint8 probabilities, `other` last) that point i saw, or -1. The
    five are renormalised without `other`, floored, and renormalised again, all in integers:
    q = max(100 p, floor sum(p)); ln(q / sum(q)) by table.
    """
    n, number_of_classes = len(keys), classes.shape[1] - 1
    hits_column = FIRST_SUM + number_of_classes
    for i in range(n):
        if i + PREFETCH_AHEAD < n:
            _prefetch(rows, _home(keys[i + PREFETCH_AHEAD], bits))
        slot = _find_or_insert(rows, bits, keys[i])
        if rows[slot, 0] == 0:
            rows[slot, 0] = keys[i]
            count += 1
        ints[slot, hits_column] += 1
        pixel = pixels[i]
        if pixel < 0:
            continue
        total = int64(0)
        for c in range(number_of_classes):
            total += classes[pixel, c]
        if total == 0:
            continue
        floor = floor_percent * total
        denominator = int64(0)
        for c in range(number_of_classes):
            denominator += max(100 * int64(classes[pixel, c]), floor)
        for c in range(number_of_classes):
            q = max(100 * int64(classes[pixel, c]), floor)
            ints[slot, FIRST_SUM + c] += log_table[q] - log_table[denominator]
            if ints[slot, FIRST_SUM + c] < -EVIDENCE_LIMIT:
                return -1
    return count


@njit(cache=True, nogil=True)
def rehash(old, new, new_bits):
    """Move every voxel of a table into a larger, empty one."""
    for i in range(len(old)):
        if old[i, 0] != 0:
            slot = _find_or_insert(new, new_bits, old[i, 0])
            for word in range(old.shape[1]):
                new[slot, word] = old[i, word]


@njit(cache=True, nogil=True)
def transform_along(xyz, stamps, first_stamp, step_s, poses, out):
    """Move every point with the pose at its own stamp, blended linearly between closely spaced poses (k, 3, 4)."""
    last = len(poses) - 2
    for i in range(len(xyz)):
        place = (stamps[i] - first_stamp) / step_s
        k = min(max(int64(np.floor(place)), 0), last)
        b = min(max(place - k, 0.0), 1.0)
        a = 1.0 - b
        x, y, z = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        for r in range(3):
            out[i, r] = (
                (a * poses[k, r, 0] + b * poses[k + 1, r, 0]) * x
                + (a * poses[k, r, 1] + b * poses[k + 1, r, 1]) * y
                + (a * poses[k, r, 2] + b * poses[k + 1, r, 2]) * z
                + (a * poses[k, r, 3] + b * poses[k + 1, r, 3])
            )


@njit(cache=True, nogil=True)
def project(p_map, P, nearest_m, half_rows, half_columns, u, v, depth, zbuffer):
    """Pixel and depth of every point (eq. 3, 4), -1 outside; the z-buffer keeps the nearest depth in a window."""
    height, width = zbuffer.shape
    zbuffer[:, :] = np.inf
    for i in range(len(p_map)):
        u[i] = -1
        w = P[2, 0] * p_map[i, 0] + P[2, 1] * p_map[i, 1] + P[2, 2] * p_map[i, 2] + P[2, 3]
        if not w > nearest_m:
            continue
        x = (P[0, 0] * p_map[i, 0] + P[0, 1] * p_map[i, 1] + P[0, 2] * p_map[i, 2] + P[0, 3]) / w
        y = (P[1, 0] * p_map[i, 0] + P[1, 1] * p_map[i, 1] + P[1, 2] * p_map[i, 2] + P[1, 3]) / w
        column, row = int64(np.floor(x + 0.5)), int64(np.floor(y + 0.5))
        if column < 0 or column >= width or row < 0 or row >= height:
            continue
        u[i], v[i], depth[i] = column, row, w
        for r in range(max(row - half_rows, 0), min(row + half_rows + 1, height)):
            for c in range(max(column - half_columns, 0), min(column + half_columns + 1, width)):
                zbuffer[r, c] = min(zbuffer[r, c], w)


@njit(cache=True, nogil=True)
def visible(u, v, depth, zbuffer, tolerance_ratio, tolerance_m, shrink, class_width, class_height, pixels):
    """Row of the class image that each point sees, or -1 where it is outside or something nearer hides it."""
    count = 0
    for i in range(len(u)):
        pixels[i] = -1
        if u[i] >= 0 and depth[i] <= (1.0 + tolerance_ratio) * zbuffer[v[i], u[i]] + tolerance_m:
            row, column = min(v[i] // shrink, class_height - 1), min(u[i] // shrink, class_width - 1)
            pixels[i] = row * class_width + column
            count += 1
    return count


@njit(cache=True, nogil=True)
def find(keys, wanted, places):
    """Place of every wanted key in sorted `keys`, or -1; neighbours in a scan are often the same voxel."""
    previous_key, previous_place = int64(-1), int64(-1)
    for i in range(len(wanted)):
        if wanted[i] != previous_key:
            previous_key = wanted[i]
            place = np.searchsorted(keys, previous_key)
            previous_place = place if place < len(keys) and keys[place] == previous_key else -1
        places[i] = previous_place

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
HITS_LIMIT = (1 << 31) - 1
"""No voxel may count more points than this."""
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
def _home(key, size):
    """Row where the search for a key begins: a multiplicative hash, scaled to any table size.

    It is always the first of two rows that share a cache line. Rows are in the order of their hash, so that a larger
    table is filled from front to back, never at random.
    """
    h = uint64(key) * uint64(0x9E3779B97F4A7C15)
    h ^= h >> uint64(32)
    h *= uint64(0xD6E8FEB86659FD93)
    return int64((((h >> uint64(32)) * uint64(size >> 1)) >> uint64(32)) << uint64(1))


@njit(cache=True, nogil=True)
def _find_or_insert(rows, key):
    slot = _home(key, len(rows))
    while rows[slot, 0] != key and rows[slot, 0] != 0:
        slot += 1
        if slot == len(rows):
            slot = 0
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
def fuse(
    rows, ints, count, capacity, start, keys, pixels, classes, log_table, log_percent, floor_percent, answers, abstain
):  # fmt: skip
    """Add the points of a scan from `start` on (eq. 6, as a sum of logarithms), until the table holds `capacity`.

    `pixels[i]` is the row of `classes` (p, c + 1; uint8 probabilities, `other` last) that point i saw, or -1. The
    classes of the map are renormalised without `other`, floored, and renormalised again, all in integers:
    q = max(100 p, floor sum(p)); ln(q / sum(q)) by table. `answers` (c + 1, c), or (0, c) for none, is added for what
    is most probable in the pixel, `other` included; with `abstain` a pixel that is most probably `other` says nothing.
    Returns the number of voxels and the first point that is not in yet, or -1 - i for a point i whose voxel overflows.
    """
    n, number_of_classes, size = len(keys), classes.shape[1] - 1, len(rows)
    hits_column = FIRST_SUM + number_of_classes
    for i in range(start, n):
        if i + PREFETCH_AHEAD < n:
            _prefetch(rows, _home(keys[i + PREFETCH_AHEAD], size))
        slot = _find_or_insert(rows, keys[i])
        if rows[slot, 0] == 0:
            if count == capacity:
                return count, i
            rows[slot, 0] = keys[i]
            count += 1
        if ints[slot, hits_column] == HITS_LIMIT:
            return count, -1 - i
        ints[slot, hits_column] += 1
        pixel = pixels[i]
        if pixel < 0:
            continue
        total = int64(0)
        for c in range(number_of_classes):
            total += classes[pixel, c]
        if len(answers) > 0 or abstain:
            answer = 0
            for c in range(1, number_of_classes + 1):
                if classes[pixel, c] > classes[pixel, answer]:
                    answer = c
            if classes[pixel, answer] == 0 or (abstain and answer == number_of_classes):
                continue
            if len(answers) > 0:
                for c in range(number_of_classes):
                    ints[slot, FIRST_SUM + c] += answers[answer, c]
                    if ints[slot, FIRST_SUM + c] < -EVIDENCE_LIMIT:
                        return count, -1 - i
        if total == 0:
            continue
        floor = floor_percent * total
        denominator = int64(0)
        for c in range(number_of_classes):
            denominator += max(100 * int64(classes[pixel, c]), floor)
        log_floor, log_sum = log_table[floor], log_table[denominator]
        for c in range(number_of_classes):
            ints[slot, FIRST_SUM + c] += max(log_percent[classes[pixel, c]], log_floor) - log_sum
            if ints[slot, FIRST_SUM + c] < -EVIDENCE_LIMIT:
                return count, -1 - i
    return count, n


@njit(cache=True, nogil=True)
def rehash(old, new):
    """Move every voxel of a table into a larger, empty one."""
    for i in range(len(old)):
        if old[i, 0] != 0:
            slot = _find_or_insert(new, old[i, 0])
            for word in range(old.shape[1]):
                new[slot, word] = old[i, word]


@njit(cache=True, nogil=True)
def merge(keys_a, evidence_a, hits_a, keys_b, evidence_b, hits_b, keys, evidence, hits):
    """Add two maps, both sorted by key, into room for both; returns how many voxels came out, or -1 on overflow."""
    a, b, to = 0, 0, 0
    while a < len(keys_a) or b < len(keys_b):
        from_a = b == len(keys_b) or (a < len(keys_a) and keys_a[a] <= keys_b[b])
        from_b = a == len(keys_a) or (b < len(keys_b) and keys_b[b] <= keys_a[a])
        keys[to] = keys_a[a] if from_a else keys_b[b]
        total = (int64(hits_a[a]) if from_a else int64(0)) + (int64(hits_b[b]) if from_b else int64(0))
        if total > HITS_LIMIT:
            return -1
        hits[to] = total
        for c in range(evidence.shape[1]):
            nats = (int64(evidence_a[a, c]) if from_a else int64(0)) + (
                int64(evidence_b[b, c]) if from_b else int64(0)
            )
            if nats < -EVIDENCE_LIMIT:
                return -1
            evidence[to, c] = nats
        a, b, to = a + from_a, b + from_b, to + 1
    return to


@njit(cache=True, nogil=True)
def usable(xyz, stamps, nearest_m, farthest_m, valid):
    """Mark the points that are finite and in range; returns how many, and their first and last stamp."""
    nearest, farthest = nearest_m * nearest_m, farthest_m * farthest_m
    count, first, last = 0, np.inf, -np.inf
    for i in range(len(xyz)):
        x, y, z = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        square = x * x + y * y + z * z
        valid[i] = nearest <= square <= farthest
        count += valid[i]
    for i in range(len(stamps)):
        if valid[i]:
            first, last = min(first, stamps[i]), max(last, stamps[i])
    return count, first, last


@njit(cache=True, nogil=True)
def transform_along(xyz, stamps, valid, first_stamp, step_s, poses, p_map):
    """Move every valid point with the pose at its own stamp, blended linearly between close poses.

    `poses` (k, 3, 8) are transforms (3, 4) and, beside each, what the next one adds. Without stamps (empty) every
    point moves with the first. `p_map` takes the valid points one after another.
    """
    last, per_step = len(poses) - 1, 1.0 / step_s
    k, part, to = uint64(0), 0.0, 0
    for i in range(len(xyz)):
        if not valid[i]:
            continue
        if len(stamps) > 0:
            place = (stamps[i] - first_stamp) * per_step
            k = uint64(min(max(int64(place), 0), last))
            part = place - k
        x, y, z = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        for r in range(3):
            here = poses[k, r, 0] * x + poses[k, r, 1] * y + poses[k, r, 2] * z + poses[k, r, 3]
            ahead = poses[k, r, 4] * x + poses[k, r, 5] * y + poses[k, r, 6] * z + poses[k, r, 7]
            p_map[to, r] = here + part * ahead
        to += 1


@njit(cache=True, nogil=True)
def project(p_map, P, nearest_m, half_columns, u, v, depth, nearest):
    """Pixel and depth of every point (eq. 3, 4), u = -1 outside; `nearest` (h, w) keeps the nearest depth beside it.

    A pixel reaches from its number to the next. That numbers are centres in KITTI's calibration would move points by
    half a pixel, which a real network's labels do not tell apart (accuracy 80.22 and 80.20 %).
    A point writes into its own row only, `half_columns` to either side; `visible` looks along the columns. Together
    they are a window, at the price of its edges.
    """
    height, width = nearest.shape
    nearest[:, :] = np.inf
    for i in range(len(p_map)):
        u[i] = -1
        w = P[2, 0] * p_map[i, 0] + P[2, 1] * p_map[i, 1] + P[2, 2] * p_map[i, 2] + P[2, 3]
        if not w > nearest_m:
            continue
        x = (P[0, 0] * p_map[i, 0] + P[0, 1] * p_map[i, 1] + P[0, 2] * p_map[i, 2] + P[0, 3]) / w
        y = (P[1, 0] * p_map[i, 0] + P[1, 1] * p_map[i, 1] + P[1, 2] * p_map[i, 2] + P[1, 3]) / w
        column, row = int64(np.floor(x)), int64(np.floor(y))
        if column < 0 or column >= width or row < 0 or row >= height:
            continue
        u[i], v[i], depth[i] = column, row, w
        for c in range(max(column - half_columns, 0), min(column + half_columns + 1, width)):
            nearest[row, c] = min(nearest[row, c], depth[i])


@njit(cache=True, nogil=True)
def visible(u, v, depth, nearest, half_rows, ratio, slack_m, row_of, column_of, class_width, pixels):
    """Row of the class image that each point sees, -1 outside or where something nearer hides it; returns how many.

    `row_of` (h,) and `column_of` (w,) say where a camera pixel lies in the class image: a division costs more.
    """
    height, count = len(nearest), 0
    for i in range(len(u)):
        pixels[i] = -1
        if u[i] < 0:
            continue
        closest = depth[i]
        for r in range(max(v[i] - half_rows, 0), min(v[i] + half_rows + 1, height)):
            closest = min(closest, nearest[r, u[i]])
        if depth[i] <= (1.0 + ratio) * closest + slack_m:
            pixels[i] = row_of[v[i]] * class_width + column_of[u[i]]
            count += 1
    return count


@njit(cache=True, nogil=True)
def gather(probabilities, pixels, classes):
    """Copy the class probabilities (h, w, c + 1) of the pixels that are seen, and number those points by their copy."""
    width, to = np.uint32(probabilities.shape[1]), 0
    for i in range(len(pixels)):
        if pixels[i] >= 0:
            row = np.uint32(pixels[i]) // width
            column = np.uint32(pixels[i]) - row * width
            for c in range(probabilities.shape[2]):
                classes[to, c] = probabilities[row, column, c]
            pixels[i] = to
            to += 1


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

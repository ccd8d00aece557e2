"""How flat a surface lies: the vertical part of every voxel's normal, from its neighbours alone."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.refinement.neighbours import HALF_COLUMNS, HALF_STENCIL
from gnss_sem_map.voxels.hash_unique import distinct

LEAST_VOXELS = 5
LEAST_SPREAD = 0.01
"""Middle eigenvalue, voxels squared, below which the voxels are a line and have no normal."""
SAME_SPREAD = 1e-6
"""Where the two smallest eigenvalues differ by less, no direction is the normal."""


def flatness(keys: NDArray[np.int64], wanted: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
    """|z| of the normal of sorted packed voxels (v,): 1 on level ground, 0 on a wall, NaN where it cannot be known.

    The normal is the eigenvector of the smallest eigenvalue of the covariance of the occupied voxels among 3 x 3 x 3;
    fewer than five, or a line of them, have none. Only of the `wanted` voxels (v,), where that is said; others are NaN.
    """
    result = np.full(len(keys), np.nan, np.float32)
    wanted = np.ones(len(keys), np.bool_) if wanted is None else wanted
    occupied = np.zeros((len(keys), 2), np.uint16)
    _mark(keys, HALF_COLUMNS, occupied)
    patterns, numbers = distinct(
        occupied.view(np.uint32)[wanted, 0].astype(np.int64)
    )  # of streets few differ
    upright = np.full(len(patterns), np.nan, np.float32)
    _upright(patterns.astype(np.uint32).view(np.uint16).reshape(-1, 2), MOMENTS, upright)
    result[wanted] = upright[numbers]
    return result


def _moments() -> NDArray[np.int8]:
    """Sums of 1, d and the six products d d^T over the neighbours at d of every set of 13 bits: (2^13, 10)."""
    x, y, z = HALF_STENCIL.T
    of_one = np.stack([x**0, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], axis=1)
    bits = np.arange(1 << len(HALF_STENCIL))[:, None] >> np.arange(len(HALF_STENCIL)) & 1
    return np.asarray(bits @ of_one, np.int8)


MOMENTS = _moments()


@njit(cache=True, nogil=True)
def _mark(keys, columns, occupied):
    """Set the bits (v, 2) of the occupied neighbours of HALF_STENCIL, and of those opposite."""
    for c in range(len(columns)):
        first = 0  # the first voxel that is not lower
        for i in range(len(keys)):
            lowest = keys[i] + columns[c] - 1
            while keys[first] < lowest:
                first += 1
            j = first
            while j < i and keys[j] <= lowest + 2:
                bit = 1 << (3 * c + keys[j] - lowest)
                occupied[i, 0] |= bit
                occupied[j, 1] |= bit
                j += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _upright(occupied, moments, result):
    """|z| of the eigenvector of the smallest eigenvalue, from the characteristic polynomial's roots."""
    for i in range(len(occupied)):
        one, other = moments[occupied[i, 0]], moments[occupied[i, 1]]  # the voxel itself is at d = 0
        n = 1.0 + one[0] + other[0]
        if n < LEAST_VOXELS:
            continue
        x, y, z = (one[1] - other[1]) / n, (one[2] - other[2]) / n, (one[3] - other[3]) / n
        xx, xy, xz = (one[4] + other[4]) / n, (one[5] + other[5]) / n, (one[6] + other[6]) / n
        yy, yz, zz = (one[7] + other[7]) / n, (one[8] + other[8]) / n, (one[9] + other[9]) / n
        xx, xy, xz = xx - x * x, xy - x * y, xz - x * z
        yy, yz, zz = yy - y * y, yz - y * z, zz - z * z
        mean = (xx + yy + zz) / 3
        xx, yy, zz = xx - mean, yy - mean, zz - mean
        p = np.sqrt((xx * xx + yy * yy + zz * zz + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
        half_det = (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)) / 2
        angle = np.arccos(min(max(half_det / (p * p * p), -1.0), 1.0)) / 3
        largest, least = 2 * p * np.cos(angle), 2 * p * np.cos(angle + 2 * np.pi / 3)
        middle = -largest - least
        if not (mean + middle > LEAST_SPREAD and middle - least > SAME_SPREAD):
            continue
        xx, yy, zz = xx - least, yy - least, zz - least
        result[i] = _along_z(xx, xy, xz, yy, yz, zz)


@njit(cache=True, nogil=True, inline="always")
def _along_z(xx, xy, xz, yy, yz, zz):
    """|z| of the unit vector that a symmetric matrix of rank two maps to zero: the longest product of two rows."""
    best, result = 0.0, 0.0
    for a, b, c, d, e, f in (
        (xx, xy, xz, xy, yy, yz), (xx, xy, xz, xz, yz, zz), (xy, yy, yz, xz, yz, zz)
    ):  # fmt: skip
        x, y, z = b * f - c * e, c * d - a * f, a * e - b * d
        square = x * x + y * y + z * z
        if square > best:
            best, result = square, abs(z) / np.sqrt(square)
    return result

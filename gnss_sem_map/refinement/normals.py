"""How flat a surface lies: the vertical part of every voxel's normal, from its neighbours alone."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gnss_sem_map.refinement.potts_mrf import HALF_STENCIL
from gnss_sem_map.voxels.voxel_map import pack, unpack

LEAST_VOXELS = 5
LEAST_SPREAD = 0.01
"""Middle eigenvalue, voxels squared, below which the voxels are a line and have no normal."""


def flatness(keys: NDArray[np.int64], wanted: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
    """|z| of the normal of sorted packed voxels (v,): 1 on level ground, 0 on a wall, NaN where it cannot be known.

    The normal is the eigenvector of the smallest eigenvalue of the covariance of the occupied voxels among 3 x 3 x 3;
    fewer than five, or a line of them, have none. Only of the `wanted` voxels (v,), where that is said; others are NaN.
    """
    result = np.full(len(keys), np.nan, np.float32)
    moments = np.zeros((len(keys), 10))
    moments[:, 0] = 1
    origin = pack(np.zeros((1, 3), np.int64))[0]
    _gather(keys, HALF_STENCIL, unpack(HALF_STENCIL + origin).astype(np.float64), moments)
    has_normal = moments[:, 0] >= LEAST_VOXELS
    enough = np.flatnonzero(has_normal if wanted is None else has_normal & wanted)
    means = moments[enough, 1:] / moments[enough, :1]
    covariances = means[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(-1, 3, 3)
    covariances -= means[:, :3, None] * means[:, None, :3]
    spreads, axes = np.linalg.eigh(covariances)
    known = spreads[:, 1] > LEAST_SPREAD
    result[enough[known]] = np.abs(axes[known, 2, 0])
    return result


@njit(cache=True, nogil=True)
def _gather(keys, stencil, steps, moments):
    """Add 1, d and the six products d d^T of every occupied neighbour at d to the moments (v, 10) of both voxels."""
    for k in range(len(stencil)):
        x, y, z = steps[k]
        j = 0
        for i in range(len(keys)):
            wanted = keys[i] + stencil[k]
            while keys[j] < wanted:
                j += 1
            if keys[j] == wanted:
                for row, sign in ((i, 1.0), (j, -1.0)):
                    moments[row, 0] += 1
                    moments[row, 1] += sign * x
                    moments[row, 2] += sign * y
                    moments[row, 3] += sign * z
                    moments[row, 4] += x * x
                    moments[row, 5] += x * y
                    moments[row, 6] += x * z
                    moments[row, 7] += y * y
                    moments[row, 8] += y * z
                    moments[row, 9] += z * z

"""Maps that know how high their surfaces lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.voxels.kernels import HEIGHT_UNITS
from gnss_sem_map.voxels.voxel_map import VoxelMap


def with_heights(voxels: VoxelMap, z: NDArray[np.float64]) -> VoxelMap:
    """The map with surfaces at heights z (v,) m, to half a unit of height."""
    over_bottom = z / voxels.voxel_size_m - voxels.indices[:, 2]
    sums = np.rint(voxels.hits * (HEIGHT_UNITS * over_bottom - 0.5)).astype(np.int64)
    return replace(voxels, heights=sums)


def heights_in_voxels(z: NDArray[np.float64], voxel_size_m: float) -> NDArray[np.uint8]:
    """Heights z (n,) m of points over the bottom of their voxels, in 1/256 of its edge."""
    part = z / voxel_size_m
    return np.minimum(HEIGHT_UNITS * (part - np.floor(part)), HEIGHT_UNITS - 1).astype(np.uint8)

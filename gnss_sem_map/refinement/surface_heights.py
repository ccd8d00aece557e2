"""Heights of surfaces inside voxels: the mean of the points in each, finer than the voxel itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.voxels.voxel_map import VoxelMap, keys_of, unpack


@dataclass(frozen=True, eq=False)
class SurfaceHeights:
    """Sums over the points in each voxel; `a + b` adds them."""

    keys: NDArray[np.int64]
    """(k,) packed voxels, sorted, unique."""
    sums: NDArray[np.float64]
    """(k,) m, of the points' heights in the map frame."""
    counts: NDArray[np.int64]
    """(k,) points, at least one."""

    def of(self, voxels: VoxelMap) -> NDArray[np.float64]:
        """Mean height of the points in every voxel (v,) m, NaN where none is known."""
        if not len(self.keys):
            return np.full(len(voxels), np.nan)
        places = np.minimum(np.searchsorted(self.keys, voxels.keys), len(self.keys) - 1)
        known = self.keys[places] == voxels.keys
        return np.where(known, self.sums[places] / self.counts[places], np.nan)

    def moved(self, T: NDArray[np.float64], voxel_size_m: float) -> SurfaceHeights:
        """The same surfaces in another frame, moved there by `T` (4, 4), in the voxels that hold their centres."""
        p = (unpack(self.keys) + 0.5) * voxel_size_m
        p[:, 2] = self.sums / self.counts
        p = p @ T[:3, :3].T + T[:3, 3]
        keys, rows = np.unique(keys_of(p, voxel_size_m), return_inverse=True)
        sums, counts = np.zeros(len(keys)), np.zeros(len(keys), np.int64)
        np.add.at(sums, rows, p[:, 2] * self.counts)
        np.add.at(counts, rows, self.counts)
        return SurfaceHeights(keys, sums, counts)

    def __add__(self, other: SurfaceHeights) -> SurfaceHeights:
        """Of the points of both."""
        keys, rows = np.unique(np.concatenate([self.keys, other.keys]), return_inverse=True)
        sums, counts = np.zeros(len(keys)), np.zeros(len(keys), np.int64)
        np.add.at(sums, rows, np.concatenate([self.sums, other.sums]))
        np.add.at(counts, rows, np.concatenate([self.counts, other.counts]))
        return SurfaceHeights(keys, sums, counts)

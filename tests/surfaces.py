"""Maps that know how high their surfaces lie, and geoids."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio
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


def write_geoid(path: Path, lat_deg: float, lon_deg: float, height_m: float) -> Path:
    """A grid as PROJ reads it: a geoid so high above the ellipsoid around a place."""
    heights = np.full((5, 5), height_m, np.float32)
    profile = {"driver": "GTiff", "height": 5, "width": 5, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    corner = rasterio.Affine(0.5, 0, lon_deg - 1.25, 0, -0.5, lat_deg + 1.25)
    with rasterio.open(path, "w", transform=corner, **profile) as grid:
        grid.write(heights, 1)
    return path

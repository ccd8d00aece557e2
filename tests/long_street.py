"""A street of 700 m in voxels, which several tests of the refinement share: seven tiles, one behind the other."""

from __future__ import annotations

import numpy as np
from scenes import DENSE
from surfaces import with_heights

from gnss_sem_map.dynamics.visibility import KeyframeScans, RangeImage
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

URBAN = open_label_set()
SIZE_M = 0.2
ROAD, SIDEWALK = 0, 1
LENGTH = 3500


def street() -> VoxelMap:
    """A long road beside a sidewalk, with something over it in places; labels err, heights of surfaces are known."""
    rng = np.random.default_rng(0)
    ground = np.stack(np.meshgrid(range(LENGTH), range(8), [0], indexing="ij"), -1).reshape(-1, 3)
    overhead = ground[::3] + np.array([0, 0, 4])
    indices = np.concatenate([ground, overhead])
    keys = pack(indices)
    order = np.argsort(keys)
    indices, keys = indices[order], keys[order]
    true = np.where(indices[:, 1] < 4, ROAD, SIDEWALK)
    labels = np.where(rng.random(len(keys)) < 0.15, rng.integers(0, 5, len(keys)), true)
    evidence = -rng.integers(1500, 3000, (len(keys), 5)).astype(np.int32)
    evidence[np.arange(len(keys)), labels] = -rng.integers(1, 1500, len(keys))
    evidence[rng.random(len(keys)) < 0.1] = 0
    z = np.where(true == ROAD, 0.02, 0.14) + rng.normal(0, 0.01, len(keys))
    hits = np.ones(len(keys), np.uint32)
    return with_heights(VoxelMap(SIZE_M, URBAN, keys, evidence, hits), z)


def keyframes() -> KeyframeScans:
    """Scans over the street that see nothing nearer than 70 m, so that their rays traverse all of it."""
    azimuth, elevation = np.radians(np.meshgrid(np.arange(-180, 180, 0.2), np.arange(-25, 3, 0.2)))
    flat = 70.0 * np.cos(elevation)
    sphere = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), 70.0 * np.sin(elevation)], -1)
    scans = []
    for x in np.linspace(325.0, 350.0, 10):
        T_map_lidar = np.eye(4)
        T_map_lidar[:3, 3] = (x, 0.0, 2.0)
        scans.append(RangeImage.of(sphere.reshape(-1, 3) + T_map_lidar[:3, 3], T_map_lidar, DENSE))
    return KeyframeScans.of(scans)

"""Drives that are mapped in chunks or at once, and whether two maps are the same."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gnss_sem_map.mapping.checkpoints import REMOVED, STATIC
from gnss_sem_map.mapping.fusion import map_scans
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.voxels.voxel_map import VoxelMap


def by_chunks(drive: Drive, window_scans: int) -> Drive:
    """The drive, with two windows of so many scans in a chunk."""
    dynamics = drive.settings.dynamics.model_copy(update={"window_scans": window_scans})
    return replace(drive, settings=drive.settings.model_copy(update={"dynamics": dynamics}))


def assert_same(a: VoxelMap, b: VoxelMap) -> None:
    """Fail where two maps differ."""
    for name in ("keys", "evidence", "hits", "heights", "of_images"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@dataclass(frozen=True, eq=False)
class Maps:
    """The map of static points and the map of moving points; no point is in both."""

    static: VoxelMap
    removed: VoxelMap


def build_maps(drive: Drive, stats: RunStats) -> Maps:
    """Both maps of a drive in memory."""
    with tempfile.TemporaryDirectory() as folder:
        store = map_scans(drive, Path(folder), stats)
        return Maps(store.whole(STATIC), store.whole(REMOVED))

"""Drives that are mapped in chunks, and whether two maps are the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.voxels.voxel_map import VoxelMap


def by_chunks(drive: Drive, window_scans: int) -> Drive:
    """The drive, with two windows of so many scans in a chunk."""
    dynamics = drive.settings.dynamics.model_copy(update={"window_scans": window_scans})
    return replace(drive, settings=drive.settings.model_copy(update={"dynamics": dynamics}))


def assert_same(a: VoxelMap, b: VoxelMap) -> None:
    """Fail where two maps differ."""
    for name in ("keys", "evidence", "hits", "heights"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)

"""The surface in a voxel: the mean height of all points that any scan put there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gnss_sem_map import config, pipeline
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.mapping import surface_heights
from gnss_sem_map.mapping.fusion import build_map
from gnss_sem_map.mapping.labelled_scans import map_points
from gnss_sem_map.run_stats import RunStats
from gnss_sem_map.simulation import simulate
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.voxel_map import keys_of


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tmp_path_factory.mktemp("drive"), 2.0, 1)


def test_heights_are_those_of_numpy_and_part_of_a_drive_tells_nearly_as_well(
    drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, settings = open_drive(drive), config.Settings()
    trajectory, _ = pipeline.estimate_trajectory(log, settings, RunStats())
    semantic_map = SemanticMap.of(build_map(log, trajectory, None, settings, RunStats()))
    voxels = semantic_map.voxels
    heights = surface_heights.measure_surface_heights(log, trajectory, settings, voxels).of(voxels)

    p_map = np.concatenate([map_points(s.read(), s, trajectory, log, settings.mapping)[0] for s in log.scans])
    keys, place = np.unique(keys_of(p_map, settings.mapping.voxel_size_m), return_inverse=True)
    np.testing.assert_array_equal(keys, semantic_map.voxels.keys)
    expected = np.bincount(place, p_map[:, 2]) / np.bincount(place)
    np.testing.assert_allclose(heights, expected, atol=1e-9)

    monkeypatch.setattr(surface_heights, "ENOUGH_SCANS", len(log.scans) // surface_heights.EVERY)
    part = surface_heights.measure_surface_heights(log, trajectory, settings, voxels).of(voxels)
    known = np.isfinite(part)
    assert 0.3 < known.mean() < 1
    assert np.median(np.abs(part - heights)[known]) < 0.02


def test_a_damaged_scan_is_left_out(drive: Path, tmp_path: Path) -> None:
    log, settings = open_drive(drive), config.Settings()
    trajectory, _ = pipeline.estimate_trajectory(log, settings, RunStats())
    semantic_map = SemanticMap.of(build_map(log, trajectory, None, settings, RunStats()))
    first = drive / "velodyne_points" / "data" / f"{log.scans[0].name}.bin"
    whole = first.read_bytes()
    try:
        first.write_bytes(whole[:-5])
        measured = surface_heights.measure_surface_heights(log, trajectory, settings, semantic_map.voxels)
        heights = measured.of(semantic_map.voxels)
    finally:
        first.write_bytes(whole)
    assert 0.8 < np.isfinite(heights).mean() < 1

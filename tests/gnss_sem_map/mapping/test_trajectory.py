"""The trajectory of a drive: what its first solution is for, and when it is the last one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.trajectory import check_heights, locate, smooth_log
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.sensor_log import Points, SensorLog
from gnss_sem_map.voxels.tile_files import local_keys
from gnss_sem_map.voxels.voxel_map import keys_of


def test_a_drive_of_which_no_scan_matches_is_smoothed_in_full(small_log: SensorLog) -> None:
    def damaged() -> Points:
        raise DataError("this scan is damaged")

    settings = Settings()
    blind = replace(small_log, scans=tuple(replace(scan, read=damaged) for scan in small_log.scans))
    found = locate(blind, settings, RunStats())
    expected = smooth_log(small_log, settings.trajectory)
    assert found.solution is not None
    assert not found.from_lidar_odometry
    np.testing.assert_array_equal(found.trajectory.T_map_imu, expected.trajectory.T_map_imu)
    assert (found.solution.vehicle is None) == (expected.vehicle is None)
    assert expected.vehicle is not None, "the first solution has no vehicle constraint"


@pytest.mark.parametrize(
    ("voxel_size_m", "up_m", "fits"),
    [(0.2, 1638, True), (0.2, 1639, False), (0.2, -1639, False), (0.4, 1639, True)],
)
def test_a_drive_is_refused_before_it_is_mapped_where_no_tile_holds_its_heights(
    voxel_size_m: float, up_m: float, fits: bool
) -> None:
    T_map_imu = np.tile(np.eye(4), (2, 1, 1))
    T_map_imu[1, 2, 3] = up_m
    trajectory = Trajectory(np.array([0.0, 1.0]), T_map_imu)
    for keeps in (
        lambda: check_heights("high", trajectory, voxel_size_m),
        lambda: local_keys(keys_of(trajectory.positions, voxel_size_m)),
    ):
        if fits:
            keeps()
        else:
            with pytest.raises(DataError, match=f"{up_m}|voxel heights"):
                keeps()

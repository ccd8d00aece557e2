"""The trajectory of a drive: what its first solution is for, and when it is the last one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.trajectory import locate, smooth_log
from gnss_sem_map.run_stats import RunStats
from gnss_sem_map.sensor_log import Points, SensorLog


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

"""A drive's trajectory: GNSS and IMU smoothed, then once more, bound by the sweeps matched with the first one."""

from __future__ import annotations

from factor_graphs.relative_poses import RelativePoses
from factor_graphs.smoothing import Solution, smooth
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.run_stats import Progress, RunStats, silent
from gnss_sem_map.scans.lidar_odometry import TrajectorySettings, match_scans
from gnss_sem_map.sensor_log import SensorLog


def estimate_trajectory(
    log: SensorLog, settings: Settings, account: RunStats, progress: Progress = silent
) -> tuple[Trajectory, Solution | None]:
    """The poses that came with the drive, or GNSS and IMU smoothed, bound by LiDAR odometry where there are scans."""
    return final(log, solve(log, settings, account, progress))


def final(log: SensorLog, solutions: tuple[Solution, ...]) -> tuple[Trajectory, Solution | None]:
    """The last of the solutions, or the poses that came with the drive."""
    if log.given is not None:
        return log.given, None
    return solutions[-1].trajectory, solutions[-1]


def solve(
    log: SensorLog,
    settings: Settings,
    account: RunStats,
    progress: Progress = silent,
    first: Solution | None = None,
) -> tuple[Solution, ...]:
    """GNSS and IMU smoothed, and then once more bound by the sweeps matched with that; none where poses are given.

    `first` is what `smooth_log` makes of this log, where somebody has it already.
    """
    if log.given is not None:
        return ()
    log = log.in_our_conventions(settings.sensors)
    solutions = [first if first is not None else smooth_log(log, settings.trajectory)]
    if settings.trajectory.lidar_odometry and log.scans:
        matches = match_scans(log, solutions[0].trajectory, settings.trajectory.scan_matching, progress)
        account.counts.update(matches.counts)
        # a scan that cannot be used at all is reported when the map is built
        account.skips.extend(skip for skip in matches.skips if skip.what == "scan matching")
        if len(matches.relative_poses):
            solutions.append(smooth_log(log, settings.trajectory, matches.relative_poses))
    account.warnings.extend(solutions[-1].notes)
    return tuple(solutions)


def smooth_log(
    log: SensorLog, settings: TrajectorySettings, relative_poses: RelativePoses | None = None
) -> Solution:
    """IMU and GNSS of a drive smoothed; the drive's own word on the noise of its IMU counts unless a setting is given.

    Raises DataError without IMU and GNSS, MeasurementError and EstimationError.
    """
    if log.imu is None or log.gnss is None or log.frame is None:
        raise DataError(f"{log.name}: found neither poses nor IMU with GNSS; expected one of them")
    smoother = settings
    if log.imu_noise is not None and "imu_noise" not in settings.model_fields_set:
        smoother = settings.model_copy(update={"imu_noise": log.imu_noise})
    lever = log.calibration.p_imu_antenna
    return smooth(log.imu, log.gnss, log.frame, smoother, lever, log.initial_attitude, relative_poses)

"""Trajectory of a drive: smoothed from GNSS and IMU, then once more with relative poses from LiDAR odometry.

Places that the drive passes again are bound to their first pass in the end (`mapping.passes`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factor_graphs.geodesy import LocalFrame
from factor_graphs.given_poses import held_by
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.smoothing import Solution, smooth
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.passes import LocatedDrive, TwoPasses, bind_passes, count_passes
from gnss_sem_map.process.run_stats import Progress, RunStats, silent
from gnss_sem_map.scans.lidar_odometry import ScanMatches, TrajectorySettings, match_scans
from gnss_sem_map.scans.local_maps import sweeps_along
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels.kernels import AXIS_BITS
from gnss_sem_map.voxels.tile_files import Z_OFFSET

MATCHED_SHARE = 0.95
"""With this share of matched scans, poses are accurate enough to tell slow objects from static ones."""


@dataclass(frozen=True, eq=False)
class DriveTrajectory:
    """The trajectory of a drive, and how it was estimated."""

    trajectory: Trajectory
    solution: Solution | None = None
    """Solution of the smoother; None if the drive has poses."""
    without_lidar: Trajectory | None = None
    """The estimate from GNSS and IMU alone, or the given poses; None if LiDAR odometry was not used."""
    from_lidar_odometry: bool = False
    """Whether nearly all scans were matched, so that static objects are not blurred in the map."""
    alone: Trajectory | None = None
    """The trajectory before it was bound to itself; None where nothing binds it."""
    passes: tuple[TwoPasses, ...] = ()
    """What the drive passed again, and how well it fits."""


def estimate_trajectory(
    log: SensorLog, settings: Settings, stats: RunStats, progress: Progress = silent
) -> tuple[Trajectory, Solution | None]:
    """The trajectory of a drive and its solution; see `locate`."""
    found = locate(log, settings, stats, progress)
    return found.trajectory, found.solution


def locate(
    log: SensorLog,
    settings: Settings,
    stats: RunStats,
    progress: Progress = silent,
    first: Solution | None = None,
    bound: bool = True,
) -> DriveTrajectory:
    """The trajectory of a drive that is open, at once: `first_trajectory`, scan matching, `final_trajectory`.

    `first` is the result of `smooth_log` for this log, if it is known already. Places that are passed again are
    registered, unless not `bound`.
    """
    log = log.in_our_conventions(settings.sensors)
    track, matches = first_trajectory(log, settings, first), None
    if track is not None:
        matches = match_scans(log, track, settings.trajectory.scan_matching, progress)
    found = final_trajectory(log, settings, stats, track, matches)
    drive = located(log, found)
    if not bound or drive is None:
        return found
    together = bind_passes([drive], settings.trajectory.revisits)
    count_passes(together, stats)
    correction, found = together.corrections[0], replace(found, passes=together.passes)
    if correction is None:
        return found
    return replace(found, trajectory=correction.of(found.trajectory), alone=found.trajectory)


def first_trajectory(log: SensorLog, settings: Settings, first: Solution | None = None) -> Trajectory | None:
    """The trajectory along which the scans of a drive are matched; None where none are.

    `first` is the result of `smooth_log`, if it is known already. Raises as `smooth_log` does.
    """
    if not matches_scans(log, settings):
        return None
    if log.given is not None:
        return log.given
    return (first or smooth_log(log, _plain(settings.trajectory))).trajectory


def final_trajectory(
    log: SensorLog,
    settings: Settings,
    stats: RunStats,
    first: Trajectory | None,
    matches: ScanMatches | None,
) -> DriveTrajectory:
    """The poses of the drive if it has some; else GNSS and IMU smoothed, with the relative poses of its scans.

    Given poses that are measurements (see `matches_scans`) are smoothed with the relative poses, too. `matches` are
    those along the `first` trajectory.
    """
    is_sharp, chosen = False, settings.trajectory
    if matches is not None:
        stats.counts.update(matches.counts)
        # a scan that cannot be used at all is reported when the map is built
        stats.skips.extend(skip for skip in matches.skips if skip.what == "scan matching")
        is_sharp = matches.counts["scans matched"] >= MATCHED_SHARE * len(log.scans)
    if log.given is not None:
        if matches is None:
            return DriveTrajectory(log.given)
        stddevs = np.radians(chosen.given_stddev_deg), chosen.given_stddev_m
        held = held_by(log.given, matches.relative_poses, stddevs, chosen.drift_correlation_time_s)
        return DriveTrajectory(held, without_lidar=log.given, from_lidar_odometry=is_sharp)
    relative = None if matches is None or not len(matches.relative_poses) else matches.relative_poses
    found = smooth_log(log, chosen, relative)
    stats.warnings.extend(found.notes)
    return DriveTrajectory(found.trajectory, found, None if relative is None else first, is_sharp)


def located(log: SensorLog, found: DriveTrajectory, saved: Path | None = None) -> LocatedDrive | None:
    """What binds a drive where it comes to a place again; None where its trajectory cannot be bound.

    `saved`: the folder of sweeps that were saved when they were matched.
    """
    if found.solution is None or found.solution.condensed is None or found.without_lidar is None:
        return None
    sweeps = sweeps_along(log, found.without_lidar, saved)
    return LocatedDrive(log.name, sweeps, found.trajectory, found.solution.condensed)


def matches_scans(log: SensorLog, settings: Settings) -> bool:
    """Whether LiDAR odometry has a part in the trajectory: it has none in given poses, unless they are measurements."""
    chosen = settings.trajectory
    is_open = log.given is None or chosen.given_poses == "measured"
    return is_open and chosen.lidar_odometry and bool(log.scans)


def _plain(settings: TrajectorySettings) -> TrajectorySettings:
    """How a drive is smoothed before LiDAR odometry: only the motion within a sweep counts."""
    return settings.model_copy(
        update={"vehicle_constraint": "off", "estimate_time_offset": False, "forward_backward": False}
    )


def in_frame(
    log: SensorLog, trajectory: Trajectory, origin: LocalFrame | None
) -> tuple[SensorLog, Trajectory]:
    """A log and its trajectory in the frame `origin`, or as they are where there is none."""
    if origin is None or log.frame is None or origin == log.frame:
        return log, trajectory
    return replace(log, frame=origin), trajectory.moved(origin.pose_of(log.frame))


def check_georeference(log: SensorLog, origin: LocalFrame | None, voxel_size_m: float) -> None:
    """Raise DataError for a drive in its own poses, which fits into no frame, and for one too far from the origin."""
    if origin is None or origin == log.frame:
        return
    if log.frame is None:
        raise DataError(
            f"{log.name}: has no georeference, so its map has no origin; expected GNSS, or no --origin and no other"
            " drive"
        )
    p_origin = origin.pose_of(log.frame)[:3, 3]
    farthest_m, highest_m = voxel_size_m * (1 << AXIS_BITS - 1), voxel_size_m * Z_OFFSET
    if max(abs(p_origin[:2])) >= farthest_m or abs(p_origin[2]) >= highest_m:
        raise DataError(
            f"{log.name}: lies {np.linalg.norm(p_origin[:2]) / 1000:.1f} km from the origin of the map"
            f" ({origin.lat_deg:.6f}, {origin.lon_deg:.6f}, {origin.alt_m:.1f} m) and {p_origin[2]:.0f} m above its"
            f" plane, expected less than {farthest_m / 1000:.0f} km and +-{highest_m:.0f} m; choose an --origin near"
            " the drive, or make two maps"
        )


def check_heights(name: str, trajectory: Trajectory, voxel_size_m: float) -> None:
    """Raise DataError for a drive of this name that goes higher or lower than a map has voxels."""
    up, highest_m = trajectory.positions[:, 2], voxel_size_m * Z_OFFSET
    if len(up) and max(-up.min(), up.max()) >= highest_m:
        raise DataError(
            f"{name}: lies between {up.min():.0f} and {up.max():.0f} m over the origin of the map, expected less than"
            f" +-{highest_m:.0f} m with voxels of {voxel_size_m:g} m; choose a larger mapping.voxel_size_m, or see to"
            " the heights of the poses"
        )


def smooth_log(
    log: SensorLog, settings: TrajectorySettings, relative_poses: RelativePoses | None = None
) -> Solution:
    """Smooth IMU, GNSS and wheel speed of a drive; settings of the IMU are before the drive's own.

    Raises DataError without IMU and GNSS, MeasurementError and EstimationError.
    """
    if log.imu is None or log.gnss is None or log.frame is None:
        raise DataError(f"{log.name}: found neither poses nor IMU with GNSS; expected one of them")
    of_log = {"imu_noise": log.imu_noise, "imu_sample_instant": log.imu_sample_instant}
    unset = {name: value for name, value in of_log.items() if getattr(settings, name) is None}
    smoother = settings.model_copy(update=unset)
    return smooth(
        log.imu,
        log.gnss,
        log.frame,
        smoother,
        log.calibration.p_imu_antenna,
        log.initial_attitude,
        relative_poses,
        log.wheels,
        condensed=relative_poses is not None and settings.revisits.enabled,
        also=[one for one in (log.velocities, log.headings, log.points) if one is not None],
    )

"""A trajectory in a file of its own, in place of the smoothed one: TUM, `trajectory.parquet` of a run, SBET.

    .tum, .txt     stamp tx ty tz qx qy qz qw of T_map_imu; seconds of the log, or Unix time
    .parquet       as a run writes it, with velocities and covariances
    .sbet, .out    SBET: a georeference of its own, seconds of the GPS week

`trajectory.tum` and `trajectory.parquet` in a run folder have the clock and the origin of the run.json beside them.
Other poses without an origin are taken as they are where the fixes of the drive agree, else fitted to these.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.geodesy import LocalFrame
from factor_graphs.given_poses import do_fit, misses, pose_by_fixes, turns_seen
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.datasets.gnss_files import sbet
from gnss_sem_map.datasets.kitti_calibration import read_table
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.files.untrusted import is_file, refused, shown
from gnss_sem_map.sensor_log import Scan, SensorLog, Skip
from gnss_sem_map.sensor_log.conventions import SensorConventions

Array = NDArray[np.float64]

SBET = (".sbet", ".out")
FARTHEST_M = 1e12
QUATERNION_TOLERANCE = 1e-2
LONGEST_STEP_S = 1.0
"""Between poses that are farther apart a vehicle does not move on a straight line: scans there are left out."""
STAMP_TOLERANCE_S = 1e-3
"""Stamps in text files are rounded."""
POSSIBLE, SURE = 1.0, 1.7
"""Of 2: a vehicle that drives forward and upright, and one that does beyond doubt."""
OF_A_RUN = "trajectory"


@dataclass(frozen=True, eq=False)
class _File:
    """The poses of a file; `epoch_ns`: Unix time of its stamp zero, and `frame`: its origin, where it tells them."""

    trajectory: Trajectory
    epoch_ns: int | None = None
    frame: LocalFrame | None = None


def along(log: SensorLog, file: Path, with_imu: bool = True) -> SensorLog:
    """The log with the poses of a file, and the scans that have one; raises DataError, MeasurementError.

    It is an error when the file has no time in common with the log, or no poses. `with_imu`: as the log was read.
    """
    ours = log.in_our_conventions(SensorConventions())
    first, last = _span(ours)
    found = _read(file, log.epoch_ns + round((first + last) / 2 * 1e9))
    trajectory, clock = _on_clock_of(ours, found, file)
    if len(trajectory) < 2:
        raise refused(file, "found one pose, expected at least 2")
    if with_imu and file.suffix not in (".parquet", *SBET):
        _refuse_scalar_first(trajectory, ours, file)
    frame, trajectory, place = _placed(ours, trajectory, found.frame)
    scans, skips = _with_pose(log, trajectory, file)
    how = f"{len(trajectory)} poses of {shown(file.name)}; {clock}; {place}"
    return replace(scans, given=trajectory, frame=frame, given_how=how, skips=(*log.skips, *skips))


def _read(file: Path, near_ns: int) -> _File:
    if not is_file(file):
        raise refused(file, "no such file; expected a trajectory (.tum, .parquet, .sbet)")
    if file.suffix in SBET:
        stamps_ns, geodetic, R_local_imu = sbet.read_poses(file, near_ns)
        frame = LocalFrame(*(float(value) for value in geodetic[0]))
        T = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
        T[:, :3, 3] = frame.to_map(*geodetic.T)
        T[:, :3, :3] = frame.axes_at(T[:, :3, 3]) @ R_local_imu
        return _File(Trajectory(np.asarray((stamps_ns - near_ns) * 1e-9, np.float64), T), near_ns, frame)
    trajectory = Trajectory.load(file) if file.suffix == ".parquet" else read_tum(file)
    if file.stem != OF_A_RUN or not is_file(file.parent / "run.json"):
        return _File(trajectory)
    about = read_run(file.parent)
    try:
        origin = about["local_frame"]
        return _File(trajectory, int(about["epoch_ns"]), None if origin is None else LocalFrame(**origin))
    except (KeyError, TypeError, ValueError) as error:
        raise refused(file.parent / "run.json", f"damaged ({type(error).__name__} {error})") from None


def read_tum(path: Path) -> Trajectory:
    """Read `stamp tx ty tz qx qy qz qw`, a pose per line; raises DataError for anything else."""
    rows = read_table(path, 8)
    stamps, small = rows[:, 0], np.clip(rows[:, 4:], -FARTHEST_M, FARTHEST_M)
    faults = {
        f"a number beyond {FARTHEST_M:g}": np.abs(rows).max(axis=1) > FARTHEST_M,
        "a stamp that is not later than the one before; sort the poses and drop repeats":
            np.diff(stamps, prepend=-np.inf) <= 0,
        "a quaternion that is no rotation, expected qx qy qz qw of length one":
            np.abs(np.linalg.norm(small, axis=1) - 1) > QUATERNION_TOLERANCE,
    }  # fmt: skip
    for what, wrong in faults.items():
        if wrong.any():
            row = int(wrong.argmax())
            raise refused(
                path,
                f"pose {row + 1}, at {stamps[row]:.15g} s: found {what}; {wrong.sum()} of"
                f" {len(rows)} poses have this fault",
            )
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4]
    return Trajectory(stamps, T)


def _span(log: SensorLog) -> tuple[float, float]:
    """First and last moment of the scans, s; without any, of what else there is."""
    of_scans = [scan.stamp for one in log.by_lidar for scan in one.scans]
    tables = [table.stamps for table in (log.imu, log.gnss) if table is not None]
    stamps = np.array(of_scans) if of_scans else np.concatenate([np.empty(0), *tables])
    if not len(stamps):
        raise DataError(f"{log.name}: found neither scans nor IMU nor GNSS to go with the poses")
    return float(stamps.min()), float(stamps.max())


def _on_clock_of(log: SensorLog, found: _File, file: Path) -> tuple[Trajectory, str]:
    """The trajectory in seconds of the log, and what its stamps were; raises DataError without time in common."""
    clocks = {"its stamps are seconds of the log": 0.0, "its stamps are Unix time": log.epoch_ns * 1e-9}
    if found.epoch_ns is not None:
        clocks = {"its file tells the date": (log.epoch_ns - found.epoch_ns) * 1e-9}
    (first, last), poses = _span(log), found.trajectory
    common = {
        how: min(poses.end - zero, last) - max(poses.start - zero, first) for how, zero in clocks.items()
    }
    how = max(common, key=lambda each: common[each])
    zero = clocks[how]
    if common[how] < 0:
        raise refused(
            file,
            f"its poses are from {poses.start - zero:.3f} to {poses.end - zero:.3f} s, and {log.name} is"
            f" from {first:.3f} to {last:.3f} s after {log.epoch_ns * 1e-9:.3f}, Unix time: no time in common; is it of"
            " another drive?",
        )
    return replace(poses, stamps=poses.stamps - zero) if zero else poses, how


def _refuse_scalar_first(trajectory: Trajectory, log: SensorLog, file: Path) -> None:
    """Raise DataError where the rotations make sense only with qw as the first of the four numbers.

    The gyroscope tells; where it cannot, a vehicle drives forward and upright most of the time.
    """
    T = trajectory.T_map_imu.copy()
    x_y_z_w = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    T[:, :3, :3] = Rotation.from_quat(x_y_z_w[:, [1, 2, 3, 0]]).as_matrix()
    other = replace(trajectory, T_map_imu=T)
    seen = [None if log.imu is None else turns_seen(one, log.imu) for one in (trajectory, other)]
    if seen[0] is not None and seen[1] is not None and seen[0].is_known:
        is_other = not seen[0].fits(seen[0].off_then) and seen[1].fits(seen[1].off_then)
        why = "the poses turn as the gyroscope does"
    else:
        is_other = _plausibility(trajectory) < POSSIBLE and _plausibility(other) > SURE
        why = "the vehicle drives forward and upright"
    if is_other:
        raise refused(
            file,
            f"looks like qw first: read so, {why}; expected qw last, in stamp tx ty tz qx qy qz qw",
        )


def _plausibility(trajectory: Trajectory) -> float:
    """How far a vehicle drives along its x axis, -1 to 1, and stands upright, -1 to 1: their sum."""
    every = max(1, round(0.5 / float(np.median(np.diff(trajectory.stamps)))))
    T = trajectory.T_map_imu[::every]
    steps = np.einsum("kji,kj->ki", T[:-1, :3, :3], np.diff(T[:, :3, 3], axis=0))
    sizes = np.linalg.norm(steps, axis=1)
    ahead = 0.0 if not sizes.sum() else float(steps[:, 0].sum() / sizes.sum())
    return ahead + float(T[:, 2, 2].mean())


def _placed(
    log: SensorLog, trajectory: Trajectory, origin: LocalFrame | None
) -> tuple[LocalFrame | None, Trajectory, str]:
    """The frame of the map, the trajectory in it, and how it came there; `origin` is that of the file."""
    if origin is not None:
        frame = log.frame or origin
        return (
            frame,
            trajectory if frame == origin else trajectory.moved(frame.pose_of(origin)),
            "georeferenced",
        )
    if log.frame is None:
        return None, trajectory, "in a frame of their own, without a georeference"
    lever = log.calibration.p_imu_antenna
    off, claimed = (np.empty(0),) * 2 if log.gnss is None else misses(trajectory, log.gnss, lever)
    if log.gnss is None or not len(off):
        return log.frame, trajectory, "taken to be in the frame of the drive: no fix tells"
    if do_fit(off, claimed):
        return log.frame, trajectory, f"in the frame of the fixes, {np.median(off):.2f} m from the usual one"
    T = pose_by_fixes(trajectory, log.gnss, lever)
    if T is None:
        why = "the way within the fixes is too short to tell the heading"
        return None, trajectory, f"in a frame of their own, without a georeference: {why}"
    moved, turn = trajectory.moved(T), np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude())
    left = np.median(misses(moved, log.gnss, lever)[0])
    return (
        log.frame,
        moved,
        f"fitted to {len(off)} fixes, turned by {turn:.2f}°, {left:.2f} m from the usual one",
    )


def _with_pose(log: SensorLog, trajectory: Trajectory, file: Path) -> tuple[SensorLog, list[Skip]]:
    """The log with the scans that have a pose, and how many have none."""
    stamps, outside, between = trajectory.stamps, 0, 0
    late_s = 0.0 if log.conventions is None else log.conventions.lidar_time_offset_s or 0.0

    def kept(scans: tuple[Scan, ...]) -> tuple[Scan, ...]:
        nonlocal outside, between
        t = np.array([scan.stamp for scan in scans]) + late_s
        is_out = (t < trajectory.start - STAMP_TOLERANCE_S) | (t > trajectory.end + STAMP_TOLERANCE_S)
        after = np.searchsorted(stamps, t).clip(1, len(stamps) - 1)
        is_between = ~is_out & (stamps[after] - stamps[after - 1] > LONGEST_STEP_S + STAMP_TOLERANCE_S)
        outside, between = outside + int(is_out.sum()), between + int(is_between.sum())
        return tuple(scan for scan, lost in zip(scans, is_out | is_between, strict=True) if not lost)

    log = log.with_scans(kept)
    reasons = {
        f"{outside} scans before {trajectory.start:.3f} s or after {trajectory.end:.3f} s have no pose": outside,
        f"{between} scans between poses more than {LONGEST_STEP_S:g} s apart": between,
    }
    return log, [Skip("scan", shown(file), reason, n) for reason, n in reasons.items() if n]

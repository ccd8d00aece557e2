"""The navigation unit of KITTI, `oxts/`: its IMU, its positions as fixes, and its own poses.

Rows jitter against the scans, so nothing may be paired by index.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.alignment import AttitudePrior
from factor_graphs.filled_gaps import filled_in
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import LARGEST_OF_IMU, GnssFixes, ImuNoise, ImuSamples
from factor_graphs.stamps import far_off
from factor_graphs.trajectory import Trajectory
from factor_graphs.valid_fixes import valid_fixes
from gnss_sem_map.datasets import frames
from gnss_sem_map.datasets.kitti_calibration import stamps_ns
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import is_folder, read_text, refused, shown
from gnss_sem_map.sensor_log import Skip, skipped

Array = NDArray[np.float64]

MOST_ROW_BYTES = 10_000
MOST_FIXES_PER_S = 10.0
"""More often, the unit repeats its own errors: of 100 Hz every tenth row is a fix, as in a `_sync` drive."""
ATTITUDE_STDDEVS_RAD = np.array([0.005, 0.005, 0.01])
"""Standard deviations of the unit's first roll, pitch, yaw; with a larger one a short track rotates the whole map."""
OXTS_NOISE = ImuNoise(
    accelerometer_noise_density=5e-4,
    gyroscope_noise_density=6e-5,
    accelerometer_bias_walk=1e-5,
    gyroscope_bias_walk=1e-6,
    accelerometer_bias_stddev=0.02,
    gyroscope_bias_stddev=1e-4,
)
"""Of the RT3003, whose rates and forces are already corrected for bias by its own filter. Gyroscopes by its data sheet,
0.2 °/√h and stable to 2 °/h; accelerometers worse, 0.005 m/s/√h, because the car vibrates."""
OXTS_COLUMNS = 30
LAT, LON, ALT, ROLL, PITCH, YAW = range(6)
SPECIFIC_FORCE = slice(11, 14)
"""ax ay az: in the body frame; af al au are levelled with the unit's own attitude, which would influence the result."""
ANGULAR_RATE = slice(17, 20)
OF_IMU = np.r_[SPECIFIC_FORCE, ANGULAR_RATE]
POSITION_ACCURACY = 23
LEAST_ACCURACY_M = 1e-4
"""Standard deviations must be positive; too small ones are a matter of the pre-flight check."""


@dataclass(frozen=True, eq=False)
class Navigation:
    """What the navigation unit of a drive measured."""

    epoch_ns: int
    """Unix time of its first row."""
    frame: LocalFrame
    """At its first fix."""
    imu: ImuSamples
    gnss: GnssFixes
    attitude: AttitudePrior
    """Its own, at the first row of the IMU."""
    reference: Trajectory
    """Its own solution."""
    skips: list[Skip]


def navigation(drive: Path, twins: tuple[Path, ...], with_imu: bool = True) -> Navigation:
    """Read `drive/oxts`, and the IMU from the first of the 100 Hz `twins` that is there.

    Without `with_imu`, the thousands of files of a twin are not read. Raises DataError.
    """
    oxts_ns, oxts, skips = oxts_rows(drive)
    stamps = _seconds(oxts_ns, int(oxts_ns[0]))
    is_fix, invalid = valid_fixes(stamps, oxts[:, [LAT, LON, ALT]], oxts[:, [POSITION_ACCURACY]])
    if not is_fix.any():
        raise refused(
            drive / "oxts",
            f"not one of {len(oxts)} rows is a fix; found {next(iter(invalid))} (columns 1 to 3, 24)",
        )
    fix_skips = skipped("fix", drive / "oxts", "rows", invalid)
    epoch_ns = int(oxts_ns[0])
    if np.median(np.diff(stamps)) < 0.5 / MOST_FIXES_PER_S:
        is_fix &= np.diff(np.floor(stamps * MOST_FIXES_PER_S + 1e-3), prepend=-1.0) > 0
    fixes = oxts[is_fix]
    frame = LocalFrame(*(float(v) for v in fixes[0, [LAT, LON, ALT]]))
    accuracy = np.maximum(fixes[:, POSITION_ACCURACY], LEAST_ACCURACY_M)
    gnss = GnssFixes(
        stamps[is_fix], frame.to_map(*fixes[:, [LAT, LON, ALT]].T), np.repeat(accuracy[:, None], 3, axis=1)
    )
    imu_stamps, imu_rows, imu_skips = (
        _imu_rows(twins, epoch_ns, stamps, oxts) if with_imu else (stamps, oxts, [])
    )
    return Navigation(
        epoch_ns=epoch_ns,
        frame=frame,
        imu=ImuSamples(imu_stamps, imu_rows[:, SPECIFIC_FORCE], imu_rows[:, ANGULAR_RATE]),
        gnss=gnss,
        attitude=AttitudePrior(_attitudes(imu_rows[:1])[0], ATTITUDE_STDDEVS_RAD),
        reference=Trajectory(gnss.stamps, _reference_poses(gnss.positions, fixes)),
        skips=[*skips, *fix_skips, *imu_skips],
    )


def oxts_rows(drive: Path) -> tuple[NDArray[np.int64], Array, list[Skip]]:
    """Stamps and rows of the navigation unit, sorted, without repeated stamps; and the skipped rows."""
    found = frames.numbered("oxts", drive / "oxts" / "data", ".txt")
    stamps, skips = stamps_ns(drive / "oxts" / "timestamps.txt")
    of_files, lost = found.joined(stamps)
    skips += lost
    rows: dict[int, Array] = {}
    for _, path, stamp in of_files:
        fault, row = _oxts_row(path)
        if fault := fault or ("repeated stamp" if stamp in rows else ""):
            skips.append(Skip("oxts", shown(path), fault))
        else:
            rows[stamp] = row
    order = sorted(rows)
    off = far_off(np.array(order, np.float64) * 1e-9)
    for stamp in (stamp for stamp, is_off in zip(order, off, strict=True) if is_off):
        del rows[stamp]
        told = f"stamp {np.datetime64(stamp, 'ns')} is far off all others"
        skips.append(Skip("oxts", shown(drive / "oxts"), told))
    order = sorted(rows)
    if len(order) < 3:
        raise refused(
            drive / "oxts",
            f"found {len(order)} usable rows of {len(found.files)}, expected at least 3"
            + (f"; first reason: {skips[0].where}: {skips[0].reason}" if skips else ""),
        )
    return _measured(drive, np.array(order, np.int64), np.stack([rows[stamp] for stamp in order]), skips)


def _seconds(stamps_ns: NDArray[np.int64], epoch_ns: int) -> Array:
    return np.asarray((stamps_ns - epoch_ns) * 1e-9, np.float64)


def _measured(
    drive: Path, stamps: NDArray[np.int64], rows: Array, skips: list[Skip]
) -> tuple[NDArray[np.int64], Array, list[Skip]]:
    """Stamps and rows without those that fill gaps, and the skipped ones with them."""
    filled = filled_in(_seconds(stamps, int(stamps[0])), rows[:, OF_IMU])
    if count := int(np.count_nonzero(filled)):
        reason = f"{count} rows on straight lines that fill gaps"
        skips = [*skips, Skip("oxts", shown(drive / "oxts"), reason, count)]
    return stamps[~filled], rows[~filled], skips


def _oxts_row(path: Path) -> tuple[str, Array]:
    """Error of a row of the navigation unit, if any, and its numbers; the accuracy may be missing."""
    try:
        row = np.array([float(number) for number in read_text(path, MOST_ROW_BYTES).split()])
    except DataError as error:
        return str(error), np.empty(0)
    except ValueError:
        row = np.empty(0)
    if row.shape != (OXTS_COLUMNS,):
        return f"found {row.size} numbers, expected {OXTS_COLUMNS} finite ones", row
    is_finite = np.isfinite(row)
    is_finite[POSITION_ACCURACY] = True
    if not is_finite.all():
        bad = int(is_finite.argmin())
        return f"number {bad + 1} of {OXTS_COLUMNS} is {row[bad]}, expected a finite one", row
    if np.abs(row[OF_IMU]).max() > LARGEST_OF_IMU:
        return "found a force or a rate beyond the range of any sensor", row
    return "", row


def _imu_rows(
    twins: tuple[Path, ...], epoch_ns: int, stamps: Array, oxts: Array
) -> tuple[Array, Array, list[Skip]]:
    """The 100 Hz rows of a twin of the drive, else the 10 Hz rows of the drive."""
    for twin in twins:
        if is_folder(twin / "oxts" / "data"):
            twin_ns, rows, skips = oxts_rows(twin)
            return _seconds(twin_ns, epoch_ns), rows, skips
    return stamps, oxts, []


def _reference_poses(positions: Array, oxts: Array) -> Array:
    """Poses of the navigation unit: T_map_imu (k, 4, 4)."""
    T_map_imu = np.tile(np.eye(4), (len(oxts), 1, 1))
    T_map_imu[:, :3, :3] = _attitudes(oxts)
    T_map_imu[:, :3, 3] = positions
    return T_map_imu


def _attitudes(oxts: Array) -> Array:
    """R_map_imu (k, 3, 3) by the navigation unit."""
    return np.asarray(Rotation.from_quat(quaternions(oxts)).as_matrix())


def quaternions(oxts: Array) -> Array:
    """Attitudes by the navigation unit (k, 4), x y z w. Yaw is 0 towards east, counter-clockwise."""
    return np.asarray(Rotation.from_euler("ZYX", oxts[:, [YAW, PITCH, ROLL]]).as_quat())

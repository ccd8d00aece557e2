"""Dataset readers: each reads one folder layout into a `SensorLog`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import inside, is_file, is_folder, shown
from gnss_sem_map.sensor_log import SensorLog

DriveFormat = Literal["kitti-raw", "kitti-odometry", "table"]


def detect_format(drive: Path) -> DriveFormat:
    """Detect the format of a drive from its files; raises DataError for an unknown one."""
    if not is_folder(drive):
        raise DataError(f"{shown(drive)}: no such folder; expected a drive")
    if is_folder(drive / "oxts"):
        return "kitti-raw"
    if is_file(drive / "imu.csv") or is_file(drive / "gnss.csv"):
        return "table"
    if is_file(drive / "calib.txt") or is_file(drive / "poses.txt"):
        return "kitti-odometry"
    found = [shown(path.name) for path in inside(drive)][:8]
    raise DataError(
        f"{shown(drive)}: no drive that we know; found {found}, expected oxts/ (KITTI raw), calib.txt and poses.txt"
        " (KITTI odometry, SemanticKITTI), or imu.csv and gnss.csv (table log)"
    )


def open_drive(drive: Path, drive_format: DriveFormat | None = None) -> SensorLog:
    """Open a drive of any known format: tables are read now, scans and images when they are needed."""
    from gnss_sem_map.datasets import csv_log, kitti_odometry, kitti_raw

    readers = {
        "kitti-raw": kitti_raw.read,
        "kitti-odometry": kitti_odometry.read,
        "table": csv_log.read,
    }
    return readers[drive_format or detect_format(drive)](drive)

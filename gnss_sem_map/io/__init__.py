"""Drives in: every reader turns one folder layout into a `SensorLog`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import SensorLog

DriveFormat = Literal["kitti-raw", "kitti-odometry", "table"]


def detect_format(drive: Path) -> DriveFormat:
    """Say what kind of drive a folder holds, from what is there; raises DataError when it is none."""
    if not drive.is_dir():
        raise DataError(f"{drive}: no such folder; expected a drive")
    if (drive / "oxts").is_dir():
        return "kitti-raw"
    if (drive / "imu.csv").is_file() or (drive / "gnss.csv").is_file():
        return "table"
    if (drive / "calib.txt").is_file() or (drive / "poses.txt").is_file():
        return "kitti-odometry"
    found = sorted(path.name for path in drive.iterdir())[:8]
    raise DataError(
        f"{drive}: no drive that we know; found {found}, expected oxts/ (KITTI raw), calib.txt and poses.txt"
        " (KITTI odometry, SemanticKITTI), or imu.csv and gnss.csv (table log)"
    )


def open_drive(drive: Path, drive_format: DriveFormat | None = None) -> SensorLog:
    """Open a drive of any known format: small things are read now, scans and images when they are needed."""
    from gnss_sem_map.io import kitti_raw, semantic_kitti, table_log

    readers = {
        "kitti-raw": kitti_raw.read,
        "kitti-odometry": semantic_kitti.read,
        "table": table_log.read,
    }
    return readers[drive_format or detect_format(drive)](drive)

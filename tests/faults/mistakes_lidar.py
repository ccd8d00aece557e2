"""Mistakes with the LiDAR and its mounting, as users make them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from faults.changed_files import (
    Array,
    Inject,
    change_log,
    change_rows,
    change_scans,
    change_stamps,
    changed_Tr,
)
from faults.mistakes import Mistake
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.scans.deskew import usable_points_at_stamp


def turned_lidar(rotation_deg: Sequence[float]) -> Inject:
    """T_imu_lidar turned about the axes of the imu; the file of KITTI raw holds its inverse."""

    def inject(drive: Path) -> None:
        R = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix()
        if (drive / "log.yaml").is_file():

            def change(about: dict[str, Any]) -> dict[str, Any]:
                T = np.array(about["T_imu_lidar"])
                T[:3, :3] = R @ T[:3, :3]
                return {"T_imu_lidar": T.tolist()}

            change_log(drive, change)
            return
        change_rows(
            drive.parent / "calib_imu_to_velo.txt",
            lambda rows: {"R": rows["R"].reshape(3, 3) @ R.T},
        )  # fmt: skip

    return inject


def scaled_lidar(factor: float) -> Inject:
    """The translation of T_imu_lidar in another unit."""

    def inject(drive: Path) -> None:
        if (drive / "log.yaml").is_file():

            def change(about: dict[str, Any]) -> dict[str, Any]:
                T = np.array(about["T_imu_lidar"])
                T[:3, 3] *= factor
                return {"T_imu_lidar": T.tolist()}

            change_log(drive, change)
            return
        change_rows(drive.parent / "calib_imu_to_velo.txt", lambda rows: {"T": factor * rows["T"]})

    return inject


def lost_line(name: str, at: float) -> Inject:
    """A stamp file lost a line at this part of the frames that the drive has."""

    def inject(drive: Path) -> None:
        path = drive / f"velodyne_points/timestamps{name}.txt"
        numbers = sorted(int(file.stem) for file in (drive / "velodyne_points/data").iterdir())
        lines = path.read_text().splitlines()
        del lines[numbers[int(at * (len(numbers) - 1))]]
        path.write_text("\n".join(lines) + "\n")

    return inject


def point_times(change: Callable[[Array], Array]) -> Inject:
    """Other times in the fifth column of a table log."""

    def inject(drive: Path) -> None:
        def changed(rows: NDArray[np.float32]) -> NDArray[Any]:
            return np.column_stack([rows[:, :4], change(rows[:, 4].astype(np.float64))])

        change_scans(drive, changed, 5)

    return inject


def raw_called_compensated(drive: Path) -> None:
    """Scans of a table log without their times, said to be compensated."""
    change_scans(drive, lambda rows: rows[:, :4], 5)
    change_log(drive, lambda about: {"lidar_is_compensated": True})


def compensated_called_raw(drive: Path) -> None:
    """Scans of KITTI raw, compensated to their stamp by somebody else."""
    log = open_drive(drive)
    trajectory = Sample(log, Settings(), None).trajectory
    assert trajectory is not None
    for scan in log.scans:
        points = scan.read()
        xyz, _ = usable_points_at_stamp(points, scan.stamp, trajectory, log.calibration.T_imu_lidar, 2.0)
        rows = np.column_stack([xyz, np.full(len(xyz), 0.5)])
        rows.astype("<f4").tofile(drive / f"velodyne_points/data/{scan.name}.bin")


def random_bytes(part: float) -> Inject:
    """Every so many scans hold other bytes of the same size."""

    def inject(drive: Path) -> None:
        rng = np.random.default_rng(1)
        paths = sorted((drive / "velodyne_points/data").glob("*.bin"))
        for path in paths[:: round(1 / part)]:
            path.write_bytes(rng.bytes(path.stat().st_size))

    return inject


def scans_in_mm(drive: Path) -> None:
    """Coordinates in mm."""
    change_scans(drive, lambda rows: np.column_stack([1000 * rows[:, :3], rows[:, 3:]]), 4)


def late_scans(by_s: float) -> Inject:
    """Stamps of the scans by another clock."""

    def inject(drive: Path) -> None:
        change_stamps(drive / "lidar/stamps.csv", by_s)

    return inject


def _mistakes() -> list[Mistake]:
    turned = ("turned",)
    found = [
        Mistake("T_imu_lidar in mm", "kitti-raw", scaled_lidar(1000.0), ("in mm",)),
        Mistake("T_imu_lidar in mm (table)", "table", scaled_lidar(1000.0), ("in mm",)),
    ]
    angles = {
        "yaw": [(0, 0, a) for a in (90, -90, 180, 5, -5, 10, -20)],
        "pitch": [(0, a, 0) for a in (5, -5, 10, 90)],
        "roll": [(a, 0, 0) for a in (8, -8, 15, 90, 180)],
    }
    for word, rotations in angles.items():
        for rotation in rotations:
            name = f"T_imu_lidar turned, {word} {sum(rotation)} deg"
            found.append(Mistake(name, "kitti-raw", turned_lidar(rotation), turned))
    found.append(Mistake("T_imu_lidar turned (table)", "table", turned_lidar((0, 0, 90)), turned))
    for file in ("_end", "_start", ""):
        for at in (0.1, 0.5):
            name = f"a line lost in timestamps{file}.txt at {at:.0%}"
            found.append(Mistake(name, "kitti-raw", lost_line(file, at), (f"timestamps{file}.txt",)))
    times: dict[str, tuple[Callable[[Array], Array], tuple[str, ...]]] = {
        "zero": (lambda t: 0 * t, ("all zero",)),
        "equal": (lambda t: 0 * t + 0.05, ("all the same",)),
        "reversed": (lambda t: -t, ("reversed",)),
        "in ms": (lambda t: 1e3 * t, ("in ms",)),
        "in µs": (lambda t: 1e6 * t, ("in µs",)),
        "in ns": (lambda t: 1e9 * t, ("in ns",)),
        "absolute": (lambda t: t + 1000.0, ("absolute",)),
    }
    for word, (change, says) in times.items():
        found.append(Mistake(f"point times {word}", "table", point_times(change), says))
    return [
        *found,
        Mistake("raw scans called compensated", "table", raw_called_compensated, ("raw scans",)),
        Mistake("compensated scans called raw", "kitti-raw", compensated_called_raw, ("compensated scans",)),
        Mistake("random bytes in every scan", "kitti-raw", random_bytes(1.0), ("other bytes",)),
        Mistake("random bytes in every third scan", "kitti-raw", random_bytes(1 / 3), ("other bytes",)),
        Mistake("scans in mm", "kitti-raw", scans_in_mm, ("mm", "other bytes")),
        Mistake("scans 1 s late", "table", late_scans(1.0), ("another clock", "time or drive")),
        Mistake("scans 1 s early", "table", late_scans(-1.0), ("another clock", "time or drive")),
        Mistake("Tr inverted", "odometry", changed_Tr(np.linalg.inv), ("tr in calib.txt",)),
    ]  # fmt: skip


MISTAKES = _mistakes()

"""Mistakes with the LiDAR, its mounting, the camera and labels, as users make them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from faults.mistakes import Mistake
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.evaluation.preflight.sample import Sample
from gnss_sem_map.scans.deskew import usable_points_at_stamp

Array = NDArray[np.float64]
Inject = Callable[[Path], None]


# files


def _rows(path: Path) -> dict[str, str]:
    lines = path.read_text().splitlines()
    return dict(line.split(": ", 1) for line in lines if ": " in line)


def _change_rows(path: Path, change: Callable[[dict[str, Array]], dict[str, Array]]) -> None:
    """Change the numbers of a calibration file of KITTI."""
    rows = _rows(path)
    numbers = {name: np.array(row.split(), np.float64) for name, row in rows.items() if name != "calib_time"}
    changed = change(numbers)
    rows |= {name: " ".join(f"{v:.12e}" for v in np.ravel(row)) for name, row in changed.items()}
    path.write_text("".join(f"{name}: {row}\n" for name, row in rows.items()))


def _change_log(drive: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    about = yaml.safe_load((drive / "log.yaml").read_text())
    (drive / "log.yaml").write_text(yaml.safe_dump(about | change(about)))


def _change_scans(drive: Path, change: Callable[[NDArray[np.float32]], NDArray[Any]], columns: int) -> None:
    folder = next(
        f for f in (drive / "lidar", drive / "velodyne_points/data", drive / "velodyne") if f.is_dir()
    )
    for path in folder.glob("*.bin"):
        change(np.fromfile(path, "<f4").reshape(-1, columns)).astype("<f4").tofile(path)


def _change_stamps(path: Path, by_s: float) -> None:
    """A stamp file of KITTI (date and time per line) or of a table log (number and stamp)."""
    if path.suffix == ".csv":
        header, *lines = path.read_text().splitlines()
        rows = [(line.split(",")[0], float(line.split(",")[1]) + by_s) for line in lines]
        path.write_text("\n".join([header, *(f"{number},{stamp:.9f}" for number, stamp in rows)]) + "\n")
        return
    lines = []
    for line in path.read_text().splitlines():
        if line.strip():
            stamp = np.datetime64(line.strip().replace(" ", "T"), "ns") + np.timedelta64(
                round(by_s * 1e9), "ns"
            )
            line = str(stamp).replace("T", " ")
        lines.append(line)
    path.write_text("\n".join(lines) + "\n")


# mounting of the LiDAR


def turned_lidar(rotation_deg: Sequence[float]) -> Inject:
    """T_imu_lidar turned about the axes of the imu; the file of KITTI raw holds its inverse."""

    def inject(drive: Path) -> None:
        R = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix()
        if (drive / "log.yaml").is_file():

            def change(about: dict[str, Any]) -> dict[str, Any]:
                T = np.array(about["T_imu_lidar"])
                T[:3, :3] = R @ T[:3, :3]
                return {"T_imu_lidar": T.tolist()}

            _change_log(drive, change)
            return
        _change_rows(
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

            _change_log(drive, change)
            return
        _change_rows(drive.parent / "calib_imu_to_velo.txt", lambda rows: {"T": factor * rows["T"]})

    return inject


# sweeps


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

        _change_scans(drive, changed, 5)

    return inject


def raw_called_compensated(drive: Path) -> None:
    """Scans of a table log without their times, said to be compensated."""
    _change_scans(drive, lambda rows: rows[:, :4], 5)
    _change_log(drive, lambda about: {"lidar_is_compensated": True})


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
    _change_scans(drive, lambda rows: np.column_stack([1000 * rows[:, :3], rows[:, 3:]]), 4)


def late_scans(by_s: float) -> Inject:
    """Stamps of the scans by another clock."""

    def inject(drive: Path) -> None:
        _change_stamps(drive / "lidar/stamps.csv", by_s)

    return inject


def changed_Tr(change: Callable[[Array], Array]) -> Inject:
    """Another Tr in calib.txt of an odometry sequence."""

    def inject(sequence: Path) -> None:
        def rows(given: dict[str, Array]) -> dict[str, Array]:
            Tr = np.vstack([given["Tr"].reshape(3, 4), [0, 0, 0, 1]])
            return {"Tr": change(Tr)[:3]}

        _change_rows(sequence / "calib.txt", rows)

    return inject


# camera


def turned_camera(rotation_deg: Sequence[float]) -> Inject:
    """T_camera_lidar turned about the axes of the camera."""

    def inject(drive: Path) -> None:
        R = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix()
        if (drive / "log.yaml").is_file():

            def change(about: dict[str, Any]) -> dict[str, Any]:
                T = np.array(about["T_camera_lidar"])
                T[:3] = R @ T[:3]
                return {"T_camera_lidar": T.tolist()}

            _change_log(drive, change)
            return
        if (drive / "calib.txt").is_file():
            changed_Tr(lambda Tr: np.vstack([R @ Tr[:3], Tr[3:]]))(drive)
            return
        _change_rows(
            drive.parent / "calib_velo_to_cam.txt",
            lambda rows: {"R": R @ rows["R"].reshape(3, 3), "T": R @ rows["T"]},
        )  # fmt: skip

    return inject


def inverted_camera(drive: Path) -> None:
    """T_lidar_camera where T_camera_lidar is expected."""
    if (drive / "log.yaml").is_file():
        _change_log(
            drive, lambda about: {"T_camera_lidar": np.linalg.inv(np.array(about["T_camera_lidar"])).tolist()}
        )
        return

    def invert(rows: dict[str, Array]) -> dict[str, Array]:
        R = rows["R"].reshape(3, 3)
        return {"R": R.T, "T": -R.T @ rows["T"]}

    _change_rows(drive.parent / "calib_velo_to_cam.txt", invert)


def changed_K(change: Callable[[Array], Array]) -> Inject:
    """Other intrinsics, (3, 3), the shift between the cameras kept."""

    def inject(drive: Path) -> None:
        if (drive / "log.yaml").is_file():
            _change_log(drive, lambda about: {"K": change(np.array(about["K"])).tolist()})
            return

        def rows(given: dict[str, Array], name: str) -> dict[str, Array]:
            P = given[name].reshape(3, 4)
            K = change(P[:, :3].copy())
            return {name: np.column_stack([K, K @ np.linalg.solve(P[:, :3], P[:, 3])])}

        odometry = (drive / "calib.txt").is_file()
        path = drive / "calib.txt" if odometry else drive.parent / "calib_cam_to_cam.txt"
        _change_rows(path, functools.partial(rows, name="P2" if odometry else "P_rect_02"))

    return inject


def scaled_K(factor: float, centre: bool = True) -> Inject:
    """K of an image of another size, or of another lens."""

    def change(K: Array) -> Array:
        K[0, 0] *= factor
        K[1, 1] *= factor
        if centre:
            K[:2, 2] *= factor
        return K

    return changed_K(change)


def scaled_S(factor: float) -> Inject:
    """The size of other images than these."""

    def inject(drive: Path) -> None:
        _change_rows(
            drive.parent / "calib_cam_to_cam.txt",
            lambda rows: {"S_rect_02": np.floor(factor * rows["S_rect_02"])},
        )

    return inject


def late_images(by_s: float) -> Inject:
    """Image stamps that are off."""

    def inject(drive: Path) -> None:
        file = "images/stamps.csv" if (drive / "images").is_dir() else "image_02/timestamps.txt"
        _change_stamps(drive / file, by_s)

    return inject


# labels: `inject` changes a folder of labels


def zero_labels(folder: Path) -> None:
    """Files of the right size that hold nothing."""
    for path in folder.glob("*.npz"):
        with np.load(path) as content:
            np.savez_compressed(
                path,
                probabilities=np.zeros_like(content["probabilities"]),
                class_names=content["class_names"],
            )
    for path in folder.glob("*.png"):
        ids = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.zeros_like(ids))


def other_frames(by: int) -> Inject:
    """Labels of frames earlier or later, as of another drive: each file takes the name of another."""

    def inject(folder: Path) -> None:
        paths = sorted([*folder.glob("*.npz"), *folder.glob("*.png")])
        contents = [path.read_bytes() for path in paths]
        for k, path in enumerate(paths):
            path.write_bytes(contents[(k + by) % len(paths)])

    return inject


def shifted_labels(by_px: int) -> Inject:
    """Labels moved to the side, as of images cropped elsewhere."""

    def inject(folder: Path) -> None:
        for path in folder.glob("*.npz"):
            with np.load(path) as content:
                names, moved = content["class_names"], np.roll(content["probabilities"], by_px, axis=1)
            np.savez_compressed(path, probabilities=moved, class_names=names)
        for path in folder.glob("*.png"):
            ids = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(path), np.roll(ids, 2 * by_px, axis=1))

    return inject


def _lidar() -> list[Mistake]:
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


def _camera() -> list[Mistake]:
    turned = ("camera is turned", "t_camera_lidar")
    found = []
    for axis, name in enumerate("xyz"):
        for angle in (3.0, -3.0, 5.0):
            rotation = angle * np.eye(3)[axis]
            found.append(
                Mistake(
                    f"camera turned {angle:+g} deg about {name}", "kitti-raw", turned_camera(rotation), turned
                )
            )
    found += [
        Mistake("camera turned (table)", "table", turned_camera((0, 3, 0)), turned),
        Mistake("camera turned by 180 deg about y", "kitti-raw", turned_camera((0, 180, 0)), turned),
        Mistake("camera inverted", "kitti-raw", inverted_camera, ("inverted",)),
        Mistake("camera inverted (table)", "table", inverted_camera, ("inverted",)),
        Mistake("K halved", "kitti-raw", scaled_K(0.5), ("k is of", "principal point")),
        Mistake("K halved (table)", "table", scaled_K(0.5), ("k is of", "principal point")),
        Mistake("K doubled", "kitti-raw", scaled_K(2.0), ("k is of", "principal point")),
        Mistake("focal length halved", "kitti-raw", scaled_K(0.5, centre=False), ("focal length",)),
        Mistake("focal length 1.2 times", "kitti-raw", scaled_K(1.2, centre=False), ("focal length",)),
        Mistake("K transposed", "kitti-raw", changed_K(np.transpose), ("camera matrix", "rectified camera")),
        Mistake(
            "K with skew", "table", changed_K(lambda K: K + np.eye(3, k=1) * 100.0), ("camera matrix", "skew")
        ),
        Mistake("fx and fy far apart", "table", changed_K(lambda K: K * [[2], [1], [1]]), ("fx",)),
        Mistake("S_rect halved", "kitti-raw", scaled_S(0.5), ("size",)),
        Mistake("S_rect doubled", "kitti-raw", scaled_S(2.0), ("size",)),
        Mistake("images 0.1 s late", "kitti-raw", late_images(0.1), ("late",)),
        Mistake("images 0.1 s early", "kitti-raw", late_images(-0.1), ("early",)),
        Mistake("images 0.2 s late", "table", late_images(0.2), ("late",)),
        Mistake("images of another clock", "kitti-raw", late_images(3600.0), ("clock",)),
        Mistake("images of another clock (table)", "table", late_images(-37.0), ("clock",)),
    ]
    return found


MISTAKES = [*_lidar(), *_camera()]
OFF = ("shifted", "another drive", "other frames")
LABEL_MISTAKES = [
    Mistake("all-zero labels", "labels", zero_labels, ("zero", "one class", "no class")),
    Mistake("labels ten frames on", "labels", other_frames(10), ("other frames", "another drive")),
    Mistake("labels shifted by 20 pixels", "labels", shifted_labels(20), OFF),
    Mistake("labels shifted by -40 pixels", "labels", shifted_labels(-40), OFF),
]  # fmt: skip

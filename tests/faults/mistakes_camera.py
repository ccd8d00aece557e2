"""Mistakes with the camera and its labels, as users make them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from faults.changed_files import (
    Array,
    Inject,
    change_log,
    change_rows,
    change_stamps,
    changed_Tr,
)
from faults.mistakes import Mistake
from scipy.spatial.transform import Rotation


def turned_camera(rotation_deg: Sequence[float]) -> Inject:
    """T_camera_lidar turned about the axes of the camera."""

    def inject(drive: Path) -> None:
        R = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix()
        if (drive / "log.yaml").is_file():

            def change(about: dict[str, Any]) -> dict[str, Any]:
                T = np.array(about["T_camera_lidar"])
                T[:3] = R @ T[:3]
                return {"T_camera_lidar": T.tolist()}

            change_log(drive, change)
            return
        if (drive / "calib.txt").is_file():
            changed_Tr(lambda Tr: np.vstack([R @ Tr[:3], Tr[3:]]))(drive)
            return
        change_rows(
            drive.parent / "calib_velo_to_cam.txt",
            lambda rows: {"R": R @ rows["R"].reshape(3, 3), "T": R @ rows["T"]},
        )  # fmt: skip

    return inject


def inverted_camera(drive: Path) -> None:
    """T_lidar_camera where T_camera_lidar is expected."""
    if (drive / "log.yaml").is_file():
        change_log(
            drive, lambda about: {"T_camera_lidar": np.linalg.inv(np.array(about["T_camera_lidar"])).tolist()}
        )
        return

    def invert(rows: dict[str, Array]) -> dict[str, Array]:
        R = rows["R"].reshape(3, 3)
        return {"R": R.T, "T": -R.T @ rows["T"]}

    change_rows(drive.parent / "calib_velo_to_cam.txt", invert)


def changed_K(change: Callable[[Array], Array]) -> Inject:
    """Other intrinsics, (3, 3), the shift between the cameras kept."""

    def inject(drive: Path) -> None:
        if (drive / "log.yaml").is_file():
            change_log(drive, lambda about: {"K": change(np.array(about["K"])).tolist()})
            return

        def rows(given: dict[str, Array], name: str) -> dict[str, Array]:
            P = given[name].reshape(3, 4)
            K = change(P[:, :3].copy())
            return {name: np.column_stack([K, K @ np.linalg.solve(P[:, :3], P[:, 3])])}

        odometry = (drive / "calib.txt").is_file()
        path = drive / "calib.txt" if odometry else drive.parent / "calib_cam_to_cam.txt"
        change_rows(path, functools.partial(rows, name="P2" if odometry else "P_rect_02"))

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
        change_rows(
            drive.parent / "calib_cam_to_cam.txt",
            lambda rows: {"S_rect_02": np.floor(factor * rows["S_rect_02"])},
        )

    return inject


def late_images(by_s: float) -> Inject:
    """Image stamps that are off."""

    def inject(drive: Path) -> None:
        file = "images/stamps.csv" if (drive / "images").is_dir() else "image_02/timestamps.txt"
        change_stamps(drive / file, by_s)

    return inject


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


def _mistakes() -> list[Mistake]:
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


MISTAKES = _mistakes()
OFF = ("shifted", "another drive", "other frames")
LABEL_MISTAKES = [
    Mistake("all-zero labels", "labels", zero_labels, ("zero", "one class", "no class")),
    Mistake("labels ten frames on", "labels", other_frames(10), ("other frames", "another drive")),
    Mistake("labels shifted by 20 pixels", "labels", shifted_labels(20), OFF),
    Mistake("labels shifted by -40 pixels", "labels", shifted_labels(-40), OFF),
]  # fmt: skip

"""KITTI's calibration files: rows `name: numbers`, and what they stand for; tables of numbers; and stamps."""

from __future__ import annotations

import re
from functools import cache
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.datasets.stamps import FIRST_YEAR, LAST_YEAR
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import expect_file, is_file, read_bytes, read_lines, refused, shown
from gnss_sem_map.sensor_log import Skip
from gnss_sem_map.sensor_log.cameras import is_rigid

Array = NDArray[np.float64]

MOST_BYTES = 1 << 20
LARGEST = 1e6
"""Largest length in m or px."""
LARGEST_SIDE_PX = 65_535
STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d(:\d\d(\.\d{1,18})?)?", re.ASCII)


class CalibrationFile:
    """The named rows of a file; raises DataError when one is missing, or is not what it is asked for as."""

    def __init__(self, path: Path, expected: dict[str, int]) -> None:
        if not is_file(path):
            raise refused(
                path,
                f"missing calibration file; expected rows {sorted(expected)}; *_calib.zip of the date has it",
            )
        read_bytes(path, MOST_BYTES)
        try:
            rows = _pykitti_utils().read_calib_file(str(path))
        except (ValueError, IndexError, OSError):
            raise refused(path, "not a calibration file; expected lines `name: numbers`") from None
        self._path, self.rows = path, dict[str, Array]()
        for name, count in expected.items():
            row = np.asarray(rows.get(name, ()), np.float64)
            if row.shape != (count,) or not (np.abs(row) <= LARGEST).all():
                far = row[~(np.abs(row) <= LARGEST)].tolist() if row.shape == (count,) else []
                found = f"{far[0]} among them" if far else f"{row.size} numbers" if row.size else "nothing"
                raise refused(path, f"row {name!r}: found {found}, expected {count} finite numbers")
            self.rows[name] = row

    def _where(self, name: str) -> str:
        return f"{shown(self._path)}: {name}"

    def pose(self, R: str, t: str = "") -> Array:
        """The transform (4, 4) of a rotation alone or with the shift of another row, or of a row of both."""
        row, shift = self.rows[R], self.rows[t] if t else np.zeros(3)
        whole = row if row.size == 12 else np.column_stack([row.reshape(3, 3), shift]).ravel()
        return transform(whole, self._where(R))

    def projection(self, name: str) -> tuple[Array, Array]:
        """Intrinsics K, and the shift (4, 4) from camera 0 to this camera, of a rectified P = K [I | t]."""
        P, T = self.rows[name].reshape(3, 4), np.eye(4)
        K, below = P[:, :3].copy(), np.array([P[1, 0], P[2, 0], P[2, 1]])
        if min(K[0, 0], K[1, 1]) < 1e-3 or np.abs(below).max() > 1e-6 or abs(K[2, 2] - 1) > 1e-6:
            raise DataError(
                f"{self._where(name)}: found {np.array2string(K, precision=4).replace(chr(10), '')}, expected that of"
                " a rectified camera: focal lengths above 0, and 0 0 1 in the last row"
            )
        T[:3, 3] = np.linalg.solve(K, P[:, 3])
        if not np.isfinite(T).all() or np.abs(T).max() > LARGEST:
            far = np.abs(T[:3, 3]).max()
            raise DataError(f"{self._where(name)}: its last column puts the camera {far:.3g} m away")
        return K, T

    def size(self, name: str) -> tuple[int, int]:
        """(width, height), px, of a row of two whole numbers that can be a picture's."""
        size = self.rows[name]
        if not ((size >= 1) & (size <= LARGEST_SIDE_PX) & (size == np.floor(size))).all():
            raise DataError(f"{self._where(name)}: found {size.tolist()}, expected width and height, px")
        return int(size[0]), int(size[1])


@cache
def _pykitti_utils() -> ModuleType:
    """`pykitti.utils` alone: `import pykitti` imports pandas, which takes 0.4 s and 40 MB of every process."""
    package = find_spec("pykitti")
    [folder] = (package and package.submodule_search_locations) or [""]
    spec = spec_from_file_location("pykitti.utils", Path(folder, "utils.py"))
    utils = module_from_spec(cast("ModuleSpec", spec))
    cast("Any", spec).loader.exec_module(utils)
    return utils


def transform(numbers: Array, where: str) -> Array:
    """A (4, 4) transform from twelve numbers, row by row; raises DataError for no rotation."""
    T = np.vstack([numbers.reshape(3, 4), (0.0, 0.0, 0.0, 1.0)])
    if not is_rigid(T):
        raise refused(
            where,
            f"{rotation_fault(T[:3, :3])}, expected a rotation to 1e-3; check the file",
        )
    return T


def quaternion_of(T: Array) -> Array:
    """The rotation of a transform, or the one that is nearest to it, as x y z w."""
    return np.asarray(Rotation.from_matrix(T[:3, :3]).as_quat())


def exact(T: Array) -> Array:
    """The transform with the rotation of its quaternion: files have seven or nine digits of its matrix."""
    found = T.copy()
    found[:3, :3] = Rotation.from_quat(quaternion_of(T)).as_matrix()
    return found


def rotation_fault(R: Array) -> str:
    """Why a matrix (3, 3) is not a rotation, in a few words."""
    with np.errstate(all="ignore"):
        determinant = float(np.linalg.det(R))
        scale = float(np.cbrt(determinant))
        if determinant < 0 and np.allclose(R @ R.T, np.eye(3), atol=1e-3):
            return "found a mirrored rotation (determinant -1)"
        if abs(determinant) > 1e-6 and np.allclose(R @ R.T, scale**2 * np.eye(3), atol=1e-3 * scale**2):
            return f"found a rotation scaled by {scale:.6g}"
        return f"found a matrix of determinant {determinant:.4g}"


def read_table(path: Path, columns: int) -> Array:
    """Rows (n, columns) of numbers, without comments; raises DataError, with the line, for anything else."""
    expected = f"one line of {columns} numbers per frame"
    expect_file(path, f"{expected}; of KITTI odometry, data_odometry_calib.zip has times.txt")
    rows = []
    for number, line in enumerate(read_lines(path), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != columns or not np.isfinite(row).all():
            raise refused(path, f"line {number}: found {line[:40]!r}, expected {columns} finite numbers")
        rows.append(row)
    if not rows:
        raise refused(path, f"empty; expected {expected}")
    return np.array(rows)


def stamps_ns(path: Path) -> tuple[dict[int, int], list[Skip]]:
    """Unix nanoseconds by frame number; blank lines are missing frames.

    Stamps of impossible years are skipped, and those in a leap second, which Unix time does not have.
    """
    expect_file(path, "stamps, one line `date time` per frame")
    stamps, skips = {}, []
    for number, line in enumerate(read_lines(path)):
        text = line.strip()
        if not text:
            continue
        if STAMP.fullmatch(text) is None:
            raise _no_stamp(path, number, text)
        is_leap_second = text[17:19] == "60"
        if is_leap_second or not FIRST_YEAR <= int(text[:4]) <= LAST_YEAR:
            why = "in a leap second" if is_leap_second else "no time of a drive"
            skips.append(Skip("stamp", f"{shown(path)}: line {number + 1}", f"found {text}, {why}"))
            continue
        try:
            stamps[number] = int(np.datetime64(text.replace(" ", "T"), "ns").astype(np.int64))
        except ValueError:
            raise _no_stamp(path, number, text) from None
    return stamps, skips


def _no_stamp(path: Path, number: int, text: str) -> DataError:
    return refused(path, f"line {number + 1}: found {text[:40]!r}, expected `yyyy-mm-dd hh:mm:ss.nnnnnnnnn`")

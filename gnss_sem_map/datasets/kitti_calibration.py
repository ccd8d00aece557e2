"""KITTI's calibration files: rows `name: numbers`."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import is_file, read_bytes, shown
from gnss_sem_map.sensor_log.cameras import is_rigid

Array = NDArray[np.float64]

MOST_BYTES = 1 << 20
LARGEST = 1e6
"""Largest length in m or px."""
LARGEST_SIDE_PX = 65_535


def read_rows(path: Path, expected: dict[str, int]) -> dict[str, Array]:
    """The named rows of a calibration file; raises DataError when one is missing or has another count of numbers."""
    if not is_file(path):
        raise DataError(
            f"{shown(path)}: missing calibration file; expected rows {sorted(expected)}."
            " It comes with the drive's date (KITTI raw: *_calib.zip) or the data set (KITTI-360: calibration.zip)"
        )
    read_bytes(path, MOST_BYTES)
    try:
        rows = _pykitti_utils().read_calib_file(str(path))
    except (ValueError, IndexError, OSError):
        raise DataError(f"{shown(path)}: not a calibration file; expected lines `name: numbers`") from None
    for name, count in expected.items():
        row = rows.get(name)
        if row is None or np.shape(row) != (count,) or not (np.abs(row) <= LARGEST).all():
            found = "nothing" if row is None else f"{np.size(row)} numbers"
            if np.shape(row) == (count,):
                found = f"{row[np.flatnonzero(~(np.abs(row) <= LARGEST))[0]]} among them"
            raise DataError(f"{shown(path)}: row {name!r}: found {found}, expected {count} finite numbers")
    return {name: np.asarray(rows[name], np.float64) for name in expected}


@cache
def _pykitti_utils() -> ModuleType:
    """`pykitti.utils` alone: `import pykitti` imports pandas, which takes 0.4 s and 40 MB of every process."""
    package = find_spec("pykitti")
    assert package is not None
    folders = package.submodule_search_locations
    assert folders is not None
    spec = spec_from_file_location("pykitti.utils", Path(folders[0], "utils.py"))
    assert spec is not None
    assert spec.loader is not None
    utils = module_from_spec(spec)
    spec.loader.exec_module(utils)
    return utils


def transform(R: Array, t: Array, where: str) -> Array:
    """A (4, 4) transform from nine numbers of rotation and three of translation; raises DataError for no rotation."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.reshape(3, 3), t
    if not is_rigid(T):
        raise DataError(
            f"{where}: {rotation_fault(T[:3, :3])}, expected a rotation to 1e-3 in a rigid transform; check the file"
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


def split_projection(P: Array, where: str) -> tuple[Array, Array]:
    """Intrinsics K, and the shift from camera 0 to this camera, of a rectified projection P = K [I | t].

    Raises DataError for a matrix that is no projection.
    """
    P = P.reshape(3, 4)
    K, T = P[:, :3].copy(), np.eye(4)
    below = np.array([K[1, 0], K[2, 0], K[2, 1]])
    if min(K[0, 0], K[1, 1]) < 1e-3 or np.abs(below).max() > 1e-6 or abs(K[2, 2] - 1) > 1e-6:
        raise DataError(
            f"{where}: found {np.array2string(K, precision=4).replace(chr(10), '')}, expected the camera matrix of a"
            " rectified camera: focal lengths above 0, and 0 0 1 in the last row"
        )
    T[:3, 3] = np.linalg.solve(K, P[:, 3])
    if not np.isfinite(T).all() or np.abs(T).max() > LARGEST:
        raise DataError(f"{where}: its last column puts the camera {np.abs(T[:3, 3]).max():.3g} m away")
    return K, T


def image_size(size: Array, where: str) -> tuple[int, int]:
    """(width, height), px, from a row of two numbers; raises DataError unless they are whole and can be a picture's."""
    if not ((size >= 1) & (size <= LARGEST_SIDE_PX) & (size == np.floor(size))).all():
        raise DataError(f"{where}: found {size.tolist()}, expected width and height of the images, px")
    return int(size[0]), int(size[1])

"""KITTI's calibration files: rows `name: numbers`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError

Array = NDArray[np.float64]


def read_rows(path: Path, expected: dict[str, int]) -> dict[str, Array]:
    """The named rows of a calibration file; raises DataError when one is missing or has another count of numbers."""
    from pykitti.utils import read_calib_file

    if not path.is_file():
        raise DataError(
            f"{path}: missing calibration file; expected rows {sorted(expected)}."
            " It comes with the drive's date (KITTI raw: *_calib.zip)"
        )
    try:
        rows = read_calib_file(str(path))
    except (ValueError, UnicodeDecodeError, IndexError):
        raise DataError(f"{path}: not a calibration file; expected lines `name: numbers`") from None
    for name, count in expected.items():
        row = rows.get(name)
        if row is None or np.shape(row) != (count,) or not np.isfinite(row).all():
            found = "nothing" if row is None else f"{np.size(row)} numbers"
            raise DataError(f"{path}: row {name!r}: found {found}, expected {count} finite numbers")
    return {name: np.asarray(rows[name], np.float64) for name in expected}


def transform(R: Array, t: Array) -> Array:
    """A (4, 4) transform from nine numbers of rotation and three of translation."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.reshape(3, 3), t
    return T


def split_projection(P: Array) -> tuple[Array, Array]:
    """Intrinsics K, and the shift from camera 0 to this camera, of a rectified projection P = K [I | t]."""
    P = P.reshape(3, 4)
    K, T = P[:, :3].copy(), np.eye(4)
    T[:3, 3] = np.linalg.solve(K, P[:, 3])
    return K, T

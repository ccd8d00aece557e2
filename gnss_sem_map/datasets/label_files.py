"""SemanticKITTI `.label` files: one little-endian uint32 per point, and folders of them keyed by scan name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.files.untrusted import inside, is_folder, read_bytes, refused

MOST_LABEL_BYTES = 1 << 28


def read_labels(path: Path) -> NDArray[np.uint32]:
    """The entries of one file; raises DataError when it is cut short."""
    return _values(path, "<u4")


def read_confidence(path: Path) -> NDArray[np.float16]:
    """The probabilities of one file; raises DataError when it is cut short, or holds other values."""
    found = _values(path, "<f2")
    if not ((found >= 0) & (found <= 1)).all():
        raise refused(path, "found values outside 0..1, expected probabilities")
    return found


def read_looks(path: Path) -> NDArray[np.uint8]:
    """The LiDAR points of the voxel of each point, 255 for more; raises DataError when it cannot be read."""
    return _values(path, "u1")


def _values(path: Path, dtype: str) -> NDArray[Any]:
    content, size = read_bytes(path, MOST_LABEL_BYTES), np.dtype(dtype).itemsize
    if len(content) % size:
        raise refused(path, f"truncated labels; found {len(content)} bytes, expected a multiple of {size}")
    return np.frombuffer(content, dtype)


def label_files(folder: Path) -> dict[str, Path]:
    """The label files of a folder by scan name, or, in folders of several LiDARs, by LIDAR/NAME.

    Raises DataError when there are none.
    """
    found = inside(folder) if is_folder(folder) else []
    deeper = [path for lidar in found if lidar.is_dir() for path in inside(lidar)]
    files = {
        path.relative_to(folder).with_suffix("").as_posix(): path
        for path in (*found, *deeper)
        if path.suffix == ".label"
    }
    if not files:
        raise refused(folder, "no .label files; expected one per scan")
    return files


def truth_folder(truth: Path) -> Path:
    """Folder with the labels of the truth: the folder itself, or `labels` in it."""
    return truth / "labels" if is_folder(truth / "labels") else truth

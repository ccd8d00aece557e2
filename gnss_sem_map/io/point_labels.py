"""SemanticKITTI `.label` files: one little-endian uint32 per point, and folders of them keyed by scan name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError


def read_labels(path: Path) -> NDArray[np.uint32]:
    """The entries of one file; raises DataError when it is cut short."""
    try:
        size = path.stat().st_size
        if size % 4:
            raise DataError(f"{path}: truncated label file; found {size} bytes, expected a multiple of 4")
        return np.fromfile(path, "<u4")
    except OSError as error:
        raise DataError(f"{path}: cannot read the labels ({error.strerror})") from None


def label_files(folder: Path) -> dict[str, Path]:
    """The label files of a folder by scan name; raises DataError when there are none."""
    files = {path.stem: path for path in sorted(folder.glob("*.label"))}
    if not files:
        raise DataError(f"{folder}: no .label files; expected one per scan")
    return files


def truth_folder(truth: Path) -> Path:
    """Where the truth's labels are: the folder itself, or `labels` in it."""
    return truth / "labels" if (truth / "labels").is_dir() else truth

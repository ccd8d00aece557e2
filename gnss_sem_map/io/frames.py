"""Files numbered by frame: the number in the name is the key, the position in the folder means nothing."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError, ImageSizeError
from gnss_sem_map.sensor_log import Skip


def numbered(folder: Path, suffix: str) -> dict[int, Path]:
    """The files of a folder by the frame number in their name, in order; empty when there is no such folder."""
    if not folder.is_dir():
        return {}
    found: dict[int, Path] = {}
    for path in sorted(folder.glob(f"*{suffix}")):
        if path.stem.isdecimal():
            found.setdefault(int(path.stem), path)  # `repeated` names the others
    return dict(sorted(found.items()))


def repeated(folder: Path, suffix: str, what: str, kept: dict[int, Path]) -> list[Skip]:
    """Files whose frame has another file already: `5.bin` beside `0000000005.bin`."""
    return [
        Skip(what, str(path), f"frame {int(path.stem)} has another file, {kept[int(path.stem)].name}")
        for path in sorted(folder.glob(f"*{suffix}"))
        if path.stem.isdecimal() and kept.get(int(path.stem), path) != path
    ]


def missing(what: str, folder: Path, known: Iterable[int], files: dict[int, Path]) -> list[Skip]:
    """One skip for every run of known frames without a file."""
    absent = sorted(set(known) - set(files))
    breaks = [i for i in range(1, len(absent)) if absent[i] != absent[i - 1] + 1]
    runs = [absent[a:b] for a, b in zip([0, *breaks], [*breaks, len(absent)], strict=True) if a < b]
    return [
        Skip(what, f"{folder}: frames {run[0]} to {run[-1]}", f"{len(run)} files missing", len(run))
        for run in runs
    ]


FARTHEST_M, NEAREST_M = 1000.0, 1e-6
"""No LiDAR on a road sees farther; and a coordinate nearer to zero, but not zero, is no measurement."""
NO_POINTS, EVERY = 0.1, 8
"""With so many of its points out of these bounds a file is no scan: of random bytes nine in ten coordinates are. Every
eighth point tells it at no cost."""


def read_points(path: Path, columns: int = 4) -> NDArray[np.float32]:
    """Rows of little-endian float32 (n, columns); raises DataError for a file that is cut short, empty, or no scan."""
    try:
        with path.open("rb", buffering=0) as file:
            size = os.fstat(file.fileno()).st_size
            rows = np.empty((size // (4 * columns), columns), "<f4")
            if size == 0 or size != rows.nbytes or file.readinto(rows.data) != size:
                raise DataError(
                    f"{path}: truncated scan; found {size} bytes, expected a multiple of {4 * columns} and more than 0"
                )
        _refuse_other_bytes(rows, path)
        return rows
    except OSError as error:
        raise DataError(f"{path}: cannot read the scan ({error.strerror})") from None


def _refuse_other_bytes(rows: NDArray[np.float32], path: Path) -> None:
    """Points that were not measured, zero or not finite, are no reason to refuse a scan."""
    sizes = np.abs(rows[::EVERY, :3])
    out = ((sizes > FARTHEST_M) & np.isfinite(sizes)) | ((sizes < NEAREST_M) & (sizes > 0))
    share = float(out.any(axis=1).mean())
    if share > NO_POINTS:
        raise DataError(
            f"{path}: no scan; {share:.0%} of its points lie beyond {FARTHEST_M:g} m or within {NEAREST_M:g} m of zero,"
            " expected metres; are these other bytes, another count of columns, or mm?"
        )


def read_image(path: Path, size: tuple[int, int] | None) -> NDArray[np.uint8]:
    """RGB pixels (h, w, 3); raises DataError for a damaged file or another (width, height) than the calibration's."""
    import cv2

    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise DataError(f"{path}: cannot read the image ({error.strerror})") from None
    pixels = cv2.imdecode(content, cv2.IMREAD_COLOR) if content.size else None
    if pixels is None:
        raise DataError(f"{path}: damaged image; expected PNG or JPEG")
    if size is not None and (pixels.shape[1], pixels.shape[0]) != size:
        raise ImageSizeError(
            f"{path}: found {pixels.shape[1]} x {pixels.shape[0]} pixels, expected {size[0]} x {size[1]} as in the"
            " calibration; is this the right camera, and the rectified image?",
            (pixels.shape[1], pixels.shape[0]),
        )
    return np.ascontiguousarray(pixels[:, :, ::-1])

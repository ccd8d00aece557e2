"""Files numbered by frame: the key is the number in the name, never the position in the folder."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.pictures import read_picture
from gnss_sem_map.files.untrusted import inside, is_folder, open_file, reason, refused, shown, status
from gnss_sem_map.sensor_log import Skip

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""If a frame has two images, the first of these endings is read."""
SCAN_SUFFIXES = (".bin", ".txt")
"""Numbers of 32 bits, or text."""
MOST_POINTS = 10_000_000
FARTHEST_M, NEAREST_M = 1000.0, 1e-6
"""Range limit of LiDARs on roads; and coordinates nearer to zero, but not zero, are no measurements."""
NO_POINTS, EVERY = 0.1, 8
"""A file with a larger share of points out of these bounds is no scan: of random bytes, nine in ten coordinates are
out of bounds. Every eighth point is tested."""
LARGEST_NUMBER = 2**63 - 1
OF_KITTI = ("data", "data_rgb", "data_rect")
"""Folders of files within that of a sensor, by which it is named."""

T = TypeVar("T")
State = tuple[int, int]
"""Size in bytes and time of the last change, ns, of a file."""


@dataclass(frozen=True)
class Frames:
    """The files of a folder by frame number, in order, and the skipped ones."""

    what: str
    folder: Path
    files: dict[int, Path]
    skips: list[Skip]

    def joined(
        self, stamps: Mapping[int, T], why: str = "no stamp for this frame"
    ) -> tuple[list[tuple[int, Path, T]], list[Skip]]:
        """Number, file and stamp of the frames that have both; a skip for each other file, and run of other stamps."""
        skips = [*self.skips, *self.missing(stamps)]
        skips += [Skip(self.what, shown(path), why) for n, path in self.files.items() if n not in stamps]
        return [(n, path, stamps[n]) for n, path in self.files.items() if n in stamps], skips

    def missing(self, known: Iterable[int]) -> list[Skip]:
        """One skip for every run of known frames without a file."""
        folder = self.folder.parent if self.folder.name in OF_KITTI else self.folder
        absent = sorted(set(known) - set(self.files))
        breaks = [i for i in range(1, len(absent)) if absent[i] != absent[i - 1] + 1]
        runs = [absent[a:b] for a, b in zip([0, *breaks], [*breaks, len(absent)], strict=True) if a < b]
        return [
            Skip(self.what, f"{shown(folder)}: frames {a[0]} to {a[-1]}", f"{len(a)} files missing", len(a))
            for a in runs
        ]


def numbered(what: str, folder: Path, *suffixes: str) -> Frames:
    """The files whose name is a number, of any of these endings; none when there is no such folder.

    Of several files of one frame, the first by ending, then by name, is used. Raises DataError for a
    folder that cannot be listed.
    """
    if not is_folder(folder):
        return Frames(what, folder, {}, [])
    of_kind = [path for path in inside(folder) if path.suffix.lower() in suffixes and path.stem.isdecimal()]
    files: dict[int, Path] = {}
    skips = []
    for path in sorted(of_kind, key=lambda path: suffixes.index(path.suffix.lower())):
        number = int(path.stem)
        if number > LARGEST_NUMBER:
            skips.append(Skip(what, shown(path), f"frame number above {LARGEST_NUMBER}"))
        elif number in files:
            skips.append(Skip(what, shown(path), f"frame {number} has another file, {files[number].name}"))
        else:
            files[number] = path
    return Frames(what, folder, dict(sorted(files.items())), skips)


def state_of(path: Path) -> State | None:
    """State of a file, to be compared when it is read; None if it cannot be read."""
    try:
        found = status(path)
    except DataError:
        return None  # reported when it is read
    return None if found is None else (found.st_size, found.st_mtime_ns)


def read_points(path: Path, columns: int = 4, state: State | None = None) -> NDArray[np.float32]:
    """Rows of little-endian float32, or of text (n, columns).

    Raises DataError for a file that is cut short, empty, too large, or changed since its `state` was taken.
    """
    with os.fdopen(open_file(path), "rb", buffering=0) as file:
        found = os.fstat(file.fileno())
        size = found.st_size
        if state is not None and state != (size, found.st_mtime_ns):
            raise refused(path, f"changed while the drive was read; found {size} bytes, once {state[0]}")
        if size > 4 * columns * MOST_POINTS:
            raise refused(path, f"found {size} bytes, more than {MOST_POINTS} points; is it a scan?")
        try:
            if path.suffix.lower() == ".txt":
                return _rows_of_text(file.readall(), columns, path)
            rows = np.empty((size // (4 * columns), columns), "<f4")
            if size == 0 or size != rows.nbytes or file.readinto(rows.data) != size:
                raise refused(
                    path,
                    f"truncated scan; found {size} bytes, expected {columns} columns of 4 bytes",
                )
        except OSError as error:
            raise refused(path, f"cannot read it ({reason(error)})") from None
    refuse_other_bytes(rows, shown(path))
    return rows


def _rows_of_text(content: bytes, columns: int, path: Path) -> NDArray[np.float32]:
    try:
        lines = [line for line in content.decode("ascii").split("\n") if line.strip()]
        rows = (
            np.loadtxt(lines, np.float32, comments=None, ndmin=2) if lines else np.empty((0, 0), np.float32)
        )
    except ValueError as error:
        raise refused(path, f"no rows of {columns} numbers ({' '.join(str(error).split())[:100]})") from None
    if rows.shape[1] != columns:
        raise refused(path, f"found {rows.shape[1]} numbers per line, expected {columns}; is it truncated?")
    refuse_other_bytes(rows, shown(path))
    return rows


def first_size(files: Iterable[Path]) -> tuple[int, int] | None:
    """(width, height) of the first image that can be read."""
    for path in files:
        try:
            height, width = read_picture(path).shape[:2]
        except DataError:
            continue
        return width, height
    return None


def refuse_other_bytes(rows: NDArray[np.float32], where: str) -> None:
    """Check the coordinates of a scan; points that were not measured (zero or not finite) are accepted."""
    sizes = np.abs(np.ascontiguousarray(rows[::EVERY, :3].T))  # axis by axis: a third of the time
    out = ((sizes > FARTHEST_M) & np.isfinite(sizes)) | ((sizes < NEAREST_M) & (sizes > 0))
    share = float(out.any(axis=0).mean())
    if share > NO_POINTS:
        raise refused(
            where,
            f"no scan; {share:.0%} of its points lie beyond {FARTHEST_M:g} m, or in zero; other columns, or mm?",
        )


def scale_intensity(rows: NDArray[np.float32], intensity_max: float) -> None:
    """Divide the fourth column of points (n, 4 or more) by the number that stands for an intensity of 1; NaN is 0."""
    if intensity_max != 1:
        with np.errstate(over="ignore", invalid="ignore"):  # of damaged points
            rows[:, 3] = rows[:, 3] / np.float64(intensity_max)
    np.copyto(rows[:, 3], 0.0, where=np.isnan(rows[:, 3]))

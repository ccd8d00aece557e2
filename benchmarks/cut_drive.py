"""Cut a long drive in KITTI raw format into shorter ones, each complete: its frames count from zero again.

    python benchmarks/cut_drive.py DRIVE PROBABILITIES OUT --seconds 30

writes OUT/<date>/<drive>_<k>_sync with its _extract twin, and OUT/probabilities/<drive>_<k>_sync. Files are hard links
where that is possible, so a cut takes no room.
"""

from __future__ import annotations

import argparse
import os
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FRAMES_PER_S = 10
FOLDERS = (
    ("velodyne_points", ("timestamps.txt", "timestamps_start.txt", "timestamps_end.txt"), (".bin",)),
    ("image_02", ("timestamps.txt",), (".png", ".jpg")),
    ("oxts", ("timestamps.txt",), (".txt",)),
)
AROUND_S = 0.6
"""IMU and GNSS begin before the first scan and end after the last."""


def cut(drive: Path, probabilities: Path, out: Path, first: int, last: int, number: int) -> Path:
    """Write the frames first to last - 1 as a drive of its own; returns its folder."""
    name = drive.name.removesuffix("_sync")
    new = out / drive.parent.name / f"{name}_{number:02d}_sync"
    new.mkdir(parents=True)
    for path in drive.parent.glob("calib*.txt"):
        if not (new.parent / path.name).exists():
            shutil.copyfile(path, new.parent / path.name)
    for folder, stamps, suffixes in FOLDERS:
        (new / folder / "data").mkdir(parents=True)
        for file in stamps:
            lines = (drive / folder / file).read_text().splitlines(keepends=True)
            (new / folder / file).write_text("".join(lines[first:last]))
        for frame in range(first, last):
            for suffix in suffixes:
                link(drive / folder / "data" / f"{frame:010d}{suffix}", new / folder / "data", frame - first)
    for frame in range(first, last):
        link(probabilities / f"{frame:010d}.npz", out / "probabilities" / new.name, frame - first)
    shutil.copyfile(drive / "oxts" / "dataformat.txt", new / "oxts" / "dataformat.txt")
    _cut_extract(drive, new)
    return new


def link(source: Path, folder: Path, frame: int) -> None:
    """A second name for a file of a frame, if there is one."""
    if not source.exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{frame:010d}{source.suffix}"
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def _cut_extract(drive: Path, new: Path) -> None:
    """The rows of the navigation unit at its full rate, from a little before the drive to a little after."""
    source = Path(str(drive).removesuffix("_sync") + "_extract") / "oxts"
    target = Path(str(new).removesuffix("_sync") + "_extract") / "oxts"
    (target / "data").mkdir(parents=True)
    shutil.copyfile(source / "dataformat.txt", target / "dataformat.txt")
    lines = (source / "timestamps.txt").read_text().splitlines(keepends=True)
    stamps = _read(lines)
    scans = _read((new / "velodyne_points" / "timestamps.txt").read_text().splitlines())
    around = np.timedelta64(round(AROUND_S * 1e9), "ns")
    first, last = np.searchsorted(stamps, [scans[0] - around, scans[-1] + around])
    (target / "timestamps.txt").write_text("".join(lines[first:last]))
    for row in range(first, last):
        link(source / "data" / f"{row:010d}.txt", target / "data", row - first)


def _read(lines: list[str]) -> NDArray[np.datetime64]:
    return np.array([line.strip().replace(" ", "T") for line in lines], "datetime64[ns]")


def cut_all(drive: Path, probabilities: Path, out: Path, seconds: float) -> list[Path]:
    """The drive in parts of so many seconds; what is left at its end is left out."""
    each = round(seconds * FRAMES_PER_S)
    frames = len(list((drive / "velodyne_points" / "data").glob("*.bin")))
    starts = range(0, frames - each + 1, each)
    return [
        cut(drive, probabilities, out, start, start + each, number) for number, start in enumerate(starts)
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("probabilities", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seconds", type=float, default=30.0)
    given = parser.parse_args()
    for made in cut_all(given.drive, given.probabilities, given.out, given.seconds):
        print(made)

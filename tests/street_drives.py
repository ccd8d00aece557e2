"""The small street driven in parts: drives of one place, each with an epoch and an origin of its own."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import street

from factor_graphs.simulation import Motion

SCANS = 6
"""Of each drive."""
ROWS = SCANS + 3
"""Of IMU and GNSS; the last come after the last scan."""


@dataclass(frozen=True)
class Drives:
    """Drives one after another along the street; they see the same walls."""

    by_name: dict[str, Path]
    labels: str
    """The segmenter of all."""
    motion: Motion
    starts_s: dict[str, float]
    """Stamp zero of each drive, s of the motion."""


def write(folder: Path, names: tuple[str, ...] = ("a", "b", "c")) -> Drives:
    """Write drives of these names, and their class probabilities."""
    whole = street.write(folder / "whole", tuple(range(SCANS * len(names))), beams=16, azimuths=400)
    date = folder / whole.drive.parent.name
    date.mkdir()
    for calibration in whole.drive.parent.glob("calib*.txt"):
        shutil.copyfile(calibration, date / calibration.name)
    firsts = {name: number * SCANS for number, name in enumerate(names)}
    for name, first in firsts.items():
        _write_part(whole, date / name, folder / "labels" / name, first)
    return Drives(
        {name: date / name for name in names},
        f"labels:{folder}/labels/{{drive}}",
        whole.motion,
        {name: first * street.SWEEP_S - 0.02 for name, first in firsts.items()},
    )


def _write_part(whole: street.Street, drive: Path, labels: Path, first: int) -> None:
    """The scans from `first` on as a drive of its own, whose frames count from zero."""
    for folder, stamps, count in (
        ("velodyne_points", ("timestamps", "timestamps_start", "timestamps_end"), SCANS),
        ("image_02", ("timestamps",), SCANS),
        ("oxts", ("timestamps",), ROWS),
    ):
        files = sorted((whole.drive / folder / "data").iterdir())[first : first + count]
        _copy(files, drive / folder / "data")
        for name in stamps:
            lines = (whole.drive / folder / f"{name}.txt").read_text().splitlines(keepends=True)
            (drive / folder / f"{name}.txt").write_text("".join(lines[first : first + count]))
    _copy(sorted(whole.labels.iterdir())[first : first + SCANS], labels)


def _copy(files: list[Path], folder: Path) -> None:
    folder.mkdir(parents=True)
    for number, file in enumerate(files):
        shutil.copyfile(file, folder / f"{number:010d}{file.suffix}")

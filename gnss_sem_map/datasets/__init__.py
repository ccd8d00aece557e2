"""Readers of drives: each reads one folder layout into a `SensorLog`.

A reader is a module of this folder with `FORMAT` (its name), `SIGNS` (the content of such a drive, in words),
`is_drive(path)` and `read(path, with_imu)`. Where a drive may be one file, `FILES` are the endings of its name; where
the IMU can be read without a receiver, `read_imu(path)` does.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from factor_graphs.measurements import ImuSamples
from gnss_sem_map.datasets.given_trajectory import along
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import inside, is_file, is_folder, refused, shown
from gnss_sem_map.sensor_log import SensorLog, Skip
from gnss_sem_map.sensor_log.conventions import SensorConventions

ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".zst", ".7z", ".rar")
MOST_SEARCHED, MOST_OFFERED = 300, 8
"""Drives are looked for among so many files and folders of each folder; and so many are named."""


@cache
def readers() -> dict[str, Any]:
    """All readers by the name of their format."""
    modules = [import_module(f"{__name__}.{found.name}") for found in iter_modules(__path__)]
    return {module.FORMAT: module for module in modules if hasattr(module, "FORMAT")}


def detect_format(drive: Path) -> str:
    """Name of the format of a drive, by its files; raises DataError for what is no drive."""
    endings = {ending: name for name, reader in readers().items() for ending in getattr(reader, "FILES", ())}
    if not drive.is_dir() and is_file(drive):
        if drive.suffix.lower() in endings:
            return endings[drive.suffix.lower()]
        more = "; unpack it" if drive.suffix.lower() in ARCHIVES else ""
        raise refused(
            drive,
            f"found a file, expected a folder, or one ending in {', '.join(endings)}{more}",
        )
    if not is_folder(drive):
        raise refused(drive, "no such folder; expected a drive")
    fitting = [name for name, reader in readers().items() if reader.is_drive(drive)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise refused(drive, f"looks like {' and '.join(fitting)}; choose one with --format")
    if offered := drives_in(drive):
        more = f" and {len(offered) - MOST_OFFERED} more" if len(offered) > MOST_OFFERED else ""
        raise refused(
            drive,
            f"a folder of drives; give one of them, or several:"
            f" {', '.join(shown(path) for path in offered[:MOST_OFFERED])}{more}",
        )
    found = [shown(path.name) for path in inside(drive)][:8]
    signs = ", or ".join(f"{reader.SIGNS}" for reader in readers().values())
    packed = archives_in(drive)
    way = (
        f"; unpack {', '.join(packed)}" if packed else "; other data: write a CSV log (docs/your_own_log.md)"
    )
    raise refused(drive, f"no drive of a known format; found {found}, expected {signs}{way}")


def archives_in(folder: Path) -> list[str]:
    """Names of the archives in a folder, which nothing is read from."""
    return [shown(path.name) for path in inside(folder) if path.suffix.lower() in ARCHIVES][:MOST_OFFERED]


def drives_in(folder: Path, depth: int = 3) -> list[Path]:
    """The drives in a folder, as far down as a data set has them; folders that cannot be read have none."""
    found: list[Path] = []
    with suppress(DataError):
        for path in inside(folder)[:MOST_SEARCHED]:
            if path.is_symlink() or not path.is_dir():
                continue
            if any(reader.is_drive(path) for reader in readers().values()):
                found.append(path)
            elif depth > 1:
                found += drives_in(path, depth - 1)
    return found


def open_drive(
    drive: Path | str,
    drive_format: str | None = None,
    with_imu: bool = True,
    trajectory: Path | str | None = None,
) -> SensorLog:
    """Open a drive of any known format; scans and images are read later, when they are needed.

    `with_imu`: False for those who have a trajectory. A reader may then leave out what takes long to read.
    `trajectory`: a file of poses in place of the drive's own, see `given_trajectory`.
    """
    log: SensorLog = _reader(Path(drive), drive_format).read(Path(drive), with_imu)
    if not log.scans and Path(drive).is_dir() and (packed := archives_in(Path(drive))):
        lost = Skip("scan", shown(drive), f"no scans, but archives: unpack {', '.join(packed)}", len(packed))
        log = replace(log, skips=(*log.skips, lost))
    if trajectory is not None:
        return along(log, Path(trajectory), with_imu)
    log.check_located()
    return log


def read_imu(drive: Path, drive_format: str | None = None) -> tuple[ImuSamples, SensorConventions]:
    """The samples of an IMU and their conventions: of a log that may have no other sensor, where its format allows.

    Raises DataError as `open_drive` does, and for a drive without an IMU.
    """
    reader = _reader(drive, drive_format)
    if hasattr(reader, "read_imu"):
        found: tuple[ImuSamples, SensorConventions] = reader.read_imu(drive)
        return found
    log: SensorLog = reader.read(drive, True)
    if log.imu is None:
        raise refused(drive, "has no IMU, only poses; expected a log with the samples of an IMU")
    return log.imu, log.conventions or SensorConventions()


def _reader(drive: Path, drive_format: str | None) -> Any:
    if drive_format is not None and drive_format not in readers():
        raise refused(drive, f"found format {drive_format!r}, expected one of {sorted(readers())}")
    return readers()[drive_format or detect_format(drive)]

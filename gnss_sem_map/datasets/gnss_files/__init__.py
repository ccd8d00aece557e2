"""Positions of a receiver in a file of its own: RTKLIB .pos, NMEA, SBET, GPX, NovAtel, or a table with named columns.

What it is, is told by its content. `GnssFile` says what the file does not: its clock, the height of the geoid, and how
good its positions are. Positions become rows like those of gnss.csv, and errors of the clock are found where they leave
no fix within the drive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from gnss_sem_map.datasets.gnss_files import named_columns, nmea, other_formats, rtklib, sbet
from gnss_sem_map.datasets.gnss_files.positions import Positions, rows_of
from gnss_sem_map.datasets.gnss_files.time_systems import LEAP_S, gps_minus_utc_s
from gnss_sem_map.files.geoid import undulation
from gnss_sem_map.files.untrusted import is_file, read_bytes, read_lines, refused, shown
from gnss_sem_map.sensor_log import Skip

Array = NDArray[np.float64]

OF_NMEA, OF_SBET = (".nmea", ".nma", ".ubx"), (".sbet", ".out")
"""Endings that say what a file is, whatever is in it."""
LONGEST_OFFSET_S = 14 * 3600


class GnssFile(BaseModel):
    """A file of positions, and what it does not say."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    path: str = Field(
        description="Beside the file that names it: RTKLIB, NMEA, a table with named columns, or .sbet or .out (SBET)."
    )
    time: Literal["utc", "gps"] | None = Field(
        None, description="Time system of its stamps; default: as the file says; NMEA utc, SBET gps."
    )
    utc_offset_s: float = Field(
        0.0, ge=-LONGEST_OFFSET_S, le=LONGEST_OFFSET_S,
        description="Its clock is ahead by so much: 7200 where it shows the summer time of Berlin.",
    )  # fmt: skip
    accuracy: str | None = Field(None, description="SBET: the file of its errors (smrmsg).")
    stddevs_m: tuple[float, float, float] | None = Field(
        None, description="East, north, up, m; default: by the file's deviations and quality flags."
    )
    geoid: float | str | None = Field(
        None,
        description="Height of the geoid above the ellipsoid, m, or its grid (.tif, .gtx), for heights above it.",
    )


@dataclass(frozen=True, eq=False)
class FileFixes:
    """Rows of a file of positions on the clock of a log."""

    rows: Array
    """(n, 18) as `receiver_rows.ROW_COLUMNS`: stamp s, latitude and longitude °, height m, their deviations m, ..."""
    stamps_ns: NDArray[np.int64]
    """(n,) Unix time, ns."""
    skips: list[Skip]


def read_gnss_file(
    about: GnssFile, folder: Path, epoch_ns: int | None, drive_ns: tuple[int, int] | None
) -> FileFixes:
    """The positions of a file, with stamps from `epoch_ns` on, or from the first one on.

    `drive_ns`: first and last moment of the drive, Unix ns, where another sensor tells; it also tells the week of an
    SBET and the day of an NMEA without dates. Raises DataError for a file that is none of these, or not of the drive.
    """
    path = _inside(folder, about.path)
    accuracy = None if about.accuracy is None else _inside(folder, about.accuracy)
    ahead_ns = round(about.utc_offset_s * 1e9)
    # the middle of the drive by the clock of the file
    near_ns = None if drive_ns is None else sum(drive_ns) // 2 + ahead_ns
    found = _above_ellipsoid(
        path, _read(path, near_ns, accuracy, about.stddevs_m is not None), about.geoid, folder
    )
    stamps_ns = _on_unix_clock(found, about)
    if drive_ns is not None:
        _check_overlap(path, stamps_ns, drive_ns)
    zero = int(stamps_ns[0]) if epoch_ns is None else epoch_ns
    return FileFixes(rows_of(found, zero, stamps_ns, about.stddevs_m), stamps_ns, found.skips)


def _read(path: Path, near_ns: int | None, accuracy: Path | None, has_stddevs: bool) -> Positions:
    """The positions of a file by the reader of its content."""
    ending = path.suffix.lower()
    content = read_bytes(path)
    if ending in OF_SBET or sbet.is_sbet(content):
        return sbet.read(path, near_ns, accuracy, has_stddevs)
    lines = read_lines(path)
    if rtklib.is_solution(lines):
        return rtklib.read(path, lines)
    if nmea.is_nmea(lines) or (ending in OF_NMEA and content.startswith(b"$")):
        return nmea.read(path, lines, near_ns)
    if why := other_formats.no_positions(content):
        raise refused(path, f"{why}")
    if ending in OF_NMEA:
        return nmea.read(path, lines, near_ns)
    return named_columns.read(path, other_formats.as_table(content), near_ns, has_stddevs)


def _above_ellipsoid(path: Path, found: Positions, geoid: float | str | None, folder: Path) -> Positions:
    """With heights above the ellipsoid; raises DataError where all are above a geoid whose height nothing tells."""
    above = found.above_geoid
    if above is None or not above.any():
        return found
    if geoid is None and above.all():
        raise refused(
            path,
            "heights are above the geoid; set `geoid:` to its height, m, or to its grid (.tif, .gtx)",
        )
    if geoid is None:
        why = f"{int(above.sum())} fixes: height above a geoid of unknown height; `geoid:` tells it"
        found.skips.append(Skip("fix", shown(path), why, int(above.sum())))
        return replace(
            found, stamps_ns=found.stamps_ns[~above], geodetic=found.geodetic[~above], stddevs=found.stddevs[~above],
            more={name: values[~above] for name, values in found.more.items()},
        )  # fmt: skip
    lat, lon, height = found.geodetic.T
    if isinstance(geoid, str):
        *_, raised = undulation(_inside(folder, geoid), "geoid").transform(
            lon, lat, height, direction="INVERSE"
        )
        if not np.isfinite(raised[above]).all():
            raise refused(path, f"the grid {geoid[:100]} does not cover its positions")
    else:
        raised = height + geoid
    return replace(found, geodetic=np.column_stack([lat, lon, np.where(above, raised, height)]))


def _inside(folder: Path, name: str) -> Path:
    """A file in a folder; raises DataError for one that is elsewhere or missing."""
    path = folder / name
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise refused(folder, f"found the GNSS file {name[:100]!r}, expected a path within this folder")
    if not is_file(path):
        raise refused(path, "no such file; expected positions of the receiver")
    return path


def _on_unix_clock(found: Positions, about: GnssFile) -> NDArray[np.int64]:
    stamps = found.stamps_ns - round(about.utc_offset_s * 1e9)
    if (about.time or found.time) == "gps":
        return np.asarray(stamps - gps_minus_utc_s(stamps) * 1_000_000_000)
    return stamps


def _check_overlap(path: Path, stamps_ns: NDArray[np.int64], drive_ns: tuple[int, int]) -> None:
    """Raise DataError when no fix lies within the drive, with the offset of a clock that would explain it."""
    first, last = int(stamps_ns.min()), int(stamps_ns.max())
    if first <= drive_ns[1] and last >= drive_ns[0]:
        return
    late_s = ((first + last) - (drive_ns[0] + drive_ns[1])) / 2e9
    hours = round(late_s / 1800) * 1800
    near = min((hours, hours - LEAP_S, hours + LEAP_S), key=lambda s: abs(late_s - s))
    slack_s = (last - first + drive_ns[1] - drive_ns[0]) / 2e9
    fits = hours and abs(hours) <= LONGEST_OFFSET_S and abs(late_s - near) <= slack_s
    raise refused(
        path,
        f"no fix lies within the drive: the fixes are {late_s:.0f} s after it (middle to middle);"
        + (f" is it local time? set utc_offset_s: {hours}" if fits else " is it the file of this drive?"),
    )

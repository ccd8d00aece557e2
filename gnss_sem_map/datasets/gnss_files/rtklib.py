"""RTKLIB's solution files (.pos): latitude, longitude, height in degrees and metres.

Format: RTKLIB manual, appendix B.1. The standard deviations of the solution are too small where its quality is not a
fixed ambiguity: no row counts as better than its quality flag.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from gnss_sem_map.datasets.gnss_files.positions import Positions
from gnss_sem_map.datasets.gnss_files.time_systems import DAY_NS, GPS_EPOCH_NS, WEEK_NS
from gnss_sem_map.datasets.stamps import FIRST_YEAR, LAST_YEAR
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import read_lines, shown
from gnss_sem_map.sensor_log import Skip

BEST_M = {1: (0.01, 0.02), 2: (0.3, 0.5), 3: (1.0, 2.0), 4: (0.6, 1.0), 5: (2.0, 4.0), 6: (0.1, 0.2)}
"""Horizontal and vertical standard deviations, m, that no row of a quality is better than: fix, float, SBAS, DGPS,
single, PPP."""
FIRST_NS, END_NS = (
    int(np.datetime64(f"{year}-01-01", "ns").astype(np.int64)) for year in (FIRST_YEAR, LAST_YEAR + 1)
)
COLUMNS = "date time latitude longitude height Q ns sdn sde sdu"


def read(path: Path, near_ns: int | None, accuracy: Path | None, has_stddevs: bool) -> Positions:
    """The solutions of a file; rows of unknown quality, form or year are skipped.

    Raises DataError where there is none.
    """
    del near_ns, accuracy, has_stddevs  # it has its own date and deviations
    lines = read_lines(path)
    time = _checked_header(path, [line for line in lines if line.startswith("%")])
    rows = [_row(line) for line in lines if line.strip() and not line.startswith("%")]
    found = [row for row in rows if row is not None]
    if not found:
        raise DataError(f"{shown(path)}: found no solution among {len(rows)} lines, expected {COLUMNS}")
    lost = len(rows) - len(found)
    reason = f"{lost} lines: no solution of a known quality, or no time of a drive"
    skips = [Skip("fix", shown(path), reason, lost)] if lost else []
    table = np.array([row[1:] for row in found])
    return Positions(np.array([row[0] for row in found], np.int64), table[:, :3], table[:, 3:], time, skips)


def _checked_header(path: Path, header: list[str]) -> Literal["utc", "gps"]:
    """The time system; raises DataError for positions in another form than degrees above the ellipsoid."""
    said = "\n".join(header)
    columns = next(
        (line for line in header if "latitude" in line or "ecef" in line or "baseline" in line), ""
    )
    if "latitude(deg)" not in columns or "(d'" in columns:
        found = " ".join(columns.lstrip("% ").split())[:100] or "no header"
        raise DataError(
            f"{shown(path)}: found {found}, expected latitude(deg) longitude(deg) height(m); solve with"
            " out-solformat=llh and out-degform=deg"
        )
    if "WGS84/geodetic" in said:
        raise DataError(
            f"{shown(path)}: heights are above the geoid, expected above the ellipsoid; solve with"
            " out-height=ellipsoidal"
        )
    if "JST" in columns:
        raise DataError(
            f"{shown(path)}: stamps are in JST, expected GPST or UTC; solve with out-timesys=gpst"
        )
    return "utc" if "UTC" in columns else "gps"


def _row(line: str) -> tuple[int, float, float, float, float, float, float] | None:
    """Stamp, ns; latitude, longitude, height; deviations east, north, up; None for a line that is none of a drive."""
    words = line.replace(",", " ").split()
    try:
        stamp = _stamp_ns(words[0], words[1])
        if not FIRST_NS <= stamp < END_NS:
            return None
        lat, lon, height = map(float, words[2:5])
        across, up = BEST_M[int(float(words[5]))]  # some tools write 1.0000000
        sdn, sde, sdu = map(float, words[7:10]) if len(words) >= 10 else (across, across, up)
    except (ValueError, IndexError, KeyError, OverflowError):
        return None
    return stamp, lat, lon, height, max(sde, across), max(sdn, across), max(sdu, up)


def _stamp_ns(first: str, second: str) -> int:
    """From a date and a time of day, or a GPS week and the seconds in it."""
    if "/" in first:
        day = int(np.datetime64(first.replace("/", "-"), "D").astype(np.int64)) * DAY_NS  # of any year
        hours, minutes, seconds = second.split(":")
        return day + (int(hours) * 60 + int(minutes)) * 60_000_000_000 + _ns(seconds)
    return GPS_EPOCH_NS + int(first) * WEEK_NS + _ns(second)


def _ns(seconds: str) -> int:
    """Decimal seconds, exactly."""
    whole, _, part = seconds.partition(".")
    return int(whole) * 1_000_000_000 + int((part + "000000000")[:9])

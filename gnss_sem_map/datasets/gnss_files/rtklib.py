"""RTKLIB's solution files (.pos): degrees, degrees with minutes and seconds, geocentric, or a baseline, and metres.

Format: RTKLIB manual, appendix B.1. The standard deviations of the solution are too small where its quality is not a
fixed ambiguity: no row counts as better than its quality flag. Covariances (sdne, sdeu, sdun) are the square roots of
their size, with their sign. Velocities (out-outvel=on) follow age and ratio. The header says which of these it is, and
the clock; fields may be separated by any of space, tab, comma and semicolon.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.datasets.gnss_files.positions import Positions, enu_of_ecef, geodetic_of_ecef
from gnss_sem_map.datasets.gnss_files.time_systems import DAY_NS, GPS_EPOCH_NS, WEEK_NS
from gnss_sem_map.datasets.stamps import FIRST_YEAR, LAST_YEAR
from gnss_sem_map.files.untrusted import refused, shown
from gnss_sem_map.sensor_log import Skip

Array = NDArray[np.float64]
Form = Literal["deg", "dms", "ecef", "enu"]

BEST_M: dict[float, tuple[float, float]] = {
    1: (0.01, 0.02),
    2: (0.3, 0.5),
    3: (1.0, 2.0),
    4: (0.6, 1.0),
    5: (2.0, 4.0),
    6: (0.1, 0.2),
}
"""Horizontal and vertical standard deviations, m, that no row of a quality is better than: fix, float, SBAS, DGPS,
single, PPP."""
FIRST_NS, END_NS = (
    int(np.datetime64(f"{year}-01-01", "ns").astype(np.int64)) for year in (FIRST_YEAR, LAST_YEAR + 1)
)
COLUMNS = "date time latitude longitude height Q ns sdn sde sdu"
BEHIND = 17
"""Numbers behind quality and number of satellites: three of deviations, three of covariances, age, ratio, and as many
of the velocity as of the position. Deviations and covariances are of the axes 1, 2, 3, 12, 23 and 31."""
VELOCITIES, LEAST_VELOCITY_STDDEV = re.compile(r"v[nx]\(m/s\)"), 0.01
"""Name of the first column of velocities; no velocity is believed more than by the second, m/s."""
LARGEST = 1e9
"""No number of a solution is larger."""
ENU_OF_NEU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
JST_NS = 9 * 3600 * 10**9
FIELDS = re.compile(r"[;,\s]+")
ROW = re.compile(
    r"\s*(\d{4}/\d\d/\d\d[;,\s]+\d\d:\d\d:\d\d|\d{3,4}[;,\s]+\d+\.\d+)\S*[;,\s]+-?\d+\.\d+[;,\s]"
)


def is_solution(lines: list[str]) -> bool:
    """Whether lines of text are of such a file: by its columns, or where it has none, by its first row."""
    header, rows = _parts(lines[:100])
    return bool(_columns(header)) or (not header and bool(rows) and ROW.match(rows[0]) is not None)


def read(path: Path, lines: list[str]) -> Positions:
    """The solutions of a file; rows of unknown quality, form or year are skipped.

    Raises DataError where there is none, or a baseline without its `ref pos`.
    """
    header, rows = _parts(lines)
    columns = _columns(header)
    form: Form = _form(columns) if columns else "deg"
    found = [row for row in (_row(line, form) for line in rows) if row is not None]
    if not found:
        raise refused(path, f"found no solution among {len(rows)} lines, expected {COLUMNS}")
    lost = len(rows) - len(found)
    reason = f"{lost} lines: no solution of a known quality, or no time of a drive"
    skips = [Skip("fix", shown(path), reason, lost)] if lost else []
    stamps = np.array([row[0] for row in found], np.int64) - (JST_NS if "JST" in columns else 0)
    table = np.array([row[1] for row in found])
    places, best, behind = table[:, :3], table[:, 3:5], table[:, 5:]
    R: Array = ENU_OF_NEU
    if form == "ecef":
        places = geodetic_of_ecef(places)
        R = enu_of_ecef(places)
    elif form == "enu":
        places, R = np.column_stack(_base(path, header).to_geodetic(places)), np.eye(3)
    stddevs, correlations = _in_enu(behind[:, :3], behind[:, 3:6], R)
    least = best[:, [0, 0, 1]]
    more = {"correlations": correlations}
    if VELOCITIES.search(columns):
        more["velocities"] = np.einsum("...ij,nj->ni" if R.ndim == 2 else "nij,nj->ni", R, behind[:, 8:11])
        of_velocity, _ = _in_enu(behind[:, 11:14], behind[:, 14:17], R)
        more["velocity_stddevs"] = np.maximum(of_velocity, LEAST_VELOCITY_STDDEV)
    is_above_geoid = "WGS84/geodetic" in "\n".join(header) and form in ("deg", "dms")
    return Positions(
        stamps, places, np.fmax(stddevs, least), "utc" if "UTC" in columns or "JST" in columns else "gps", skips,
        more, np.full(len(stamps), is_above_geoid),
    )  # fmt: skip


def _parts(lines: list[str]) -> tuple[list[str], list[str]]:
    """The header, whose lines begin with a percent sign or name the columns, and the rows."""
    header = [line for line in lines if line.startswith("%") or _is_of_names(line)]
    return header, [
        line for line in lines if line.strip() and not (line.startswith("%") or _is_of_names(line))
    ]


def _is_of_names(line: str) -> bool:
    return any(name in line for name in ("latitude(d", "x-ecef(m", "e-baseline(m")) and "Q" in line


def _columns(header: list[str]) -> str:
    """The line that names the columns, empty where there is none."""
    return next(filter(_is_of_names, header), "")


def _form(columns: str) -> Form:
    if "x-ecef(" in columns:
        return "ecef"
    if "e-baseline(" in columns:
        return "enu"
    return "dms" if "(d'" in columns else "deg"


def _row(line: str, form: Form) -> tuple[int, tuple[float, ...]] | None:
    """Stamp, ns; place, its best deviations, and what is behind them, NaN where nothing is; None if it is no fix."""
    words = FIELDS.split(line.strip())
    try:
        stamp = _stamp_ns(words[0], words[1])
        if not FIRST_NS <= stamp < END_NS:
            return None
        end = 9 if form == "dms" else 5
        place = [float(word) for word in words[2:end]]
        if form == "dms":
            place = [_degrees(words[2:5]), _degrees(words[5:8]), place[6]]
        best = BEST_M[float(words[end])]  # tools write 1.0
        behind = [float(word) for word in words[end + 2 : end + 2 + BEHIND] if word]
    except (ValueError, IndexError, KeyError, OverflowError):
        return None
    if not all(abs(number) < LARGEST for number in (*place, *behind)):
        return None
    if len(behind) < 3:
        behind = []
    return stamp, (*place, *best, *behind, *[float("nan")] * (BEHIND - len(behind)))


def _degrees(words: list[str]) -> float:
    """Of degrees, minutes and seconds; a sign before zero counts."""
    degrees, minutes, seconds = map(float, words)
    return float(np.copysign(abs(degrees) + minutes / 60 + seconds / 3600, degrees))


def _in_enu(deviations: Array, roots: Array, R: Array) -> tuple[Array, Array]:
    """Standard deviations and correlations en, eu, nu of errors along other axes; NaN where they are not told.

    `roots` (n, 3) are of the covariances of axes 12, 23, 31; R_enu_axes (3, 3), or one for each row.
    """
    C = np.einsum("ni,ij->nij", deviations**2, np.eye(3))
    for k, (i, j) in enumerate([(0, 1), (1, 2), (2, 0)]):
        C[:, i, j] = C[:, j, i] = np.nan_to_num(roots[:, k] * np.abs(roots[:, k]))
    C = R @ C @ np.swapaxes(R, -1, -2)
    stddevs = np.sqrt(np.maximum(np.einsum("nii->ni", C), 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.stack(
            [C[:, i, j] / (stddevs[:, i] * stddevs[:, j]) for i, j in ((0, 1), (0, 2), (1, 2))], axis=1
        )
    shares[(stddevs == 0).any(axis=1)] = 0.0
    shares[np.isnan(roots).any(axis=1)] = np.nan
    return stddevs, shares


def _base(path: Path, header: list[str]) -> LocalFrame:
    """The frame of baselines, at the place that the header tells."""
    for line in header:
        if "ref pos" in line and ":" in line:
            words = re.findall(r"[-+]?[0-9]+\.?[0-9]*", line.partition(":")[2])
            if len(words) == 7:  # with minutes and seconds
                return LocalFrame(_degrees(words[:3]), _degrees(words[3:6]), float(words[6]))
            if len(words) == 3:
                place = np.array([[float(word) for word in words]])
                return LocalFrame(*(geodetic_of_ecef(place) if abs(place[0, 0]) > 90 else place)[0].tolist())
    raise refused(
        path,
        "its positions are baselines, no `ref pos` in its header; add it, or out-solformat=llh",
    )


def _stamp_ns(first: str, second: str) -> int:
    """From a date and a time of day, or a GPS week and the seconds in it."""
    if "/" in first:
        day = int(np.datetime64(first.replace("/", "-"), "D").astype(np.int64)) * DAY_NS  # of any year
        hours, minutes, seconds = second.split(":")
        return day + (int(hours) * 60 + int(minutes)) * 60_000_000_000 + _ns(seconds)
    return GPS_EPOCH_NS + int(float(first)) * WEEK_NS + _ns(second)


def _ns(seconds: str) -> int:
    """Decimal seconds, exactly."""
    whole, _, part = seconds.partition(".")
    return int(whole) * 1_000_000_000 + int((part + "000000000")[:9])

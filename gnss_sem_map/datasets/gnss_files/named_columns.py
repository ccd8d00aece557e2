"""Positions in a table with named columns: exports of Inertial Explorer and POSPac, CSRS-PPP, a CSV of one's own.

Names and units are those of `factor_graphs.tables`. Times are a GPS week and its seconds, a date and a time of day or
of the week, ISO 8601, or Unix time; or times of a week or a day alone, then of the one nearest to the drive. Latitude
and longitude are degrees, or degrees, minutes and seconds, in one column or three; or positions are geocentric.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.stamps import DAY_S
from factor_graphs.table_dates import are_dates, days_of, seconds_of_dates, unix_scale
from factor_graphs.tables import NAMES, Column, Layout, layout_of
from gnss_sem_map.datasets.gnss_files.positions import (
    FLAT_STDDEV_M,
    Positions,
    geodetic_of_ecef,
    thinned,
    without_heights,
)
from gnss_sem_map.datasets.gnss_files.sbet import over_weeks
from gnss_sem_map.datasets.gnss_files.time_systems import DAY_NS, GPS_EPOCH_NS, WEEK_NS, nearest
from gnss_sem_map.datasets.stamps import LAST_YEAR
from gnss_sem_map.files.untrusted import MOST_LINES, refused, shown
from gnss_sem_map.sensor_log import Skip

Array = NDArray[np.float64]
System = Literal["utc", "gps"]

ANGLES = ("lat_deg", "lon_deg")
PARTS = {"lat_deg": ("lat_d", "lat_min", "lat_s"), "lon_deg": ("lon_d", "lon_min", "lon_s")}
GEOCENTRIC, STDDEVS = ("x_m", "y_m", "z_m"), ("std_e_m", "std_n_m", "std_u_m")
NAMED = (
    *ANGLES, *PARTS["lat_deg"], *PARTS["lon_deg"], *GEOCENTRIC, *STDDEVS, "alt_m", "msl_m", "separation_m",
    "week", "sow", "date", "clock", "stamp_s",
)  # fmt: skip
EXPECTED = (
    "expected RTKLIB, NMEA, or columns of time, latitude, longitude and height, such as Week GPSTime Latitude Longitude"
    " H-Ell"
)
WEEK_S = 7 * DAY_S
LARGEST, LATEST_S = 1e19, (LAST_YEAR - 1970) * 366 * DAY_S
"""No number of a table is larger, and no time of a drive is later."""
SIDES = {"lat_deg": ("N", "S"), "lon_deg": ("E", "W")}
"""Letters of the hemispheres above and below zero, which may have a column of their own behind an angle."""


@dataclass(frozen=True, eq=False)
class _Table:
    """Lines of rows, and the columns that were found."""

    layout: Layout
    columns: dict[str, Column]
    lines: list[str]
    are_angles_split: bool
    """Degrees, minutes and seconds are cells of their own, though the header has one name for them."""

    def has(self, *names: str) -> bool:
        """Whether all of these columns are there."""
        return all(name in self.columns for name in names)

    def texts(self, name: str) -> list[str]:
        """The cells of a column; those of an angle joined by spaces."""
        at, count = self.columns[name].at, 1
        if self.are_angles_split:
            at += 2 * sum(self.columns[angle].at < at for angle in ANGLES)
            count = 3 if name in ANGLES else 1
        rows = (line.split(self.layout.separator) for line in self.lines)
        return [" ".join(row[at : at + count]).strip().strip('"') for row in rows]

    def numbers(self, name: str) -> Array:
        """Numbers of a column in our units; NaN for what is none."""
        return self.columns[name].in_our_units(np.array([_number(text) for text in self.texts(name)]))

    def beside(self, name: str) -> list[str]:
        """The cells behind a column."""
        at = self.columns[name].at + 1
        rows = (line.split(self.layout.separator) for line in self.lines)
        return ["".join(row[at : at + 1]).strip().strip('"').upper() for row in rows]


def read(path: Path, content: bytes, near_ns: int | None, has_stddevs: bool) -> Positions:
    """Positions of a table, at most ten a second; raises DataError where it is none, or tells no accuracy."""
    table = _opened(path, content)
    moments, system = _moments(table, near_ns, path)
    count, usable = len(moments), np.abs(moments) < LATEST_S
    rows = np.flatnonzero(usable)
    if len(rows) and (np.diff(moments[rows]) > 0).all():
        rows = rows[thinned(moments[rows])]
    lost, moments = count - int(usable.sum()), moments[rows]
    table = _Table(
        table.layout, table.columns, [table.lines[k] for k in rows.tolist()], table.are_angles_split
    )
    is_flat = not ({"alt_m", "msl_m", "x_m"} & table.columns.keys())
    told = STDDEVS[:2] if is_flat else STDDEVS
    if not table.has(*told) and not has_stddevs:
        raise refused(path, f"{table.layout.shown} tells no accuracy; set `stddevs_m: [east, north, up]`")
    places, above_geoid = _places(table, path)
    stddevs = np.column_stack(
        [table.numbers(name) if table.has(*told, name) else np.ones(len(rows)) for name in STDDEVS]
    )
    if is_flat:
        stddevs[:, 2] = FLAT_STDDEV_M
    known = np.isfinite(places).all(axis=1) & np.isfinite(stddevs).all(axis=1)
    if not known.any():
        raise refused(path, f"found no position among {count} rows of {table.layout.shown}; {EXPECTED}")
    lost += int((~known).sum())
    skips = [Skip("fix", shown(path), f"{lost} rows without a time or a place", lost)] if lost else []
    skips += [without_heights(shown(path), int(known.sum()))] if is_flat else []
    stamps = np.round(moments[known] * 1e9).astype(np.int64)
    return Positions(
        stamps, places[known], stddevs[known], system, skips, above_geoid=np.full(len(stamps), above_geoid)
    )


def _opened(path: Path, content: bytes) -> _Table:
    try:
        layout = layout_of(content, NAMED)
        found = {name: layout.column(name) for name in NAMED}
    except MeasurementError as error:
        raise refused(path, f"{error}") from None
    lines = bytes(layout.rows).decode("utf-8", "replace").split("\n")[1:]
    lines = [line for line in lines if line.strip()]
    if len(lines) > MOST_LINES:
        raise refused(path, f"found {len(lines)} lines, expected at most {MOST_LINES}")
    columns = {name: column for name, column in found.items() if column is not None}
    if not lines or not ({"lat_deg", "lat_d", "x_m"} & columns.keys()):
        projected = {"easting_m", "northing_m"} & {name for name in NAMES if layout.column(name) is not None}
        why = (
            "eastings and northings; write latitude and longitude (cs2cs EPSG:... EPSG:4979)"
            if projected
            else ""
        )
        why = why or layout.missing("lat_deg", ("time", "latitude", "longitude", "altitude"))
        raise refused(path, f"{why if lines else 'empty'}; {EXPECTED}")
    if layout.decimal == ",":
        lines = [line.replace(",", ".") for line in lines]
    cells = len(lines[0].split(layout.separator))
    return _Table(layout, columns, lines, cells == len(layout.header) + 4 and {*ANGLES} <= columns.keys())


def _places(table: _Table, path: Path) -> tuple[Array, bool]:
    """Latitude, longitude °, height m (n, 3), NaN for what is none; and whether heights are above the geoid."""
    if table.has(*GEOCENTRIC) and not table.has("lat_deg"):
        return geodetic_of_ecef(np.column_stack([table.numbers(name) for name in GEOCENTRIC])), False
    angles = [_angles(table, name) for name in ANGLES if table.has(name) or table.has(*PARTS[name])]
    if len(angles) < len(ANGLES):
        raise refused(path, f"found {table.layout.shown}; {EXPECTED}")
    if not ({"alt_m", "msl_m"} & table.columns.keys()):
        return np.column_stack([*angles, np.zeros(len(table.lines))]), False
    if table.has("alt_m"):
        return np.column_stack([*angles, table.numbers("alt_m")]), False
    height = table.numbers("msl_m")
    if table.has("separation_m"):
        return np.column_stack([*angles, height + table.numbers("separation_m")]), False
    return np.column_stack([*angles, height]), True


def _angles(table: _Table, name: str) -> Array:
    if table.has(name):
        degrees = table.columns[name].in_our_units(np.array([_degrees(text) for text in table.texts(name)]))
        sides = np.array([] if table.are_angles_split else table.beside(name))
        above, below = SIDES[name]
        if len(sides) and np.isin(sides, (above, below)).all():
            degrees = np.where(sides == below, -np.abs(degrees), degrees)
        return degrees
    parts = zip(*(table.texts(part) for part in PARTS[name]), strict=True)
    return np.array([_degrees(" ".join(texts)) for texts in parts])


def _moments(table: _Table, near_ns: int | None, path: Path) -> tuple[Array, System]:
    """Times (n,), s since 1970 on their clock, NaN for what is none; and which clock it is."""
    if table.has("week", "sow"):
        return GPS_EPOCH_NS * 1e-9 + table.numbers("week") * WEEK_S + table.numbers("sow"), "gps"
    name = next((name for name in ("sow", "clock", "stamp_s", "date") if table.has(name)), None)
    if name is None:
        raise refused(path, f"found {table.layout.shown}; {EXPECTED}")
    texts = table.texts(name)
    label = table.layout.header[table.columns[name].at].lower()
    is_gps = name == "sow" or label.startswith(("gps", "hr"))  # CSRS-PPP has GPS time
    clock = np.array([_clock(text) for text in texts])
    if are_dates(texts) and np.isnan(clock).all():  # with the day
        return seconds_of_dates(texts, 0), "gps" if is_gps else "utc"
    if table.has("date"):
        days = days_of(table.texts("date"))
        sundays = days - (days / DAY_S + 4) % 7 * DAY_S
        return np.where(clock >= DAY_S, sundays, days) + clock, "gps" if is_gps else "utc"
    column = table.columns[name]
    clock = clock * (column.scale if column.unit else unix_scale(clock))
    known = np.abs(clock) < LATEST_S
    if not known.any() or np.median(clock[known]) > 2 * WEEK_S:
        return clock, "utc"
    return _nearest(clock, known, is_of_day=":" in texts[int(np.argmax(known))], near_ns=near_ns, path=path)


def _nearest(
    clock: Array, known: NDArray[np.bool_], is_of_day: bool, near_ns: int | None, path: Path
) -> tuple[Array, System]:
    """Times of a day of UTC, or of a GPS week, on the day or week nearest to a moment."""
    if near_ns is None:
        raise refused(path, "tells neither date nor week, nor does another sensor; add a column Week")
    times, start, period = clock[known], GPS_EPOCH_NS, WEEK_NS
    if is_of_day:
        times, start, period = (
            times + DAY_S * np.cumsum(np.diff(times, prepend=times[:1]) < -DAY_S / 2),
            0,
            DAY_NS,
        )
    else:
        times = over_weeks(times)
    moments = np.full(len(clock), np.nan)
    moments[known] = nearest(start + np.round(times * 1e9).astype(np.int64), period, near_ns) * 1e-9
    return moments, "utc" if is_of_day else "gps"


def _clock(text: str) -> float:
    """Hours, minutes and seconds, or a number, as s; NaN for what is neither."""
    words = text.split(":")
    if len(words) != 3:
        return _number(text)
    hours, minutes, seconds = map(_number, words)
    return hours * 3600 + minutes * 60 + seconds


def _degrees(text: str) -> float:
    """A number, or degrees, minutes and seconds, with a sign or the letter of a hemisphere; NaN for what is neither."""
    whole = _number(text)
    if np.isfinite(whole):
        return whole
    numbers = [float(word) for word in re.findall(r"\d{1,9}(?:\.\d{0,15})?", text)]
    if not 1 <= len(numbers) <= 3 or any(part >= 60 for part in numbers[1:]):
        return float("nan")
    size = sum(part / 60**k for k, part in enumerate(numbers))
    is_below = text.lstrip().startswith("-") or text.strip().upper().endswith(("S", "W"))
    return float(-size if is_below else size)


def _number(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        return float("nan")
    return number if abs(number) < LARGEST else float("nan")

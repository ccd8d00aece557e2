"""How a table of text is written: encoding, comment lines, separators, and the names and units of its columns.

One list of names and one of units serve all readers of tables. Of a name only letters and digits count. Its unit is in
brackets behind it, at its end, or in a line below the names.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.table_dates import GPS_TIME, ZONE

HEADER_BYTES, HEADER_LINES, MAGIC_BYTES = 100_000, 100, 64
MOST_COLUMNS, LONGEST_NAME = 1000, 200
SEPARATORS = ";\t|,"
COMMENT = re.compile(r"^\s*(?:#|%|//)+\s*")
BRACKETS = re.compile(r"^(.*?)\s*[\[(<{]\s*([^\])>}]*)[\])>}]?\s*$")
NUMBER_CELL = re.compile(r"^\s*[+-]?(nan|inf|[0-9]*[.,]?[0-9]+[.,]?(e[+-]?[0-9]+)?)\s*$", re.IGNORECASE)
SPELLED = str.maketrans({"²": "2", "µ": "u", "μ": "u", "°": "deg"})
DECIMAL_COMMA = re.compile(r"^\s*[+-]?[0-9]*,[0-9]+\s*$")

DECIMAL_POINT = re.compile(r"^\s*[+-]?[0-9]*\.[0-9]+\s*$")

_SCALES: dict[str, dict[float, str]] = {
    "time": {
        1.0: "s sec secs second seconds hms", 1e-3: "ms msec msecs millis milliseconds",
        1e-6: "us usec usecs micros microseconds", 1e-9: "ns nsec nsecs nanos nanoseconds",
    },
    "angle": {1.0: "deg degs degree degrees dms", 180 / np.pi: "rad radian radians", 1e-7: "dege7 1e7deg"},
    "length": {
        1.0: "m meter meters metre metres 68%", 1e-3: "mm", 1e-2: "cm", 0.3048: "ft feet", 1200 / 3937: "usft ftus",
        1 / 1.96: "95%",
    },
    "force": {1.0: "ms2 mps2 mss msecsec", 9.80665: "g gs", 9.80665e-3: "mg"},
    "rate": {1.0: "rads radps radsec rads1", np.pi / 180: "degs dps degps degsec", np.pi / 180e3: "mdps"},
    "speed": {1.0: "ms mps msec", 1 / 3.6: "kmh kph kmph", 1609.344 / 3600: "mph", 1852 / 3600: "kn kt kts knots"},
}  # fmt: skip
UNITS = {
    kind: {word: scale for scale, words in scales.items() for word in words.split()}
    for kind, scales in _SCALES.items()
}
"""By kind: unit -> what a number of it is multiplied by."""
_FORCE = "a acc accel accelerometer acceleration linearacceleration linearacc linacc specificforce force arss"
_RATE = "w g gyr gyro gyroscope omega angularvelocity angularvel angvel angularrate rotationrate rate wrss"
ACROSS = "hacc horizontalaccuracy haccuracy accuracy"
_NAMES: dict[str, dict[str, str]] = {
    "time": {
        "stamp_s": "stamp headerstamp time timestamp datetime t unixtime epoch utctime utc timeutc gpst timegpst"
        " sec secs seconds secondselapsed timestartup gpstime sow tow gpstow",
    },
    "angle": {"lat_deg": "lat latitude", "lon_deg": "lon lng long longitude"},
    "length": {
        "alt_m": "alt hell althae ellipsoidheight ellipsoidalheight heightellipsoid altitude height hgt h",
        "msl_m": "msl hmsl altmsl altitudemsl heightmsl orthometricheight elevation ele",
        "separation_m": "separation geoidseparation geoidsep geoidheight undulation",
        "std_e_m": f"stde sde sdeast eastsd stdeast sigmae sigmaeast eaststd eaststddev sdlon stdlon {ACROSS}",
        "std_n_m": f"stdn sdn sdnorth northsd stdnorth sigman sigmanorth northstd northstddev sdlat stdlat {ACROSS}",
        "std_u_m": "stdu sdu sdup upsd sdheight heightsd stdup sigmau sigmaup upstd upstddev sdhgt stdalt vacc"
        " verticalaccuracy vaccuracy",
        "x_m": "xecef ecefx", "y_m": "yecef ecefy", "z_m": "zecef ecefz", "easting_m": "easting",
        "northing_m": "northing", "height_m": "",
    },
    "force": {f"a{x}": " ".join([*(f"{n}{x}" for n in _FORCE.split()), f"{x}acc", f"{x}accel"]) for x in "xyz"},
    "rate": {f"w{x}": " ".join([*(f"{n}{x}" for n in _RATE.split()), f"{x}gyr", f"{x}gyro"]) for x in "xyz"},
    "speed": {
        "speed_mps": "speed velocity vel v wheelspeed vehiclespeed", "ve_mps": "ve", "vn_mps": "vn", "vu_mps": "vu",
        "std_ve_mps": "stdve", "std_vn_mps": "stdvn", "std_vu_mps": "stdvu",
    },
    "none": {
        "number": "number frame index frameid framenumber seq no id", "name": "name point pointname pointid id",
        "stamp_ns": "headerstampnanosec headerstampnsec headerstampnsecs stampnanosec stampnsec stampnsecs nanosec nsec"
        " nsecs",
        "type": "type", "epsg": "epsg", "heading_deg": "headingdeg", "std_heading_deg": "stdheadingdeg",
        "corr_en": "corren", "corr_eu": "correu", "corr_nu": "corrnu",
        "week": "week gpsweek weekno", "sow": "gpstime corrtime sow tow gpstow gpssow",
        "date": "date utcdate gpsdate yearmmdd", "clock": "hrmnssss hrmnsssss utctime utc time timeutc",
        "lat_d": "latdd", "lat_min": "latmn", "lat_s": "latss", "lon_d": "londd", "lon_min": "lonmn", "lon_s": "lonss",
    },
}  # fmt: skip
NAMES = {name: words.split() for names in _NAMES.values() for name, words in names.items()}
"""Name of a column -> what others call it; of several that are there, the first of this list is taken."""
KINDS = {name: kind for kind, names in _NAMES.items() for name in names}
WORDS = {word for words in NAMES.values() for word in words}
VARIANCES = {
    f"std_{axis}_m": [f"positioncovariance{k}", f"var{axis}", f"var{name}"]
    for axis, name, k in (("e", "east", 0), ("n", "north", 4), ("u", "up", 8))
}
"""Columns whose root is a standard deviation: NavSatFix as tables of it have it, and others."""
PREFIX = re.compile(r"^(?:(?:imu|gnss|gps|ins|fix|field)[0-9]?[ _:]+|[^/.]*[/.]+)", re.IGNORECASE)
"""What may stand before a name: the sensor, or a path of it, as tables of ROS topics have it."""
MOST_PARTS = 8


@dataclass(frozen=True)
class Column:
    """Where a column is in its table, and what its numbers are multiplied by; `unit`: the table tells its unit."""

    at: int
    scale: float = 1.0
    unit: bool = False
    is_variance: bool = False

    @property
    def is_in_our_units(self) -> bool:
        """Whether its numbers stay as they are."""
        return self.scale == 1.0 and not self.is_variance

    def in_our_units(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """Numbers (n,) of this column in SI units or degrees; NaN for a variance below zero."""
        if not self.is_variance:
            return numbers * self.scale
        return np.sqrt(np.where(numbers >= 0, numbers, np.nan))


@dataclass(frozen=True, eq=False)
class Layout:
    """How a table is written: `rows` are UTF-8, without comment lines, from the line before the first row on."""

    header: list[str]
    rows: memoryview
    separator: str = ","
    decimal: str = "."
    above: str = ""
    """What stands above the names."""

    @cached_property
    def _plain(self) -> list[list[tuple[str, str | None]]]:
        """Name and unit of each column, if it tells one; first as it is, then without more and more of its path."""
        rows = [self._named(self.header)]
        shorter = self.header
        while len(rows) < MOST_PARTS and (cut := [PREFIX.sub("", text) for text in shorter]) != shorter:
            rows.append(self._named(cut))
            shorter = cut
        return rows

    @staticmethod
    def _named(header: list[str]) -> list[tuple[str, str | None]]:
        cells = [BRACKETS.match(text[:LONGEST_NAME]) for text in header]
        return [
            (_letters(text), None) if cell is None else (_letters(cell[1]), _letters(cell[2]))
            for text, cell in zip(header, cells, strict=True)
        ]

    def column(self, name: str) -> Column | None:
        """The column of a name of `NAMES`; raises MeasurementError where there are two, or its unit is unknown."""
        found = [Column(k, unit=True) for k, text in enumerate(self.header) if text == name]
        for named in self._plain:
            for word in NAMES.get(name, []):
                found = found or list(self._called(word, name, named))
        if not found and name in VARIANCES:
            found = [
                Column(k, is_variance=True)
                for named in self._plain[:1]
                for k, (plain, unit) in enumerate(named)
                if plain + (unit or "") in VARIANCES[name]
            ]
        if len(found) > 1 and name == "stamp_s":  # beside seconds, those below
            found = [one for one in found if one.scale == 1.0] or found
        if len(found) > 1:
            raise MeasurementError(f"column {name} is missing or repeated in {self.shown}")
        return found[0] if found else None

    def _called(self, word: str, name: str, named: list[tuple[str, str | None]]) -> Iterator[Column]:
        units = UNITS.get(KINDS[name], {})
        for k, (plain, unit) in enumerate(named):
            is_other = self.header[k] in NAMES
            at_end = plain[len(word) :] if plain.startswith(word) and not is_other else None
            if (at_end == "" and unit in (None, "")) or (unit and plain + unit == word):
                yield Column(k)
            elif at_end == "" and (unit in units or not units):
                yield Column(k, units.get(str(unit), 1.0), True)
            elif at_end == "" and plain + str(unit) not in WORDS:
                raise MeasurementError(
                    f"column {self.header[k][:50]!r} is in a unit that is not known; expected one of {', '.join(units)}"
                )
            elif at_end in units:
                yield Column(k, units[at_end], True)

    @cached_property
    def _head(self) -> list[list[str]]:
        start = bytes(self.rows[:HEADER_BYTES]).decode("utf-8", "replace").split("\n")[1 : HEADER_LINES + 1]
        return [_cells(line, self.separator) for line in start]

    def first(self, at: int) -> str:
        """The first cell of a column that has something; empty where there is none."""
        cells = (row[at].strip().strip('"') for row in self._head if at < len(row))
        return next((cell for cell in cells if cell), "")

    def is_of_gps_time(self, at: int) -> bool:
        """Whether the name of a column of dates, or what stands above the names, says that they are of GPS time."""
        return bool(GPS_TIME.search(f"{self.header[at]}\n{self.above}")) and not ZONE.search(self.first(at))

    def missing(self, name: str, expected: Collection[str]) -> str:
        """Why a column is not there, and what to do."""
        if all(NUMBER_CELL.match(cell) for cell in self.header if cell):
            return f"has no line of names; write one above its rows, such as {','.join(expected)}"
        names = ", ".join([name, *NAMES.get(name, [])[:5]])
        return f"found no column {name} in {self.shown}; name it so in its first line (read are {names}, ...)"

    @property
    def shown(self) -> str:
        """The header for messages."""
        return " ".join(",".join(self.header).split())[:200]


def layout_of(content: bytes, wanted: Collection[str], most: Collection[str] = ()) -> Layout:
    """How a table is written that has `wanted` columns, and perhaps some of `most`; of another, by its first line."""
    content = as_utf8(content)
    if b"\0" in content[:MAGIC_BYTES]:
        raise MeasurementError("is no text (a spreadsheet, an archive or the like); save it as CSV in UTF-8")
    lines = _decoded(content[:HEADER_BYTES]).split("\n")[:HEADER_LINES]
    at = _header_line(lines, wanted, most)
    above, (header, header_separator) = "\n".join(lines[:at]), _split(COMMENT.sub("", lines[at]))
    rest = [k for k in range(at + 1, len(lines)) if lines[k].strip() and not COMMENT.match(lines[k])]
    if rest and _are_units(lines[rest[0]]):
        header, at, rest = _with_units(lines[at], header, lines[rest[0]]), rest[0], rest[1:]
    separator, is_ended = _separator([lines[k] for k in rest], len(header), header_separator)
    cells = [cell for k in rest for cell in _cells(lines[k], separator)]
    has_commas = any(map(DECIMAL_COMMA.match, cells)) and not any(map(DECIMAL_POINT.match, cells))
    decimal = "," if separator != "," and has_commas else "."
    rows = memoryview(content)[_end_of_line(content, at - 1) :]
    if any(b"\n" + mark in content for mark in (b"#", b"%", b"//", b" #", b"\t#")):
        rows = memoryview(re.sub(rb"(?<=\n)[ \t]*(?:#|%|//).*\n?", b"", rows))
    if separator == " ":
        by_tabs = b"\n".join(b"\t".join(row.split()) for row in bytes(rows).split(b"\n"))
        rows, separator = memoryview(by_tabs), "\t"
    return Layout([*header, ""] if is_ended else header, rows, separator, decimal, above)


def as_utf8(content: bytes) -> bytes:
    """UTF-16, which other programs write, as UTF-8; lines of old ones end in line feeds."""
    high, low = (2 * content[k:200:2].count(0) >= len(content[k:200:2]) > 0 for k in (0, 1))
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        content = content.decode("utf-16", "replace").encode()
    elif high != low:  # every second byte of Latin letters is zero
        content = content.decode("utf-16-le" if low else "utf-16-be", "replace").encode()
    return content if b"\n" in content or b"\r" not in content else content.replace(b"\r", b"\n")


def _decoded(head: bytes) -> str:
    try:
        return head.rpartition(b"\n")[0].decode("utf-8-sig") if b"\n" in head else head.decode("utf-8-sig")
    except UnicodeDecodeError:
        return head.decode("cp1252", "replace")  # of Windows, with its degree sign


def _header_line(lines: list[str], wanted: Collection[str], most: Collection[str]) -> int:
    """The line that has most of the names; else the first that is none of a comment."""
    scores = []
    for line in lines:
        layout = Layout(_split(COMMENT.sub("", line))[0], memoryview(b""))
        scores.append(sum(_has(layout, n) for n in wanted) + 1e-3 * sum(_has(layout, n) for n in most))
        if scores[-1] >= len(wanted) > 0:
            return len(scores) - 1
    if max(scores) >= 1:
        return int(np.argmax(scores))
    return next((k for k, line in enumerate(lines) if line.strip() and not COMMENT.match(line)), 0)


def _has(layout: Layout, name: str) -> bool:
    try:
        return layout.column(name) is not None
    except MeasurementError:
        return True


def _split(line: str) -> tuple[list[str], str]:
    """The cells of a line that may be of names, and what separates them."""
    separator = next((mark for mark in SEPARATORS if mark in line.strip()), " ")
    return [cell.strip().strip('"') for cell in _cells(line, separator)[:MOST_COLUMNS]], separator


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    try:
        return next(csv.reader([line.rstrip("\r\n")], delimiter=separator), [])
    except csv.Error:
        return line.split(separator)


def _separator(rows: list[str], columns: int, of_header: str) -> tuple[str, bool]:
    """What separates the cells of rows, by the first; and whether it ends them, too."""
    row = rows[0] if rows else of_header
    for separator in (of_header, *SEPARATORS, " "):
        cells = _cells(row, separator)
        if len(cells) == columns:
            return separator, False
        if len(cells) == columns + 1 and not cells[-1].strip():
            return separator, True
    return (of_header if of_header in row else " "), False


def _are_units(line: str) -> bool:
    """Whether a line below the names tells their units."""
    cells = _split(line)[0]
    known = {unit for units in UNITS.values() for unit in units}
    if any(map(NUMBER_CELL.match, cells)):
        return False
    return line.lstrip()[:1] in ("(", "[") or any(_letters(cell) in known for cell in cells)


def _with_units(names: str, header: list[str], below: str) -> list[str]:
    """The names with the units that stand below them: as many, or where they end."""
    words = re.findall(r"[\[(][^\])]*[\])]", below)
    units = _split(below)[0] if len(_split(below)[0]) == len(header) else words
    if len(units) != len(header):
        ends = np.array([m.end() for m in re.finditer(r"\S+", names)])
        if len(ends) != len(header):
            return header
        there = {int(np.abs(ends - m.end()).argmin()): m[0] for m in re.finditer(r"[\[(][^\])]*[\])]", below)}
        units = [there.get(k, "") for k in range(len(header))]
    return [f"{name} [{unit.strip('[]()')}]" for name, unit in zip(header, units, strict=True)]


def _letters(text: str) -> str:
    """Letters, digits and percent signs of a name or a unit, in lower case; units are spelled out."""
    text = text.strip().strip('"').lower().translate(SPELLED)
    return re.sub("[^a-z0-9%]", "", text.removeprefix("field."))


def _end_of_line(content: bytes, line: int) -> int:
    """Where a line ends, from 0."""
    at = -1
    for _ in range(line + 1):
        at = content.find(b"\n", at + 1)
        if at < 0:
            return len(content)
    return at + 1

"""A log of two CSV files, `imu.csv` and `gnss.csv`, and if there is one a third, `wheels.csv`.

What has one obvious repair is repaired, with a warning that counts the rows; all else is refused.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factor_graphs.errors import MeasurementError, RepairWarning
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import (
    AntennaHeadings,
    GnssFixes,
    GnssVelocities,
    ImuSamples,
    Repairs,
    WheelSpeeds,
    clean_imu,
    clean_wheels,
)
from factor_graphs.receiver_rows import GNSS_COLUMNS as GNSS_COLUMNS
from factor_graphs.receiver_rows import MORE_COLUMNS, fixes_of, headings_of, velocities_of
from factor_graphs.stamps import UNITS, far_off, unit_fault, unit_of_steps
from factor_graphs.surveyed_points import SurveyedPoints, to_points
from factor_graphs.table_dates import are_dates, seconds_of_dates, unix_scale
from factor_graphs.tables import Column, Layout, layout_of
from factor_graphs.valid_fixes import valid_fixes

if TYPE_CHECKING:
    from pyarrow import Table
    from pyarrow.csv import InvalidRow

Array = NDArray[np.float64]

IMU_COLUMNS = ("stamp_s", "ax", "ay", "az", "wx", "wy", "wz")
WHEEL_COLUMNS = ("stamp_s", "speed_mps")
# Usual steps are far shorter; stamps in milliseconds instead of seconds make them longer.
LONGEST_IMU_STEP_S, LONGEST_FIX_STEP_S, LONGEST_WHEEL_STEP_S = 0.5, 100.0, 5.0
MAY_LACK = ("stamp_s", "std_e_m", "std_n_m", "std_u_m")
POINT_COLUMNS = ("lat_deg", "lon_deg", "alt_m", "easting_m", "northing_m", "height_m", "epsg", *MAY_LACK)
NOT_DEFINITE = "their covariance is not positive definite; used without correlations"
NUMBER = r"^[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?$"
# A table with a larger share of damaged rows is another kind of table; its first row is in line 2.
MOST_DAMAGED, FIRST_ROW = 0.5, 2
STAMP = "stamp_s"


def read_csv(folder: Path | str) -> tuple[ImuSamples, GnssFixes, LocalFrame]:
    """Read `imu.csv` and `gnss.csv` of a folder; the local frame has its origin at the first valid fix.

    IMU columns: stamp_s; ax, ay, az, specific force, m/s²; wx, wy, wz, rad/s; x forward, y left, z up. GNSS
    columns: stamp_s; lat_deg, lon_deg, alt_m on WGS 84; std_e_m, std_n_m, std_u_m; if they are there, corr_en,
    corr_eu, corr_nu, the correlations of the errors. Other columns are ignored. Rows that are damaged, without a
    value, with a repeated stamp, or without a valid fix are dropped, and rows out of order are sorted: a
    RepairWarning says how many. Raises MeasurementError for a file that is missing, holds no such table, has more
    damaged rows than others, or has stamps in another unit than seconds.
    """
    imu_csv, gnss_csv = Path(folder) / "imu.csv", Path(folder) / "gnss.csv"
    imu_rows, of_imu = _numbers(imu_csv, IMU_COLUMNS, LONGEST_IMU_STEP_S)
    imu, imu_repairs = clean_imu(imu_rows[:, 0], imu_rows[:, 1:4], imu_rows[:, 4:7])
    gnss_rows, frame, of_gnss = _rows_in_frame(folder)
    fixes, gnss_repairs, no_covariance = fixes_of(gnss_rows, frame)
    of_gnss += [f"{no_covariance} rows: {NOT_DEFINITE}"] if no_covariance else []
    _warn(imu_csv, imu_repairs, of_imu)
    _warn(gnss_csv, gnss_repairs, of_gnss)
    return imu, fixes, frame


def read_velocities(folder: Path | str) -> GnssVelocities | None:
    """Read the velocities in `gnss.csv` of a folder, for `smooth(..., also=...)`; None where there are none.

    Columns: ve_mps, vn_mps, vu_mps, east, north, up, and std_ve_mps, std_vn_mps, std_vu_mps; without those of up it is
    not measured. Rows are repaired, and errors raised, as by `read_csv`.
    """
    rows, frame, _ = _rows_in_frame(folder)
    velocities, repairs = velocities_of(rows, frame)
    _warn(Path(folder) / "gnss.csv", repairs)
    return velocities


def read_headings(folder: Path | str, baseline: ArrayLike | None = None) -> AntennaHeadings | None:
    """Read the headings in `gnss.csv` of a folder, for `smooth(..., also=...)`; None where there are none.

    Columns: heading_deg, clockwise from north; std_heading_deg. `baseline` (3,) m from the main antenna to the second
    one in the imu frame; None: the heading is that of the imu's x axis. Rows are repaired, and errors raised, as by
    `read_csv`.
    """
    rows, frame, _ = _rows_in_frame(folder)
    headings, repairs = headings_of(rows, frame, baseline)
    _warn(Path(folder) / "gnss.csv", repairs)
    return headings


def _rows_in_frame(folder: Path | str) -> tuple[Array, LocalFrame, list[str]]:
    """Valid rows of `gnss.csv`, the local frame of the first, and what is to be told of the others."""
    path = Path(folder) / "gnss.csv"
    rows, told = _numbers(path, GNSS_COLUMNS, LONGEST_FIX_STEP_S, MORE_COLUMNS)
    rows, invalid = fix_rows(rows, str(path))
    told += [f"{n} rows dropped: {why}" for why, n in invalid.items()]
    return rows, LocalFrame(*(float(value) for value in rows[0, 1:4])), told


def _warn(path: Path, repairs: Repairs | None, told: Iterable[str] = ()) -> None:
    """Of rows that a reader of the caller dropped or sorted, and what else is told."""
    if repairs is not None and (repairs.dropped or repairs.out_of_order):
        told = [*told, str(repairs)]
    for message in told:
        warnings.warn(f"{path}: {message}", RepairWarning, stacklevel=3)


def _content(path: Path, expected: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise MeasurementError(f"{path}: cannot be read ({error.strerror}); expected {expected}") from None


def read_points(path: Path | str, frame: LocalFrame) -> SurveyedPoints:
    """Read surveyed points, for `smooth(..., also=...)`.

    Columns: name; type, control or check; lat_deg, lon_deg, alt_m, or easting_m, northing_m, height_m and epsg; if they
    are there, stamp_s and std_e_m, std_n_m, std_u_m. Heights are above the ellipsoid. Raises MeasurementError as
    `surveyed_points.to_points` does, and for a row that is damaged.
    """
    return parse_points(_content(Path(path), "a table of points"), frame, str(path))


def parse_points(content: bytes, frame: LocalFrame, where: str) -> SurveyedPoints:
    """Surveyed points of the content of a CSV file; see `read_points`."""
    layout = layout_of(content, ("name", "type"), POINT_COLUMNS)
    numbers = [name for name in POINT_COLUMNS if layout.column(name) is not None]
    types = {"name": "string", "type": "string"} | dict.fromkeys(numbers, "float64")
    table = parse_columns(content, types, where)
    names, kinds = ([str(text).strip() for text in table[column].to_pylist()] for column in ("name", "type"))
    values = {name: table[name].to_numpy().astype(np.float64) for name in numbers}
    for name in [name for name in numbers if name not in MAY_LACK]:
        if np.isnan(values[name]).any():
            row = int(np.flatnonzero(np.isnan(values[name]))[0])
            raise MeasurementError(f"{where}: point {names[row]} has no {name}; expected a number")
    return to_points(values, tuple(names), tuple(kinds), frame, where)


def read_wheels(folder: Path | str) -> WheelSpeeds | None:
    """Read `wheels.csv` of a folder, for `smooth(..., wheels=...)`; None where there is none.

    Columns: stamp_s; speed_mps, below zero in reverse if the sensor tells. Rows are repaired, and errors raised, as by
    `read_csv`.
    """
    path = Path(folder) / "wheels.csv"
    if not path.exists():
        return None
    rows, told = _numbers(path, WHEEL_COLUMNS, LONGEST_WHEEL_STEP_S)
    wheels, repairs = clean_wheels(rows[:, 0], rows[:, 1])
    _warn(path, repairs, told)
    return wheels


def fix_rows(rows: Array, where: str) -> tuple[Array, dict[str, int]]:
    """Of rows (n, c) that begin with GNSS_COLUMNS the valid fixes, in file order; how many of each kind are invalid.

    Raises MeasurementError when no row is a valid fix.
    """
    stamped = np.isfinite(rows[:, 0])
    stamped[stamped] = ~far_off(rows[stamped, 0])
    near = rows[stamped]
    valid, invalid = valid_fixes(near[:, 0], near[:, 1:4], near[:, 4:7])
    if not stamped.all():
        invalid["no stamp, or one far off all others"] = int((~stamped).sum())
    if not valid.any():
        raise MeasurementError(
            f"{where}: no usable fix among {len(rows)} rows; expected degrees and metres of WGS 84, and standard"
            f" deviations above 0; found {'; '.join(f'{count} rows: {why}' for why, count in invalid.items())}"
        )
    return near[valid], invalid


def parse_numbers(
    content: bytes,
    columns: tuple[str, ...],
    where: str,
    longest_step_s: float,
    more: tuple[str, ...] = (),
    epoch_ns: int = 0,
    told: list[str] | None = None,
) -> Array:
    """The named columns of a CSV file, whatever their order, (n, c), then those of `more`; the first is a stamp, s.

    A cell without a value is NaN, and so is a column of `more` that is not there. Raises MeasurementError, and adds to
    what is `told`, as `parse_columns` does; also raises it for stamps in another unit.
    """
    types = dict.fromkeys(columns, "float64")
    table = parse_columns(content, types, where, epoch_ns, more, longest_step_s, told)
    rows = np.full((table.num_rows, len(columns) + len(more)), np.nan)
    for k, name in enumerate([*columns, *more]):
        if name in table.column_names:
            rows[:, k] = table[name].to_numpy()
    if fault := unit_fault(rows[:, 0], longest_step_s):
        raise MeasurementError(f"{where}: {fault}; the column may be named so: stamp_ms, stamp_us, stamp_ns")
    return rows


def parse_columns(
    content: bytes,
    types: Mapping[str, str],
    where: str,
    epoch_ns: int = 0,
    more: tuple[str, ...] = (),
    longest_step_s: float = np.inf,
    told: list[str] | None = None,
) -> Table:
    """The named columns of a CSV file, each with its Arrow type; a damaged row has none of the damaged values.

    Columns of `more` are numbers that may be missing. Stamps that are dates count from `epoch_ns`, Unix ns; where no
    unit is told, it is one in which their usual step is at most `longest_step_s`, and that is added to what is `told`.
    How the table may be written: `tables`. Raises MeasurementError for another table, and where most rows are damaged.
    """
    import pyarrow as pa

    expected = f"expected numbers in columns {','.join(types)}; a stamp is a number of seconds, or a date"
    also = ("date", "stamp_ns") if types.get(STAMP) == "float64" else ()
    try:
        layout = layout_of(content, types, more)
        found = {name: layout.column(name) for name in (*types, *more, *also)}
        if also and found[STAMP] is None:
            found[STAMP] = found["date"]
    except MeasurementError as error:
        raise MeasurementError(f"{where}: {error}; {expected}") from None
    if layout.header in ([], [""]):
        raise MeasurementError(f"{where}: empty; {expected}")
    if wrong := [name for name in types if found[name] is None]:
        raise MeasurementError(f"{where}: {layout.missing(wrong[0], types)}; {expected}")
    columns = {name: column for name, column in found.items() if column is not None}
    kinds = {name: types.get(name, "float64") for name in columns}
    if also and are_dates([layout.first(columns[STAMP].at)]):
        kinds[STAMP] = kinds["date"] = "string"
    if kinds.get("date") == "float64" or columns.get("date") == columns.get(STAMP):
        columns.pop("date", None)
    kinds = {name: kinds[name] for name in columns}
    try:
        table = _read(layout, columns, kinds)
    except (pa.ArrowException, ValueError, KeyError) as error:
        repaired = _without_damage(layout, columns, kinds)
        if repaired is None:
            raise MeasurementError(f"{where}: {' '.join(str(error).split())[:200]}; {expected}") from None
        table = repaired
    if table.num_rows == 0:
        raise MeasurementError(f"{where}: no rows; {expected}")
    are_gps = STAMP in columns and layout.is_of_gps_time(columns[STAMP].at)
    return _in_our_units(table, columns, kinds, epoch_ns, are_gps, longest_step_s, told)


def _in_our_units(
    table: Table, columns: Mapping[str, Column], kinds: Mapping[str, str], epoch_ns: int, are_gps: bool,
    longest_step_s: float, told: list[str] | None,
) -> Table:  # fmt: skip
    """The same table in SI units and degrees; stamps of several columns are one."""
    import pyarrow as pa

    for name, column in columns.items():
        if name == STAMP and kinds[name] == "string":
            texts = table[name].to_pylist()
            if "date" in columns:
                days = table["date"].to_pylist()
                texts = [f"{day} {text}" for day, text in zip(days, texts, strict=True)]
            values = seconds_of_dates(texts, epoch_ns, are_gps)
        elif kinds[name] == "string" or (name != STAMP and column.is_in_our_units):
            continue
        else:
            values = column.in_our_units(table[name].to_numpy().astype(np.float64))
            if name == STAMP and "stamp_ns" in columns and not (values % 1).any():
                values = values + table["stamp_ns"].to_numpy().astype(np.float64) * 1e-9
            elif name == STAMP and not column.unit:
                values = values * _scale_of(values, longest_step_s, told)
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    return table


def _scale_of(stamps: Array, longest_step_s: float, told: list[str] | None) -> float:
    """What stamps (n,) of an unknown unit are multiplied by to be seconds; 1 for numbers of rows."""
    scale = unix_scale(stamps)
    if scale != 1.0 or len(stamps) < 2 or np.nanmedian(np.diff(stamps)) == 1.0:
        return scale
    fitting = unit_of_steps(stamps, longest_step_s)
    if fitting is not None and told is not None:
        told.append(
            f"stamps without a unit: taken as {fitting} by their steps; stamp_ms, stamp_us, stamp_ns say it"
        )
    return scale if fitting is None else UNITS[fitting]


def _read(
    layout: Layout,
    columns: Mapping[str, Column],
    types: Mapping[str, str],
    if_invalid: Callable[[InvalidRow], str] | None = None,
    encoding: str = "utf8",
) -> Table:
    """The columns in `types` of a table; raises what pyarrow does."""
    import pyarrow as pa
    from pyarrow import csv

    names = [f"column {k}" for k in range(len(layout.header))]
    table = csv.read_csv(
        pa.BufferReader(pa.py_buffer(layout.rows)),
        # with several threads an error does not tell its row
        read_options=csv.ReadOptions(column_names=names, skip_rows=1, use_threads=False, encoding=encoding),
        parse_options=csv.ParseOptions(delimiter=layout.separator, invalid_row_handler=if_invalid),
        convert_options=csv.ConvertOptions(
            include_columns=list(dict.fromkeys(names[columns[name].at] for name in types)),
            column_types={names[columns[name].at]: pa.type_for_alias(kind) for name, kind in types.items()},
            strings_can_be_null=True,
            decimal_point=layout.decimal,
        ),
    )
    # one column may have two names: the horizontal accuracy
    return table.select([names[columns[name].at] for name in types]).rename_columns(list(types))


def _without_damage(layout: Layout, columns: Mapping[str, Column], types: Mapping[str, str]) -> Table | None:
    """The table without what is damaged in it; None where most rows are damaged: it is another kind of table.

    A row with too many or too few cells becomes a row without values, and a cell that is no number is without a value:
    so both are dropped and counted as such. That takes longer than to read an intact file.
    """
    import pyarrow as pa
    from pyarrow import compute

    invalid: list[tuple[int, int]] = []

    def leave_out(row: InvalidRow) -> str:
        invalid.append((row.number, row.text.count("\n") + 1))  # a lost quote joins lines
        return "skip"

    try:  # as latin1 every byte is a character
        texts = _read(layout, columns, dict.fromkeys(types, "string"), leave_out, "latin1")
    except (pa.ArrowException, ValueError, KeyError):
        return None
    damaged, values = np.zeros(texts.num_rows, np.bool_), {}
    for name, kind in types.items():
        values[name] = texts[name]
        if kind != "string":
            cells = compute.utf8_trim_whitespace(texts[name])
            if layout.decimal == ",":
                cells = compute.replace_substring(cells, ",", ".")
            is_number = compute.match_substring_regex(cells, NUMBER)
            damaged |= compute.invert(is_number).fill_null(False).to_numpy()
            values[name] = compute.if_else(is_number, cells, None).cast(kind)
    first, lines = np.array(invalid, dtype=np.int64).reshape(-1, 2).T
    if damaged.sum() + lines.sum() > MOST_DAMAGED * (texts.num_rows + lines.sum()):
        return None
    places = np.repeat(first - FIRST_ROW - np.arange(len(first)), lines)
    rows = np.insert(np.arange(texts.num_rows), places, -1)
    return pa.table(values).take(pa.array(rows, mask=rows < 0))


def _numbers(
    path: Path, columns: tuple[str, ...], longest_step_s: float, more: tuple[str, ...] = ()
) -> tuple[Array, list[str]]:
    """The rows of a file, and what is to be told of its stamps."""
    told: list[str] = []
    content = _content(path, f"a table with columns {','.join(columns)}")
    return parse_numbers(content, columns, str(path), longest_step_s, more, told=told), told

"""What moved, for everybody's own tools: a row per object in a GeoParquet file, and the same as GeoJSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.dynamics.movers import Mover
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.dates import date_of
from gnss_sem_map.export.geoparquet import write_shapes
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.longitudes import DEGREE_DIGITS, box_around, line_through
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.files.untrusted import is_file, shown

PARQUET, GEOJSON = "objects.parquet", "objects.geojson"
DIGITS = 3
TRACK = {
    "stamp_s": pa.float64(),
    "east_m": pa.float64(),
    "north_m": pa.float64(),
    "up_m": pa.float64(),
    "stddev_east_m": pa.float64(),
    "stddev_north_m": pa.float64(),
    "speed_mps": pa.float64(),
    "speed_stddev_mps": pa.float64(),
    "heading_deg": pa.float64(),
}
"""Fields of a place of a track, in the frame of the map."""
ENDS, AXES = ("start", "end"), ("easting_m", "northing_m", "lat_deg", "lon_deg", "alt_m")
COLUMNS = {
    "id": pa.int32(), "drive": pa.string(), "lidar": pa.string(), "class": pa.string(), "class_from": pa.string(),
    "labelled": pa.float64(), "motion": pa.string(), "probability": pa.float64(), "evidence": pa.string(),
    "points": pa.int64(), "scans": pa.int32(),
    "first_time": pa.timestamp("us", "UTC"), "last_time": pa.timestamp("us", "UTC"),
    "first_stamp_s": pa.float64(), "last_stamp_s": pa.float64(),
    "length_m": pa.float64(), "width_m": pa.float64(), "height_m": pa.float64(),
    "way_m": pa.float64(), "speed_mps": pa.float64(), "speed_stddev_mps": pa.float64(),
    "highest_speed_mps": pa.float64(), "heading_deg": pa.float64(),
    "utm_epsg": pa.int32(),
    **{f"{end}_{axis}": pa.float64() for end in ENDS for axis in AXES},
    "track": pa.list_(pa.struct(TRACK)),
    "geometry": pa.binary(),
}  # fmt: skip
"""Columns of the table: a row per mover."""


@dataclass(frozen=True, eq=False)
class DriveOfMovers:
    """What the files say of the drive in which something moved."""

    name: str
    epoch_ns: int
    frame: LocalFrame | None
    """None: the map is in the drive's own poses, and so are the objects."""


def write_movers(movers: Sequence[Mover], drive: DriveOfMovers, folder: Path) -> None:
    """Write `objects.parquet` (GeoParquet 1.1) and, where the map is georeferenced, `objects.geojson` (RFC 7946).

    Geometry is the track, WGS 84 with heights above the ellipsoid, cut at the 180 degree meridian; without a
    georeference it is in the frame of the map, and the CRS is null. Raises DataError when a file cannot be written.
    """
    rows = [_row(number, mover, drive) for number, mover in enumerate(movers, 1)]
    _write(pa.Table.from_pylist(rows, pa.schema(COLUMNS)), drive.frame is not None, folder)


def join_movers(parts: Sequence[Path], folder: Path) -> None:
    """Write the movers of several drives, which are in the folders `parts`, as those of one map; raises DataError."""
    tables = [_read(part / PARQUET) for part in parts if is_file(part / PARQUET)]
    if tables:
        _write(pa.concat_tables(tables), True, folder)


def read_movers(folder: Path) -> list[dict[str, Any]]:
    """The rows of `objects.parquet` in a run folder; none where it has no such file. Raises DataError."""
    return list(_read(folder / PARQUET).to_pylist()) if is_file(folder / PARQUET) else []


def _read(path: Path) -> pa.Table:
    try:
        table = pq.read_table(path, memory_map=False)
    except (OSError, pa.ArrowException) as error:
        raise DataError(f"{shown(path)}: cannot be read ({str(error)[:80]}); make the run again") from None
    if missing := set(COLUMNS) - set(table.column_names):
        raise DataError(f"{shown(path)}: found no column {min(missing)!r} in it; make the run again")
    return table.select(list(COLUMNS)).cast(pa.schema(COLUMNS))


def _row(number: int, mover: Mover, drive: DriveOfMovers) -> dict[str, Any]:
    """One mover as the table has it."""
    speed, stddev = mover.mean_speed
    times = [date_of(drive.epoch_ns, stamp) for stamp in mover.stamps[[0, -1]].tolist()]
    start, end = mover.positions[[0, -1]]
    length, width, height = mover.size_m
    heading = np.degrees(np.arctan2(*(end - start)[:2])) % 360
    return {
        "id": number, "drive": drive.name, "lidar": " ".join(mover.lidars), "class": mover.name,
        "class_from": "labels" if mover.is_labelled else "shape", "labelled": round(mover.labelled, DIGITS),
        "motion": str(mover.motion), "probability": round(mover.probability, DIGITS), "evidence": mover.evidence,
        "points": mover.points, "scans": len(mover.stamps),
        "first_time": times[0], "last_time": times[1],
        "first_stamp_s": round(float(mover.stamps[0]), 6), "last_stamp_s": round(float(mover.stamps[-1]), 6),
        "length_m": round(length, DIGITS), "width_m": round(width, DIGITS), "height_m": round(height, DIGITS),
        "way_m": round(mover.way_m, DIGITS),
        "speed_mps": round(speed, DIGITS), "speed_stddev_mps": round(stddev, DIGITS),
        "highest_speed_mps": round(float(mover.speeds.max()), DIGITS), "heading_deg": round(float(heading), 1),
        "track": _track(mover), **_places(mover, drive.frame),
    }  # fmt: skip


def _track(mover: Mover) -> list[dict[str, float]]:
    values = np.column_stack([
        mover.stamps.round(6), mover.positions.round(DIGITS), mover.position_stddevs.round(DIGITS),
        mover.speeds.round(DIGITS), mover.speed_stddevs.round(DIGITS), mover.headings_deg.round(1),
    ])  # fmt: skip
    return [dict(zip(TRACK, row, strict=True)) for row in values.tolist()]


def _places(mover: Mover, frame: LocalFrame | None) -> dict[str, Any]:
    """The track as a line, and its ends in degrees and metres."""
    if frame is None:
        return {"geometry": shapely.to_wkb(shapely.LineString(mover.positions.round(DIGITS)), byte_order=1)}
    lat_deg, lon_deg, alt_m = frame.to_geodetic(mover.positions)
    line = line_through(lon_deg, lat_deg, alt_m)
    lat_deg, lon_deg, alt_m = lat_deg.round(DEGREE_DIGITS), lon_deg.round(DEGREE_DIGITS), alt_m.round(DIGITS)
    places: dict[str, Any] = {"geometry": shapely.to_wkb(line, byte_order=1), "utm_epsg": frame.utm_epsg}
    utm = Georeference(frame).from_map(mover.positions[[0, -1]]).round(DIGITS)
    for end, row, at in (("start", 0, utm[0]), ("end", -1, utm[1])):
        places |= {
            f"{end}_easting_m": at[0], f"{end}_northing_m": at[1],
            f"{end}_lat_deg": lat_deg[row], f"{end}_lon_deg": lon_deg[row], f"{end}_alt_m": alt_m[row],
        }  # fmt: skip
    return places


def _write(table: pa.Table, is_georeferenced: bool, folder: Path) -> None:
    shapes = shapely.from_wkb(table["geometry"].to_pylist())
    types = {f"{shape.geom_type} Z" for shape in shapes}
    bbox: list[float] = []
    if len(table):
        at = shapely.get_coordinates(shapes, include_z=True)
        flat = [*at.min(axis=0).tolist(), *at.max(axis=0).tolist()]
        bbox = box_around(at) if is_georeferenced else flat
    write_shapes(table, types, bbox, is_georeferenced, folder / PARQUET)
    if is_georeferenced:
        rows = table.drop_columns(["geometry"]).to_pylist()
        features = [_feature(*pair) for pair in zip(rows, shapes, strict=True)]
        with replacing(folder / GEOJSON) as file:
            file.write(json.dumps({"type": "FeatureCollection", "features": features}).encode())


def _feature(row: Mapping[str, Any], line: shapely.Geometry) -> dict[str, Any]:
    """A row as GeoJSON has it: the track as a line, its times and speeds as lists beside it."""
    track = row["track"]
    properties = {name: _plain(value) for name, value in row.items() if name != "track"}
    properties |= {f"track_{name}": [_plain(place[name]) for place in track] for name in TRACK}
    return {"type": "Feature", "geometry": line.__geo_interface__, "properties": properties}


def _plain(value: Any) -> Any:
    """A moment as text; all else as it is."""
    return value.isoformat() if isinstance(value, datetime) else value

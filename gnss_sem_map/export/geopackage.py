"""The map as vectors: a GeoPackage of areas, lines and outlines. Source: OGC 12-128r18 (GeoPackage 1.3).

It is written with sqlite3 alone: GDAL would write the time into the file, so that the same map gave other bytes.
"""

from __future__ import annotations

import errno
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import shapely
from pyproj import CRS

from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.georeference import WGS84_EPSG, Georeference
from gnss_sem_map.export.vectors import LAYERS, features_of
from gnss_sem_map.files.atomic import replacing

APPLICATION_ID, VERSION = 0x47504B47, 10300
"""`GPKG`, and 1.3."""
NO_TIME = "1970-01-01T00:00:00.000Z"
SYSTEMS = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
 organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
 description TEXT DEFAULT '', last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
 srs_id INTEGER, CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
 geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
 CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),
 CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
 CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id))
"""


def write_geopackage(exported: Exported, path: Path | str) -> None:
    """Write the layers of `vectors.LAYERS` as a GeoPackage in the CRS of the delivery.

    Raises DataError for a map without a georeference, and when the file cannot be written.
    """
    import rasterio

    georeference = exported.georeference_for("a GeoPackage")
    # every function of rasterio would make an environment of its own
    with replacing(path) as file, _new_database(file.name) as database, rasterio.Env():
        _describe(database, georeference)
        boxes: dict[str, tuple[float, ...]] = {}
        for feature in features_of(exported.map, georeference):
            box = feature.geometry.bounds
            low, high = boxes.get(feature.layer, box)[:2], boxes.get(feature.layer, box)[2:]
            boxes[feature.layer] = (*np.minimum(low, box[:2]).tolist(), *np.maximum(high, box[2:]).tolist())
            places = ", ".join("?" * (2 + len(feature.values)))
            row = (None, _blob(feature.geometry, georeference.horizontal_epsg), *feature.values)
            database.execute(f"INSERT INTO {feature.layer} VALUES ({places})", row)
        for name, box in boxes.items():
            database.execute(
                "UPDATE gpkg_contents SET min_x=?, min_y=?, max_x=?, max_y=? WHERE table_name=?", (*box, name)
            )


@contextmanager
def _new_database(name: str) -> Iterator[sqlite3.Connection]:
    """A database in an empty file, written in one transaction; raises OSError when there is no room."""
    try:
        with closing(sqlite3.connect(name, isolation_level=None)) as database:
            database.execute("PRAGMA journal_mode=OFF")  # what is not finished is removed
            database.execute("PRAGMA synchronous=OFF")  # `replacing` does that
            database.execute(f"PRAGMA application_id={APPLICATION_ID}")
            database.execute(f"PRAGMA user_version={VERSION}")
            database.execute("BEGIN")
            yield database
            database.execute("COMMIT")
    except sqlite3.OperationalError as error:
        is_full = error.sqlite_errorcode & 0xFF in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR)
        raise OSError(errno.ENOSPC if is_full else errno.EIO, str(error)) from None


def _describe(database: sqlite3.Connection, georeference: Georeference) -> None:
    """The tables of the standard, and an empty one for every layer."""
    for statement in SYSTEMS.split(";"):
        database.execute(statement)
    rows = [
        ("undefined Cartesian", -1, "NONE", -1, "undefined"),
        ("undefined geographic", 0, "NONE", 0, "undefined"),
    ]
    epsg = georeference.horizontal_epsg
    for code in (WGS84_EPSG, epsg):
        crs = CRS.from_epsg(code)
        rows.append((crs.name, code, "EPSG", code, crs.to_wkt("WKT1_GDAL")))
    database.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)", rows)
    for layer in LAYERS:
        columns = ", ".join(f"{name} DOUBLE" for name in layer.columns)
        database.execute(
            f"CREATE TABLE {layer.name} (fid INTEGER PRIMARY KEY NOT NULL, geom {layer.kind}, {columns})"
        )
        about = f"{layer.what}; {georeference.words}"
        database.execute(
            "INSERT INTO gpkg_contents VALUES (?, 'features', ?, ?, ?, NULL, NULL, NULL, NULL, ?)",
            (layer.name, layer.name, about, NO_TIME, epsg),
        )
        database.execute(
            "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)", (layer.name, layer.kind, epsg)
        )


def _blob(geometry: shapely.Geometry, epsg: int) -> bytes:
    """A geometry as the standard stores it: header, flags (little endian, with an envelope), CRS, envelope, WKB."""
    west, south, east, north = geometry.bounds
    head = struct.pack("<2sBBi4d", b"GP", 0, 0b00000011, epsg, west, east, south, north)
    return head + bytes(shapely.to_wkb(geometry, byte_order=1))

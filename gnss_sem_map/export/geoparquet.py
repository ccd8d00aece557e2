"""GeoParquet 1.1: a table with a column of shapes as WKB, and what these are, in the metadata of its schema."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pyproj import CRS

from gnss_sem_map.files.atomic import replacing

if TYPE_CHECKING:
    import pyarrow as pa

GEOMETRY = "geometry"
"""Column of the shapes."""
WGS84_3D_EPSG = 4979


def write_shapes(
    table: pa.Table, types: Iterable[str], bbox: Sequence[float], is_georeferenced: bool, path: Path | str
) -> None:
    """Write a table, the `types` of its shapes and the box around them (empty: there are none); raises DataError.

    The CRS is WGS 84 with heights above the ellipsoid, or null where the shapes are not on the Earth.
    """
    import pyarrow.parquet as pq

    about: dict[str, Any] = {"encoding": "WKB", "geometry_types": sorted(types)}
    about["crs"] = CRS.from_epsg(WGS84_3D_EPSG).to_json_dict() if is_georeferenced else None
    if bbox:
        about["bbox"] = list(bbox)
    geo = {"version": "1.1.0", "primary_column": GEOMETRY, "columns": {GEOMETRY: about}}
    with replacing(path) as file:
        pq.write_table(table.replace_schema_metadata({"geo": json.dumps(geo)}), file, compression="zstd")

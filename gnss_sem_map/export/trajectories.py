"""The trajectory for evo (TUM, KITTI) and for maps in the browser and in QGIS (GeoJSON, GeoParquet)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from factor_graphs import tum
from factor_graphs.geodesy import LocalFrame
from factor_graphs.heading import stddevs_of_heading
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.export.dates import are_dates
from gnss_sem_map.export.geoparquet import GEOMETRY, write_shapes
from gnss_sem_map.export.longitudes import box_around, line_through
from gnss_sem_map.export.navigation import fixes_along
from gnss_sem_map.files.atomic import replacing

Array = NDArray[np.float64]


def write_tum(trajectory: Trajectory, path: Path | str) -> None:
    """Write the poses as `factor_graphs.tum` does. Raises DataError when the file cannot be written."""
    with replacing(path) as file:
        tum.write_tum(trajectory, file)


def write_covariance_tum(trajectory: Trajectory, path: Path | str) -> None:
    """Write poses and covariances as `factor_graphs.tum` does.

    Raises MeasurementError without covariances, DataError when the file cannot be written.
    """
    with replacing(path) as file:
        tum.write_covariance_tum(trajectory, file)


def write_kitti(trajectory: Trajectory, path: Path | str) -> None:
    """Write the upper three rows of T_map_imu, 12 numbers per line; KITTI's format holds no stamps.

    Raises DataError when the file cannot be written.
    """
    with replacing(path) as file:
        np.savetxt(file, trajectory.T_map_imu[:, :3].reshape(-1, 12), fmt="%.12g")


def write_geojson(trajectory: Trajectory, frame: LocalFrame, path: Path | str) -> None:
    """Write the track as a GeoJSON feature (RFC 7946): lon, lat, height above the ellipsoid, and the stamps.

    A trajectory of one pose becomes a point. The ends where a line is cut at the 180 degree
    meridian are no poses, and have no stamps. Raises DataError when the file cannot be written.
    """
    lat_deg, lon_deg, alt_m = frame.to_geodetic(trajectory.positions)
    feature = {
        "type": "Feature",
        "geometry": line_through(lon_deg, lat_deg, alt_m).__geo_interface__,
        "properties": {"name": "trajectory", "stamps_s": trajectory.stamps.round(9).tolist()},
    }
    with replacing(path) as file:
        file.write(json.dumps({"type": "FeatureCollection", "features": [feature]}).encode())


def write_geoparquet(
    trajectory: Trajectory,
    frame: LocalFrame,
    epoch_ns: int,
    path: Path | str,
    fix_stamps: Array | None = None,
    rejected: NDArray[np.bool_] | None = None,
) -> None:
    """Write a point per pose as GeoParquet 1.1: WGS 84 (EPSG:4979), heights above the ellipsoid.

    Columns: `time` (UTC; null where the log has no date), `stamp_s`, `heading_deg` from north over east, `speed_mps`
    where velocities are known, `stddev_east_m`, `stddev_north_m`, `stddev_up_m`, `stddev_heading_deg` where covariances
    are, the columns of `navigation.fixes_along` where fixes are, and `geometry` (WKB). Raises DataError when the
    file cannot be written.
    """
    import pyarrow as pa

    lat_deg, lon_deg, alt_m = frame.to_geodetic(trajectory.positions)
    places = np.column_stack([lon_deg, lat_deg, alt_m])
    forward = trajectory.T_map_imu[:, :2, 0]
    times = epoch_ns + np.round(1e9 * trajectory.stamps).astype(np.int64)
    columns = {
        "time": pa.array(times, pa.timestamp("ns", "UTC"), mask=~are_dates(times)),
        "stamp_s": trajectory.stamps,
        "heading_deg": np.degrees(np.arctan2(*forward.T)) % 360,
    }
    if trajectory.velocities is not None:
        columns["speed_mps"] = np.linalg.norm(trajectory.velocities, axis=1)
    if trajectory.covariances is not None:
        names = (f"stddev_{axis}_m" for axis in ("east", "north", "up"))
        columns |= dict(zip(names, trajectory.position_stddevs.T, strict=True))
        of_heading = stddevs_of_heading(trajectory.T_map_imu[:, :3, :3], trajectory.covariances)
        columns["stddev_heading_deg"] = np.degrees(of_heading)
    if fix_stamps is not None:
        columns |= fixes_along(trajectory.stamps, fix_stamps, rejected)
    columns[GEOMETRY] = pa.array(shapely.to_wkb(shapely.points(places), byte_order=1).tolist(), pa.binary())
    write_shapes(pa.table(columns), ["Point Z"], box_around(places), True, path)

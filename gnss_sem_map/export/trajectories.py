"""The trajectory for evo (TUM, KITTI) and for maps in the browser and in QGIS (GeoJSON)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from factor_graphs import tum
from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.files.atomic import replacing

DEGREE_DIGITS = 9  # 0.1 mm of latitude


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

    A trajectory of one pose becomes a point, as a line needs two. Raises DataError when the file cannot be
    written.
    """
    lat_deg, lon_deg, alt_m = frame.to_geodetic(trajectory.positions)
    degrees = np.column_stack([lon_deg, lat_deg]).round(DEGREE_DIGITS).tolist()
    coordinates = [[*lon_lat, alt] for lon_lat, alt in zip(degrees, alt_m.round(3).tolist(), strict=True)]
    if len(coordinates) > 1:
        geometry = {"type": "LineString", "coordinates": coordinates}
    else:
        geometry = {"type": "Point", "coordinates": coordinates[0]}
    feature = {
        "type": "Feature",
        "geometry": geometry,
        "properties": {"name": "trajectory", "stamps_s": trajectory.stamps.round(9).tolist()},
    }
    with replacing(path) as file:
        file.write(json.dumps({"type": "FeatureCollection", "features": [feature]}).encode())

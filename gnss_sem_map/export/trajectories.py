"""The trajectory for evo (TUM, KITTI) and for maps in the browser and in QGIS (GeoJSON)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.files.atomic import replacing

TUM_FORMAT = ["%.9f", *["%.6f"] * 3, *["%.12f"] * 4]
DEGREE_DIGITS = 9  # 0.1 mm of latitude


def write_tum(trajectory: Trajectory, path: Path | str) -> None:
    """Write `stamp tx ty tz qx qy qz qw` of T_map_imu, one pose per line, stamps in seconds of the log.

    Stamps keep the nanosecond, positions the micrometre. Raises DataError when the file cannot be written.
    """
    with replacing(path) as file:
        np.savetxt(file, _tum_rows(trajectory), fmt=TUM_FORMAT)


def _tum_rows(trajectory: Trajectory) -> NDArray[np.float64]:
    quat_xyzw = Rotation.from_matrix(trajectory.T_map_imu[:, :3, :3]).as_quat(canonical=True)
    return np.column_stack([trajectory.stamps, trajectory.positions, quat_xyzw])


def write_covariance_tum(trajectory: Trajectory, path: Path | str) -> None:
    """Write every pose as `write_tum` does, then its covariance: 29 numbers per line, the "wide TUM" of smfeval.

    The last 21 are the lower triangle, row by row, of the covariance (6, 6) of the tangent (translation m, rotation
    rad, in the axes of the imu) with T_true = T Exp(tangent). Raises MeasurementError without covariances, DataError
    when the file cannot be written.
    """
    if trajectory.covariances is None:
        raise MeasurementError("the trajectory has no covariances: write it with write_tum")
    order = [3, 4, 5, 0, 1, 2]  # the trajectory has rotations first
    rows, columns = np.tril_indices(6)
    lower = trajectory.covariances[:, order][:, :, order][:, rows, columns]
    with replacing(path) as file:
        np.savetxt(file, np.hstack([_tum_rows(trajectory), lower]), fmt=[*TUM_FORMAT, *["%.8g"] * 21])


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

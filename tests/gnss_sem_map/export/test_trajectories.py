"""Trajectory files as evo and json read them."""

import json
import warnings
from pathlib import Path

import numpy as np
from pyproj import Geod

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.export.trajectories import write_geojson, write_kitti, write_tum

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # evo's imports warn, not we
    from evo.tools import file_interface


def test_evo_reads_the_tum_file_back(track: Trajectory, tmp_path: Path) -> None:
    write_tum(track, tmp_path / "trajectory.tum")
    read = file_interface.read_tum_trajectory_file(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(read.timestamps, track.stamps, atol=1e-9)
    np.testing.assert_allclose(np.array(read.poses_se3), track.T_map_imu, atol=1e-6)


def test_evo_reads_the_kitti_file_back(track: Trajectory, tmp_path: Path) -> None:
    write_kitti(track, tmp_path / "trajectory_kitti.txt")
    read = file_interface.read_kitti_poses_file(tmp_path / "trajectory_kitti.txt")
    np.testing.assert_allclose(np.array(read.poses_se3), track.T_map_imu, atol=1e-9)


def test_the_geojson_track_lies_where_the_geodesic_says(
    track: Trajectory, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    write_geojson(track, karlsruhe, tmp_path / "trajectory.geojson")
    (feature,) = json.loads((tmp_path / "trajectory.geojson").read_text())["features"]
    lon, lat, alt = np.array(feature["geometry"]["coordinates"]).T
    assert feature["geometry"]["type"] == "LineString"
    np.testing.assert_allclose(feature["properties"]["stamps_s"], track.stamps, atol=1e-9)
    azimuth, _, distance = Geod(ellps="WGS84").inv(np.full(40, 8.4), np.full(40, 49.0), lon, lat)
    east, north, up = track.positions.T
    on_ellipsoid = 1 - 115.0 / 6_371_000
    np.testing.assert_allclose(distance * np.sin(np.radians(azimuth)), on_ellipsoid * east, atol=2e-3)
    np.testing.assert_allclose(distance * np.cos(np.radians(azimuth)), on_ellipsoid * north, atol=2e-3)
    np.testing.assert_allclose(alt, 115.0 + up, atol=2e-3)


def test_one_pose_is_a_point(karlsruhe: LocalFrame, tmp_path: Path) -> None:
    write_geojson(Trajectory(np.zeros(1), np.eye(4)[None]), karlsruhe, tmp_path / "trajectory.geojson")
    (feature,) = json.loads((tmp_path / "trajectory.geojson").read_text())["features"]
    assert feature["geometry"] == {"type": "Point", "coordinates": [8.4, 49.0, 115.0]}

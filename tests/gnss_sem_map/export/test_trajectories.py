"""Trajectory files as evo and json read them."""

import json
import warnings
from itertools import pairwise
from pathlib import Path

import geopandas
import numpy as np
import pyarrow.parquet as pq
import pytest
from pyproj import Geod
from scipy.spatial.transform import Rotation
from smfeval.cli.main import main as smfeval
from smfeval.io.load import load_estimate

from factor_graphs.accuracy import coverage, pose_nees
from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.export.trajectories import (
    write_covariance_tum,
    write_geojson,
    write_geoparquet,
    write_kitti,
    write_tum,
)

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # evo's imports warn, not we
    from evo.tools import file_interface


@pytest.fixture
def uncertain(track: Trajectory) -> Trajectory:
    """The track with covariances like those of a drive: no axis like another, and no block without correlation."""
    root = np.random.default_rng(3).standard_normal((len(track), 6, 6)) * [
        [1e-3],
        [2e-3],
        [4e-3],
        [0.1],
        [0.3],
        [0.6],
    ]
    return Trajectory(track.stamps, track.T_map_imu, covariances=root @ np.swapaxes(root, 1, 2))


def test_evo_reads_the_tum_file_back(track: Trajectory, tmp_path: Path) -> None:
    write_tum(track, tmp_path / "trajectory.tum")
    read = file_interface.read_tum_trajectory_file(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(read.timestamps, track.stamps, atol=1e-9)
    np.testing.assert_allclose(np.array(read.poses_se3), track.T_map_imu, atol=1e-6)


def test_smfeval_reads_the_covariances_back(uncertain: Trajectory, tmp_path: Path) -> None:
    write_covariance_tum(uncertain, tmp_path / "trajectory_covariance.tum")
    header, steps = load_estimate(tmp_path / "trajectory_covariance.tum", body_frame="imu")
    assert (header.tangent_order.value, header.tangent_convention.value) == (
        "translation_rotation",
        "right_perturbation",
    )
    np.testing.assert_allclose([step.timestamp for step in steps], uncertain.stamps, atol=1e-9)
    np.testing.assert_allclose([step.translation for step in steps], uncertain.positions, atol=1e-6)
    swapped = np.roll(np.roll([step.covariance for step in steps], 3, axis=1), 3, axis=2)
    np.testing.assert_allclose(swapped, uncertain.covariances, rtol=1e-7)


def test_smfeval_finds_the_coverage_that_we_find(
    uncertain: Trajectory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert uncertain.covariances is not None
    roots = np.linalg.cholesky(1.5 * uncertain.covariances)
    tangent = (roots @ np.random.default_rng(5).standard_normal((len(uncertain), 6, 1)))[:, :, 0]
    off = np.tile(np.eye(4), (len(uncertain), 1, 1))
    off[:, :3, :3], off[:, :3, 3] = Rotation.from_rotvec(tangent[:, :3]).as_matrix(), tangent[:, 3:]
    truth = Trajectory(uncertain.stamps, uncertain.T_map_imu @ off)
    write_covariance_tum(uncertain, tmp_path / "estimate.tum")
    write_tum(truth, tmp_path / "truth.tum")
    files = [str(tmp_path / name) for name in ("estimate.tum", "truth.tum")]
    smfeval(["nees", *files, "--est-body-frame=imu", "--ref-body-frame=imu", "--align=none", "--json"])
    theirs = json.loads(capsys.readouterr().out)
    ours = coverage(pose_nees(uncertain, truth).position, 3)
    assert ours.scale_gap == pytest.approx(theirs["k"], rel=0.02)  # they take the logarithm of the pose
    assert ours.inside[1] == pytest.approx(theirs["coverage"], abs=1.5 / len(uncertain))  # one on the edge


def test_a_trajectory_without_covariances_is_refused(track: Trajectory, tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match="no covariances"):
        write_covariance_tum(
            Trajectory(track.stamps, track.T_map_imu), tmp_path / "trajectory_covariance.tum"
        )
    assert not list(tmp_path.iterdir())


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


def test_geopandas_reads_the_geoparquet_back(
    uncertain: Trajectory, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    epoch_ns = 1_317_000_000_000_000_000
    write_geoparquet(uncertain, karlsruhe, epoch_ns, tmp_path / "trajectory_wgs84.parquet")
    table = geopandas.read_parquet(tmp_path / "trajectory_wgs84.parquet")
    assert table.crs.to_epsg() == 4979
    lat_deg, lon_deg, alt_m = karlsruhe.to_geodetic(uncertain.positions)
    points = table.geometry
    np.testing.assert_allclose(
        np.column_stack([points.x, points.y, points.z]), np.column_stack([lon_deg, lat_deg, alt_m])
    )
    assert str(table["time"].dt.tz) == "UTC"
    seconds = (table["time"].astype("int64") - epoch_ns) / 1e9
    np.testing.assert_allclose(seconds, uncertain.stamps, atol=1e-6)
    np.testing.assert_allclose(table["stddev_up_m"], uncertain.position_stddevs[:, 2])
    east = np.arctan2(*uncertain.T_map_imu[:, :2, 0].T)
    np.testing.assert_allclose(np.sin(np.radians(table["heading_deg"])), np.sin(east), atol=1e-9)


def test_the_geoparquet_tells_heading_and_fixes_along_the_track(
    uncertain: Trajectory, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    """The deviation of the heading is that of turns that are drawn; every fix within is counted once."""
    rng, span = np.random.default_rng(8), uncertain.end - uncertain.start
    fixes = np.sort(rng.uniform(uncertain.start - 1, uncertain.end, 30))
    rejected = rng.random(30) < 0.3
    write_geoparquet(uncertain, karlsruhe, 0, tmp_path / "track.parquet", fixes, rejected)
    table = geopandas.read_parquet(tmp_path / "track.parquet")
    inside = fixes >= uncertain.start
    assert (table["fixes"].sum(), table["fixes_rejected"].sum()) == (inside.sum(), (inside & rejected).sum())
    nearest = np.abs(uncertain.stamps[:, None] - fixes[~rejected]).min(axis=1)
    np.testing.assert_allclose(table["nearest_fix_s"], nearest)
    assert nearest.max() > span / 100
    assert uncertain.covariances is not None
    turns = rng.multivariate_normal(np.zeros(3), uncertain.covariances[5, :3, :3], 100_000)
    about_up = turns @ uncertain.T_map_imu[5, 2, :3]
    assert table["stddev_heading_deg"][5] == pytest.approx(np.degrees(about_up.std()), rel=0.02)


def test_a_log_without_a_date_has_no_times(
    uncertain: Trajectory, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    write_geoparquet(uncertain, karlsruhe, 0, tmp_path / "track.parquet")
    assert geopandas.read_parquet(tmp_path / "track.parquet")["time"].isna().all()


def test_a_track_across_the_180_degree_meridian_is_cut_there(track: Trajectory, tmp_path: Path) -> None:
    """As RFC 7946 asks, sections 3.1.9 and 5.2: else it is a line around the Earth."""
    middle = track.positions[len(track) // 2]
    fiji = LocalFrame(-17.0, 180.0 - middle[0] / 106_000, 100.0)
    write_geojson(track, fiji, tmp_path / "trajectory.geojson")
    (feature,) = json.loads((tmp_path / "trajectory.geojson").read_text())["features"]
    assert feature["geometry"]["type"] == "MultiLineString"
    lines = [np.array(line) for line in feature["geometry"]["coordinates"]]
    assert len(lines) > 1
    for line in lines:
        assert np.ptp(line[:, 0]) < 0.1
    for before, after in pairwise(lines):
        assert (before[-1, 0], before[-1, 1:].tolist()) == (-after[0, 0], after[0, 1:].tolist())
        assert abs(before[-1, 0]) == 180
        neighbours = np.sort([before[-2, 1:], after[1, 1:]], axis=0)
        np.testing.assert_array_equal(before[-1, 1:].clip(*neighbours), before[-1, 1:])
    cuts = 2 * (len(lines) - 1)
    assert sum(map(len, lines)) - cuts == len(track) == len(feature["properties"]["stamps_s"])
    write_geoparquet(track, fiji, 0, tmp_path / "track.parquet")
    geo = json.loads(pq.read_schema(tmp_path / "track.parquet").metadata[b"geo"])
    west, _, _, east, _, _ = geo["columns"]["geometry"]["bbox"]
    assert 179.9 < west < 180
    assert -180 < east < -179.9

"""A georeferenced cloud that others wrote, in the frame of a map."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray
from pyproj import CRS, Geod, Transformer

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.datasets.laz_cloud import read_base
from gnss_sem_map.errors import DataError

FRAME = LocalFrame(49.011, 8.423, 112.0)
UTM = 32632


def write(path: Path, lon_lat_alt: NDArray[np.float64], epsg: int | None = UTM, withheld: int = 0) -> Path:
    """Points as a surveyor's LAZ; the last ones are withheld."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 1e-7 if epsg == 4979 else 1e-3)
    x, y, z = lon_lat_alt.T
    if epsg is not None:
        header.add_crs(CRS.from_epsg(epsg))
        x, y = Transformer.from_crs(4326, epsg, always_xy=True).transform(x, y)
    header.offsets = np.floor([x[0], y[0], z[0]])
    las = laspy.LasData(header)
    las.x, las.y, las.z = x, y, z
    flags = np.zeros(len(x), np.uint8)
    flags[len(x) - withheld :] = 1
    las.withheld = flags
    las.write(path)
    return path


def around(metres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Longitude, latitude and height of points so many metres east, north and up of the origin, along geodesics."""
    azimuth = np.degrees(np.arctan2(metres[:, 0], metres[:, 1]))
    distance = np.hypot(metres[:, 0], metres[:, 1])
    lon, lat, _ = Geod(ellps="WGS84").fwd(
        np.full(len(metres), FRAME.lon_deg), np.full(len(metres), FRAME.lat_deg), azimuth, distance
    )
    return np.column_stack([lon, lat, FRAME.alt_m + metres[:, 2]])


@pytest.mark.parametrize("epsg", [UTM, 3857, 4979])
def test_points_are_where_they_are_on_earth_in_any_coordinate_system(tmp_path: Path, epsg: int) -> None:
    metres = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 1.0], [7.0, -20.0, 2.0], [-15.0, 25.0, -1.0]])
    base = read_base(write(tmp_path / "base.laz", around(metres), epsg), FRAME)
    assert base.name == "base.laz"
    order = np.lexsort(base.points.T[::-1])
    assert np.abs(base.points[order] - metres[np.lexsort(metres.T[::-1])]).max() < 0.02


def test_cubes_become_their_mean_and_withheld_points_are_left_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    metres = np.concatenate([rng.uniform(0.05, 0.35, (1000, 3)), rng.uniform(10.05, 10.35, (50, 3))])
    points = read_base(write(tmp_path / "base.laz", around(metres), withheld=50), FRAME).points
    assert len(points) == 1
    assert np.abs(points[0] - 0.2).max() < 0.02


def test_a_cloud_is_seen_from_a_pose_in_its_axes(tmp_path: Path) -> None:
    metres = np.random.default_rng(1).uniform([-100, -5, 0], [100, 5, 3], (20000, 3))
    base = read_base(write(tmp_path / "base.laz", around(metres)), FRAME)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], [50.0, 0.0, 1.0]
    seen = np.asarray(base.around(T).points())[:, :3]
    assert np.linalg.norm(seen, axis=1).max() <= 60.0
    assert np.ptp(seen[:, 1]) > 100.0  # along the map's east is across the pose
    assert np.ptp(seen[:, 0]) < 11.0
    T[0, 3] = 500.0
    assert base.around(T).size() == 0


def test_what_is_no_base_is_refused_by_name(tmp_path: Path) -> None:
    metres = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    with pytest.raises(DataError, match=r"^\S*local\.laz: has no coordinate system; .* LAS or LAZ$"):
        read_base(write(tmp_path / "local.laz", around(metres), epsg=None), FRAME)
    with pytest.raises(DataError, match="found no point within 100 km"):
        read_base(write(tmp_path / "far.laz", around(metres)), LocalFrame(52.5, 13.4, 34.0))
    text = tmp_path / "text.laz"
    text.write_text("no cloud")
    for path in (text, tmp_path / "absent.laz"):
        with pytest.raises(DataError, match=f"{path.name}: cannot be read as LAS or LAZ"):
            read_base(path, FRAME)


@pytest.mark.parametrize("kept", [0.5, -20])
def test_a_truncated_file_is_refused(tmp_path: Path, kept: float) -> None:
    metres = np.random.default_rng(2).uniform(-50, 50, (100_000, 3))
    path = write(tmp_path / "base.laz", around(metres))
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content)) if kept > 0 else int(kept)])
    with pytest.raises(DataError, match=r"base\.laz: cannot be read as LAS or LAZ"):
        read_base(path, FRAME)


def test_heights_above_a_geoid_that_is_not_there_are_refused(tmp_path: Path) -> None:
    """PROJ alone would take them for ellipsoidal ones, and the cloud would stand 47 m too low."""
    write(tmp_path / "city.laz", around(np.array([[10.0, 5.0, 1.0]])), epsg=None)
    las = laspy.read(tmp_path / "city.laz")
    las.header.add_crs(CRS.from_user_input("EPSG:25832+5773"))
    las.write(tmp_path / "city.laz")
    with pytest.raises(
        DataError, match=r"^\S*city\.laz: its heights are those of EGM96 height, .* ellipsoid"
    ):
        read_base(tmp_path / "city.laz", FRAME)

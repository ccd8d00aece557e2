"""A georeferenced cloud that others wrote, in the frame of a map."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import GeoKeyDirectoryVlr
from numpy.typing import NDArray
from pyproj import CRS, Geod, Transformer
from surfaces import write_geoid

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


@pytest.mark.parametrize("epsg", [31467, 2056])
def test_heights_beside_two_axes_are_not_those_above_their_ellipsoid(tmp_path: Path, epsg: int) -> None:
    """Of Bessel, in Germany and Switzerland: its ellipsoid lies some 50 m off that of WGS 84."""
    metres = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 1.0], [7.0, -20.0, 2.0]])
    base = read_base(write(tmp_path / "base.laz", around(metres), epsg), FRAME)
    np.testing.assert_allclose(np.sort(base.points[:, 2]), [0, 1, 2], atol=0.01)


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
    with pytest.raises(DataError, match=r"^\S*local\.laz: has no coordinate system; .*pdal translate .*EPSG"):
        read_base(write(tmp_path / "local.laz", around(metres), epsg=None), FRAME)
    with pytest.raises(DataError, match="holds no points"):
        read_base(write(tmp_path / "empty.laz", around(metres[:1]), withheld=1), FRAME)
    with pytest.raises(DataError, match="found no point within 100 km"):
        read_base(write(tmp_path / "far.laz", around(metres)), LocalFrame(52.5, 13.4, 34.0))
    text = tmp_path / "text.laz"
    text.write_text("no cloud")
    with pytest.raises(DataError, match=r"text\.laz: cannot be read as LAS or LAZ"):
        read_base(text, FRAME)
    with pytest.raises(DataError, match=r"absent\.laz: cannot read it"):
        read_base(tmp_path / "absent.laz", FRAME)


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


FEET, SURVEY_FEET = 0.3048, 1200 / 3937
IN_TEXAS = LocalFrame(30.27, -97.74, 150.0)


def write_in(
    crs: CRS | None, place: NDArray[np.float64], path: Path, keys: dict[int, int] | None = None
) -> Path:
    """One point by coordinates of a file, with its CRS as WKT, or as GeoTIFF keys."""
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-4), np.floor(place)
    if crs is not None:
        header.add_crs(crs)
    if keys:
        directory = GeoKeyDirectoryVlr()
        rows = [(1, 1, 0, len(keys)), *((key, 0, 1, value) for key, value in sorted(keys.items()))]
        directory.parse_record_data(np.array(rows, "<u2").tobytes())
        header.vlrs.append(directory)
    las = laspy.LasData(header)
    las.x, las.y, las.z = place[:, None]
    las.write(path)
    return path


@pytest.mark.parametrize(("epsg", "unit_m"), [(2277, SURVEY_FEET), (32614, 1.0), (4979, 1.0)])
def test_heights_are_in_the_unit_of_the_coordinates(tmp_path: Path, epsg: int, unit_m: float) -> None:
    x, y = Transformer.from_crs(4326, epsg, always_xy=True).transform(IN_TEXAS.lon_deg, IN_TEXAS.lat_deg)
    file = write_in(CRS.from_epsg(epsg), np.array([x, y, 153.0 / unit_m]), tmp_path / "feet.laz")
    assert abs(read_base(file, IN_TEXAS).points[0, 2] - 3.0) < 1e-3


@pytest.mark.parametrize(("code", "unit_m"), [(9001, 1.0), (9002, FEET), (9003, SURVEY_FEET)])
def test_a_unit_of_their_own_counts_for_heights(tmp_path: Path, code: int, unit_m: float) -> None:
    x, y = Transformer.from_crs(4326, 2277, always_xy=True).transform(IN_TEXAS.lon_deg, IN_TEXAS.lat_deg)
    keys = {1024: 1, 3072: 2277, 4099: code}
    file = write_in(None, np.array([x, y, 153.0 / unit_m]), tmp_path / "keys.las", keys)
    assert abs(read_base(file, IN_TEXAS).points[0, 2] - 3.0) < 1e-3


@pytest.mark.parametrize("keys", [{3072: 32614, 4096: 5703}, {3072: 2277, 4096: 6360, 4099: 9003}])
def test_heights_above_a_geoid_by_a_geotiff_key_need_its_grid(tmp_path: Path, keys: dict[int, int]) -> None:
    """laspy reads only the CRS of the plane; without the key the cloud would stand 26 m too low."""
    x, y = Transformer.from_crs(4326, keys[3072], always_xy=True).transform(
        IN_TEXAS.lon_deg, IN_TEXAS.lat_deg
    )
    unit_m = SURVEY_FEET if 4099 in keys else 1.0
    file = write_in(None, np.array([x, y, 179.0 / unit_m]), tmp_path / "navd.las", {1024: 1, **keys})
    with pytest.raises(DataError, match=r"navd\.las: its heights are those of NAVD88 height.*--geoid"):
        read_base(file, IN_TEXAS)
    grid = write_geoid(tmp_path / "geoid.tif", IN_TEXAS.lat_deg, IN_TEXAS.lon_deg, -26.0)
    assert abs(read_base(file, IN_TEXAS, grid).points[0, 2] - 3.0) < 1e-3


@pytest.mark.parametrize(
    ("at", "form", "count"),
    [
        (100, "<I", 3_400_000_000),
        (247, "<Q", 3_400_000_000),
        (243, "<I", 3_400_000_000),
        (96, "<I", 3_400_000_000),
    ],
)
def test_a_header_that_counts_more_than_the_file_has_is_refused_before_memory(
    tmp_path: Path, at: int, form: str, count: int
) -> None:
    path = write(tmp_path / "base.las", around(np.zeros((10, 3))))
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, at, count)
    path.write_bytes(content)
    with pytest.raises(
        DataError, match=r"base\.las: its .* need \d+ bytes, and there are \d+; is it truncated\?"
    ):
        read_base(path, FRAME)

"""Coordinates of a delivery: any projected CRS, heights above ellipsoid or geoid, and files that say which."""

import re
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from pyproj import CRS, Transformer

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.georeference import Georeference, check_delivery
from gnss_sem_map.export.point_cloud import write_laz
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.tiles import in_memory

EGM96 = 5773


def geoid(path: Path, epsg: int | None = EGM96) -> Path:
    """A grid of one degree around Karlsruhe: 48 m, and 0.5 m more for each degree north and east."""
    rows, columns = np.mgrid[0:5, 0:5]
    undulation = 48.0 + 0.5 * ((51 - rows) - 49) + 0.5 * ((6 + columns) - 8)
    path.parent.mkdir(exist_ok=True)
    with rasterio.open(
        path, "w", driver="GTiff", dtype="float32", count=1, width=5, height=5, crs="EPSG:4326",
        transform=rasterio.Affine(1, 0, 5.5, 0, -1, 51.5),
    ) as grid:  # fmt: skip
        grid.write(undulation.astype(np.float32), 1)
        if epsg is not None:
            grid.update_tags(target_crs_epsg_code=str(epsg))
    return path


def undulation(lat_deg: np.ndarray, lon_deg: np.ndarray) -> np.ndarray:
    return np.asarray(48.0 + 0.5 * (lat_deg - 49) + 0.5 * (lon_deg - 8))


@pytest.mark.parametrize("epsg", [25832, 31467, 3857])
def test_points_lie_where_pyproj_says_in_any_crs(
    epsg: int, street: SemanticMap, karlsruhe: LocalFrame
) -> None:
    p_map = street.voxels.centres[::500]
    georeference = Georeference(karlsruhe, epsg)
    placed = georeference.from_map(p_map)
    lat_deg, lon_deg, alt_m = karlsruhe.to_geodetic(p_map)
    x, y = Transformer.from_crs(4326, epsg, always_xy=True).transform(lon_deg, lat_deg)
    np.testing.assert_allclose(placed, np.column_stack([x, y, alt_m]), atol=1e-6)
    np.testing.assert_allclose(georeference.to_map(placed), p_map, atol=1e-3)


def test_orthometric_heights_are_lower_by_the_undulation(
    street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    p_map = street.voxels.centres[::500]
    georeference = Georeference(karlsruhe, None, geoid(tmp_path / "a folder" / "egm96.tif"))
    placed, plain = georeference.from_map(p_map), Georeference(karlsruhe).from_map(p_map)
    lat_deg, lon_deg, _ = karlsruhe.to_geodetic(p_map)
    np.testing.assert_array_equal(placed[:, :2], plain[:, :2])
    np.testing.assert_allclose(plain[:, 2] - placed[:, 2], undulation(lat_deg, lon_deg), atol=1e-4)
    np.testing.assert_allclose(georeference.to_map(placed), p_map, atol=1e-6)


@pytest.mark.parametrize("code", [EGM96, None])
def test_a_file_says_its_compound_crs_and_its_heights_in_words(
    code: int | None, street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    grid = geoid(tmp_path / "heights.tif", code)
    write_laz(Exported(in_memory(street, karlsruhe), epsg=25832, geoid=grid), tmp_path / "map.laz")
    las = laspy.read(tmp_path / "map.laz")
    horizontal, vertical = las.header.parse_crs().sub_crs_list
    assert horizontal.to_epsg() == 25832
    assert vertical.is_vertical
    assert vertical.to_epsg() == code
    [words] = [vlr.record_data for vlr in las.header.vlrs if vlr.description == "CRS and heights"]
    assert b"EPSG:25832" in words
    assert b"orthometric" in words
    assert (b"EGM96" if code else b"height above heights") in words


@pytest.mark.parametrize("code", [999999, 4326, 4979, 6360])  # no CRS, one of degrees, with heights, in feet
def test_a_grid_that_names_no_vertical_crs_in_metres_gives_its_own_name(
    code: int, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    georeference = Georeference(karlsruhe, 25832, geoid(tmp_path / "heights.tif", code))
    horizontal, vertical = georeference.crs.sub_crs_list
    assert (horizontal.to_epsg(), vertical.name) == (25832, "height above heights")
    assert georeference.crs.to_wkt("WKT1_GDAL").startswith("COMPD_CS")


def test_without_a_geoid_the_words_say_that_heights_are_ellipsoidal(karlsruhe: LocalFrame) -> None:
    georeference = Georeference(karlsruhe)
    assert georeference.words == "EPSG:32632 (WGS 84 / UTM zone 32N), heights above the WGS 84 ellipsoid"
    assert georeference.crs == CRS.from_epsg(32632)


@pytest.mark.parametrize(
    ("epsg", "said"),
    [
        (4326, "found EPSG:4326 .* expected a projected CRS in metres"),
        (2263, "expected a projected CRS in metres"),  # feet
        (7423, "expected a projected CRS in metres"),  # compound
        (99, "no EPSG code"),
        (6247, r"EPSG:6247 \(MAGNA-SIRGAS / Bogota urban grid\), whose projection WKT 1 has no name for"),
    ],
)
def test_what_is_no_projected_crs_in_metres_is_refused(epsg: int, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_delivery(epsg, None)


def test_a_crs_or_a_geoid_of_another_place_is_refused(karlsruhe: LocalFrame, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"EPSG:27700 is for .* found an origin at 49\.0000, 8\.4000"):
        Georeference(karlsruhe, 27700)
    with pytest.raises(ConfigError, match=r"does not cover the origin"):
        Georeference(LocalFrame(-33.9, 151.2, 0), None, geoid(tmp_path / "g.tif"))


@pytest.mark.parametrize(
    ("epsg", "place", "doubted"),
    [
        (None, (49.0, 8.4, 115.0), ""),
        (25832, (49.0, 8.4, 115.0), ""),  # ETRS89
        (2056, (47.0, 8.0, 400.0), ""),
        (26910, (45.0, -122.0, 50.0), "EPSG:26910 .* right to 4 m only .*NAD83 to WGS 84"),
        (7855, (-35.0, 147.0, 50.0), "EPSG:7855 .* right to 3 m only .*GDA2020"),
    ],
)
def test_a_datum_that_proj_reaches_only_to_metres_is_doubted(
    epsg: int | None, place: tuple[float, float, float], doubted: str
) -> None:
    georeference = Georeference(LocalFrame(*place), epsg)
    assert bool(georeference.doubt) == bool(doubted)
    assert re.search(doubted, georeference.doubt)
    assert georeference.about().get("doubt", "") == georeference.doubt


def test_a_geoid_of_a_part_of_the_map_is_refused_both_ways(karlsruhe: LocalFrame, tmp_path: Path) -> None:
    """The grid ends at 48.5 and 9.5 degrees or beyond: 60 km south of the origin nothing is known."""
    georeference = Georeference(karlsruhe, None, geoid(tmp_path / "g.tif"))
    beyond = np.array([[0.0, 0.0, 0.0], [0.0, -300_000.0, 7000.0]])
    with pytest.raises(ConfigError, match=r"g\.tif does not cover all of the map: found a place at 46\.3"):
        georeference.from_map(beyond)
    with pytest.raises(ConfigError, match=r"does not cover all of the map"):
        georeference.to_map(Georeference(karlsruhe).from_map(beyond))


def test_what_is_no_grid_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "g.tif").write_bytes(b"no grid")
    for file in (tmp_path / "g.tif", tmp_path / "absent.gtx"):
        with pytest.raises(
            ConfigError, match=r"delivery\.geoid: .* expected a grid of geoid heights"
        ) as caught:
            check_delivery(None, file)
        assert "\n" not in str(caught.value)

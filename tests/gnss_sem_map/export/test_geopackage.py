"""The vectors of a street of exactly known areas, as GDAL reads them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import Geod, Transformer

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.geopackage import write_geopackage
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.vectors import LAYERS
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import VoxelMap, pack


def read(path: Path, layer: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Geometries and columns of a layer."""
    about, _, geometries, columns = pyogrio.raw.read(path, layer=layer)
    return shapely.from_wkb(geometries), dict(zip(about["fields"], columns, strict=True))


@pytest.fixture
def package(street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path) -> Path:
    write_geopackage(Exported(tiles.in_memory(street, karlsruhe)), tmp_path / "map.gpkg")
    return tmp_path / "map.gpkg"


def test_gdal_finds_every_layer_in_the_crs_of_the_map(package: Path) -> None:
    assert [name for name, _ in pyogrio.list_layers(package)] == [layer.name for layer in LAYERS]
    for layer in LAYERS:
        info = pyogrio.read_info(package, layer=layer.name)
        assert info["crs"] == "EPSG:32632"
        assert info["geometry_type"].upper() == layer.kind
        assert tuple(info["fields"]) == layer.columns
    assert pyogrio.read_info(package, layer="poles")["features"] == 0


def test_areas_and_kerbs_are_those_of_the_street(package: Path) -> None:
    """60 m of a road 8 m wide, with a sidewalk of 2 m along it under which no part of a house is."""
    for name, area in (("road", 480.0), ("sidewalk", 120.0)):
        shapes, columns = read(package, name)
        assert shapely.is_valid(shapes).all()
        assert shapely.area(shapes).sum() == pytest.approx(area, rel=0.005)
        np.testing.assert_allclose(columns["area_m2"].sum(), area, rtol=0.005)
        assert ((columns["confidence"] > 0.5) & (columns["confidence"] < 1)).all()
        middle = 115.0 + (0.1 if name == "road" else 0.3)  # of the uppermost voxels, as in map.laz
        np.testing.assert_allclose(columns["height_m"], middle, atol=0.005)
    lines, columns = read(package, "kerbs")
    assert shapely.length(lines).sum() == pytest.approx(60.0, rel=0.005)
    road, _ = read(package, "road")
    assert shapely.distance(shapely.union_all(road).boundary, lines).max() < 1e-6


@pytest.mark.parametrize("epsg", [None, 3857])
def test_lengths_and_areas_are_true_metres_in_every_crs(
    epsg: int | None, street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    path = tmp_path / "map.gpkg"
    write_geopackage(Exported(tiles.in_memory(street, karlsruhe), epsg=epsg), path)
    to_degrees = Transformer.from_crs(epsg or karlsruhe.utm_epsg, 4326, always_xy=True)
    geod = Geod(ellps="WGS84")
    for layer in ("road", "sidewalk", "kerbs", "buildings", "vehicles"):
        shapes, columns = read(path, layer)
        shapes = [shapely.transform(shape, to_degrees.transform, interleaved=False) for shape in shapes]
        if "area_m2" in columns:
            areas = [abs(geod.geometry_area_perimeter(shape)[0]) for shape in shapes]
            np.testing.assert_allclose(columns["area_m2"], areas, rtol=2e-4)
        else:
            lengths = (
                2 * (columns["length_m"] + columns["width_m"]) if layer == "vehicles" else columns["length_m"]
            )
            np.testing.assert_allclose(lengths, [geod.geometry_length(shape) for shape in shapes], rtol=2e-4)


def test_simplified_edges_leave_neither_gaps_nor_overlaps(package: Path) -> None:
    shapes = np.concatenate([read(package, name)[0] for name in ("road", "sidewalk")])
    whole = shapely.union_all(shapes, grid_size=1e-6)
    assert whole.area == pytest.approx(shapely.area(shapes).sum(), abs=1e-2)
    assert whole.geom_type == "Polygon"


def test_the_wall_and_the_standing_car_are_outlined_and_what_was_removed_is_not(
    package: Path, karlsruhe: LocalFrame
) -> None:
    [wall], columns = read(package, "buildings")
    length, width = sides(wall)
    assert (length, width) == pytest.approx((45.0, 0.4), abs=0.05)
    assert columns["base_m"][0] == pytest.approx(115.0, abs=0.01)
    assert columns["top_m"][0] == pytest.approx(123.0, abs=0.01)
    [car], columns = read(package, "vehicles")
    assert sides(car) == pytest.approx((4.0, 2.0), abs=0.01)
    assert (columns["length_m"][0], columns["width_m"][0]) == pytest.approx((4.0, 2.0), abs=0.01)
    middle = Georeference(karlsruhe).from_map(np.array([[22.0, 2.6, 0.2]]))[0]
    assert np.hypot(car.centroid.x - middle[0], car.centroid.y - middle[1]) < 0.01


def moved(whole: SemanticMap, shift: tuple[int, int, int]) -> SemanticMap:
    """So many voxels away: the order of the voxels stays."""
    keys = pack(whole.voxels.indices + np.array(shift))
    return replace(whole, voxels=replace(whole.voxels, keys=keys))


def sides(shape: shapely.Geometry) -> tuple[float, float]:
    corners = shapely.get_coordinates(shapely.oriented_envelope(shape))
    short, long = sorted(np.linalg.norm(np.diff(corners[:3], axis=0), axis=1))
    return float(long), float(short)


def test_an_object_across_tiles_is_one(street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path) -> None:
    """A street that is moved so that a border of tiles runs through wall and car has the same objects."""
    for shift in ((490, 10, 0), (400, 500, 0), (-110, -31, 0)):
        path = tmp_path / "moved.gpkg"
        write_geopackage(Exported(tiles.in_memory(moved(street, shift), karlsruhe)), path)
        assert len(read(path, "buildings")[0]) == 1
        [car], columns = read(path, "vehicles")
        assert sides(car) == pytest.approx((4.0, 2.0), abs=0.01)
        assert columns["voxels"][0] == ((street.labels == 2) & (street.states != State.REMOVED)).sum()
        assert shapely.area(read(path, "road")[0]).sum() == pytest.approx(480, rel=0.005)


def test_each_outline_of_a_building_has_its_own_voxels_and_heights(
    street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    """Two walls, one behind the other and 2 m up, whose ends are one cell apart."""
    wall = street[np.flatnonzero(street.labels == 3)]
    both = tiles.joined(
        [wall, moved(wall, (226, 3, 10))], street.voxels.voxel_size_m, street.voxels.label_set
    )
    write_geopackage(Exported(tiles.in_memory(both, karlsruhe)), tmp_path / "map.gpkg")
    shapes, columns = read(tmp_path / "map.gpkg", "buildings")
    assert shapely.area(shapes) == pytest.approx([18.0, 18.0], abs=0.1)
    assert columns["voxels"].tolist() == [len(wall), len(wall)]
    assert sorted(columns["base_m"]) == pytest.approx([115.0, 117.0], abs=0.01)
    assert sorted(columns["top_m"]) == pytest.approx([123.0, 125.0], abs=0.01)


def test_a_pole_of_one_column_is_listed_and_single_voxels_are_not(
    karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    urban = open_label_set().about()
    pole = {"name": "pole", "colour": [9, 9, 9], "semantic_kitti_id": 80, "asprs_code": 5}
    classes = open_label_set(urban | {"classes": [*urban["classes"], pole]})
    sign = np.column_stack([np.full(12, 5), np.full(12, 7), np.arange(12)])
    crumbs = np.array([[20, 20, 3], [20, 20, 9]])
    keys = np.sort(pack(np.concatenate([sign, crumbs])))
    voxels = VoxelMap(0.2, classes, keys, np.zeros((len(keys), 6), np.int32), np.ones(len(keys), np.uint32))
    states = np.full(len(keys), State.OBSERVED, np.uint8)
    whole = SemanticMap(voxels, np.full(len(keys), 5, np.int8), np.ones(len(keys), np.float32), states)
    write_geopackage(Exported(tiles.in_memory(whole, karlsruhe)), tmp_path / "map.gpkg")
    [place], columns = read(tmp_path / "map.gpkg", "poles")
    middle = Georeference(karlsruhe).from_map(np.array([[1.1, 1.5, 0.0]]))[0]
    assert np.hypot(place.x - middle[0], place.y - middle[1]) < 0.001
    assert columns["voxels"].tolist() == [12]
    assert columns["top_m"] - columns["base_m"] == pytest.approx(2.4)


def test_a_map_without_georeference_is_refused(street: SemanticMap, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="needs a georeference"):
        write_geopackage(Exported(tiles.in_memory(street), title="street"), tmp_path / "map.gpkg")


def test_the_documentation_names_every_layer_and_column() -> None:
    text = (Path(__file__).parents[3] / "docs" / "formats.md").read_text("utf-8")
    names = {name for layer in LAYERS for name in (layer.name, *layer.columns)}
    assert {name for name in names if f"`{name}`" not in text} == set()

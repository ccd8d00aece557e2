"""PLY as plyfile reads it, LAZ as laspy reads it, coordinates as the textbook computes them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import copclib
import laspy
import numpy as np
import plyfile
import pytest
from pyproj import Geod, Proj
from scipy.spatial import cKDTree

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.point_cloud import (
    NOT_DATED,
    adjusted_gps_time,
    las_header,
    write_laz,
    write_ply,
    write_removed,
)
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import in_memory
from gnss_sem_map.voxels.voxel_map import VoxelMap


def as_written(whole: SemanticMap) -> np.ndarray:
    """The places of the voxels in the order of files: tile by tile, of 512 x 512 columns, and sorted in each."""
    x, y, _ = whole.voxels.indices.T
    order = np.lexsort((whole.voxels.keys, y // 512, x // 512))
    assert (order != np.arange(len(whole))).any()  # the street lies in more than one tile
    return order


def standing(whole: SemanticMap) -> np.ndarray:
    """Those of them that were not removed."""
    order = as_written(whole)
    return order[whole.states[order] != State.REMOVED]


def test_the_ply_holds_what_is_shown_and_reads_back_equal(street: SemanticMap, tmp_path: Path) -> None:
    write_ply(Exported(in_memory(street)), tmp_path / "map.ply")
    vertices = plyfile.PlyData.read(tmp_path / "map.ply")["vertex"]
    shown = as_written(street)[street.shown[as_written(street)]]
    assert 0 < len(shown) < len(street)
    read = np.column_stack([vertices[axis] for axis in "xyz"])
    np.testing.assert_allclose(read, street.voxels.centres[shown], atol=1e-5)
    np.testing.assert_array_equal(vertices["label"], street.labels[shown])
    np.testing.assert_array_equal(vertices["confidence"], street.confidence[shown])
    np.testing.assert_array_equal(vertices["hits"], street.voxels.hits[shown])
    np.testing.assert_array_equal(vertices["state"], street.states[shown])
    rgb = np.column_stack([vertices[c] for c in ("red", "green", "blue")])
    np.testing.assert_array_equal(rgb, street.voxels.label_set.legend.colours[street.labels[shown]])


def test_the_ply_says_its_frame_and_its_classes(
    street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    write_ply(Exported(in_memory(street, karlsruhe)), tmp_path / "map.ply")
    comments = "\n".join(plyfile.PlyData.read(tmp_path / "map.ply").comments)
    assert "lat_deg 49.0000000000 lon_deg 8.4000000000 alt_m 115.0000" in comments
    assert "label 3: building" in comments
    assert "label 5: other\n" in comments


def test_a_map_that_no_camera_saw_is_still_worth_a_file(street: SemanticMap, tmp_path: Path) -> None:
    dark = VoxelMap(
        0.2, street.voxels.label_set, street.voxels.keys, 0 * street.voxels.evidence, street.voxels.hits
    )
    write_ply(Exported(in_memory(SemanticMap.of(dark))), tmp_path / "map.ply")
    vertices = plyfile.PlyData.read(tmp_path / "map.ply")["vertex"]
    assert len(vertices.data) == len(street)
    assert (vertices["label"] == 255).all()


def test_class_names_cannot_break_out_of_the_header(street: SemanticMap, tmp_path: Path) -> None:
    old = street.voxels.label_set
    names = ("road\nend_header", "trottoir d'été", *old.names[2:])
    spiteful = LabelSet("x", names, old.colours, old.semantic_kitti_ids, old.asprs_codes, {})
    voxels = VoxelMap(0.2, spiteful, street.voxels.keys, street.voxels.evidence, street.voxels.hits)
    hostile = SemanticMap(voxels, street.labels, street.confidence, street.states)
    write_ply(Exported(in_memory(hostile)), tmp_path / "map.ply")
    write_laz(Exported(in_memory(hostile, LocalFrame(49.0, 8.4, 115.0))), tmp_path / "map.laz")
    assert len(plyfile.PlyData.read(tmp_path / "map.ply")["vertex"].data) == street.shown.sum()
    assert len(laspy.read(tmp_path / "map.laz").points) == (street.states != State.REMOVED).sum()


@pytest.mark.parametrize(("write", "removed"), [(write_laz, False), (write_removed, True)])
def test_every_voxel_is_in_one_of_two_files_and_reads_back_equal(
    write: Callable[[Exported, Path], None],
    removed: bool,
    street: SemanticMap,
    karlsruhe: LocalFrame,
    tmp_path: Path,
) -> None:
    gone = np.flatnonzero(street.states == State.REMOVED)
    reasons = np.zeros(len(street), np.uint8)
    reasons[gone] = 1 + np.arange(len(gone)) % 3
    street = replace(street, reasons=reasons)
    write(Exported(in_memory(street, karlsruhe)), tmp_path / "map.laz")
    las = laspy.read(tmp_path / "map.laz")
    assert (str(las.header.version), las.header.point_format.id) == ("1.4", 7)
    order = as_written(street)
    order = order[(street.states[order] == State.REMOVED) == removed]
    assert len(las.points) == len(order) > 100
    labels, states = street.labels[order], street.states[order]
    unlabelled = labels < 0
    ids = np.where(unlabelled, 0, street.voxels.label_set.legend.semantic_kitti_ids[labels])
    codes = np.where(unlabelled, 0, street.voxels.label_set.legend.asprs_codes[labels])
    np.testing.assert_array_equal(las["sem_label"], ids)
    np.testing.assert_array_equal(las.classification, codes)
    assert (las["sem_label"] == 99).sum() == (las.classification == 66).sum() == (labels == 5).sum()
    np.testing.assert_array_equal(las["confidence"], street.confidence[order])
    np.testing.assert_array_equal(las["hits"], street.voxels.hits[order])
    np.testing.assert_array_equal(las["state"], states)
    np.testing.assert_array_equal(las.user_data, reasons[order])
    np.testing.assert_array_equal(np.asarray(las.withheld), states == State.REMOVED)
    np.testing.assert_array_equal(
        las.red[~unlabelled] >> 8, street.voxels.label_set.legend.colours[labels[~unlabelled], 0]
    )
    assert las.header.vlrs.get("ClassificationLookupVlr")[0][64] == "vehicle"
    assert las.header.vlrs.get("ClassificationLookupVlr")[0][66] == "other"
    assert las.header.number_of_points_by_return[0] == len(order)
    assert las.header.creation_date == NOT_DATED


def test_a_code_of_several_classes_has_the_names_of_all() -> None:
    urban = open_label_set().about()
    bush = {"name": "bush", "colour": [9, 9, 9], "semantic_kitti_id": 71, "asprs_code": 5}
    header = las_header(open_label_set(urban | {"classes": [*urban["classes"], bush]}), None)
    names = header.vlrs.get("ClassificationLookupVlr")[0].lookups
    assert names == {
        5: "vegetation/bush",
        6: "building",
        11: "road",
        64: "vehicle",
        65: "sidewalk",
        66: "other",
    }


def test_a_reader_that_knows_no_flags_sees_no_ghost_in_the_map(
    street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    """By a decoder in C++ that is not the one of laspy: of the car that was removed no point is in the file."""
    write_laz(Exported(in_memory(street, karlsruhe)), tmp_path / "map.laz")
    points = copclib.LazReader(str(tmp_path / "map.laz")).GetPoints()
    found = np.column_stack([points.x, points.y, points.z])
    removed = street.voxels.centres[street.states == State.REMOVED]
    ghosts = Georeference(karlsruhe).from_map(removed)
    nearest, _ = cKDTree(found).query(ghosts)
    assert len(found) == (street.states != State.REMOVED).sum()
    assert nearest.min() > 0.1


@pytest.mark.parametrize(
    ("frame", "epsg"),
    [
        (LocalFrame(49.0, 8.4, 115.0), 32632),
        (LocalFrame(-33.9, 151.2, 20.0), 32756),
        (LocalFrame(0.00001, -179.99, -5.0), 32601),
        (LocalFrame(64.1, -21.9, 60.0), 32627),
    ],
)
def test_the_laz_lies_in_the_zone_and_hemisphere_of_the_origin(
    frame: LocalFrame, epsg: int, street: SemanticMap, tmp_path: Path
) -> None:
    write_laz(Exported(in_memory(street, frame)), tmp_path / "map.laz")
    las = laspy.read(tmp_path / "map.laz")
    crs = las.header.parse_crs()
    assert crs is not None
    assert crs.to_epsg() == epsg
    assert las.header.global_encoding.wkt
    expected = utm_by_geodesic(street.voxels.centres[standing(street)], frame, epsg)
    np.testing.assert_allclose(las.xyz, expected, atol=0.002)


def test_a_map_without_georeference_keeps_its_metres_and_claims_no_crs(
    street: SemanticMap, tmp_path: Path
) -> None:
    write_laz(Exported(in_memory(street)), tmp_path / "map.laz")
    las = laspy.read(tmp_path / "map.laz")
    assert las.header.parse_crs() is None
    np.testing.assert_allclose(las.xyz, street.voxels.centres[standing(street)], atol=0.001)


def utm_by_geodesic(p_map: np.ndarray, frame: LocalFrame, epsg: int) -> np.ndarray:
    """Independent of cart and topocentric steps: along the geodesic from the origin, then PROJ's tmerc.

    Over 100 m the tangent plane and the ellipsoid differ by d²/2R < 1 mm, and the geodesic runs on the
    ellipsoid, below points at height h by the factor 1 + h/R.
    """
    east, north, up = p_map.T
    radius = 6_371_000.0
    distance = np.hypot(east, north) / (1 + (frame.alt_m + up) / radius)
    start = np.ones(len(p_map))
    lon, lat, _ = Geod(ellps="WGS84").fwd(
        frame.lon_deg * start, frame.lat_deg * start, np.degrees(np.arctan2(east, north)), distance
    )
    false_northing = 10_000_000 if epsg // 100 == 327 else 0
    tmerc = Proj(
        f"+proj=tmerc +lat_0=0 +lon_0={6 * (epsg % 100) - 183} +k=0.9996"
        f" +x_0=500000 +y_0={false_northing} +ellps=WGS84"
    )
    easting, northing = tmerc(lon, lat)
    return np.column_stack([easting, northing, frame.alt_m + up + (east**2 + north**2) / (2 * radius)])


def test_a_tile_larger_than_one_chunk_is_written_whole(
    street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_laz(Exported(in_memory(street, karlsruhe)), tmp_path / "whole.laz")
    monkeypatch.setattr("gnss_sem_map.export.point_cloud.LAZ_CHUNK", 1000)
    write_laz(Exported(in_memory(street, karlsruhe)), tmp_path / "chunked.laz")
    whole, chunked = (laspy.read(tmp_path / name).points.array for name in ("whole.laz", "chunked.laz"))
    np.testing.assert_array_equal(whole, chunked)


def test_an_empty_map_gives_empty_files_that_still_open(
    street: SemanticMap, karlsruhe: LocalFrame, tmp_path: Path
) -> None:
    empty = SemanticMap.of(street.voxels[np.zeros(len(street), bool)])
    write_ply(Exported(in_memory(empty)), tmp_path / "map.ply")
    write_laz(Exported(in_memory(empty, karlsruhe)), tmp_path / "map.laz")
    assert len(plyfile.PlyData.read(tmp_path / "map.ply")["vertex"].data) == 0
    assert len(laspy.read(tmp_path / "map.laz").points) == 0


@pytest.mark.parametrize(
    ("utc", "gps_s"),
    [
        ("1980-01-06T00:00:00", 0),
        ("2011-09-14T01:46:25", 1_000_000_000),
        ("2016-12-31T23:59:59", 1_167_264_016),
        ("2017-01-01T00:00:00", 1_167_264_018),  # after the leap second
    ],
)
def test_times_are_adjusted_standard_gps_time(utc: str, gps_s: int) -> None:
    unix_us = np.array([np.datetime64(utc, "us")]).astype(np.int64)
    assert adjusted_gps_time(unix_us + 250_000) == gps_s - 1_000_000_000 + 0.25


def test_a_moment_before_gps_has_no_gps_time() -> None:
    assert adjusted_gps_time(np.array([0, 12_000_000, -5])).tolist() == [0, 0, 0]

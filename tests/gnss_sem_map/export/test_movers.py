"""Files of what moved, as geopandas, pyarrow and json read them."""

import json
from dataclasses import replace

import geopandas
import numpy as np
import pyarrow.parquet as pq
import pytest
from pyproj import Transformer

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.dynamics.constant_acceleration import smooth
from gnss_sem_map.dynamics.movers import Mover
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.movers import DriveOfMovers, join_movers, read_movers, write_movers
from gnss_sem_map.export.report import write_report

EPOCH_NS = 1_317_000_000_000_000_000


@pytest.fixture
def mover():
    """From (0, 0) with 5 m/s to the north-east, 0.1 m of noise."""
    stamps = np.arange(31) / 10
    way = 5.0 * stamps[:, None] * (0.6, 0.8)
    noisy = way + np.random.default_rng(2).normal(0.0, 0.1, way.shape)
    return Mover(
        lidars=("left", "right"), name="vehicle", kind="vehicle", is_labelled=True, labelled=0.75, motion="moving",
        probability=1.0, evidence="went 15.0 m", points=1234, size_m=(4.5, 1.8, 1.5), stamps=stamps,
        heights=0.1 * stamps, track=smooth(stamps, noisy, np.full((31, 2), 0.1**2)),
    )  # fmt: skip


def test_geopandas_reads_a_row_per_mover(mover, karlsruhe, tmp_path) -> None:
    write_movers([mover, mover], DriveOfMovers("monday", EPOCH_NS, karlsruhe), tmp_path)
    table = geopandas.read_parquet(tmp_path / "objects.parquet")
    assert table.crs.to_epsg() == 4979
    assert table["id"].tolist() == [1, 2]
    row = table.iloc[0]
    assert (row["drive"], row["lidar"], row["class"], row["class_from"]) == (
        "monday",
        "left right",
        "vehicle",
        "labels",
    )
    assert row["speed_mps"] == pytest.approx(5.0, abs=3 * float(row["speed_stddev_mps"]))
    assert 0 < row["speed_stddev_mps"] < 0.1
    assert row["way_m"] == pytest.approx(15.0, abs=0.3)
    assert row["heading_deg"] == pytest.approx(np.degrees(np.arctan2(0.6, 0.8)), abs=2.0)
    assert (row["last_time"] - row["first_time"]).total_seconds() == pytest.approx(3.0)
    assert row["first_time"].value == EPOCH_NS
    assert len(row["track"]) == row["scans"] == 31
    line = np.array([point[:3] for point in row.geometry.coords])
    lat_deg, lon_deg, alt_m = karlsruhe.to_geodetic(mover.positions)
    np.testing.assert_allclose(line, np.column_stack([lon_deg, lat_deg, alt_m]), rtol=0, atol=2e-3)
    np.testing.assert_allclose(line[:, :2], np.column_stack([lon_deg, lat_deg]), rtol=0, atol=1e-8)
    east, north = Transformer.from_crs(4979, row["utm_epsg"], always_xy=True).transform(*line[-1, :2])
    assert (row["end_easting_m"], row["end_northing_m"]) == (
        pytest.approx(east, abs=5e-3),
        pytest.approx(north, abs=5e-3),
    )
    assert [row["end_lon_deg"], row["end_lat_deg"], row["end_alt_m"]] == pytest.approx(line[-1].tolist())


def test_a_log_without_a_date_has_no_times(mover, karlsruhe, tmp_path) -> None:
    write_movers([mover], DriveOfMovers("monday", 0, karlsruhe), tmp_path)
    [row] = read_movers(tmp_path)
    assert row["first_time"] is None
    assert row["last_time"] is None
    assert row["last_stamp_s"] == 3.0
    [feature] = json.loads((tmp_path / "objects.geojson").read_text())["features"]
    assert feature["properties"]["first_time"] is None


def test_the_track_is_that_of_the_mover(mover, karlsruhe, tmp_path) -> None:
    write_movers([mover], DriveOfMovers("monday", EPOCH_NS, karlsruhe), tmp_path)
    (row,) = pq.read_table(tmp_path / "objects.parquet").to_pylist()
    found = {name: np.array([place[name] for place in row["track"]]) for name in row["track"][0]}
    np.testing.assert_allclose(found["stamp_s"], mover.stamps)
    np.testing.assert_allclose(
        np.column_stack([found["east_m"], found["north_m"], found["up_m"]]), mover.positions, atol=1e-3
    )
    np.testing.assert_allclose(found["speed_mps"], mover.speeds, atol=1e-3)
    np.testing.assert_allclose(found["speed_stddev_mps"], mover.speed_stddevs, atol=1e-3)
    stddevs = np.column_stack([found["stddev_east_m"], found["stddev_north_m"]])
    np.testing.assert_allclose(stddevs, mover.position_stddevs, atol=1e-3)


def test_the_geojson_says_the_same(mover, karlsruhe, tmp_path) -> None:
    write_movers([mover], DriveOfMovers("monday", EPOCH_NS, karlsruhe), tmp_path)
    collection = json.loads((tmp_path / "objects.geojson").read_text())
    assert set(collection) == {"type", "features"}  # RFC 7946: no crs
    (feature,) = collection["features"]
    table = geopandas.read_parquet(tmp_path / "objects.parquet").iloc[0]
    np.testing.assert_array_equal(feature["geometry"]["coordinates"], table.geometry.coords)
    properties = feature["properties"]
    for name in ("speed_mps", "speed_stddev_mps", "length_m", "class", "evidence", "points", "drive"):
        assert properties[name] == table[name]
    assert len(properties["track_stamp_s"]) == len(feature["geometry"]["coordinates"])


def test_a_track_across_the_180_degree_meridian_is_cut_there(mover, tmp_path) -> None:
    fiji = LocalFrame(-17.0, 180.0 - 4.0 / 106_500, 100.0)
    write_movers([mover], DriveOfMovers("monday", EPOCH_NS, fiji), tmp_path)
    (feature,) = json.loads((tmp_path / "objects.geojson").read_text())["features"]
    east, west = (np.array(line) for line in feature["geometry"]["coordinates"])
    assert (east[-1, 0], west[0, 0]) == (180, -180)
    assert east[:, 0].min() > 179.999
    assert west[:, 0].max() < -179.999
    lat, alt = (np.array([line[axis] for line in (east[-1], west[0])]) for axis in (1, 2))
    assert (np.ptp(lat), np.ptp(alt)) == (0, 0)
    geo = json.loads(pq.read_schema(tmp_path / "objects.parquet").metadata[b"geo"])["columns"]["geometry"]
    assert geo["geometry_types"] == ["MultiLineString Z"]
    assert (geo["bbox"][0], geo["bbox"][3]) == (east[0, 0], west[-1, 0])
    geopandas.read_parquet(tmp_path / "objects.parquet")


def test_without_a_georeference_it_is_in_the_frame_of_the_map(mover, tmp_path) -> None:
    write_movers([mover], DriveOfMovers("monday", EPOCH_NS, None), tmp_path)
    table = geopandas.read_parquet(tmp_path / "objects.parquet")
    assert table.crs is None
    np.testing.assert_allclose([point[:3] for point in table.geometry[0].coords], mover.positions, atol=1e-3)
    assert table["start_lat_deg"].isna().all()
    assert not (tmp_path / "objects.geojson").exists()


def test_nothing_moved_is_an_empty_table(karlsruhe, tmp_path) -> None:
    write_movers([], DriveOfMovers("monday", EPOCH_NS, karlsruhe), tmp_path)
    assert len(geopandas.read_parquet(tmp_path / "objects.parquet")) == 0
    assert json.loads((tmp_path / "objects.geojson").read_text())["features"] == []
    assert read_movers(tmp_path) == []


def test_drives_are_joined_row_by_row(mover, karlsruhe, tmp_path) -> None:
    parts = [tmp_path / name for name in ("monday", "none", "tuesday")]
    for part in parts:
        part.mkdir()
    write_movers([mover], DriveOfMovers("monday", EPOCH_NS, karlsruhe), parts[0])
    other = replace(mover, name="person")
    write_movers([other, mover], DriveOfMovers("tuesday", EPOCH_NS, karlsruhe), parts[2])
    join_movers(parts, tmp_path)
    rows = read_movers(tmp_path)
    assert [(row["drive"], row["id"], row["class"]) for row in rows] == [
        ("monday", 1, "vehicle"), ("tuesday", 1, "person"), ("tuesday", 2, "vehicle"),
    ]  # fmt: skip
    assert len(geopandas.read_parquet(tmp_path / "objects.parquet").total_bounds) == 4
    assert len(json.loads((tmp_path / "objects.geojson").read_text())["features"]) == 3
    (alone := tmp_path / "alone").mkdir()
    join_movers(parts[:1], alone)
    for name in ("objects.parquet", "objects.geojson"):
        assert (alone / name).read_bytes() == (parts[0] / name).read_bytes()


def test_the_report_lists_it(mover, karlsruhe, tmp_path) -> None:
    write_movers([mover], DriveOfMovers("monday", EPOCH_NS, karlsruhe), tmp_path)
    write_report(tmp_path, {"name": "monday"}, {})
    page = (tmp_path / "report.html").read_text()
    (row,) = read_movers(tmp_path)
    for text in ("What moved", "<td>1</td>", "vehicle, by its labels", "went 15.0 m", "objects.geojson"):
        assert text in page
    assert f"{row['speed_mps']:.1f}\u00a0±\u00a0{row['speed_stddev_mps']:.1f}" in page
    write_report(tmp_path, {"name": "week", "drives": {"monday": {}}}, {})
    assert "<td>monday, 1</td>" in (tmp_path / "report.html").read_text()


def test_a_damaged_table_is_named(tmp_path) -> None:
    (tmp_path / "objects.parquet").write_bytes(b"PAR1 not really")
    with pytest.raises(DataError, match=r"objects\.parquet: cannot be read"):
        read_movers(tmp_path)

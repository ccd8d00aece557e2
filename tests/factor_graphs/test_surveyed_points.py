"""Surveyed points: control points hold, check points judge, another CRS or exchanged columns are named."""

from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from factor_graphs.csv_log import read_points
from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise
from factor_graphs.settings import SmootherSettings
from factor_graphs.smoothing import smooth
from factor_graphs.surveyed_points import SurveyedPoints

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
FREE = SmootherSettings(vehicle_constraint="off")
STAMPS = np.array([20.0, 40.0, 60.0, 80.0])
CONTROL = np.array([True, False, True, True])


def antennas(drive, stamps: np.ndarray) -> np.ndarray:
    T = drive.motion.poses(stamps)
    return T[:, :3, 3] + T[:, :3, :3] @ LEVER


def surveyed(drive, positions: np.ndarray | None = None, stamps: np.ndarray = STAMPS) -> SurveyedPoints:
    places = antennas(drive, STAMPS) if positions is None else positions
    return SurveyedPoints(("P1", "P2", "P3", "P4"), places, np.full((4, 3), 0.02), stamps, CONTROL)


def test_control_points_hold_and_the_table_says_how_far_off_all_are(simulate):
    """With fixes of 1 m: control points within 5 cm, and a check point between them closer than without."""
    by_check, by_control = [], []
    for seed in range(3):
        drive = simulate(seed, 100.0, ImuNoise())
        found = smooth(drive.imu, drive.fixes, FRAME, FREE, LEVER, also=(surveyed(drive),))
        points = {p.name: p for p in found.points}
        assert [p.used for p in found.points] == CONTROL.tolist()
        assert points["P2"].kind == "check"
        assert points["P1"].stamp_s == pytest.approx(20.0)
        by_control.append([points["P1"].d_east_m, points["P3"].d_north_m, points["P4"].d_up_m])
        by_check.append([points["P2"].d_east_m, points["P2"].d_north_m])
        T = found.keyframes.at([40.0])[0]
        off = T[:3, 3] + T[:3, :3] @ LEVER - antennas(drive, STAMPS)[1]
        np.testing.assert_allclose([points["P2"].d_east_m, points["P2"].d_north_m, points["P2"].d_up_m], off)
    assert np.abs(by_control).max() < 0.05
    assert np.sqrt(np.mean(np.square(by_check))) < 0.3


def test_a_point_without_a_moment_is_where_the_vehicle_stood(simulate):
    drive = next(d for d in (simulate(seed, 120.0, ImuNoise()) for seed in range(20)) if _stops(d).any())
    stop = float(np.arange(0, 119, 0.5)[_stops(d := drive)][0]) + 0.5
    place = antennas(d, np.array([stop]))
    points = SurveyedPoints(("S",), place, np.full((1, 3), 0.02), np.array([np.nan]), np.array([True]))
    found = smooth(d.imu, d.fixes, FRAME, FREE, LEVER, also=(points,))
    assert found.points[0].used
    distance = np.linalg.norm(antennas(d, np.array([found.points[0].stamp_s])) - place)
    assert distance < 0.05


def _stops(drive) -> np.ndarray:
    speeds = np.linalg.norm(drive.motion.velocities(np.arange(0, 119, 0.5)), axis=1)
    return (speeds < 0.01) & (np.roll(speeds, -2) < 0.01) & (np.arange(len(speeds)) > 20)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda p: p[:, [1, 0, 2]], "east and north exchanged"),
        (lambda p: np.add(p, [0, 0, 47.5]), "above the geoid"),
        (lambda p: np.add(p, [80.0, -60.0, 1.0]), "another datum or CRS"),
        (lambda p: np.add(p, [[0, 0, 0], [0, 0, 0], [9.0, 0, 0], [0, 0, 0]]), "P3 not fitting"),
    ],
)
def test_points_of_another_crs_are_named_and_not_held(simulate, made, said):
    drive = simulate(1, 100.0, ImuNoise())
    wrong = surveyed(drive, np.asarray(made(antennas(drive, STAMPS)), float))
    found = smooth(drive.imu, drive.fixes, FRAME, FREE, LEVER, also=(wrong,))
    note = next(note for note in found.notes if note.startswith("surveyed points"))
    assert said in note
    assert sum(p.used for p in found.points) == (2 if "P3" in said else 0)


@pytest.mark.parametrize("metres", [300.0, 5000.0])
def test_points_without_a_moment_that_are_nowhere_near_are_of_another_crs(simulate, metres):
    drive = simulate(1, 100.0, ImuNoise())
    way = antennas(drive, np.arange(0.0, 100.0, 0.1))
    far = np.add(antennas(drive, STAMPS), [metres, metres, 0])
    nearest = np.linalg.norm((far[:, None] - way)[..., :2], axis=2).min()
    found = smooth(
        drive.imu, drive.fixes, FRAME, FREE, LEVER, also=(surveyed(drive, far, np.full(4, np.nan)),)
    )
    [note] = [note for note in found.notes if note.startswith("surveyed points: 0 of 3")]
    said = float(note.split("the nearest lies ")[1].split(" m from the way")[0])
    assert said == pytest.approx(nearest, abs=5)
    assert note.endswith("of another datum, CRS or drive?")


def test_points_are_read_in_degrees_or_in_a_projected_crs(tmp_path: Path):
    lat, lon = np.array([49.001, 49.0]), np.array([8.401, 8.41])
    east, north = Transformer.from_crs(4326, 25832, always_xy=True).transform(lon, lat)
    head = "name,type,stamp_s,"
    rows = [("A", "control", "12.5"), ("B", "check", "")]
    (tmp_path / "geo.csv").write_text(
        f"{head}lat_deg,lon_deg,alt_m,std_e_m\n"
        + "".join(f"{','.join(r)},{a},{b},120,0.05\n" for r, a, b in zip(rows, lat, lon, strict=True))
    )
    (tmp_path / "utm.csv").write_text(
        f"{head}easting_m,northing_m,height_m,epsg\n"
        + "".join(f"{','.join(r)},{e},{n},120,25832\n" for r, e, n in zip(rows, east, north, strict=True))
    )
    geo, utm = read_points(tmp_path / "geo.csv", FRAME), read_points(tmp_path / "utm.csv", FRAME)
    np.testing.assert_allclose(geo.positions, FRAME.to_map(lat, lon, [120.0, 120.0]))
    np.testing.assert_allclose(utm.positions, geo.positions, atol=1e-3)
    assert geo.names == ("A", "B")
    assert geo.control.tolist() == [True, False]
    assert geo.stddevs.tolist() == [[0.05, 0.02, 0.02]] * 2
    assert geo.stamps[0] == 12.5
    assert np.isnan(geo.stamps[1])


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("A,target,1,49,8.4,100", "found type 'target', expected control or check"),
        ("A,check,1,8.4,49,100", "km from the drive.*exchanged, or of another CRS"),
        ("A,check,1,49,,100", "point A has no lon_deg"),
    ],
)
def test_points_that_cannot_be_are_refused(tmp_path: Path, row: str, said: str):
    (tmp_path / "points.csv").write_text(f"name,type,stamp_s,lat_deg,lon_deg,alt_m\n{row}\n")
    with pytest.raises(MeasurementError, match=said):
        read_points(tmp_path / "points.csv", FRAME)

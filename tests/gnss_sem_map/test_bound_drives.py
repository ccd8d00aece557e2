"""Two days in one street: the surfaces of both drives come together, whichever way the second one is added."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import laspy
import numpy as np
import pytest
from pyproj import CRS, Transformer
from viewer_pages import part

from factor_graphs.errors import EstimationError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.given_trajectory import read_tum
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.mapping import passes
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.mapping.trajectory import locate
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.runs import drive_tasks, finished_run, many_drives
from gnss_sem_map.runs.binding import groups_of
from gnss_sem_map.runs.finished_run import Run
from gnss_sem_map.runs.many_drives import HowMapped, add_drive, remove_drive, run_drives
from gnss_sem_map.scans.deskew import points_in_map
from gnss_sem_map.simulation import Camera, Lidar, simulate

pytestmark = pytest.mark.integration

SECONDS, SEED = 8.0, 5
HOW = HowMapped(force=True)
OF_MOMENT = ("run.json", "report.html", ".gnss-sem-map.json")


def products(out: Path) -> dict[str, bytes]:
    """All files but those that hold times and memory."""
    files = [path for path in sorted(out.rglob("*")) if path.is_file() and path.name not in OF_MOMENT]
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The same street on two days; read only. Half the columns, and small images, at which nothing looks."""
    folder = tmp_path_factory.mktemp("days")
    camera, lidar = Camera(62, 18, 36.0, 30.5, 8.6), Lidar(columns=1040)
    return [
        simulate(folder, SECONDS, SEED, lidar=lidar, camera=camera, session=session) for session in (0, 1)
    ]


@pytest.fixture(scope="module")
def both(days: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of both; read only."""
    out = tmp_path_factory.mktemp("made") / "both"
    run_drives(days, out, Settings(), HOW)
    return out


def truth_of(drive: Path) -> Trajectory:
    return read_tum(drive / "truth" / "trajectory.tum")


def between(days: list[Path], tracks: list[Trajectory], frame: LocalFrame) -> tuple[np.ndarray, np.ndarray]:
    """How the second day's track lies to the first one's, and should: offsets where it is nearest, (k, 3) m."""
    true = []
    for drive in days:
        log = open_drive(drive, with_imu=False)
        assert log.frame is not None
        true.append(truth_of(drive).moved(frame.pose_of(log.frame)))
    stamps = [np.arange(track.start + 0.5, track.end - 0.5, 0.5) for track in true]
    at = [track.at(of_day)[:, :3, 3] for track, of_day in zip(true, stamps, strict=True)]
    near = np.linalg.norm(at[0][None] - at[1][:, None], axis=2).argmin(axis=1)
    found = [track.at(of_day)[:, :3, 3] for track, of_day in zip(tracks, stamps, strict=True)]
    return found[1] - found[0][near], at[1] - at[0][near]


def tracks_in(out: Path, days: list[Path], file: str = "trajectory") -> list[Trajectory]:
    return [Trajectory.load(out / "drives" / drive.name / f"{file}.parquet") for drive in days]


def test_both_days_lie_to_each_other_as_they_were_driven(days: list[Path], both: Path) -> None:
    about = read_run(both)
    (row,) = about["passes"]
    assert [row["first"], row["second"]] == [drive.name for drive in days]
    assert row["bound"] >= 3
    assert row["after_m"] < 0.02 < row["before_m"]
    frame = LocalFrame(**about["local_frame"])
    found, true = between(days, tracks_in(both, days), frame)
    assert np.linalg.norm(found - true, axis=1).max() < 0.03
    found, true = between(days, tracks_in(both, days, "trajectory_alone"), frame)
    assert np.linalg.norm(found - true, axis=1).min() > 0.1, "they come together by themselves"


@pytest.mark.slow
def test_without_revisits_they_lie_apart(days: list[Path], both: Path, tmp_path: Path) -> None:
    apart = Settings.model_validate({"trajectory": {"revisits": {"enabled": False}}})
    run_drives(days, tmp_path / "apart", apart, HOW)
    assert read_run(tmp_path / "apart")["passes"] == []
    for track, alone in zip(
        tracks_in(tmp_path / "apart", days), tracks_in(both, days, "trajectory_alone"), strict=True
    ):
        np.testing.assert_array_equal(track.positions, alone.positions)


def stopped(*_: object, **__: object) -> NoReturn:
    raise KeyboardInterrupt


@pytest.mark.slow
def test_a_day_that_is_added_moves_the_first_one_as_a_run_of_both_does(
    days: list[Path], both: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    finished_run.run(days[0], out, None, Settings(), force=True)
    alone = products(out)
    add_drive(out, days[1], HOW)
    found, expected = products(out), products(both)
    assert [name for name in expected if found.get(name) != expected[name]] == []
    assert found.keys() == expected.keys()
    with monkeypatch.context() as patch:
        patch.setattr(many_drives, "write_drives", stopped)
        with pytest.raises(KeyboardInterrupt):
            remove_drive(out, days[1].name)
    monkeypatch.setattr(drive_tasks, "write_map", stopped)  # the first day was mapped again
    remove_drive(out, days[1].name, resume=True)
    assert products(out)[f"drives/{days[0].name}/trajectory.tum"] == alone["trajectory.tum"]


@pytest.mark.slow
def test_a_drive_is_not_added_where_one_that_it_moves_is_gone(days: list[Path], tmp_path: Path) -> None:
    date = tmp_path / days[0].parent.name
    shutil.copytree(days[0].parent, date)
    out = tmp_path / "out"
    finished_run.run(date / days[0].name, out, None, Settings(), force=True)
    before = products(out)
    shutil.rmtree(date)
    with pytest.raises(DataError, match=f"stays as it was; {days[0].name} passes the same places"):
        add_drive(out, days[1], HOW)
    assert products(out) == before


@pytest.mark.slow
def test_a_drive_that_is_left_out_moves_no_other(
    days: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its labels are missing, which is seen before it is bound; or no scan of it can be mapped, which is seen later."""
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / days[0].name).symlink_to(days[0] / "truth/train_ids")
    how = HowMapped(f"labels:{tmp_path}/labels/{{drive}}", force=True)
    run_drives(days[:1], tmp_path / "one", Settings(), how)
    made = run_drives(days, tmp_path / "both", Settings(), how)
    assert list(made.failed) == [days[1].name]
    assert made.about["passes"] == []
    assert products(tmp_path / "both") == products(tmp_path / "one")
    write_map = drive_tasks.write_map

    def fails(drive: Drive, *rest: Any) -> None:
        if drive.log.name == days[1].name:
            raise DataError("no scan can be used")
        write_map(drive, *rest)

    monkeypatch.setattr(drive_tasks, "write_map", fails)
    one = replace(how, segmenter=f"labels:{tmp_path}/labels/{days[0].name}")
    run_drives(days[:1], tmp_path / "one", Settings(), one)
    made = run_drives(days, tmp_path / "both", Settings(), one)
    assert made.failed == {days[1].name: "no scan can be used"}
    assert products(tmp_path / "both") == products(tmp_path / "one")


def test_tracks_are_grouped_by_where_they_come_near() -> None:
    x = np.arange(0.0, 500.0, 3.0)
    way = np.column_stack([x, 0 * x, 0 * x])
    tracks = {
        "d": way + np.array([0.0, 4000.0, 0.0]),
        "a": way,
        "c": way + np.array([450.0, 30.0, 0.0]),
        "b": way + np.array([900.0, 40.0, 0.0]),
        "e": way + np.array([0.0, 200.0, 0.0]),
    }
    assert groups_of(tracks) == [["a", "b", "c"], ["d"], ["e"]]
    assert groups_of({}) == []


def write_base(drive: Path, path: Path, shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Path:
    """What a surveyor has of the first day: its points, exactly georeferenced, or shifted."""
    log, true = open_drive(drive, with_imu=False), truth_of(drive)
    assert log.frame is not None
    scans = [scan for scan in log.scans[::4] if true.start < scan.stamp - 0.1 and scan.stamp + 0.1 < true.end]
    points = [points_in_map(scan.read(), scan.stamp, true, log.calibration.T_imu_lidar) for scan in scans]
    lat_deg, lon_deg, alt_m = log.frame.to_geodetic(np.concatenate(points)[::3])
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.add_crs(CRS.from_epsg(log.frame.utm_epsg))
    x, y = Transformer.from_crs(4326, log.frame.utm_epsg, always_xy=True).transform(lon_deg, lat_deg)
    header.scales, header.offsets = np.full(3, 1e-3), np.floor([x[0], y[0], alt_m[0]])
    las = laspy.LasData(header)
    las.x, las.y, las.z = (axis + shift for axis, shift in zip((x, y, alt_m), shift_m, strict=True))
    las.write(path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shift_m", "said"),
    [
        ((0.0, 0.0, -47.6), r"0 of its 3 places fit; the cloud begins 0\.\d m .* lies 4\d\.\d m below it"),
        ((0.0, 0.0, 30.0), r"0 of its 3 places fit; the cloud begins 0\.\d m .* lies 29\.\d m above it"),
        ((300.0, 300.0, 0.0), r"none of its places is near; the cloud begins \d{3}\.\d m aside of its track"),
    ],
)
def test_a_cloud_that_fits_nowhere_is_refused_with_its_distance(
    days: list[Path], tmp_path: Path, shift_m: tuple[float, float, float], said: str
) -> None:
    base, how = write_base(days[0], tmp_path / "base.laz", shift_m), replace(HOW, force=False)
    with pytest.raises(DataError, match=rf"{days[1].name}: not held onto base\.laz: {said}.* --force"):
        run_drives(days[1:], tmp_path / "out", Settings(), how, align_to=base)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_by_force_a_cloud_that_fits_nowhere_is_a_warning(days: list[Path], tmp_path: Path) -> None:
    base = write_base(days[0], tmp_path / "base.laz", (300.0, 300.0, 0.0))
    about = run_drives(days[1:], tmp_path / "out", Settings(), HOW, align_to=base).about
    assert [text.partition(";")[0] for text in about["warnings"]] == [
        f"{days[1].name}: not held onto base.laz: none of its places is near"
    ]


def test_without_odometry_nothing_is_held_onto_a_cloud(days: list[Path], tmp_path: Path) -> None:
    base = write_base(days[0], tmp_path / "base.laz")
    settings = Settings().changed("trajectory.revisits.enabled=false")
    with pytest.raises(
        DataError, match=r"base\.laz: nothing is held onto it without trajectory\.revisits\.enabled"
    ):
        run_drives(days[1:], tmp_path / "out", settings, HOW, align_to=base)


@pytest.mark.slow
def test_a_drive_is_held_onto_a_cloud_that_stands(days: list[Path], tmp_path: Path) -> None:
    write_base(days[0], tmp_path / "base.laz")
    made = run_drives(days[1:], tmp_path / "out", Settings(), HOW, align_to=tmp_path / "base.laz")
    (row,) = made.about["passes"]
    assert (row["first"], row["second"]) == (days[1].name, "base.laz") or row["first"] == "base.laz"
    assert row["bound"] >= 3
    frame = LocalFrame(**made.about["local_frame"])
    log = open_drive(days[1], with_imu=False)
    assert log.frame is not None
    true = truth_of(days[1]).moved(frame.pose_of(log.frame))
    for file, least, most in (("trajectory", 0.0, 0.03), ("trajectory_alone", 0.2, np.inf)):
        track = Trajectory.load(tmp_path / "out" / "drives" / days[1].name / f"{file}.parquet")
        stamps = np.arange(true.start + 0.5, true.end - 0.5, 0.5)
        off = np.linalg.norm(track.at(stamps)[:, :3, 3] - true.at(stamps)[:, :3, 3], axis=1)
        assert least <= off.min()
        assert off.max() < most


def test_what_changed_is_in_the_truth_and_in_the_files(days: list[Path], both: Path) -> None:
    about = read_run(both)
    frame, log = LocalFrame(**about["local_frame"]), open_drive(days[1], with_imu=False)
    assert log.frame is not None
    G, true = frame.pose_of(log.frame), truth_of(days[1])
    stamps = np.arange(true.start + 0.5, true.end - 0.5, 0.5)
    offset = (tracks_in(both, days)[1].at(stamps) - G @ true.at(stamps))[:, :3, 3].mean(axis=0)
    truth = json.loads((days[1] / "truth" / "changes.json").read_text())["changes"]
    cars = [
        change for change in about["changes"] if min(change["size_m"][:2]) > 1.5 and change["voxels"] > 200
    ]
    assert len(cars) >= 3
    for change in cars:
        apart = [
            np.linalg.norm(
                (G @ [*(box[f"{axis}_m"] for axis in "xyz"), 1.0])[:2] + offset[:2] - change["centre_m"][:2]
            )
            for box in truth
            if box["change"] == change["change"]
        ]
        assert min(apart) < 1.0
    features = json.loads((both / "changes.geojson").read_text())["features"]
    points = laspy.read(both / "changes.laz")
    assert [feature["properties"] for feature in features] == about["changes"]
    lon_lat = Transformer.from_crs(points.header.parse_crs(), 4326, always_xy=True).transform(
        points.x, points.y
    )
    for n, (feature, change) in enumerate(zip(features, about["changes"], strict=True)):
        ring = np.array(feature["geometry"]["coordinates"][0])[:, :2]
        assert np.array_equal(ring[0], ring[-1])
        mine = np.asarray(points.point_source_id) == n
        assert mine.sum() == change["voxels"]
        assert set(np.asarray(points.user_data)[mine]) == {1 if change["change"] == "appeared" else 2}
        places = np.column_stack([axis[mine] for axis in lon_lat])
        slack = 3e-6  # degrees: 0.3 m
        assert (places >= ring.min(axis=0) - slack).all()
        assert (places <= ring.max(axis=0) + slack).all()


@pytest.mark.slow
def test_the_viewer_shows_what_changed_and_all_of_it_stays_when_the_map_is_refined_again(
    both: Path, tmp_path: Path
) -> None:
    again = Run.open(both).refine(Settings(), tmp_path / "again").folder
    for out in (both, again):
        changes = read_run(out)["changes"]
        meta = json.loads(part((out / "viewer.html").read_text("utf-8"), "meta"))
        assert [box["layer"] for box in meta["changes"]] == [change["change"] for change in changes]
        centres = np.array([np.mean(box["corners"], axis=0) for box in meta["changes"]])
        places = (centres + meta["origin"]) * meta["voxel_m"]
        np.testing.assert_allclose(places, [change["centre_m"] for change in changes], atol=0.02)
    found, expected = products(again), products(both)
    assert {name: found.get(name) for name in expected} == expected


@pytest.mark.slow
def test_drives_whose_equations_have_no_solution_stay_as_they_are_and_are_named(
    days: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unsolvable(*_: object) -> NoReturn:
        raise EstimationError("the equations of the drives have no solution: singular")

    monkeypatch.setattr(passes, "bind", unsolvable)
    about = run_drives(days, tmp_path / "out", Settings(), HOW).about
    names = ", ".join(drive.name for drive in days)
    assert about["warnings"] == [
        f"{names}: not bound where they passed again; the equations of the drives have no solution: singular"
    ]
    assert about["failed"] == {}
    assert about["passes"] == about["changes"] == []


@pytest.mark.slow
def test_a_drive_around_the_block_is_bound_to_its_first_lap(tmp_path: Path) -> None:
    """With a quarter of the columns, and an image of a few pixels, which nobody looks at."""
    lidar = Lidar(columns=520)
    camera = Camera(width=62, height=19, focal_px=36.0, centre_u_px=30.5, centre_v_px=9.0)
    drive = simulate(tmp_path, None, SEED, laps=2, lidar=lidar, camera=camera)
    log, stats = open_drive(drive), RunStats()
    found = locate(log, Settings(), stats)
    (row,) = found.passes
    assert (row.first, row.second) == (drive.name, drive.name)
    assert row.places >= 10
    assert row.bound > 0.9 * row.places
    assert stats.counts["places bound"] == row.bound
    assert row.after_m < 0.01
    true, alone = truth_of(drive), found.alone
    assert alone is not None
    errors = [lap_errors(true, track) for track in (alone, found.trajectory)]
    assert np.median(errors[1]) < 0.02
    assert np.median(errors[1]) < 0.5 * np.median(errors[0])
    assert locate(log, Settings(), RunStats(), bound=False).passes == ()


def lap_errors(true: Trajectory, track: Trajectory) -> np.ndarray:
    """How far from the truth the way is from where the drive was to where it is again, (k,) m."""
    stamps = np.arange(true.start + 0.5, true.end - 0.5, 0.5)
    places = true.at(stamps)[:, :3, 3]
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    apart[np.abs(stamps[:, None] - stamps[None]) < 30.0] = np.inf
    again = np.flatnonzero(apart.min(axis=1) < 5.0)
    again = again[stamps[again] > np.median(stamps)]
    first = apart[again].argmin(axis=1)
    a, b = stamps[first], stamps[again]
    way, true_way = track.at(b) - track.at(a), true.at(b) - true.at(a)
    return np.asarray(np.linalg.norm((way - true_way)[:, :3, 3], axis=1))

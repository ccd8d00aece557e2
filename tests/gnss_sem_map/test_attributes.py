"""`gps_time` and `intensity` of map.laz are what the scans say: computed here from the scans and their point labels."""

from __future__ import annotations

import json
import shutil
from collections import defaultdict
from datetime import date
from pathlib import Path

import laspy
import numpy as np
import pytest
import scenes
import street_drives

from gnss_sem_map import Run, run
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.labelled_scans import Drive, map_points
from gnss_sem_map.runs.many_drives import HowMapped, add_drive, remove_drive, run_drives
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.attribute_table import SAMPLE
from gnss_sem_map.voxels.semantic_map import State
from gnss_sem_map.voxels.voxel_map import pack

SWEEPS = 24
CAR = ((16.0, -1.2, 0.0), (20.0, 0.6, 1.5), (6.0, 0.0, 0.0))
EPOCH_NS = int(np.datetime64("2024-03-01T10:00:00.25", "ns").astype(np.int64))
ADJUSTED_AT_EPOCH_S = (
    float(
        (np.datetime64("2024-03-01T10:00:18.25", "ms") - np.datetime64("1980-01-06")) / np.timedelta64(1, "s")
    )
    - 1e9
)
"""GPS time has been 18 s ahead of UTC since 2017."""


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A car drives ahead; every point has an intensity of its own."""
    folder = scenes.write_table_log(tmp_path_factory.mktemp("drive") / "drive", scenes.street([CAR]), SWEEPS)
    about = json.loads((folder / "log.yaml").read_text())
    (folder / "log.yaml").write_text(json.dumps(about | {"epoch_ns": EPOCH_NS}))
    for number, path in enumerate(sorted((folder / "lidar").glob("*.bin"))):
        rows = np.fromfile(path, "<f4").reshape(-1, 5)
        rows[:, 3] = np.random.default_rng(number).integers(0, 256, len(rows)) / 255
        rows.tofile(path)
    return folder


@pytest.fixture(scope="module")
def finished(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run(drive, tmp_path_factory.mktemp("run") / "out", write_labels=True, force=True)


def seen(folder: Path, labels: Path, settings: Settings) -> dict[tuple[int, bool], list[tuple[float, int]]]:
    """Of every voxel, apart for points that were removed and those that were not: stamps and intensities."""
    one = Run(labels)
    log, found = one.drive(), defaultdict(list)
    for scan in log.scans:
        file = labels / f"removed/{scan.name}.label"
        points = scan.read()
        p_map, valid = map_points(points, scan, Drive(log, one.trajectory, None, settings))
        keys = pack(np.floor(p_map / 0.2).astype(int))
        removed = np.fromfile(file, "<u4")[valid] == 1
        stamps = log.epoch_ns * 1e-9 + (scan.stamp if points.stamps is None else points.stamps[valid])
        levels = np.rint(255 * points.intensity[valid])
        for key, gone, stamp, level in zip(
            keys.tolist(), removed.tolist(), np.broadcast_to(stamps, len(keys)), levels, strict=True
        ):
            found[key, gone].append((stamp, level))
    return found


def lower_median(points: list[tuple[float, int]]) -> int:
    return int(np.percentile([level for _, level in points], 50, method="lower"))


def assert_as_seen(
    out: Path, found: dict[tuple[int, bool], list[tuple[float, int]]], leap_s: float, name: str
) -> int:
    """Compare a file with what the scans say; the number of points whose median is that of all points."""
    las, refined, removed = laspy.read(out / name), tiles.open_map(out / "refined"), name == "removed.laz"
    chosen = [piece.voxels.keys[(piece.states == State.REMOVED) == removed] for piece in refined]
    keys = np.concatenate(chosen)
    assert len(las.points) == len(keys)
    adjusted_less_unix_s, exact = leap_s - 315_964_800 - 1e9, 0
    for key, gps_time, intensity in zip(keys.tolist(), las.gps_time, las.intensity, strict=True):
        points = found[key, removed]
        last = max(stamp for stamp, _ in points)
        assert abs(gps_time - (last + adjusted_less_unix_s)) < 2e-6
        if len(points) <= SAMPLE:
            assert intensity == 257 * lower_median(points)
            exact += 1
        else:  # of a sample of at least 20
            levels = [level for _, level in points]
            assert np.percentile(levels, 5) <= intensity / 257 <= np.percentile(levels, 95)
    assert las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    return exact


def test_they_are_the_last_moment_and_the_median_of_the_points(finished: Run) -> None:
    found = seen(finished.folder, finished.folder, finished.settings)
    assert assert_as_seen(finished.folder, found, 18, "map.laz") > 10_000
    assert assert_as_seen(finished.folder, found, 18, "removed.laz") > 50
    times = laspy.read(finished.folder / "map.laz").gps_time - ADJUSTED_AT_EPOCH_S
    assert -0.05 < times.min() < times.max() < SWEEPS * scenes.SWEEP_S + 0.05


@pytest.mark.parametrize("name", ["map.laz", "removed.laz"])
def test_a_file_is_dated_by_its_last_measurement_so_its_bytes_are_the_same_tomorrow(
    finished: Run, name: str
) -> None:
    assert laspy.read(finished.folder / name).header.creation_date == date(2024, 3, 1)


def test_a_mover_is_no_look_at_the_static_voxels_that_it_passes(finished: Run) -> None:
    found = seen(finished.folder, finished.folder, finished.settings)
    whole = tiles.read(finished.folder / "refined")
    static = set(whole.voxels.keys[whole.states != State.REMOVED].tolist())
    both = [key for key, gone in found if gone and key in static]
    alone = [lower_median(found[key, False]) for key in both]
    with_mover = [lower_median(found[key, False] + found[key, True]) for key in both]
    assert alone != with_mover  # so the comparison above would tell them apart


@pytest.mark.slow
def test_two_workers_write_the_same_bytes(drive: Path, finished: Run, tmp_path: Path) -> None:
    again = run(
        drive, tmp_path / "out", write_labels=True, force=True, workers=2,
        settings=Settings().changed("dynamics.window_scans=6"),
    )  # fmt: skip
    one = run(
        drive, tmp_path / "one", write_labels=True, force=True,
        settings=Settings().changed("dynamics.window_scans=6"),
    )  # fmt: skip
    files = [*one.folder.glob("attributes/*"), one.folder / "map.laz", one.folder / "removed.laz"]
    assert len(files) > 3
    for file in files:
        assert file.read_bytes() == (again.folder / file.relative_to(one.folder)).read_bytes(), file.name
    assert not list(one.folder.glob(".sightings*"))


@pytest.mark.slow
def test_copc_has_them_and_another_export_too(finished: Run, tmp_path: Path) -> None:
    copc, laz = finished.export(["copc", "laz"], tmp_path / "files")
    assert laz.read_bytes() == (finished.folder / "map.laz").read_bytes()
    one, other = laspy.read(copc), laspy.read(laz)
    assert one.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    names = ("X", "Y", "Z", "gps_time", "intensity")
    rows = [
        np.sort(np.rec.fromarrays([np.asarray(las[name]) for name in names], names=names))
        for las in (one, other)
    ]
    np.testing.assert_array_equal(*rows)


def test_attributes_of_another_map_are_refused(finished: Run, tmp_path: Path) -> None:
    shutil.copytree(finished.folder, tmp_path / "run")
    files = sorted((tmp_path / "run/attributes").iterdir())
    files[0].write_bytes(files[1].read_bytes())
    with pytest.raises(DataError, match="attributes"):
        Run.open(tmp_path / "run").export(["laz"], tmp_path / "files")


@pytest.mark.slow
def test_a_plain_run_has_them_too(drive: Path, finished: Run, tmp_path: Path) -> None:
    bare = run(drive, tmp_path / "out", force=True)
    for name in ("map.laz", "removed.laz"):
        assert (bare.folder / name).read_bytes() == (finished.folder / name).read_bytes()


@pytest.mark.slow
def test_without_them_gps_time_and_intensity_are_0(finished: Run, tmp_path: Path) -> None:
    shutil.copytree(finished.folder, tmp_path / "run")
    shutil.rmtree(tmp_path / "run/attributes")  # as older versions wrote runs
    (file,) = Run.open(tmp_path / "run").export(["laz"], tmp_path / "files")
    las = laspy.read(file)
    assert not las.gps_time.any()
    assert not las.intensity.any()
    assert las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.WEEK_TIME


@pytest.mark.slow
def test_of_several_drives_the_last_that_saw_a_voxel_counts(tmp_path: Path) -> None:
    drives = street_drives.write(tmp_path / "drives")
    how, out = HowMapped(drives.labels, force=True), tmp_path / "out"
    run_drives([drives.by_name[name] for name in "ab"], out, Settings(), how, write_labels=True)
    found = defaultdict(list)
    for name in "ab":
        for key, points in seen(out, out / "drives" / name, Settings()).items():
            found[key] += points
    refined, adjusted_less_unix_s = tiles.open_map(out / "refined"), 15 - 315_964_800 - 1e9
    keys = np.concatenate([piece.voxels.keys[piece.states != State.REMOVED] for piece in refined])
    times = laspy.read(out / "map.laz").gps_time
    last = [max(stamp for stamp, _ in found[key, False]) + adjusted_less_unix_s for key in keys.tolist()]
    np.testing.assert_allclose(times, last, atol=2e-6)


@pytest.mark.slow
def test_they_survive_what_is_done_with_runs(tmp_path: Path) -> None:
    drives = street_drives.write(tmp_path / "drives")
    how, out = HowMapped(drives.labels, force=True), tmp_path / "out"
    run_drives([drives.by_name[name] for name in "ab"], out, Settings(), how)
    before = (out / "map.laz").read_bytes()
    again = Run.open(out).refine(Run.open(out).settings, tmp_path / "again")
    assert (again.folder / "map.laz").read_bytes() == before
    add_drive(out, drives.by_name["c"], how)
    assert laspy.read(out / "map.laz").gps_time.all()
    remove_drive(out, "c")
    assert (out / "map.laz").read_bytes() == before
    alone = [
        run(drives.by_name[name], tmp_path / f"{name}_alone", drives.labels, force=True) for name in "ab"
    ]
    latest = max(laspy.read(one.folder / "map.laz").gps_time.max() for one in alone)
    assert laspy.read(out / "map.laz").gps_time.max() == latest

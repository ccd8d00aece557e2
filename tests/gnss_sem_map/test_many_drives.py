"""Many drives are one map: whoever maps them, in whatever order, the bytes are the same."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
import street
import street_drives
from street import Street
from street_drives import Drives

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map import pipeline
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.mapping.merging import merge_runs
from gnss_sem_map.runs import finished_run, many_drives, merged_run
from gnss_sem_map.runs.finished_run import Run
from gnss_sem_map.runs.many_drives import HowMapped, ManyDrives, add_drive, remove_drive, run_drives
from gnss_sem_map.runs.source import Source
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.map_json import read_frame

SETTINGS = Settings()
OF_MOMENT = ("run.json", "report.html")
"""Files of a drive that hold times and memory."""
KILLED_BY_ITSELF = """
import os, signal, sys

def look(event, details):
    place = os.fsdecode(details[1]) if event == "os.rename" else ""
    folder, _, name = place.rpartition("/")
    if folder.endswith("/drives/.b.work") and name.isdecimal():  # a chunk of its scans is put away
        os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(look)
from gnss_sem_map.cli import main
main()
"""


def products(out: Path) -> dict[str, bytes]:
    """What must not depend on how a map came to be: every file but the list of files and times of the drives."""
    files = {path.relative_to(out).as_posix(): path for path in out.rglob("*") if path.is_file()}
    return {
        name: path.read_bytes()
        for name, path in files.items()
        if path.name != ".gnss-sem-map.json" and not (name.startswith("drives/") and path.name in OF_MOMENT)
    }


def assert_same(a: Path, b: Path) -> None:
    found, expected = products(a), products(b)
    assert found.keys() == expected.keys()
    assert [name for name in found if found[name] != expected[name]] == []


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Drives:
    """Three drives, a to c; read only."""
    return street_drives.write(tmp_path_factory.mktemp("drives"))


@pytest.fixture(scope="module")
def how(drives: Drives) -> HowMapped:
    """So short a drive looks wrong before the work, hence `force`."""
    return HowMapped(drives.labels, force=True)


def mapped(names: str, drives: Drives, out: Path, how: HowMapped) -> ManyDrives:
    return run_drives([drives.by_name[name] for name in names], out, SETTINGS, how)


@pytest.fixture(scope="module")
def made(drives: Drives, how: HowMapped, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Maps of the first drive alone, of two and of three, each made at once; read only."""
    folder = tmp_path_factory.mktemp("made")
    finished_run.run(drives.by_name["a"], folder / "a", drives.labels, SETTINGS, force=True)
    for names in ("ab", "abc"):
        mapped(names, drives, folder / names, how)
    return {path.name: path for path in folder.iterdir()}


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "gnss_sem_map.cli", *map(str, arguments)]


def gnss_sem_map(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, check=False)


def run_of(places: Sequence[Path | str], drives: Drives, out: Path, *more: str | Path) -> list[str | Path]:
    return ["run", *places, "--segmenter", drives.labels, "--force", "-o", out, *more]


def as_arrays(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    voxels = tiles.read(folder).voxels
    return voxels.keys, np.column_stack([voxels.evidence, voxels.hits.astype(np.int64), voxels.heights])


def test_the_map_is_the_sum_of_the_maps_of_its_drives(made: dict[str, Path]) -> None:
    out = made["abc"]
    parts = [as_arrays(out / "drives" / name / "map") for name in "abc"]
    keys, places = np.unique(np.concatenate([of_part for of_part, _ in parts]), return_inverse=True)
    sums = np.zeros((len(keys), parts[0][1].shape[1]), np.int64)
    np.add.at(sums, places, np.concatenate([values for _, values in parts]))
    found_keys, found = as_arrays(out / "map")
    np.testing.assert_array_equal(found_keys, keys)
    np.testing.assert_array_equal(found, sums)
    assert len(keys) < 0.8 * sum(len(of_part) for of_part, _ in parts), "the drives see the same street"


def test_every_drive_lies_in_the_map_where_it_was_driven(made: dict[str, Path], drives: Drives) -> None:
    """In the frame of the first drive, though each has an origin of its own."""
    frame = read_frame(made["abc"] / "map")
    assert frame == open_drive(drives.by_name["a"]).frame
    origin = drives.motion.poses(np.array([drives.starts_s["a"]]))[0, :3, 3]
    for name, start_s in drives.starts_s.items():
        assert (open_drive(drives.by_name[name]).frame == frame) == (name == "a")
        found = Trajectory.load(made["abc"] / "drives" / name / "trajectory.parquet")
        exact = drives.motion.poses(found.stamps + start_s)[:, :3, 3] - origin
        assert np.abs(found.positions - exact).max() < 0.1


def test_viewer_and_report_show_every_drive(made: dict[str, Path]) -> None:
    out = made["abc"]
    meta = json.loads(re.search(r'id="meta"[^>]*>(.*?)<', (out / "viewer.html").read_text("utf-8"))[1])
    ends = (np.array([line[-1] for line in meta["tracks"]]) + meta["origin"]) * meta["voxel_m"]
    tracks = [Trajectory.load(out / "drives" / name / "trajectory.parquet") for name in "abc"]
    for end, track in zip(ends, tracks, strict=True):
        assert np.linalg.norm(track.positions - end, axis=1).min() < 0.01
    about, report = read_run(out), (out / "report.html").read_text("utf-8")
    assert about["name"] == "3 drives"
    assert list(about["drives"]) == list("abc")
    assert [drive["scans"] for drive in about["drives"].values()] == [
        read_run(out / "drives" / name)["counts"]["scans"] for name in "abc"
    ]
    assert all(f'href="drives/{name}/report.html"' in report for name in "abc")


@pytest.mark.parametrize(("before", "name", "after"), [("a", "b", "ab"), ("ab", "c", "abc")])
def test_a_map_to_which_a_drive_was_added_is_that_of_all_at_once(
    before: str, name: str, after: str, made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out = shutil.copytree(made[before], tmp_path / "out")
    about = add_drive(out, drives.by_name[name], how).about
    assert_same(out, made[after])
    assert about["merged"] == list(after)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_map_from_which_a_drive_was_taken_is_that_of_the_others(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out = shutil.copytree(made["abc"], tmp_path / "out")
    remove_drive(out, "c")
    assert_same(out, made["ab"])
    remove_drive(out, "a")
    frame = read_frame(made["ab"] / "map")
    run_drives([drives.by_name["b"]], tmp_path / "b", SETTINGS, how, origin=frame)
    assert_same(out, tmp_path / "b")
    with pytest.raises(DataError, match=r"out: b is its only drive; remove the folder instead$"):
        remove_drive(out, "b")


def test_a_map_of_many_drives_that_is_refined_again_keeps_its_drives(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out = shutil.copytree(made["ab"], tmp_path / "out")
    Run.open(out).refine(SETTINGS)
    assert_same(out, made["ab"])
    add_drive(out, drives.by_name["c"], how)
    assert_same(out, made["abc"])


def broken(drives: Drives, folder: Path) -> Path:
    """A copy of the third drive whose scans hold nothing."""
    date = shutil.copytree(drives.by_name["c"].parent, folder / drives.by_name["c"].parent.name)
    for path in (date / "c/velodyne_points/data").iterdir():
        path.write_bytes(b"")
    return date / "c"


def test_a_drive_that_fails_is_left_out_and_two_workers_make_the_map_of_the_others(
    made: dict[str, Path], drives: Drives, tmp_path: Path
) -> None:
    """The drives are named in another order, so the origin is given."""
    bad, out = broken(drives, tmp_path), tmp_path / "out"
    (tmp_path / "drives.txt").write_text(
        f"# every drive of the day\n\n{drives.by_name['b']}\n  {bad.relative_to(tmp_path)}  \n"
    )
    frame = open_drive(drives.by_name["a"]).frame
    assert frame is not None
    origin = f"{frame.lat_deg},{frame.lon_deg},{frame.alt_m}"
    places = [f"@{tmp_path / 'drives.txt'}", drives.by_name["a"]]
    done = gnss_sem_map(*run_of(places, drives, out, "--origin", origin, "--workers", "2"))
    assert done.returncode == 1
    [line] = [line for line in done.stderr.splitlines() if "left out" in line]
    about = json.loads((out / "run.json").read_text())
    assert about["merged"] == ["a", "b"]
    [(name, reason)] = about["failed"].items()
    assert name == "c"
    assert f"c is left out: {reason}" in line
    assert "Traceback" not in done.stderr
    expected = products(made["ab"])
    differ = {name for name, content in products(out).items() if content != expected.get(name)}
    assert differ <= {"run.json", "report.html"}
    assert products(out).keys() == expected.keys()


NETWORK = """
import os, signal
import numpy as np

def look(pixels):
    if __name__ == "network_c":
        os.kill(os.getpid(), signal.SIGKILL)
    return np.full((*pixels.shape[:2], 2), 0.5, np.float32)

look.class_names = ["road", "other"]
"""


def test_a_drive_that_kills_its_workers_is_left_out(
    drives: Drives, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "networks").mkdir()
    for name in "abc":
        (tmp_path / f"networks/network_{name}.py").write_text(NETWORK)
    monkeypatch.syspath_prepend(tmp_path / "networks")
    places, how = list(drives.by_name.values()), HowMapped("python:network_{drive}:look", force=True)
    made = run_drives(places, tmp_path / "out", SETTINGS, how, workers=2)
    assert made.about["merged"] == ["a", "b"]
    assert list(made.failed) == ["c"]
    assert made.failed["c"].startswith("given up after 3 attempts: 3 x a worker process died (SIGKILL")


def test_an_error_of_the_disk_in_one_drive_leaves_the_others(
    drives: Drives, how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = Source.open_log

    def fails(source: Source, with_imu: bool = True) -> SensorLog:
        if source.name == "b":
            raise OSError(errno.EIO, os.strerror(errno.EIO), "/torn/disk")
        return original(source, with_imu)

    monkeypatch.setattr(Source, "open_log", fails)
    made = mapped("ab", drives, tmp_path / "out", how)
    assert made.about["merged"] == ["a"]
    assert made.failed == {"b": f"/torn/disk: {os.strerror(errno.EIO)}"}


def test_where_no_drive_can_be_mapped_nothing_is_written(
    drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    bad, out = broken(drives, tmp_path / "drives"), tmp_path / "out"
    none = replace(how, frames="100:")
    with pytest.raises(DataError, match=r"out: no drive could be mapped; a: .*") as refused:
        run_drives([drives.by_name["a"], bad], out, SETTINGS, none)
    assert "\n" not in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == ["drives"]


def test_a_run_that_is_killed_in_its_second_drive_is_resumed_there(
    made: dict[str, Path], drives: Drives, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = run_of([drives.by_name["a"], drives.by_name["b"]], drives, out, "--workers", "1")
    died = subprocess.run([sys.executable, "-c", KILLED_BY_ITSELF, *map(str, words)], check=False)
    assert died.returncode == -signal.SIGKILL
    assert not out.exists()
    first = (tmp_path / ".out.work/drives/a/run.json").stat()
    assert not (tmp_path / ".out.work/drives/b/run.json").exists()
    done = gnss_sem_map(*words, "--resume")
    assert done.returncode == 0, done.stderr
    assert os.path.samestat((out / "drives/a/run.json").stat(), first), "the finished drive is mapped again"
    assert_same(out, made["ab"])
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def stopped(*_: object, **__: object) -> NoReturn:
    raise KeyboardInterrupt


def calls_of_the_pipeline(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the drives that are mapped from now on."""
    calls, original = [], pipeline.run

    def watched(log: SensorLog, *rest: Any, **named: Any) -> pipeline.Mapped:
        calls.append(log.name)
        return original(log, *rest, **named)

    monkeypatch.setattr(pipeline, "run", watched)
    return calls


def test_adding_that_was_stopped_leaves_the_map_and_is_resumed(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, calls = shutil.copytree(made["ab"], tmp_path / "out"), calls_of_the_pipeline(monkeypatch)
    with monkeypatch.context() as patch:
        patch.setattr(many_drives, "write_drives", stopped)
        with pytest.raises(KeyboardInterrupt):
            add_drive(out, drives.by_name["c"], how)
    assert products(out) == products(made["ab"])
    add_drive(out, drives.by_name["c"], replace(how, resume=True))
    assert_same(out, made["abc"])
    assert len(calls) == 1


def test_a_finished_drive_is_resumed_only_when_it_was_mapped_in_the_same_way(
    drives: Drives, how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = calls_of_the_pipeline(monkeypatch)
    monkeypatch.setattr(many_drives, "write_drives", stopped)
    coarse = Settings.model_validate({"mapping": {"voxel_size_m": 0.4}})
    elsewhere = LocalFrame(49.01, 8.42, 100.0)
    for settings, origin, again, times in (
        (SETTINGS, None, how, 1),
        (SETTINGS, None, replace(how, resume=True), 0),
        (coarse, None, replace(how, resume=True), 1),
        (coarse, elsewhere, replace(how, resume=True), 1),
        (coarse, elsewhere, replace(how, segmenter="none", resume=True), 1),
    ):
        calls.clear()
        with pytest.raises(KeyboardInterrupt):
            run_drives([drives.by_name["a"]], tmp_path / "out", settings, again, origin=origin)
        assert len(calls) == times


def test_two_drives_of_one_name_are_refused(drives: Drives, how: HowMapped, tmp_path: Path) -> None:
    other = shutil.copytree(drives.by_name["a"], tmp_path / "b")
    with pytest.raises(
        DataError, match=r"two drives have the name b, and all evidence .*; leave one out, or give"
    ):
        run_drives([drives.by_name["a"], drives.by_name["b"], other], tmp_path / "out", SETTINGS, how)


def test_a_drive_is_counted_once_whatever_its_name(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    link, again = (
        tmp_path / "monday",
        r"monday: is the drive a, whose evidence counts once; leave one of them out$",
    )
    link.symlink_to(drives.by_name["a"])
    with pytest.raises(DataError, match=again):
        run_drives([drives.by_name["a"], link], tmp_path / "out", SETTINGS, how)
    for before in ("a", "ab"):
        out = shutil.copytree(made[before], tmp_path / before)
        with pytest.raises(DataError, match=again):
            add_drive(out, link, how)
        with pytest.raises(DataError, match="two drives have the name a"):
            add_drive(out, drives.by_name["a"], how)
        assert products(out) == products(made[before])


def test_a_drive_has_the_name_of_its_folder_also_where_we_stand_in_it(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = shutil.copytree(made["a"], tmp_path / "out")
    monkeypatch.chdir(drives.by_name["b"])
    assert add_drive(out, Path("."), how).about["merged"] == ["a", "b"]
    assert_same(out, made["ab"])


def test_a_drive_without_georeference_fits_into_no_map(
    drives: Drives, small_drive: Street, how: HowMapped, tmp_path: Path
) -> None:
    sequence, out = street.write_odometry(tmp_path, small_drive), tmp_path / "out"
    geometry = HowMapped("none", force=True)
    with pytest.raises(
        DataError, match=r"99: neither it nor another drive has a georeference; expected .*GNSS$"
    ):
        run_drives([sequence], out, SETTINGS, geometry)
    assert not out.exists()
    without = run_drives([sequence, drives.by_name["a"]], tmp_path / "others", SETTINGS, geometry)
    assert without.about["merged"] == ["a"]
    assert "has no georeference" in without.failed["99"]
    finished_run.run(sequence, out, "none", SETTINGS, force=True)
    with pytest.raises(DataError, match=r"out: its map has no georeference, so no other drive fits to it$"):
        add_drive(out, drives.by_name["a"], how)


def test_a_map_stays_as_it_was_when_the_drive_to_be_added_fails(
    made: dict[str, Path], drives: Drives, small_drive: Street, how: HowMapped, tmp_path: Path
) -> None:
    out = shutil.copytree(made["a"], tmp_path / "out")
    sequence = street.write_odometry(tmp_path / "drives", small_drive)
    for drive, reason in (
        (sequence, r"99: has no georeference, so its map has no origin; expected GNSS"),
        (tmp_path / "nowhere", "nowhere: no such folder; expected a drive"),
    ):
        with pytest.raises(DataError, match=r"out: stays as it was; .*") as refused:
            add_drive(out, drive, HowMapped("none", force=True))
        assert reason in str(refused.value)
        assert products(out) == products(made["a"])
        assert sorted(path.name for path in tmp_path.iterdir()) == ["drives", "out"]


def test_only_a_drive_that_is_there_is_taken_out(made: dict[str, Path]) -> None:
    for name in ("z", "../a", "", "a/map"):
        with pytest.raises(DataError, match=rf"ab: holds no drive '{name}'; expected one of a, b$"):
            remove_drive(made["ab"], name)
    with pytest.raises(DataError, match=r"a: a is its only drive; remove the folder instead$"):
        remove_drive(made["a"], "a")


def test_a_map_of_many_drives_is_merged_with_all_its_keyframe_scans(made: dict[str, Path]) -> None:
    merged = merge_runs(made["ab"], made["a"], match=False)
    keyframes = "evidence/keyframes/0.npz"
    assert [path for path, _ in merged.keyframes] == [
        made["ab"] / "drives/a" / keyframes,
        made["ab"] / "drives/b" / keyframes,
        made["a"] / keyframes,
    ]


def labels_of(drive: Path) -> dict[str, bytes]:
    names = ("labels", "labels_raw", "confidence", "looks", "removed")
    files = [path for name in names for path in (drive / name).iterdir()]
    return {path.relative_to(drive).as_posix(): path.read_bytes() for path in files}


def test_every_drive_has_the_point_labels_of_the_map_of_all(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    """Those of one drive are those of a run of this drive alone; with two, both have some, also after refinement."""
    a, b = (drives.by_name[name] for name in "ab")
    finished_run.run(a, tmp_path / "alone", drives.labels, SETTINGS, force=True, write_labels=True)
    run_drives([a], tmp_path / "one", SETTINGS, how, write_labels=True)
    alone = labels_of(tmp_path / "alone")
    assert labels_of(tmp_path / "one/drives/a") == alone
    out = tmp_path / "two"
    run_drives([a, b], out, SETTINGS, how, write_labels=True)
    labels = {name: labels_of(out / "drives" / name) for name in "ab"}
    assert labels["a"].keys() == labels["b"].keys() == alone.keys()
    assert labels["a"] != alone, "the other drive sees the same walls"
    Run.open(out).refine(SETTINGS)
    assert {name: labels_of(out / "drives" / name) for name in "ab"} == labels
    add_drive(out, drives.by_name["c"], how)
    assert_same(out, made["abc"])


def test_a_map_of_many_drives_is_merged_into_a_run_with_their_tracks(
    made: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    merged_run.merge_run_folders(made["ab"], made["a"], out, match=False)
    assert len(list((out / "tracks").iterdir())) == 2
    assert Run(out).refine(Run(out).settings, tmp_path / "again").about["merged"] == ["ab", "a"]


def test_to_a_merged_map_no_drive_is_added(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out, again = tmp_path / "out", shutil.copytree(made["a"], tmp_path / "again")
    merged_run.merge_run_folders(made["a"], again, out, match=False)
    says = r"out: was merged by `merge` and keeps no drives; expected a map of `gnss-sem-map run`$"
    with pytest.raises(DataError, match=says):
        add_drive(out, drives.by_name["b"], how)
    with pytest.raises(DataError, match=says):
        remove_drive(out, "a")


@pytest.mark.parametrize("name", ["../../outside", "..", "", "/outside", None, 3])
def test_the_name_that_run_json_gives_a_drive_is_no_path(
    name: object, made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out = shutil.copytree(made["a"], tmp_path / "out")
    about = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(about | {"drive": name}))
    with pytest.raises(DataError, match=r"run.json: damaged \(drive: found .*, expected a name\)$"):
        add_drive(out, drives.by_name["b"], how)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]

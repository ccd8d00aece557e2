"""A drive that fails costs the other drives nothing, and the map stays as it was; a drive is not counted twice."""

from __future__ import annotations

import errno
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import pytest
import street
from commands import gnss_sem_map
from maps_of_drives import SETTINGS, assert_same, mapped, products, run_of
from street import Street
from street_drives import Drives

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.evaluation.score_run import score_run
from gnss_sem_map.files.ownership import foreign, write_list
from gnss_sem_map.runs import finished_run
from gnss_sem_map.runs.many_drives import HowMapped, add_drive, run_drives
from gnss_sem_map.runs.source import Source
from gnss_sem_map.sensor_log import SensorLog


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


@pytest.mark.slow
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
    assert "given up after 3 attempts: 3 x a worker process died (SIGKILL" in made.failed["c"]


@pytest.mark.slow
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


def test_a_disk_that_is_full_at_once_is_an_error_that_says_where(
    drives: Drives, how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(settings: Settings) -> NoReturn:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # a write that fails names no file

    monkeypatch.setattr(Settings, "to_yaml", full)
    with pytest.raises(DataError, match=r"\.work: cannot be written \(No space .*free the disk"):
        mapped("ab", drives, tmp_path / "out", how)
    assert not (tmp_path / "out").exists()


def test_where_no_drive_can_be_mapped_nothing_is_written(
    drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    bad, out = broken(drives, tmp_path / "drives"), tmp_path / "out"
    none = replace(how, frames="100:")
    with pytest.raises(DataError, match=r"out: no drive could be mapped; a: .*") as refused:
        run_drives([drives.by_name["a"], bad], out, SETTINGS, none)
    assert "\n" not in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == ["drives"]


def test_labels_in_a_result_that_would_be_replaced_are_not_removed(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out = shutil.copytree(made["ab"], tmp_path / "out")
    shutil.copytree(Path(drives.labels.partition(":")[2].format(drive="a")), out / "labels/a")
    write_list(out)
    with pytest.raises(
        DataError, match=r"out: is or holds .*out/labels/a, which is read; choose another -o$"
    ):
        mapped("ab", drives, out, replace(how, segmenter=f"labels:{out}/labels/{{drive}}"))
    assert (out / "labels/a").is_dir()


@pytest.mark.slow
def test_a_drive_of_a_map_can_be_scored_and_the_map_stays_ours(
    drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    places = [drives.by_name["a"], drives.by_name["b"]]
    run_drives(places, tmp_path / "out", SETTINGS, how, write_labels=True)
    one = tmp_path / "out/drives/a"
    score_run(one, one / "labels")
    assert foreign(tmp_path / "out") is None
    (one / "metrics.json").write_text("{}")
    assert foreign(tmp_path / "out") == "drives/a/metrics.json"
    with pytest.raises(DataError, match=r"a/metrics.json: was not written by us, or was changed since"):
        score_run(one, one / "labels")


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


@pytest.mark.slow
def test_a_drive_has_the_name_of_its_folder_also_where_we_stand_in_it(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = shutil.copytree(made["a"], tmp_path / "out")
    monkeypatch.chdir(drives.by_name["b"])
    assert add_drive(out, Path("."), how).about["merged"] == ["a", "b"]
    assert_same(out, made["ab"])


@pytest.mark.slow
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

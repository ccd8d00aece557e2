"""Many drives are one map: whoever maps them, in whatever order, the bytes are the same."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import gnss_sem_map
from maps_of_drives import SETTINGS, assert_same
from street_drives import Drives
from typer.testing import CliRunner

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.cli import app
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.evaluation.score_run import score_run
from gnss_sem_map.files import ownership
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.runs import finished_run
from gnss_sem_map.runs.finished_run import Run
from gnss_sem_map.runs.many_drives import HowMapped, add_drive, remove_drive, run_drives
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.map_json import read_frame


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


@pytest.mark.parametrize(
    ("before", "name", "after"), [("a", "b", "ab"), pytest.param("ab", "c", "abc", marks=pytest.mark.slow)]
)
def test_a_map_to_which_a_drive_was_added_is_that_of_all_at_once(
    before: str, name: str, after: str, made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out = shutil.copytree(made[before], tmp_path / "out")
    about = add_drive(out, drives.by_name[name], how).about
    assert_same(out, made[after])
    assert about["merged"] == list(after)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_map_from_which_a_drive_was_taken_is_that_of_the_others(
    made: dict[str, Path], tmp_path: Path
) -> None:
    out = shutil.copytree(made["abc"], tmp_path / "out")
    remove_drive(out, "c", workers=2)
    assert_same(out, made["ab"])


@pytest.mark.slow
def test_a_map_from_which_its_first_drive_was_taken_stays_in_its_frame(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out = shutil.copytree(made["ab"], tmp_path / "out")
    remove_drive(out, "a")
    frame = read_frame(made["ab"] / "map")
    run_drives([drives.by_name["b"]], tmp_path / "b", SETTINGS, how, origin=frame)
    assert_same(out, tmp_path / "b")
    with pytest.raises(DataError, match=r"out: b is its only drive; remove the folder instead$"):
        remove_drive(out, "b")


@pytest.mark.slow
def test_a_map_of_many_drives_that_is_refined_again_keeps_its_drives(
    made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out = shutil.copytree(made["ab"], tmp_path / "out")
    done = CliRunner().invoke(app, ["refine", str(out)])
    assert done.exit_code == 0, done.output
    assert re.fullmatch(rf"2 drives, \d+ voxels; results in {re.escape(str(out))}\n.*", done.output, re.S)
    assert_same(out, made["ab"])
    add_drive(out, drives.by_name["c"], how)
    assert_same(out, made["abc"])


@pytest.mark.slow
def test_the_drives_of_a_map_have_its_settings_also_when_it_is_refined_with_others(
    made: dict[str, Path], tmp_path: Path
) -> None:
    run, other = Run.open(made["ab"]), SETTINGS.changed("refinement.potts_mrf.enabled=false")
    out = run.refine(other, tmp_path / "out").folder
    assert [(out / f"drives/{name}/config.yaml").read_text() for name in "ab"] == [
        (out / "config.yaml").read_text()
    ] * 2
    Run.open(out).refine(SETTINGS)
    assert_same(out, made["ab"])


def test_what_merge_of_an_earlier_version_left_is_refused_with_what_to_do(
    made: dict[str, Path], tmp_path: Path
) -> None:
    """Such a folder has one map of two runs, and no drives."""
    out = shutil.copytree(made["a"], tmp_path / "out")
    (out / "run.json").write_text(json.dumps(read_run(out) | {"merged": ["a", "b"]}))
    with pytest.raises(DataError, match="gnss-sem-map run DRIVE DRIVE"):
        Run.open(out)


def test_only_a_drive_that_is_there_is_taken_out(made: dict[str, Path]) -> None:
    for name in ("z", "../a", "", "a/map"):
        with pytest.raises(DataError, match=rf"ab: holds no drive '{name}'; expected one of a, b$"):
            remove_drive(made["ab"], name)
    with pytest.raises(DataError, match=r"a: a is its only drive; remove the folder instead$"):
        remove_drive(made["a"], "a")


def labels_of(drive: Path) -> dict[str, bytes]:
    names = ("labels", "labels_raw", "confidence", "looks", "removed")
    files = [path for name in names for path in (drive / name).iterdir()]
    return {path.relative_to(drive).as_posix(): path.read_bytes() for path in files}


@pytest.mark.slow
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
    words = "--segmenter", drives.labels, "--force", "--workers", "2"
    done = gnss_sem_map("add", out, drives.by_name["c"], *words)
    assert done.returncode == 0
    assert "warning: the point labels were those of the map as it was, and are gone" in done.stderr
    assert_same(out, made["abc"])


def test_what_only_a_run_of_one_drive_can_do_is_refused_with_what_works(
    made: dict[str, Path], drives: Drives
) -> None:
    whole = Run.open(made["ab"])
    with pytest.raises(DataError, match=r"for trajectory; see drives/NAME/trajectory\.parquet in it$"):
        _ = whole.trajectory
    with pytest.raises(DataError, match="for relabelling; map the drives again with `gnss-sem-map run`"):
        whole.relabel(drives.labels)
    place = re.escape(str(made["ab"] / "drives"))
    says = f"evaluate {place}/NAME, made with --write-labels; NAME is one of a and b$"
    with pytest.raises(DataError, match=says):
        score_run(made["ab"], drives.by_name["a"])


@pytest.mark.parametrize("name", ["../../outside", "..", "", "/outside", None, 3])
def test_the_name_that_run_json_gives_a_drive_is_no_path(
    name: object, made: dict[str, Path], drives: Drives, how: HowMapped, tmp_path: Path
) -> None:
    out = shutil.copytree(made["a"], tmp_path / "out")
    about = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(about | {"drive": name}))
    ownership.write_list(out)  # who writes such a name can write its checksum, too
    with pytest.raises(DataError, match=r"run.json: damaged \(drive: found .*, expected a name\)$"):
        add_drive(out, drives.by_name["b"], how)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]

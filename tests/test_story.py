"""The command line end to end, as a user types it, checked with other people's readers."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import geopandas
import laspy
import numpy as np
import pyogrio
import pytest
import street
import street_drives
from commands import gnss_sem_map, in_a_process
from evo.tools import file_interface
from plyfile import PlyData
from street import Street

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.voxels.semantic_map import State

URBAN = open_label_set()
RAW_IDS = np.array([40, 48, 10, 50, 70, 0])
SOON = ("--set", "geometric_classifier.rows_per_fold=1000")
"""The classifier of each run is soon trained."""


def run(drive: Path, labels: Path, out: Path, *more: str) -> dict:
    done = gnss_sem_map(
        "run", drive, "--segmenter", f"labels:{labels}", "-o", out, "--write-labels", "--json", *SOON, *more
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def raw_run(small_drive: Street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As a user makes it, in a process of its own."""
    out = tmp_path_factory.mktemp("runs") / "out"
    labels = f"labels:{small_drive.labels}"
    done = in_a_process(
        "run", small_drive.drive, "--segmenter", labels, "-o", out, "--write-labels", "--json", *SOON
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == json.loads((out / "run.json").read_text())
    return out


def agreement(out: Path, driven: Street, digits: int) -> float:
    """Share of the points that a camera saw whose class is the true one."""
    right = labelled = 0
    for number in driven.frames:
        ids = np.fromfile(out / f"labels/{number:0{digits}d}.label", "<u4")
        truth = RAW_IDS[driven.scan_classes[number]]
        assert ids.shape == truth.shape
        seen = np.fromfile(out / f"labels_raw/{number:0{digits}d}.label", "<u4") > 0
        right += int((ids == truth)[seen & (ids > 0)].sum())
        labelled += int((seen & (ids > 0)).sum())
    assert labelled > 20_000
    return right / labelled


def test_a_raw_drive_becomes_a_map_with_the_right_labels(raw_run: Path, small_drive: Street) -> None:
    assert agreement(raw_run, small_drive, 10) > 0.97
    about = json.loads((raw_run / "run.json").read_text())
    assert about["counts"]["scans"] == len(small_drive.frames)
    assert about["trajectory"]["relative_poses"] >= len(small_drive.frames) - 1
    assert about["trajectory"]["relative_poses_rejected"] == 0
    assert about["counts"]["points"] == sum(map(len, small_drive.scan_classes.values()))
    assert about["skips"]["count"] == 0
    assert about["epoch_ns"] == int(street.EPOCH.astype(np.int64)) - 20_000_000
    removed = np.fromfile(raw_run / "removed/0000000003.label", "<u4")
    assert set(removed) <= {0, 1}
    assert len(removed) == len(small_drive.scan_classes[3])


def test_the_map_lies_where_the_drive_was(raw_run: Path, small_drive: Street) -> None:
    """The walls of the street stand 16 m apart, in UTM as in the PLY."""
    from pyproj import Transformer

    las = laspy.read(raw_run / "map.laz")
    crs = las.header.parse_crs()
    assert crs is not None
    assert crs.to_epsg() == 32632
    building = np.asarray(las["sem_label"]) == 50
    xyz = np.column_stack([las.x, las.y, las.z])[building]
    start = np.array(
        Transformer.from_crs(4326, 32632, always_xy=True).transform(
            street.FRAME.lon_deg, street.FRAME.lat_deg
        )
    )
    assert np.linalg.norm(xyz[:, :2].mean(axis=0) - start) < 30
    assert not (np.asarray(las["state"]) == State.REMOVED).any()
    assert (np.asarray(laspy.read(raw_run / "removed.laz")["state"]) == State.REMOVED).all()
    assert len(pyogrio.raw.read(raw_run / "map.gpkg", layer="road")[2]) > 0
    assert len(geopandas.read_parquet(raw_run / "trajectory_wgs84.parquet")) > 10
    moved = geopandas.read_parquet(raw_run / "objects.parquet")
    assert moved.crs.to_epsg() == 4979
    assert len(json.loads((raw_run / "objects.geojson").read_text())["features"]) == len(moved)
    ply = PlyData.read(raw_run / "map.ply")["vertex"]
    wall = ply["label"] == URBAN.index("building")
    north = np.asarray(ply["y"], float)[wall]
    sides = np.median(north[north > 0]), np.median(north[north < 0])
    assert sides[0] - sides[1] == pytest.approx(2 * street.WALL_M, abs=0.2)


def test_the_trajectory_is_the_motion_that_was_driven(raw_run: Path, small_drive: Street) -> None:
    tum = file_interface.read_tum_trajectory_file(str(raw_run / "trajectory.tum"))
    inside = (tum.timestamps > 0.0) & (tum.timestamps < 1.1)
    exact = small_drive.motion.poses(tum.timestamps[inside] - 0.02)[:, :3, 3]
    origin = small_drive.motion.poses(np.array([-0.02]))[0, :3, 3]
    error = tum.positions_xyz[inside] - (exact - origin)
    assert np.abs(error).max() < 0.1
    kitti = file_interface.read_kitti_poses_file(str(raw_run / "trajectory_kitti.txt"))
    np.testing.assert_allclose(kitti.positions_xyz, tum.positions_xyz, atol=1e-5)
    geojson = json.loads((raw_run / "trajectory.geojson").read_text())
    assert "coordinates" in json.dumps(geojson)


def test_an_odometry_sequence_becomes_a_map(small_drive: Street, tmp_path: Path) -> None:
    sequence = street.write_odometry(tmp_path, small_drive)
    labels = tmp_path / "probabilities"
    labels.mkdir()
    for number in small_drive.frames:
        shutil.copy(small_drive.labels / f"{number:010d}.npz", labels / f"{number:06d}.npz")
    about = run(sequence, labels, tmp_path / "out")
    assert about["local_frame"] is None
    assert agreement(tmp_path / "out", small_drive, 6) > 0.97
    assert laspy.read(tmp_path / "out/map.laz").header.parse_crs() is None


@pytest.mark.slow
def test_a_table_log_becomes_a_map(small_drive: Street, tmp_path: Path) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    run(drive, small_drive.labels, tmp_path / "out")
    assert agreement(tmp_path / "out", small_drive, 1) > 0.97


@pytest.mark.slow
def test_a_table_log_without_a_camera_is_mapped_without_asking_for_a_network(
    small_drive: Street, tmp_path: Path
) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    known = json.loads((drive / "log.yaml").read_text())
    (drive / "log.yaml").write_text(json.dumps({"T_imu_lidar": known["T_imu_lidar"]}))
    done = gnss_sem_map("run", drive, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "no camera is described, so its" in done.stderr


@pytest.mark.slow
def test_two_runs_give_the_same_map_and_a_subset_of_frames_a_smaller_one(
    raw_run: Path, small_drive: Street, tmp_path: Path
) -> None:
    run(small_drive.drive, small_drive.labels, tmp_path / "again")
    for name in ("map.ply", "map.laz", "trajectory.tum", "map/map.json", "config.yaml", "topview.png"):
        assert (raw_run / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
    about = run(small_drive.drive, small_drive.labels, tmp_path / "part", "--frames", "3:7")
    assert about["counts"]["scans"] == 4
    assert sorted(p.name for p in (tmp_path / "part/labels").iterdir()) == [
        f"{n:010d}.label" for n in range(3, 7)
    ]


@pytest.mark.slow
def test_a_drive_is_added_to_a_map_and_the_first_is_taken_out(tmp_path: Path) -> None:
    drives = street_drives.write(tmp_path, ("monday", "tuesday"))
    first, second = drives.by_name.values()
    out, segmenter = tmp_path / "out", ("--segmenter", drives.labels, "--force")
    done = gnss_sem_map("run", first, "-o", out, *segmenter)
    assert done.returncode == 0, done.stderr
    alone = json.loads((out / "run.json").read_text())["map"]["voxels"]
    done = gnss_sem_map("add", out, second)
    assert done.returncode == 1
    assert done.stderr.count("--segmenter hf:") == 3
    done = gnss_sem_map("add", out, second, *segmenter)
    assert done.returncode == 0, done.stderr
    of_both = json.loads((out / "run.json").read_text())["map"]
    assert f"2 drives, {of_both['voxels']} voxels; results in {out}" in done.stdout
    assert of_both["voxels"] > alone
    assert of_both["labelled"]["refined"]["building"] > 500
    assert len(laspy.read(out / "map.laz").points) > 1000
    done = gnss_sem_map("remove", out, "monday", "--json")
    assert done.returncode == 0, done.stderr
    about = json.loads(done.stdout)
    assert about["merged"] == ["tuesday"]
    assert about["map"]["points"] < of_both["points"]
    assert [path.name for path in (out / "drives").iterdir()] == ["tuesday"]


@pytest.mark.slow
def test_a_drive_without_images_gives_a_map_without_labels_and_a_warning(
    small_drive: Street, tmp_path: Path
) -> None:
    drive = tmp_path / "2011_09_26" / small_drive.drive.name
    shutil.copytree(small_drive.drive.parent, tmp_path / "2011_09_26")
    shutil.rmtree(drive / "image_02")
    done = gnss_sem_map("run", drive, "--segmenter", f"labels:{small_drive.labels}", "-o", tmp_path / "out")
    assert done.returncode == 0
    assert "has no images: the map shows geometry only" in done.stderr
    las = laspy.read(tmp_path / "out/map.laz")
    assert len(las.points) > 1000
    assert not np.asarray(las["sem_label"]).any()


def test_damaged_scans_and_missing_labels_are_skipped_and_counted(
    small_drive: Street, tmp_path: Path
) -> None:
    shutil.copytree(small_drive.drive.parent, tmp_path / "2011_09_26")
    shutil.copytree(small_drive.labels, tmp_path / "labels")
    data = tmp_path / "2011_09_26" / small_drive.drive.name / "velodyne_points/data"
    (data / "0000000003.bin").write_bytes((data / "0000000003.bin").read_bytes()[:1001])
    bad = np.fromfile(data / "0000000004.bin", "<f4").reshape(-1, 4)
    bad[:5] = np.nan
    bad[5:8] = 0.0
    bad[8] = 1e9
    bad.tofile(data / "0000000004.bin")
    (data / "0000000005.bin").unlink()
    np.zeros((50, 4), "<f4").tofile(data / "0000000006.bin")
    (tmp_path / "labels/0000000008.npz").unlink()
    about = run(data.parents[1], tmp_path / "labels", tmp_path / "out")
    assert about["counts"]["scans"] == 9
    assert about["counts"]["points left out"] == 9
    reasons = " ".join(skip["reason"] for skip in about["skips"]["listed"])
    assert about["skips"]["count"] == 4
    for says in ("truncated scan", "1 files missing", "no labels of frame 8", "no usable point of 50"):
        assert says in reasons + " ".join(skip["where"] for skip in about["skips"]["listed"])
    for number in (4, 7):
        ids = np.fromfile(tmp_path / f"out/labels/{number:010d}.label", "<u4")
        truth = RAW_IDS[small_drive.scan_classes[number]]
        seen = np.fromfile(tmp_path / f"out/labels_raw/{number:010d}.label", "<u4") > 0
        assert (ids == truth)[seen].mean() > 0.97, "nothing may shift"


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("run", "nowhere", "-o", "out"), 1, "nowhere: no such folder; expected a drive"),
        (("run",), 2, "Missing argument 'DRIVE...'; see gnss-sem-map run --help"),
        (("rnu",), 2, "Did you mean 'run'?; see gnss-sem-map --help"),
        (("run", "DRIVE", "-o", "out", "--segmneter", "none"), 2, "--segmneter (Possible options: --segmenter"),
        (("run", "DRIVE", "-o", "out", "--workers", "0"), 2, "Invalid value for '--workers'"),
        (("demo", "-o", "out", "--labels", "true"), 2, "Invalid value for '--labels'"),
        (("run", "DRIVE", "-o", "out", "--set", "mapping.voxl=1"), 1, "unknown setting 'mapping.voxl'"),
        (("run", "DRIVE", "-o", "out", "--frames", "3"), 2, "expected A:B"),
        (("run", "DRIVE", "-o", "out", "--frames", "5:2"), 2, "expected A:B with A below B"),
        (("run", "DRIVE", "-o", "out", "--format", "ros"), 2, "expected one of"),
        (("run", "DRIVE", "-o", "out", "--segmenter", "magic"), 1, "unknown kind 'magic'"),
        (("run", "DRIVE", "-o", "out", "--segmenter", "lables:x"), 1, "did you mean 'labels'?"),
        (("run", "DRIVE", "-o", "out", "--segmenter", "labels:nowhere"), 1, "nowhere"),
        (("run", "DRIVE", "-o", "out", "--segmenter", "none", "--frames", "100:200"), 1, "none that --frames names"),
        (("run", "DRIVE", "-o", "DRIVE"), 1, "which is read; choose another -o"),
        (("run", "DRIVE", "-o", "out", "--origin", "49.0,8.4"), 2, "found '49.0,8.4', expected three"),
        (("run", "DRIVE", "-o", "out", "--origin", "91,8.4,0"), 2, "expected |lat| <= 90"),
        (("run", "DRIVE", "-o", "out", "--segmenter", "none", "--scheduler", "x:1"), 1, "no Dask scheduler answers"),
        (("run", "A", "B", "-o", "out", "--segmenter", "none", "--scheduler", "x", "--workers", "2"), 2, "own workers"),
        (("run", "@EMPTY", "-o", "out"), 2, "found no drive in @"),
        (("run", "@nowhere.txt", "-o", "out"), 1, "nowhere.txt: cannot read it"),
        (("add", "out", "DRIVE"), 1, "no run folder here; expected the -o of an earlier `gnss-sem-map run`"),
        (("remove", "out", "DRIVE"), 1, "no run folder here; expected the -o of an earlier `gnss-sem-map run`"),
    ],
)  # fmt: skip
def test_a_mistake_is_answered_in_one_line(
    arguments: tuple[str, ...], code: int, says: str, small_drive: Street, tmp_path: Path
) -> None:
    (tmp_path / "empty.txt").write_text("# no drive yet\n\n")
    places = {"DRIVE": small_drive.drive, "out": tmp_path / "out", "@EMPTY": f"@{tmp_path / 'empty.txt'}"}
    done = gnss_sem_map(*(places.get(a, a) for a in arguments))
    assert done.returncode == code
    assert says in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert done.stderr.startswith("gnss-sem-map: ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def refused(*arguments: str | Path) -> str:
    """What a command says when it ends with an error of ours: one line."""
    done = gnss_sem_map(*arguments)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


def test_segmenting_again_says_that_nothing_was_to_do(small_drive: Street, tmp_path: Path) -> None:
    arguments = ("segment", small_drive.drive, "--segmenter", f"labels:{small_drive.labels}", "-o", tmp_path)
    images = len(list((small_drive.drive / "image_02/data").glob("*.png")))
    first, second = gnss_sem_map(*arguments), gnss_sem_map(*arguments)
    assert f"{images} images segmented" in first.stdout
    assert "images/s" in first.stdout
    assert f"nothing to do: all {images} images are segmented" in second.stdout
    assert "images/s" not in second.stdout
    for done in (first, second):
        assert f"now use --segmenter labels:{tmp_path}" in done.stdout


def test_segmenting_lists_class_names_that_nobody_knows(small_drive: Street, tmp_path: Path) -> None:
    labels = tmp_path / "labels"
    labels.mkdir()
    for path in small_drive.labels.iterdir():
        with np.load(path) as content:
            names = ["blimp" if name == "other" else name for name in content["class_names"].tolist()]
            np.savez_compressed(labels / path.name, probabilities=content["probabilities"], class_names=names)
    spec = f"labels:{labels}"
    done = gnss_sem_map("segment", small_drive.drive, "--segmenter", spec, "-o", tmp_path / "out")
    assert done.returncode == 0
    said = "warning: {}: 1 of 6 class names are unknown and count as other: blimp"
    assert done.stderr.splitlines().count(said.format(spec)) == 1


def test_what_cannot_be_evaluated_says_what_is_missing_and_what_to_do(
    raw_run: Path, small_drive: Street, tmp_path: Path
) -> None:
    again, track = tmp_path / "again", tmp_path / "track"
    shutil.copytree(raw_run, again)
    assert gnss_sem_map("trajectory", small_drive.drive, "-o", track).returncode == 0
    shutil.rmtree(again / "labels")
    for folder, missing, what_to_do in (
        (track, "a trajectory without a map", "gnss-sem-map run ... --write-labels"),
        (again, "no point labels in this run", "make it again with --write-labels"),
        (tmp_path / "nowhere", "no run folder here", "expected the -o of an earlier `gnss-sem-map run`"),
    ):  # fmt: skip
        said = refused("evaluate", folder, "--truth", raw_run)
        assert str(folder) in said
        assert missing in said
        assert what_to_do in said


def test_a_drive_with_images_and_no_segmenter_is_told_its_choices(
    small_drive: Street, tmp_path: Path
) -> None:
    done = gnss_sem_map("run", small_drive.drive, "-o", tmp_path / "out")
    assert done.returncode == 1
    assert done.stderr.count("--segmenter hf:") == 3
    assert "licence" in done.stderr
    assert not (tmp_path / "out").exists()


def test_the_settings_that_are_printed_are_those_of_the_run(raw_run: Path) -> None:
    assert gnss_sem_map("config", *SOON).stdout == (raw_run / "config.yaml").read_text()


def test_help_loads_nothing_heavy() -> None:
    code = "import sys; from gnss_sem_map.cli import app; print([m for m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for heavy in ("gtsam", "sklearn", "torch", "matplotlib", "numba", "scipy", "numpy", "pykitti", "cv2"):
        assert f"'{heavy}'" not in done.stdout, heavy


@pytest.mark.parametrize(
    ("drive", "labels", "frames"),
    [
        ("kitti_raw/2011_09_26/2011_09_26_drive_0005_sync", "kitti_raw_0005", "114:122"),
        ("semantic_kitti/sequences/08", "semantic_kitti/08", "0:5"),
    ],
)
def test_a_real_drive_becomes_a_map(
    real_data: Path, drive: str, labels: str, frames: str, tmp_path: Path
) -> None:
    place, first, end = real_data / f"labels/{labels}/probabilities", *map(int, frames.split(":"))
    about = run(real_data / drive, place, tmp_path / "out", "--frames", frames)
    assert about["counts"]["scans"] == end - first
    assert len(list((tmp_path / "out/labels").iterdir())) == end - first
    assert about["counts"]["points labelled"] > 0.12 * about["counts"]["points"]
    assert not [skip for skip in about["skips"]["listed"] if "files missing" not in skip["reason"]]

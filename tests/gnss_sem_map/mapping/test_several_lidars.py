"""Several LiDARs: each is mapped from where it is, by its own rows, and the map is the sum of what all of them see."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
import street
from chunks import assert_same, build_maps, by_chunks
from street import Street

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.label_files import label_files
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import fingerprints
from gnss_sem_map.mapping.chunks import chunks_of, map_chunks
from gnss_sem_map.mapping.edge_windows import EdgeWindows
from gnss_sem_map.mapping.fusion import map_scans
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.mapping.raw_map import open_raw, write_raw
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.sensor_log import Lidar, Scan, SensorLog
from gnss_sem_map.voxels.voxel_map import VoxelMap

URBAN = open_label_set()
STILL = Settings.model_validate({"dynamics": {"enabled": False}})
SWEEPS = 14
CAR = ((16.0, -1.2, 0.0), (20.0, 0.6, 1.5), (6.0, 0.0, 0.0))


def turned_and_moved() -> np.ndarray:
    """T_first_second of a LiDAR that is mounted elsewhere, askew."""
    T = np.eye(4)
    T[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    T[:3, 3] = 0.3, -0.4, 0.2
    return T


def as_seen_by_another(log: SensorLog, scan: Scan) -> Scan:
    """The same points, in the frame of the second LiDAR."""

    def read():
        points = scan.read()
        T = np.linalg.inv(turned_and_moved())
        return replace(points, xyz=(points.xyz @ T[:3, :3].T + T[:3, 3]).astype(np.float32))

    return replace(scan, read=read)


def second(log: SensorLog, scans: tuple[Scan, ...]) -> Lidar:
    T_imu_second = log.calibration.T_imu_lidar @ turned_and_moved()
    return Lidar("second", T_imu_second, tuple(as_seen_by_another(log, scan) for scan in scans))


@pytest.fixture(scope="module")
def still(small_drive: Street) -> Drive:
    """The small street, its labels, its exact trajectory."""
    log = open_drive(small_drive.drive)
    stamps = np.arange(small_drive.motion.start, small_drive.motion.end, 0.01)
    trajectory = Trajectory(stamps, small_drive.motion.poses(stamps), small_drive.motion.velocities(stamps))
    segmenter = open_segmenter(f"labels:{small_drive.labels}", URBAN, sizes=log.calibration.image_sizes)
    return Drive(log, trajectory, segmenter, STILL)


@pytest.fixture(scope="module")
def moving() -> Drive:
    """A street in which a car drives ahead."""
    motion = scenes.drive(SWEEPS * scenes.SWEEP_S)
    points = {k: scenes.sweep(motion, scenes.street([CAR]), k) for k in range(SWEEPS)}
    log = scenes.log_of(points, scenes.trajectory_of(motion, SWEEPS))
    assert log.given is not None
    return by_chunks(Drive(log, log.given, None, Settings()), 3)


def test_scans_of_two_lidars_are_in_the_map_where_those_of_one_would_be(still: Drive) -> None:
    """Every second scan is of a LiDAR that is mounted elsewhere: points move by rounding, and keep their labels."""
    log = still.log
    both = replace(log, scans=log.scans[::2], lidar="first", others=(second(log, log.scans[1::2]),))
    one, two = RunStats(), RunStats()
    expected = build_maps(still, one).static
    found = build_maps(replace(still, log=both), two).static
    assert two.counts["scans"] == one.counts["scans"] == len(log.scans)
    assert abs(two.counts["points labelled"] - one.counts["points labelled"]) < 20
    there = expected.indices_of(found.keys)
    assert (there >= 0).mean() > 0.99
    same = expected.evidence[there[there >= 0]] == found.evidence[there >= 0]
    assert same.all(axis=1).mean() > 0.98


def twice(one: VoxelMap) -> VoxelMap:
    return one + one


def test_two_lidars_that_see_the_same_make_the_map_of_one_twice(moving: Drive) -> None:
    """Also of what moved: each LiDAR finds it in its own scans."""
    log = moving.log
    both = replace(log, lidar="a", others=(Lidar("b", log.calibration.T_imu_lidar, log.scans),))
    one, two = build_maps(moving, RunStats()), build_maps(replace(moving, log=both), RunStats())
    assert len(one.removed) > 100
    assert_same(twice(one.static), two.static)
    assert_same(twice(one.removed), two.removed)


@pytest.mark.slow
def test_chunks_of_two_lidars_are_the_same_for_any_division(moving: Drive, tmp_path: Path) -> None:
    log = moving.log
    both = replace(moving, log=replace(log, lidar="a", others=(second(log, log.scans[2:]),)))
    count = len(chunks_of(both))
    waiting = tmp_path / "waiting"
    waiting.mkdir()
    together = list(map_chunks(both, range(count), waiting, EdgeWindows(tmp_path, "")))
    assert [chunk.number for chunk in together] == list(range(count))
    assert [chunk.lidar for chunk in together] == ["a"] * len(chunks_of(moving)) + ["second"] * (
        count - len(chunks_of(moving))
    )
    for split in range(1, count):
        work = tmp_path / str(split)
        work.mkdir()
        apart = [
            chunk
            for part in (range(split, count), range(split))
            for chunk in map_chunks(both, part, waiting, EdgeWindows(work, ""))
        ]
        for one, other in zip(together, sorted(apart, key=lambda chunk: chunk.number), strict=True):
            assert (one.number, one.lidar) == (other.number, other.lidar)
            assert_same(one.static, other.static)
            assert_same(one.removed, other.removed)
            assert all(
                np.array_equal(indices, other.moving[number]) for number, indices in one.moving.items()
            )


def test_points_that_moved_are_kept_by_lidar(moving: Drive, tmp_path: Path) -> None:
    log = moving.log
    both = replace(moving, log=replace(log, lidar="a", others=(second(log, log.scans[2:]),)))
    write_raw(map_scans(both, tmp_path / "work", RunStats()), tmp_path, scenes.FRAME)
    beside = open_raw(tmp_path, URBAN).evidence
    assert sorted(beside.moving("a")) == [scan.number for scan in log.scans]
    assert sorted(beside.moving("second")) == [scan.number for scan in log.scans[2:]]
    assert beside.moving() == {}


def test_where_another_lidar_is_decides_the_map(moving: Drive) -> None:
    log = moving.log
    places = [np.eye(4), turned_and_moved()]
    said = {
        fingerprints.of_map(
            replace(moving, log=replace(log, lidar="a", others=(Lidar("b", T, log.scans),))), ""
        )
        for T in places
    }
    assert len(said) == 2


@pytest.fixture
def two_lidars(tmp_path: Path, small_drive: Street) -> Path:
    """The small street as a CSV log; its odd scans are of a second LiDAR."""
    drive = street.write_table_log(tmp_path / "log", small_drive)
    about = json.loads((drive / "log.yaml").read_text())
    T = np.array(about.pop("T_imu_lidar"))
    about["lidars"] = {
        "top": {"T_imu_lidar": T.tolist()},
        "rear": {"T_imu_lidar": (T @ turned_and_moved()).tolist()},
    }
    (drive / "log.yaml").write_text(json.dumps(about))
    files, lines = (
        sorted((drive / "lidar").glob("*.bin")),
        (drive / "lidar/stamps.csv").read_text().splitlines(),
    )
    for number, name in enumerate(("top", "rear")):
        folder = drive / "lidar" / name
        folder.mkdir()
        for path in files:
            if int(path.stem) % 2 == number:
                rows = np.fromfile(path, "<f4").reshape(-1, 5)
                if name == "rear":
                    inverse = np.linalg.inv(turned_and_moved())
                    rows[:, :3] = rows[:, :3] @ inverse[:3, :3].T + inverse[:3, 3]
                rows.astype("<f4").tofile(folder / path.name)
        chosen = [line for line in lines[1:] if int(line.split(",")[0]) % 2 == number]
        (folder / "stamps.csv").write_text("\n".join([lines[0], *chosen]) + "\n")
    for path in files:
        path.unlink()
    (drive / "lidar/stamps.csv").unlink()
    return drive


def test_a_log_lists_its_lidars(two_lidars: Path, small_drive: Street) -> None:
    log = open_drive(two_lidars)
    assert (log.lidar, [lidar.name for lidar in log.others], log.scan_count) == (
        "top",
        ["rear"],
        len(small_drive.frames),
    )
    assert [one.lidar for one in log.by_lidar] == ["top", "rear"]
    rear = log.between("3:8").by_lidar[1]
    assert [scan.number for scan in rear.scans] == [3, 5, 7]
    np.testing.assert_allclose(
        rear.calibration.T_imu_lidar, street.T_IMU_LIDAR @ turned_and_moved(), atol=1e-9
    )
    in_imu = rear.calibration.camera().T_camera_lidar @ np.linalg.inv(rear.calibration.T_imu_lidar)
    np.testing.assert_allclose(in_imu, street.T_CAMERA_LIDAR @ np.linalg.inv(street.T_IMU_LIDAR), atol=1e-9)
    assert {path.name for path in log.folders} == {"top", "rear", "images"}


def test_lidars_without_names_of_their_own_are_refused(moving: Drive) -> None:
    log = moving.log
    other = Lidar("a", np.eye(4), log.scans)
    for name in ("", "a", "b/c"):
        with pytest.raises(DataError, match="found LiDARs"):
            replace(log, lidar=name, others=(other,))


def test_labels_of_points_are_in_the_folder_of_their_lidar(
    two_lidars: Path, small_drive: Street, tmp_path: Path
) -> None:
    """Run, refine again, and evaluate."""
    from typer.testing import CliRunner

    from gnss_sem_map.cli import app

    out, truth = tmp_path / "out", tmp_path / "truth"
    spec = f"labels:{small_drive.labels}"
    words = ["-o", str(out), "--segmenter", spec, "--write-labels", "--workers", "1", "--force"]
    ran = CliRunner().invoke(app, ["run", str(two_lidars), *words])
    assert ran.exit_code == 0, ran.output
    written = label_files(out / "labels")
    expected = {f"{('top', 'rear')[k % 2]}/{k}" for k in small_drive.frames}
    assert set(written) == expected
    assert set(label_files(out / "removed")) == expected
    ids = np.array([40, 48, 10, 50, 70, 0], "<u4")
    for k in small_drive.frames:
        file = truth / "labels" / ("top", "rear")[k % 2] / f"{k}.label"
        file.parent.mkdir(parents=True, exist_ok=True)
        ids[small_drive.scan_classes[k]].tofile(file)
        assert len(np.fromfile(out / "labels" / ("top", "rear")[k % 2] / f"{k}.label", "<u4")) == len(
            small_drive.scan_classes[k]
        )
    scored = CliRunner().invoke(app, ["evaluate", str(out), "--truth", str(truth)])
    assert scored.exit_code == 0, scored.output
    figures = json.loads((out / "metrics.json").read_text())["semantics"]["refined"]
    assert figures["mean_accuracy"] > 0.9
    shutil.rmtree(out)

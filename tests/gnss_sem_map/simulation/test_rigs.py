"""Rigs of several sensors: all lenses show points where they are, in every layout, with the truth beside them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.label_files import label_files
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.scans import kernels
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.simulation import Simulation, prepare, write_corrupted_labels
from gnss_sem_map.simulation.layouts import Layout, write_rig
from gnss_sem_map.simulation.rigs import RIGS, Rig, RigName
from gnss_sem_map.simulation.table_drive import write_table

SECONDS, SEED = 0.6, 0
COARSER = 4
TRUE = {40: 0, 60: 0, 48: 1, 50: 2, 70: 8, 72: 9, 80: 5, 10: 13, 252: 13, 18: 14, 44: 255}
"""Class in the image of a point's class."""


def coarse(name: RigName) -> Rig:
    """A rig with a quarter of the pixels and points in a row."""
    rig = RIGS[name]()
    lidars = tuple(
        replace(lidar, sensor=replace(lidar.sensor, columns=lidar.sensor.columns // COARSER))
        for lidar in rig.lidars
    )
    cameras = []
    for camera in rig.cameras:
        sensor = camera.sensor
        smaller = replace(
            sensor,
            width=sensor.width // COARSER,
            height=sensor.height // COARSER,
            focal_px=sensor.focal_px / COARSER,
            centre_u_px=(sensor.centre_u_px + 0.5) / COARSER - 0.5,
            centre_v_px=(sensor.centre_v_px + 0.5) / COARSER - 0.5,
        )
        cameras.append(replace(camera, sensor=smaller))
    return Rig(lidars, tuple(cameras))


@pytest.fixture(scope="module", params=["surround", "kitti-360"])
def simulation(request: pytest.FixtureRequest) -> Simulation:
    return prepare(SECONDS, SEED, rig=coarse(request.param))


@pytest.fixture(scope="module")
def surround() -> Simulation:
    return prepare(SECONDS, SEED, rig=coarse("surround"))


@pytest.fixture(scope="module")
def table(surround: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_table(surround, tmp_path_factory.mktemp("table"), workers=2)


def test_points_fall_on_pixels_of_their_own_class_through_every_lens(simulation: Simulation) -> None:
    """At the moment of exposure, where the image's depth is the point's own and the pixels around show one class."""
    frame = 3
    rig = simulation.rig
    for lidar_number, lidar in enumerate(rig.lidars):
        scan = simulation.scan(frame, lidar_number)
        start, end = simulation.sweeps[frame] + lidar.sweep_after_s
        columns, column = np.unique(scan.fractions, return_inverse=True)
        T_map_lidar = simulation.world.ego.poses(start + columns * (end - start)) @ lidar.T_imu_lidar
        p = np.column_stack([scan.points[:, :3].astype(np.float64), np.ones(len(scan.points))])
        p_map = np.einsum("nij,nj->ni", T_map_lidar[column], p)
        for number, camera in enumerate(rig.cameras):
            image = simulation.image(frame, number)
            moment = simulation.stamps[frame] + camera.exposure_after_s
            T_camera_map = np.linalg.inv(simulation.world.ego.poses([moment])[0] @ camera.T_imu_camera)
            u, v, z = projected(simulation, number, p_map, T_camera_map)
            right = total = 0
            height, width = image.depth.shape
            inner = (z > 0.5) & (u >= 1) & (v >= 1) & (u < width - 1) & (v < height - 1)
            for raw, row, c, depth in zip(
                scan.labels[inner] & 0xFFFF, v[inner], u[inner], z[inner], strict=True
            ):
                around = image.train_ids[row - 1 : row + 2, c - 1 : c + 2]
                if raw in TRUE and (around == around[1, 1]).all() and abs(image.depth[row, c] - depth) < 0.5:
                    total, right = total + 1, right + int(around[1, 1] == TRUE[raw])
            assert total > 200, (lidar.name, camera.name)
            assert right / total > 0.99, (lidar.name, camera.name)


def projected(
    simulation: Simulation, number: int, p_map: np.ndarray, T_camera_map: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels, and depths along the axis, by the projection of the mapping."""
    from gnss_sem_map.sensor_log.cameras import Camera

    sensor = simulation.rig.cameras[number].sensor
    camera = Camera(np.eye(4), sensor.K, (sensor.width, sensor.height), distortion=sensor.distortion)
    found, points = np.empty((len(p_map), 3)), np.ascontiguousarray(p_map[:, :3])
    kernels.pixels(points, camera.projection(T_camera_map), camera.lens, 0.5, found)
    z = p_map @ T_camera_map[2]
    pixels = np.round(np.nan_to_num(found[:, :2], nan=-1.0)).astype(np.int64)
    return pixels[:, 0], pixels[:, 1], np.where(found[:, 2] > 0, z, 0.0)


def test_the_cameras_of_the_surround_rig_see_nearly_all_that_its_lidars_see(surround: Simulation) -> None:
    rig, seen = surround.rig, []
    for number, lidar in enumerate(rig.lidars):
        points = surround.scan(3, number).points.astype(np.float64)
        p_imu = np.column_stack([points[:, :3], np.ones(len(points))]) @ lidar.T_imu_lidar.T
        shown = np.zeros(len(points), bool)
        for k, camera in enumerate(rig.cameras):
            u, v, _ = projected(surround, k, p_imu, np.linalg.inv(camera.T_imu_camera))
            sensor = camera.sensor
            shown |= (u >= 0) & (v >= 0) & (u < sensor.width) & (v < sensor.height)
        seen.append(shown.mean())
    assert min(seen) > 0.97


def test_the_table_is_read_without_a_word(table: Path, surround: Simulation) -> None:
    log = open_drive(table)
    assert log.skips == ()
    assert [one.lidar for one in log.by_lidar] == ["left", "right"]
    assert [camera.name for camera in log.cameras] == ["front", "left", "right", "back"]
    assert log.frame == surround.frame
    for number, of in enumerate(log.by_lidar):
        lidar, frame = surround.rig.lidars[number], 4
        scan, points = surround.scan(frame, number), of.scans[frame].read()
        np.testing.assert_array_equal(points.rows.reshape(-1, 4), scan.points)
        start, end = surround.sweeps[frame] + lidar.sweep_after_s - surround.zero_s
        assert points.stamps is not None
        np.testing.assert_allclose(points.stamps, start + scan.fractions * (end - start), atol=1e-8)
        np.testing.assert_allclose(of.calibration.T_imu_lidar, lidar.T_imu_lidar, atol=1e-12)
        for k, camera in enumerate(surround.rig.cameras):
            T = lidar.T_imu_lidar @ np.linalg.inv(of.calibration.camera(camera.name).T_camera_lidar)
            np.testing.assert_allclose(T, camera.T_imu_camera, atol=1e-12)
            image = of.images_of(camera.name)[frame]
            np.testing.assert_array_equal(image.read(), surround.image(frame, k).rgb)
            exposed = image.stamp + of.calibration.camera(camera.name).time_offset_s + surround.zero_s
            assert exposed == pytest.approx(surround.stamps[frame] + camera.exposure_after_s, abs=1e-8)


def test_truth_is_by_sensor_and_corrupted_labels_are_a_segmenter_s(
    table: Path, surround: Simulation, tmp_path: Path
) -> None:
    labels = label_files(table / "truth" / "labels")
    assert sorted(labels) == [f"{name}/{k:010d}" for name in ("left", "right") for k in range(6)]
    expected = surround.scan(2, 1).labels
    np.testing.assert_array_equal(np.fromfile(labels["right/0000000002"], "<u4"), expected)
    log = open_drive(table)
    write_corrupted_labels(table, tmp_path, SEED, workers=2)
    read = open_segmenter(f"labels:{tmp_path}", open_label_set(), sizes=log.calibration.image_sizes)
    right = []
    for number, camera in enumerate(log.cameras):
        ids = surround.image(2, number).train_ids[: camera.image_size[1] // 2 * 2 : 2, ::2]
        found = np.asarray(read(log.images_of(camera.name)[2])).argmax(axis=2)
        for class_id, index in ((0, 0), (2, 3), (8, 4)):
            right.append((found[ids == class_id] == index).mean())
    assert np.mean(right) > 0.8
    first, second = (
        np.load(tmp_path / name / "0000000002.npz")["probabilities"] for name in ("left", "right")
    )
    assert not np.array_equal(first, second)


@pytest.mark.parametrize("layout", [pytest.param("rosbag1", marks=pytest.mark.slow), "mcap"])
@pytest.mark.parametrize("name", ["surround", pytest.param("kitti-360", marks=pytest.mark.slow)])
def test_a_bag_of_a_rig_reads_as_its_table(name: RigName, layout: Layout, tmp_path: Path) -> None:
    simulation = prepare(0.3, SEED, rig=coarse(name))
    table = open_drive(write_table(simulation, tmp_path / "table", workers=2))
    bag = open_drive(write_rig(simulation, tmp_path / "bag", layout, workers=2))
    assert bag.skips == ()
    assert (bag.name, [one.lidar for one in bag.by_lidar]) == (
        table.name,
        [one.lidar for one in table.by_lidar],
    )
    shift = (table.epoch_ns - bag.epoch_ns) * 1e-9
    for one, other in zip(table.by_lidar, bag.by_lidar, strict=True):
        np.testing.assert_allclose(other.calibration.T_imu_lidar, one.calibration.T_imu_lidar, atol=1e-12)
        compare_scans(one, other, shift)
    for camera in table.cameras:
        found = bag.calibration.camera(camera.name)
        np.testing.assert_allclose(found.T_camera_lidar, camera.T_camera_lidar, atol=1e-12)
        np.testing.assert_array_equal(found.K, camera.K)
        assert (found.image_size, found.time_offset_s) == (camera.image_size, camera.time_offset_s)
        np.testing.assert_array_equal(found.lens, camera.lens)
        one, other = table.images_of(camera.name)[1], bag.images_of(camera.name)[1]
        assert one.stamp - other.stamp == pytest.approx(-shift, abs=2e-9)
        np.testing.assert_array_equal(other.read(), one.read())
    assert table.imu is not None
    assert bag.imu is not None
    np.testing.assert_allclose(bag.imu.stamps, table.imu.stamps + shift, atol=2e-9)
    np.testing.assert_array_equal(bag.imu.specific_force, table.imu.specific_force)


def compare_scans(table: SensorLog, bag: SensorLog, shift: float) -> None:
    """The points of a scan, and their times."""
    one, other = table.scans[1].read(), bag.scans[1].read()
    np.testing.assert_array_equal(other.rows, one.rows)
    assert one.stamps is not None
    assert other.stamps is not None
    np.testing.assert_allclose(other.stamps, one.stamps + shift, atol=2e-9)


def test_a_rig_is_not_written_over_another_nor_as_kitti_raw(table: Path, surround: Simulation) -> None:
    with pytest.raises(DataError, match="is already there"):
        write_table(surround, table.parent)
    with pytest.raises(DataError, match="one LiDAR and one camera"):
        write_rig(surround, table.parent, "kitti-raw")
    assert [path.name for path in table.parent.iterdir()] == [table.name]


@pytest.mark.slow
def test_threads_do_not_change_a_byte(table: Path, surround: Simulation, tmp_path: Path) -> None:
    again = write_table(surround, tmp_path, workers=1)
    files = sorted(path.relative_to(table) for path in table.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    assert all((table / file).read_bytes() == (again / file).read_bytes() for file in files)

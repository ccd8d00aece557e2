"""The drive on disk: other people's readers and our own read it, and its truth is the truth."""

import csv
import json
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pykitti
import pytest
from scipy.spatial.transform import Rotation

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.datasets import kitti_raw
from gnss_sem_map.errors import DataError
from gnss_sem_map.simulation import Simulation, simulate
from gnss_sem_map.simulation.kitti_rig import T_LIDAR_IMU, camera_in_lidar

FRAMES = 12


def tum(path: Path) -> np.ndarray:
    return np.loadtxt(path)


def test_pykitti_reads_the_drive(town_drive: Path, simulation: Simulation) -> None:
    date, _, number, _ = town_drive.name.rsplit("_", 3)
    drive = pykitti.raw(str(town_drive.parents[1]), date, number)
    assert len(drive) == len(drive.timestamps) == len(drive.velo_files) == len(drive.cam2_files) == FRAMES
    np.testing.assert_allclose(drive.calib.T_velo_imu, T_LIDAR_IMU, atol=1e-8)
    assert drive.calib.K_cam2[0, 0] == pytest.approx(simulation.camera.focal_px)
    np.testing.assert_allclose(
        drive.calib.T_cam2_velo[:3, :3], camera_in_lidar(simulation.camera)[:3, :3], atol=1e-6
    )
    np.testing.assert_array_equal(drive.get_velo(3), simulation.scan(3).points)
    np.testing.assert_array_equal(np.asarray(drive.get_cam2(3)), simulation.image(3).rgb)
    assert drive.oxts[0].packet.pos_accuracy > 0


def test_our_reader_reads_it_without_a_word(town_drive: Path, simulation: Simulation) -> None:
    log = kitti_raw.read(town_drive)
    assert log.skips == ()
    assert len(log.scans) == len(log.images) == FRAMES
    about = json.loads((town_drive / "truth" / "world.json").read_text())
    assert log.epoch_ns == about["epoch_ns"]
    assert log.frame is not None
    assert log.frame.lat_deg == pytest.approx(about["lat_deg"], abs=1e-11)
    truth = tum(town_drive / "truth" / "trajectory_lidar.tum")
    np.testing.assert_allclose([scan.stamp for scan in log.scans], truth[:, 0], atol=2e-7)
    exposures = np.array([image.stamp for image in log.images]) + log.calibration.camera().time_offset_s
    np.testing.assert_allclose(exposures, truth[:, 0] + 0.002, atol=2e-7)
    np.testing.assert_allclose(
        log.calibration.camera().T_camera_lidar, camera_in_lidar(simulation.camera), atol=1e-7
    )
    points = log.scans[2].read()
    assert points.stamps is not None
    assert points.stamps.min() == pytest.approx(simulation.sweeps[2, 0] - simulation.zero_s, abs=1e-3)
    assert log.imu is not None
    assert np.median(np.diff(log.imu.stamps)) == pytest.approx(0.01, abs=1e-4)


def test_the_imu_columns_integrate_to_the_true_motion(town_drive: Path) -> None:
    log = kitti_raw.read(town_drive)
    truth = tum(town_drive / "truth" / "trajectory.tum")
    assert log.imu is not None
    assert log.frame is not None
    R = Rotation.from_quat(truth[0, 4:]).as_matrix()
    p = truth[0, 1:4].copy()
    v = (truth[2, 1:4] - truth[0, 1:4]) / (truth[2, 0] - truth[0, 0])
    dt = np.diff(log.imu.stamps)
    v -= (R @ log.imu.specific_force[0] - [0, 0, log.frame.gravity]) * dt[0]
    for k, step in enumerate(dt):
        rate = 0.5 * (log.imu.angular_rate[k] + log.imu.angular_rate[k + 1])
        force = R @ log.imu.specific_force[k] - np.array([0.0, 0.0, log.frame.gravity])
        p += v * step + 0.5 * force * step**2
        v += force * step
        R = R @ Rotation.from_rotvec(rate * step).as_matrix()
    assert np.linalg.norm(p - truth[-1, 1:4]) < 0.15
    assert Rotation.from_matrix(R.T @ Rotation.from_quat(truth[-1, 4:]).as_matrix()).magnitude() < 0.004


def test_the_unit_s_position_drifts_within_what_it_claims(whole_drive: Simulation) -> None:
    reported = whole_drive.frame.to_map(*whole_drive.oxts[:, :3].T)
    true = whole_drive.to_map(whole_drive.world.ego.poses(whole_drive.oxts_stamps)[:, :3, 3])
    error = reported - true
    claimed = whole_drive.oxts[0, 23]
    assert 0.05 < np.linalg.norm(error[:, :2], axis=1).max() < 5 * claimed
    assert np.abs(np.diff(error, axis=0)).max() < 0.2  # smooth: no receiver's white noise
    yaw = whole_drive.oxts[:, 5]
    T = whole_drive.world.ego.poses(whole_drive.oxts_stamps)
    true_yaw = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    assert np.abs((yaw - true_yaw + np.pi) % (2 * np.pi) - np.pi).max() < 0.01


def test_oxts_rows_follow_the_scans_with_a_jitter(whole_drive: Simulation) -> None:
    late = whole_drive.oxts_stamps[whole_drive.sync] - whole_drive.stamps
    assert 0.004 < late.min() < late.max() < 0.029
    assert late.std() > 0.002


def test_the_map_is_the_frame_of_the_first_row(town_drive: Path, simulation: Simulation) -> None:
    about = json.loads((town_drive / "truth" / "world.json").read_text())
    first = np.fromstring((town_drive / "oxts" / "data" / "0000000000.txt").read_text(), sep=" ")
    frame = LocalFrame(about["lat_deg"], about["lon_deg"], about["alt_m"])
    np.testing.assert_allclose(frame.to_map(*first[:3, None]), 0.0, atol=1e-5)
    truth = tum(town_drive / "truth" / "trajectory_lidar.tum")
    T = simulation.world.ego.poses(simulation.stamps)
    apart = truth[:, 1:4] - T[:, :3, 3]
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-4)
    assert 1e-3 < np.linalg.norm(apart[0]) < 20.0


def test_labels_class_images_and_points_belong_together(town_drive: Path, simulation: Simulation) -> None:
    for k in range(FRAMES):
        points = np.fromfile(town_drive / "velodyne_points" / "data" / f"{k:010d}.bin", "<f4").reshape(-1, 4)
        labels = np.fromfile(town_drive / "truth" / "labels" / f"{k:010d}.label", "<u4")
        alone = np.fromfile(town_drive / "truth" / "single_frame" / f"{k:010d}.label", "<u4")
        ids = cv2.imread(str(town_drive / "truth" / "train_ids" / f"{k:010d}.png"), cv2.IMREAD_UNCHANGED)
        assert len(points) == len(labels) == len(alone) > 2000
        assert ids.shape == (simulation.camera.height, simulation.camera.width)
        assert set(np.unique(alone)) <= {0, 40, 48, 10, 50, 70}
        known = {40: 40, 60: 40, 48: 48, 10: 10, 252: 10, 18: 10, 258: 10, 50: 50, 70: 70, 71: 70}
        truth = np.array([known.get(int(label), 0) for label in labels & 0xFFFF])
        both = (alone > 0) & (truth > 0)
        assert both.sum() > 100
        assert (alone[both] == truth[both]).mean() > 0.93  # borders included, at a third of the resolution


def test_the_vehicle_table_says_where_the_points_of_a_vehicle_are(
    town_drive: Path, simulation: Simulation
) -> None:
    with (town_drive / "truth" / "vehicles.csv").open() as file:
        rows = list(csv.DictReader(file))
    truth = tum(town_drive / "truth" / "trajectory_lidar.tum")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(truth[4, 4:]).as_matrix(), truth[4, 1:4]
    scan = simulation.scan(4)
    p = (
        scan.points[:, :3] @ (T @ np.linalg.inv(T_LIDAR_IMU))[:3, :3].T
        + (T @ np.linalg.inv(T_LIDAR_IMU))[:3, 3]
    )
    checked = 0
    for row in rows:
        if abs(float(row["stamp_s"]) - truth[4, 0]) > 1e-5:
            continue
        mine = p[(scan.labels >> 16) == int(row["instance"])]
        d = mine - [float(row[name]) for name in ("x_m", "y_m", "z_m")]
        c, s = np.cos(float(row["yaw_rad"])), np.sin(float(row["yaw_rad"]))
        along, across = c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]
        # the vehicle as a whole moves on by up to half a metre during half a sweep, and the recorder likewise
        assert np.all(np.abs(along) < 0.5 * float(row["length_m"]) + 1.3)
        assert np.all(np.abs(across) < 0.5 * float(row["width_m"]) + 1.3)
        moving = (scan.labels[(scan.labels >> 16) == int(row["instance"])] & 0xFFFF) >= 252
        assert np.all(moving == bool(int(row["moving"])))
        checked += len(mine)
    assert checked > 200


def test_tracklets_are_the_boxes_of_what_the_camera_sees(town_drive: Path, simulation: Simulation) -> None:
    root = ET.parse(town_drive / "tracklet_labels.xml").getroot()
    items = root.findall("./tracklets/item")
    assert len(items) == int(root.findtext("./tracklets/count", "0")) >= 3
    for item in items:
        poses = item.findall("./poses/item")
        first = int(item.findtext("first_frame", "-1"))
        assert len(poses) == int(item.findtext("./poses/count", "0"))
        assert first >= 0
        assert first + len(poses) <= FRAMES
        assert item.findtext("objectType") in {"Car", "Van", "Truck", "Pedestrian", "Cyclist"}
    leader = simulation.world.movers[0]
    assert leader.name == "leader"
    stamp = simulation.stamps[0]
    T = T_LIDAR_IMU @ np.linalg.inv(simulation.world.ego.poses([stamp])[0])
    expected = (T @ leader.motion.poses([stamp])[0])[:3, 3]
    places = [[float(item.findtext(f"./poses/item/t{axis}", "nan")) for axis in "xyz"] for item in items]
    assert np.linalg.norm(np.array(places) - expected, axis=1).min() < 1e-3
    assert 5 < expected[0] < 25


@pytest.mark.slow
def test_threads_and_repeats_do_not_change_a_byte(
    town_drive: Path, simulation: Simulation, tmp_path: Path
) -> None:
    again = simulate(tmp_path, 1.2, 0, lidar=simulation.lidar, camera=simulation.camera, workers=1)
    files = sorted(
        path.relative_to(town_drive.parents[1]) for path in town_drive.parents[1].rglob("*") if path.is_file()
    )
    copies = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file())
    assert files == copies
    for path in files:
        assert (town_drive.parents[1] / path).read_bytes() == (tmp_path / path).read_bytes(), path
    assert again.name == town_drive.name


def test_a_drive_is_not_written_over_another(town_drive: Path) -> None:
    with pytest.raises(DataError, match="already there"):
        simulate(town_drive.parents[1], 1.2, 0)


def test_a_drive_without_three_scans_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="at least 3"):
        simulate(tmp_path, 0.1)
    assert list(tmp_path.iterdir()) == []

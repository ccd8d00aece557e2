"""KITTI-360: a drive that the simulator writes in that layout is read as it was measured."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gnss_sem_map.datasets import detect_format, kitti_360, open_drive
from gnss_sem_map.datasets.given_trajectory import read_tum
from gnss_sem_map.errors import DataError
from gnss_sem_map.simulation import Simulation, prepare
from gnss_sem_map.simulation.kitti_360_drive import write_kitti_360
from gnss_sem_map.simulation.rigs import MountedCamera, MountedLidar, Rig
from gnss_sem_map.simulation.rigs import kitti_360 as kitti_360_rig

SECONDS, SEED = 0.8, 3
COARSER = 8
CAMERAS = ["image_00", "image_01", "image_02", "image_03"]


def coarse() -> Rig:
    """The rig with an eighth of the pixels and points in a row."""
    rig = kitti_360_rig()
    lidar = rig.lidars[0]
    cameras: list[MountedCamera] = []
    for camera in rig.cameras:
        sensor, k = camera.sensor, COARSER
        smaller = replace(
            sensor, width=sensor.width // k, height=sensor.height // k, focal_px=sensor.focal_px / k,
            centre_u_px=sensor.centre_u_px / k, centre_v_px=sensor.centre_v_px / k,
        )  # fmt: skip
        cameras.append(replace(camera, sensor=smaller))
    coarser = MountedLidar(lidar.name, lidar.T_imu_lidar, replace(lidar.sensor, columns=300))
    return Rig((coarser,), tuple(cameras))


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return prepare(SECONDS, SEED, rig=coarse())


@pytest.fixture(scope="module")
def written(simulation: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_kitti_360(simulation, tmp_path_factory.mktemp("kitti_360"), workers=2)


@pytest.fixture
def drive(written: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    root = written.parent.parent
    shutil.copytree(root, tmp_path / root.name)
    return tmp_path / root.name / "data_3d_raw" / written.name


def root_of(drive: Path) -> Path:
    return drive.parent.parent


def test_a_drive_is_read_as_it_was_measured(written: Path, simulation: Simulation) -> None:
    assert detect_format(written) == "kitti-360"
    log, zero = open_drive(written), simulation.zero_s
    assert log.skips == ()
    assert log.name == written.name
    assert log.frame is not None
    np.testing.assert_allclose(
        simulation.frame.pose_of(log.frame), np.eye(4), atol=1e-6
    )  # oxts has 14 digits
    np.testing.assert_allclose([scan.stamp for scan in log.scans], simulation.stamps - zero, atol=1e-8)
    lidar = simulation.rig.lidars[0]
    np.testing.assert_allclose(log.calibration.T_imu_lidar, lidar.T_imu_lidar, atol=1e-9)
    scan, points = simulation.scan(5), log.scans[5].read()
    np.testing.assert_array_equal(points.rows.reshape(-1, 4), scan.points)
    start, end = simulation.sweeps[5] - zero
    assert points.stamps is not None
    # sweeps are not all equally long, and have no stamps of their begin and end
    np.testing.assert_allclose(points.stamps, start + scan.fractions * (end - start), atol=6e-4)
    assert [camera.name for camera in log.cameras] == CAMERAS
    for number, camera in enumerate(simulation.rig.cameras):
        found = log.calibration.camera(camera.name)
        T_imu_camera = log.calibration.T_imu_lidar @ np.linalg.inv(found.T_camera_lidar)
        np.testing.assert_allclose(T_imu_camera, camera.T_imu_camera, atol=1e-9)
        np.testing.assert_allclose(found.K, camera.sensor.K, rtol=1e-9)
        assert found.distortion == camera.sensor.distortion
        image = log.images_of(camera.name)[5]
        assert image.stamp == pytest.approx(simulation.stamps[5] + camera.stamp_after_s - zero, abs=1e-8)
        np.testing.assert_array_equal(image.read(), simulation.image(5, number).rgb)
    assert log.imu is not None
    assert np.median(np.diff(log.imu.stamps)) == pytest.approx(0.01, abs=1e-3)


def test_the_poses_are_those_of_the_truth_with_and_without_the_navigation_unit(
    written: Path, drive: Path, simulation: Simulation
) -> None:
    truth = read_tum(written / "truth" / "trajectory_lidar.tum")
    reference = open_drive(written).reference
    assert reference is not None
    np.testing.assert_allclose(reference.stamps, truth.stamps, atol=1e-8)
    np.testing.assert_allclose(reference.T_map_imu, truth.T_map_imu, atol=2e-6)
    shutil.rmtree(root_of(drive) / "data_poses" / written.name / "oxts")
    log = open_drive(drive)
    assert log.given is not None
    assert log.frame is not None
    assert (log.imu, log.gnss) == (None, None)
    T = simulation.frame.pose_of(log.frame)  # its map begins at the first pose
    np.testing.assert_allclose(T @ log.given.T_map_imu, truth.T_map_imu, atol=2e-6)


def test_the_world_of_the_poses_is_where_the_devkit_has_it() -> None:
    """Its origin, and a degree along each axis, by its formulas: scale cos(lat0), radius 6378137 m."""
    scale = np.cos(np.radians(48.9843445))
    lat, lon = np.array([48.9843445, 49.0, 48.9843445]), np.array([8.4295857, 8.4295857, 8.5])
    x, y = scale * lon * np.pi * 6378137 / 180, scale * 6378137 * np.log(np.tan((90 + lat) * np.pi / 360))
    found = kitti_360.geodetic_to_world(lat, lon, np.array([110.0, 120.0, 130.0]))
    np.testing.assert_allclose(found, np.column_stack([x - x[0], y - y[0], [110, 120, 130]]), atol=1e-7)
    np.testing.assert_allclose(kitti_360.world_to_geodetic(found), [lat, lon, [110, 120, 130]], atol=1e-11)


def test_cam0_to_world_is_the_rectified_camera(written: Path, simulation: Simulation) -> None:
    """The same world as `poses.txt`: camera 0 is where its pose in the imu is."""
    poses = root_of(written) / "data_poses" / written.name
    world = np.loadtxt(poses / "cam0_to_world.txt")[:, 1:].reshape(-1, 4, 4)
    rows = np.loadtxt(poses / "poses.txt")[:, 1:].reshape(-1, 3, 4)
    T_pose_camera = np.linalg.inv(kitti_360.T_IMU_POSE) @ simulation.rig.cameras[0].T_imu_camera
    np.testing.assert_allclose(rows @ T_pose_camera, world[:, :3], atol=1e-6)


def test_cameras_that_are_not_there_are_left_out(drive: Path) -> None:
    images = root_of(drive) / "data_2d_raw" / drive.name
    shutil.rmtree(images / "image_03")
    assert [camera.name for camera in open_drive(drive).cameras] == CAMERAS[:3]
    for name in CAMERAS[1:3]:
        shutil.rmtree(images / name)
    alone = open_drive(drive)
    assert [camera.name for camera in alone.cameras] == [""]
    shutil.rmtree(images)
    assert open_drive(drive).images == ()


def test_frames_without_a_file_or_a_stamp_are_told(drive: Path) -> None:
    points, images = drive / "velodyne_points", root_of(drive) / "data_2d_raw" / drive.name
    (points / "data" / "0000000003.bin").unlink()
    (images / "image_02" / "data_rgb" / "0000000001.png").unlink()
    stamps = (points / "timestamps.txt").read_text().splitlines()
    (points / "timestamps.txt").write_text("\n".join([*stamps[:-1], ""]) + "\n")
    log = open_drive(drive)
    assert [scan.number for scan in log.scans] == [0, 1, 2, 4, 5, 6]
    assert len(log.images_of("image_02")) == 7
    said = [f"{skip.what}: {skip.reason}" for skip in log.skips]
    assert said == ["scan: 1 files missing", "scan: no stamp for this frame", "image: 1 files missing"]


@pytest.mark.parametrize(
    ("file", "before", "after", "says"),
    [
        ("calib_cam_to_pose.txt", "image_02: ", "image_02: 9 ", "image_02': found 13 numbers, expected 12"),
        ("perspective.txt", "P_rect_01", "P_rect_99", "row 'P_rect_01': found nothing"),
        ("image_03.yaml", "xi:", "eta:", "mirror_parameters.xi: Field required"),
        ("image_03.yaml", "gamma1: ", "gamma1: -", "gamma1: Input should be greater than 0"),
        ("image_03.yaml", "image_width", "{image_width", "not YAML"),
    ],
)
def test_a_calibration_that_cannot_be_is_refused(
    drive: Path, file: str, before: str, after: str, says: str
) -> None:
    path = root_of(drive) / "calibration" / file
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))
    with pytest.raises(DataError, match=says):
        open_drive(drive)


def test_a_pose_that_is_no_rotation_is_refused(drive: Path) -> None:
    path = root_of(drive) / "calibration" / "calib_cam_to_velo.txt"
    path.write_text(" ".join(str(2 * float(word)) for word in path.read_text().split()))
    with pytest.raises(DataError, match="found a rotation scaled by 2"):
        open_drive(drive)


def test_a_drive_without_any_poses_is_refused(drive: Path) -> None:
    shutil.rmtree(root_of(drive) / "data_poses")
    with pytest.raises(DataError, match="found neither oxts nor poses"):
        open_drive(drive)


def test_other_rigs_are_not_written_in_this_layout(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="choose its own rig"):
        write_kitti_360(prepare(SECONDS, SEED), tmp_path)


def test_opencv_style_yaml_without_spaces_is_read(drive: Path) -> None:
    """Old OpenCV writes `key:value`."""
    path = root_of(drive) / "calibration" / "image_02.yaml"
    path.write_text(path.read_text().replace(": ", ":"))
    assert open_drive(drive).calibration.camera("image_02").distortion is not None


@pytest.mark.parametrize("without", [["image_00"], CAMERAS])
def test_images_without_stamps_have_those_of_the_scans_of_their_numbers(
    drive: Path, without: list[str]
) -> None:
    """Their stamps are a download of their own; the LiDAR triggers the cameras."""
    plain = open_drive(drive)
    for camera in without:
        (root_of(drive) / "data_2d_raw" / drive.name / camera / "timestamps.txt").unlink()
    found = open_drive(drive)
    assert len(found.images) == len(plain.images)
    of_scans = {scan.number: scan.stamp for scan in found.scans}
    for image in found.images:
        if image.camera in without:
            assert image.stamp == pytest.approx(of_scans[image.number], abs=1e-9)
    told = [skip for skip in found.skips if "have the stamps of the scans" in skip.reason]
    assert len(told) == len(without)


def test_the_root_of_the_data_set_offers_its_drives(drive: Path) -> None:
    with pytest.raises(DataError, match=f"a folder of drives; .*: {drive}"):
        open_drive(root_of(drive))

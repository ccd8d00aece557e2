"""Depth edges find the camera's time and mounting again, on simulated drives whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factor_graphs.trajectory import Trajectory
from gnss_sem_map import pipeline
from gnss_sem_map.camera_check import check_camera, check_projection
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.io import open_drive
from gnss_sem_map.io.scoring import read_tum
from gnss_sem_map.sensor_log import Image, SensorLog
from gnss_sem_map.simulation import Camera, Lidar, simulate

Case = tuple[SensorLog, Trajectory]
CAMERA = Camera(620, 188, 360.0, 305.0, 86.0)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of town."""
    lidar = Lidar(np.radians(np.linspace(2.0, -18.0, 32)), columns=1000, range_stddev_m=0.01)
    return simulate(tmp_path_factory.mktemp("check"), 2.0, 3, lidar=lidar, camera=CAMERA, workers=2)


@pytest.fixture(scope="module")
def town(drive: Path) -> Case:
    """The same, opened, with its exact trajectory."""
    return open_drive(drive), read_tum(drive / "truth" / "trajectory.tum")


def late(log: SensorLog, by_s: float) -> SensorLog:
    """The same drive, with all image stamps wrong."""
    images = tuple(Image(image.number, image.stamp + by_s, image.read) for image in log.images)
    return replace(log, images=images)


def turned(log: SensorLog, rotation_deg: tuple[float, float, float]) -> SensorLog:
    """The same drive, with a calibration that has the camera turned."""
    T = log.calibration.T_camera_lidar.copy()
    T[:3] = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix() @ T[:3]
    return replace(log, calibration=replace(log.calibration, T_camera_lidar=T))


def test_a_right_calibration_is_confirmed(town: Case) -> None:
    found = check_camera(*town)
    assert abs(found.time_offset_s - found.given_time_offset_s) < 0.005
    assert np.abs(found.rotation_deg[1]) < 0.1
    assert found.best_agreement >= found.agreement > 1.4
    assert found.warnings == ()


@pytest.mark.parametrize("by_s", [-0.03, 0.03])
def test_stamps_that_are_off_are_found_and_warned_of(town: Case, by_s: float) -> None:
    log, trajectory = town
    right, found = check_camera(log, trajectory), check_camera(late(log, by_s), trajectory)
    assert abs(found.time_offset_s - (right.time_offset_s - by_s)) < 0.004
    assert any("camera_time_offset_s" in warning for warning in found.warnings)


def test_a_turned_camera_is_found_and_warned_of(town: Case) -> None:
    log, trajectory = town
    found = check_camera(turned(log, (0.0, 0.6, 0.0)), trajectory)
    assert abs(found.rotation_deg[1] + 0.6) < 0.1
    assert any("about its y axis" in warning for warning in found.warnings)
    assert found.best_agreement > found.agreement


def test_images_of_something_else_are_warned_of(town: Case) -> None:
    log, trajectory = town
    rng = np.random.default_rng(0)
    width, height = log.calibration.image_size
    noise = [rng.integers(0, 255, (height, width, 3), np.uint8) for _ in log.images]
    images = tuple(
        Image(image.number, image.stamp, lambda other=other: other)
        for image, other in zip(log.images, noise, strict=True)
    )
    found = check_camera(replace(log, images=images), trajectory)
    assert "same camera" in found.warnings[0]


def test_a_camera_that_looks_away_from_every_point_is_an_error_of_check_and_of_run(town: Case) -> None:
    log, trajectory = town
    flipped = log.calibration.T_camera_lidar.copy()
    flipped[:3, :3] = np.diag([1.0, -1.0, -1.0])
    flipped[:3, 3] = 0.0, 0.0, -500.0
    away = replace(log, calibration=replace(log.calibration, T_camera_lidar=flipped))
    with pytest.raises(DataError, match="behind the camera"):
        check_camera(away, trajectory)
    with pytest.raises(DataError, match="behind the camera"):
        pipeline.run(away, lambda image: None, Settings())


def test_a_drive_without_images_or_with_too_few_says_so(town: Case) -> None:
    log, trajectory = town
    with pytest.raises(DataError, match="no camera"):
        check_projection(replace(log, images=()))
    with pytest.raises(DataError, match="expected at least 5"):
        check_camera(replace(log, images=log.images[:3]), trajectory)


def test_stamps_that_do_not_overlap_say_so(town: Case) -> None:
    log, trajectory = town
    with pytest.raises(DataError, match="no image near its stamp"):
        check_camera(late(log, 1000.0), trajectory)
    for by_s in (1000.0, -1000.0):
        with pytest.raises(DataError, match="Are their clocks the same"):
            pipeline.run(late(log, by_s), lambda image: None, Settings())


@pytest.mark.slow
def test_the_exposure_of_a_real_camera_is_where_it_was_measured(real_data: Path) -> None:
    """KITTI raw: 8.5 ms before the stamp of the image, measured with another method on two drives."""
    log = open_drive(real_data / "kitti_raw" / "2011_09_26" / "2011_09_26_drive_0005_sync")
    assert log.reference is not None
    found = check_camera(log, log.reference)
    assert abs(found.time_offset_s + 0.0085) < 0.003
    assert np.abs(found.rotation_deg).max() < 0.2
    assert found.warnings == ()

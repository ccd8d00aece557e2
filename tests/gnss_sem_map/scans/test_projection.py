"""A point takes the class of the pixel that saw it: at the image's moment, and only when nothing nearer hides it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import street
from numpy.typing import NDArray
from street import Street

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.labels.probabilities import LabelImage
from gnss_sem_map.scans.projection import (
    ClassImage,
    LabellingSettings,
    class_image,
    exposure_stamp,
    image_exposed_at,
    pixels_seen,
)
from gnss_sem_map.sensor_log import Calibration, Image, SensorLog
from gnss_sem_map.sensor_log.cameras import Camera

URBAN = open_label_set()
SETTINGS = LabellingSettings()
CAMERA = Calibration(
    street.T_IMU_LIDAR,
    (Camera(street.T_CAMERA_LIDAR, street.K, (street.WIDTH, street.HEIGHT), -street.EXPOSED_BEFORE_STAMP_S),),
)


def standing(T_map_imu: NDArray[np.float64]) -> Trajectory:
    return Trajectory(np.array([0.0, 1.0]), np.stack([T_map_imu, T_map_imu]))


def painted(classes: NDArray[np.int64]) -> ClassImage:
    return ClassImage((255 * (classes[:, :, None] == np.arange(6))).astype(np.uint8), 1)


def pixels_of(driven: Street, number: int, stamp: float, classes: ClassImage) -> NDArray[np.int32]:
    stamps = np.arange(driven.motion.start, driven.motion.end, 0.01)
    trajectory = Trajectory(stamps, driven.motion.poses(stamps), driven.motion.velocities(stamps))
    return pixels_seen(driven.p_map[number], stamp, trajectory, CAMERA, classes, SETTINGS)


def inner(classes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Pixels whose eight neighbours are of their class: rounding cannot put a point across a border there."""
    shifts = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    return np.logical_and.reduce([np.roll(classes, shift, (0, 1)) == classes for shift in shifts])


@pytest.mark.parametrize("number", [2, 5, 9])
def test_points_take_the_class_that_they_have(small_drive: Street, number: int) -> None:
    """Exact poses and images: away from borders, every point."""
    stamp = (number + 0.5) * street.SWEEP_S + street.IMAGE_AFTER_SCAN_S - street.EXPOSED_BEFORE_STAMP_S
    classes = street.class_image(small_drive.motion, stamp)
    pixels = pixels_of(small_drive, number, stamp, painted(classes))
    sure = (pixels >= 0) & inner(classes).ravel()[pixels]
    truth = small_drive.scan_classes[number][sure]
    np.testing.assert_array_equal(classes.ravel()[pixels[sure]], truth)
    assert set(truth) == {street.ROAD, street.SIDEWALK, street.VEHICLE, street.BUILDING}
    assert sure.sum() > 1000


def test_an_image_of_another_moment_fits_worse(small_drive: Street) -> None:
    number = 5
    stamp = (number + 0.5) * street.SWEEP_S
    truth = small_drive.scan_classes[number]
    agreement = []
    for late in (0.0, 0.1, 0.2):
        classes = street.class_image(small_drive.motion, stamp + late)
        pixels = pixels_of(small_drive, number, stamp, painted(classes))
        agreement.append((classes.ravel()[pixels] == truth)[pixels >= 0].mean())
    assert agreement[0] > agreement[1] > agreement[2]


def test_what_stands_behind_something_is_not_seen() -> None:
    """A board 5 m ahead hides the wall 10 m ahead where it stands, and not beside it."""
    T_map_imu = np.eye(4)
    T_map_camera = T_map_imu @ street.T_IMU_LIDAR @ np.linalg.inv(street.T_CAMERA_LIDAR)

    def at_pixel(u: float, v: float, depth: float) -> NDArray[np.float64]:
        ray = np.linalg.inv(street.K) @ np.array([u, v, 1.0]) * depth
        return np.asarray(T_map_camera[:3, :3] @ ray + T_map_camera[:3, 3])

    board = [at_pixel(u, v, 5.0) for u in range(100, 120, 4) for v in range(30, 60, 5)]
    behind = [at_pixel(u, v, 10.0) for u in range(102, 116, 3) for v in range(33, 55, 4)]
    beside = [at_pixel(u, v, 10.0) for u in range(130, 150, 3) for v in range(33, 55, 4)]
    flat = painted(np.zeros((street.HEIGHT, street.WIDTH), np.int64))
    p_map = np.array([*board, *behind, *beside])
    seen = pixels_seen(p_map, 0.5, standing(T_map_imu), CAMERA, flat, SETTINGS) >= 0
    b, h = len(board), len(board) + len(behind)
    assert seen[:b].all()
    assert not seen[b:h].any()
    assert seen[h:].all()


def test_a_point_is_in_the_pixel_that_its_coordinates_fall_into_and_in_that_ones_half() -> None:
    rng = np.random.default_rng(0)
    T_map_camera = street.T_IMU_LIDAR @ np.linalg.inv(street.T_CAMERA_LIDAR)
    u, v = rng.uniform(-40, street.WIDTH + 40, 500), rng.uniform(-40, street.HEIGHT + 40, 500)
    depth = rng.uniform(1, 60, 500)
    rays = np.column_stack([u, v, np.ones(500)]) @ np.linalg.inv(street.K).T * depth[:, None]
    p_map = rays @ T_map_camera[:3, :3].T + T_map_camera[:3, 3]
    alone = LabellingSettings(occlusion_rows_px=1, occlusion_columns_px=1)
    for shrink in (1, 2, 3):
        size = (street.HEIGHT // shrink, street.WIDTH // shrink)
        classes = ClassImage(np.zeros((*size, 6), np.uint8), shrink)
        pixels = pixels_seen(p_map, 0.5, standing(np.eye(4)), CAMERA, classes, alone)
        column, row = np.floor(u).astype(int), np.floor(v).astype(int)
        inside = (column >= 0) & (column < street.WIDTH) & (row >= 0) & (row < street.HEIGHT)
        expected = np.minimum(row // shrink, size[0] - 1) * size[1] + np.minimum(
            column // shrink, size[1] - 1
        )
        np.testing.assert_array_equal(pixels, np.where(inside, expected, -1))


def test_points_behind_the_camera_are_not_in_the_image() -> None:
    p_map = np.array([[-5.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-100.0, 3.0, 2.0]])
    flat = painted(np.zeros((street.HEIGHT, street.WIDTH), np.int64))
    assert (pixels_seen(p_map, 0.5, standing(np.eye(4)), CAMERA, flat, SETTINGS) == -1).all()


@pytest.mark.parametrize("make", [lambda p: p, lambda p: (p * 255).round().astype(np.uint8)])
def test_class_probabilities_are_summed_by_name(make: Callable[[NDArray[np.float32]], NDArray]) -> None:
    names = ("sky", "car", "truck", "road", "terrain")
    rng = np.random.default_rng(1)
    p = rng.dirichlet(np.ones(5), (96, 300)).astype(np.float32)
    image = class_image(make(p), names, URBAN, (300, 96), "here")
    expected = np.zeros((96, 300, 6))
    expected[:, :, 2] = p[:, :, 1] + p[:, :, 2]
    expected[:, :, 0] = p[:, :, 3]
    expected[:, :, 5] = p[:, :, 0] + p[:, :, 4]
    np.testing.assert_allclose(image.probabilities / 255, expected, atol=1.1 / 255)


def test_a_label_image_says_the_same_as_the_probabilities_of_its_ids() -> None:
    rng = np.random.default_rng(2)
    labels = LabelImage(
        rng.integers(0, 256, (48, 150)).astype(np.uint8), rng.integers(0, 256, (256, 6), np.uint8)
    )
    as_ids = class_image(labels, (*URBAN.names, "other"), URBAN, (300, 96), "here")
    as_probabilities = ClassImage(labels.probabilities.transpose(2, 0, 1).copy().transpose(1, 2, 0), 2)
    pixels = rng.integers(0, 48 * 150, 1000).astype(np.int32)
    assert as_ids.shrink == 2
    assert as_ids.size == as_probabilities.size == (48, 150)
    np.testing.assert_array_equal(as_ids.at(pixels), as_ids.rows[pixels])
    np.testing.assert_array_equal(as_ids.at(pixels), as_probabilities.at(pixels))


def test_a_label_map_of_another_size_is_refused() -> None:
    names = (*URBAN.names, "other")
    for shape, shrink in (((96, 300), 1), ((48, 150), 2), ((32, 100), 3), ((12, 37), 8), ((6, 18), 16)):
        assert class_image(np.zeros((*shape, 6), np.uint8), names, URBAN, (300, 96), "here").shrink == shrink
    for shape in ((96, 299), (95, 300), (300, 96), (5, 17)):
        with pytest.raises(
            DataError, match=f"here: found {shape[1]} x {shape[0]} pixels for an image of 300 x 96"
        ):
            class_image(np.zeros((*shape, 6), np.uint8), names, URBAN, (300, 96), "here")
    with pytest.raises(DataError, match=r"expected \(h, w, 6\)"):
        class_image(np.zeros((96, 300, 5), np.uint8), names, URBAN, (300, 96), "here")
    with pytest.raises(DataError, match="negative or not finite"):
        class_image(np.full((96, 300, 6), np.nan, np.float32), names, URBAN, (300, 96), "here")


def test_the_moment_of_exposure_is_the_drive_s_unless_set() -> None:
    image = Image(3, 10.0, lambda: np.zeros((1, 1, 3), np.uint8))
    assert exposure_stamp(image, CAMERA, SETTINGS) == pytest.approx(9.9915)
    assert exposure_stamp(image, CAMERA, LabellingSettings(camera_time_offset_s=0.25)) == pytest.approx(10.25)


@pytest.mark.parametrize(("offset_s", "number"), [(0.0, 2), (0.08, 1), (-0.08, 3), (0.5, None)])
def test_the_image_of_a_scan_is_the_one_exposed_nearest_to_it(offset_s: float, number: int | None) -> None:
    images = tuple(Image(k, 0.1 * k, lambda: np.zeros((1, 1, 3), np.uint8)) for k in range(5))
    camera = replace(CAMERA.camera(), time_offset_s=offset_s)
    calibration = Calibration(street.T_IMU_LIDAR, (camera,))
    log = SensorLog("drive", 0, calibration, (), images, given=standing(np.eye(4)))
    found = image_exposed_at(0.2, log, camera, SETTINGS)
    assert (None if found is None else found.number) == number
    assert image_exposed_at(0.2, log, camera, LabellingSettings(camera_time_offset_s=0.08)) is images[1]

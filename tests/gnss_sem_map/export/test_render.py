"""The renderer against rays traced one by one."""

import numpy as np
import pytest

from gnss_sem_map.export.render import Camera, Picture, draw_cubes, hollows


def trace(centres: np.ndarray, half_m: float, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth and cube of every pixel: all rays against all boxes, in numpy."""
    columns, rows = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    right, down, forward = camera.axes
    rays = forward + ((columns - camera.width_px / 2) / camera.focal_px)[..., None] * right
    rays += ((rows - camera.height_px / 2) / camera.focal_px)[..., None] * down
    low = (centres - half_m - camera.eye) / rays[:, :, None]
    high = (centres + half_m - camera.eye) / rays[:, :, None]
    enter, leave = np.minimum(low, high).max(axis=3), np.maximum(low, high).min(axis=3)
    depth = np.where((enter <= leave) & (enter > 0), enter, np.inf)
    return depth.min(axis=2), np.where(np.isfinite(depth.min(axis=2)), depth.argmin(axis=2), -1)


def drawn(
    centres: np.ndarray, half_m: float, camera: Camera, parts: int = 1, reach_m: float = 1e6
) -> Picture:
    """The picture of numbered cubes, drawn in so many parts."""
    picture = Picture.empty(camera)
    for part in np.array_split(np.arange(len(centres), dtype=np.int32), parts):
        draw_cubes(picture, camera, centres[part], half_m, part, camera.eye, reach_m)
    return picture


@pytest.mark.parametrize("seed", range(5))
def test_every_pixel_sees_what_its_ray_meets_first(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centres, half_m = rng.uniform(-6, 6, (60, 3)), rng.uniform(0.05, 0.8)
    camera = Camera(np.array([-14.0, 3.0, 8.0]), rng.uniform(-2, 2, 3), 90, 60, 70.0)
    picture = drawn(centres, half_m, camera, parts=1 + seed)
    depth, cube = trace(centres, half_m, camera)
    assert (cube >= 0).mean() > 0.1
    np.testing.assert_array_equal(picture.cube, cube)
    np.testing.assert_allclose(picture.depth, depth, rtol=1e-5)


def test_the_order_of_the_cubes_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    centres = rng.uniform(-6, 6, (200, 3))
    camera = Camera(np.array([-14.0, 3.0, 8.0]), np.zeros(3), 90, 60, 70.0)
    order = rng.permutation(200)
    shuffled = drawn(centres[order], 0.3, camera, parts=7)
    np.testing.assert_array_equal(shuffled.depth, drawn(centres, 0.3, camera).depth)


def test_cubes_beyond_the_reach_are_left_out() -> None:
    camera = Camera(np.zeros(3), np.array([1.0, 0.0, 0.0]), 40, 40, 60.0)
    picture = drawn(np.array([[30.0, 0.0, 0.0], [10.0, 2.0, 0.0]]), 1.0, camera, reach_m=20.0)
    assert set(np.unique(picture.cube)) == {-1, 1}


def test_a_cube_ahead_shows_the_face_towards_the_eye_at_its_distance() -> None:
    camera = Camera(np.zeros(3), np.array([1.0, 0.0, 0.0]), 401, 401, 60.0)
    picture = drawn(np.array([[10.0, 0.0, 0.0]]), 1.0, camera)
    assert picture.depth[200, 200] == pytest.approx(9.0)
    assert picture.face[200, 200] == 0
    assert (picture.cube >= 0).sum() == pytest.approx((2 * camera.focal_px / 9) ** 2, rel=0.03)


def test_what_is_behind_the_eye_is_not_drawn() -> None:
    camera = Camera(np.zeros(3), np.array([1.0, 0.0, 0.0]), 40, 40, 60.0)
    picture = drawn(np.array([[-5.0, 0.0, 0.0], [0.2, 0.0, 0.0]]), 0.5, camera)
    assert (picture.cube == -1).all()
    assert np.isinf(picture.depth).all()


@pytest.mark.parametrize("nothing", [np.inf, np.nan])
def test_hollows_are_deep_beside_a_step_and_nowhere_else(nothing: float) -> None:
    depth = np.full((5, 8), 10.0, np.float32)
    depth[:, 4:6], depth[:, 6:] = 4.0, nothing
    expected = np.zeros((5, 8))
    expected[:, 3] = 3.0 / 4
    found = hollows(depth, reach=1, most=3.0)
    np.testing.assert_allclose(found[:, :6], expected[:, :6])

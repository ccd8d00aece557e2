"""Points are projected through every lens as OpenCV projects them, and only where the lens maps one to one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from gnss_sem_map.errors import DataError
from gnss_sem_map.scans import kernels
from gnss_sem_map.sensor_log.cameras import Camera, Distortion

Array = NDArray[np.float64]
K = np.array([[420.0, 0.0, 640.0], [0.0, 415.0, 480.0], [0.0, 0.0, 1.0]])
BROWN = {
    "barrel": (-0.32, 0.11, 0.0007, -0.0004),
    "five": (-0.37, 0.19, -0.0011, 0.0008, -0.05),
    "pincushion": (0.12, 0.04, 0.001, 0.002, 0.0),
    "rational": (0.41, -0.12, 0.0006, -0.0003, -0.006, 0.75, -0.05, -0.03),
}
FISHEYE = {
    "narrow": (-0.04, 0.02, -0.01, 0.002),
    "plain": (0.0, 0.0, 0.0, 0.0),
    "wide": (0.07, -0.02, 0.006, -0.0007),
}


def camera(distortion: Distortion | None, T: Array | None = None) -> Camera:
    return Camera(np.eye(4) if T is None else T, K, (1280, 960), distortion=distortion)


def pixels(of: Camera, points: Array, T: Array | None = None) -> tuple[Array, Array]:
    """Pixels (n, 2) and depths (n,) of points in a frame that T takes to the camera."""
    found = np.empty_like(points)
    kernels.pixels(points, of.projection(np.eye(4) if T is None else T), of.lens, 0.5, found)
    return found[:, :2], found[:, 2]


def around(seed: int, widest_deg: float, count: int = 4000) -> Array:
    """Points at all angles to the axis up to the widest, 1 to 60 m away."""
    rng = np.random.default_rng(seed)
    angle, turn = np.radians(rng.uniform(0, widest_deg, count)), rng.uniform(0, 2 * np.pi, count)
    rays = np.column_stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
    return np.asarray(rays * rng.uniform(1.5, 60, (count, 1)))


def angles_of(points: Array) -> Array:
    return np.degrees(np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2]))


@pytest.mark.parametrize("name", BROWN)
def test_brown_lenses_are_those_of_opencv(name: str) -> None:
    lens, points = Distortion(model="brown", coefficients=BROWN[name]), around(1, 80)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix(), (0.3, -1.0, 0.2)
    p_source = (points - T[:3, 3]) @ T[:3, :3]
    expected = cv2.projectPoints(p_source, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, np.array(BROWN[name]))[
        0
    ][:, 0]
    found, depth = pixels(camera(lens), p_source, T)
    seen = depth > 0
    np.testing.assert_allclose(found[seen], expected[seen], atol=1e-8 * np.abs(expected[seen]).max())
    np.testing.assert_allclose(depth[seen], points[seen, 2], atol=1e-12 * 60 + 1e-12)
    assert seen.sum() > 1000


@pytest.mark.parametrize("name", FISHEYE)
def test_fisheye_lenses_are_those_of_opencv_and_go_on_behind_it(name: str) -> None:
    lens, points = Distortion(model="fisheye", coefficients=FISHEYE[name]), around(2, 89)
    zero = np.zeros(3)
    expected = cv2.fisheye.projectPoints(points[:, None], zero, zero, K, np.array(FISHEYE[name]))[0][:, 0]
    found, depth = pixels(camera(lens), points)
    seen = depth > 0
    assert seen.mean() > 0.9
    np.testing.assert_allclose(found[seen], expected[seen], atol=1e-8)
    np.testing.assert_allclose(depth[seen], np.linalg.norm(points[seen], axis=1))
    if name == "plain":  # f times the angle, whatever the angle
        behind = around(3, 170)
        found, depth = pixels(camera(lens), behind)
        focal = np.hypot(*((found - K[:2, 2]) / (K[0, 0], K[1, 1])).T)
        assert (depth > 0).all()
        np.testing.assert_allclose(focal, np.radians(angles_of(behind)), atol=1e-9)


@pytest.mark.parametrize("xi", [0.0, 0.8, 2.2134])
def test_mei_lenses_are_the_unit_sphere_seen_from_behind_its_centre(xi: float) -> None:
    """In plain numpy; with xi 0 the model is Brown's."""
    k = (0.0165, 1.66, 0.0004, 0.0006) if xi > 2 else (-0.05, 0.002, 0.0004, 0.0006)
    lens, points = Distortion(model="mei", coefficients=k, xi=xi), around(4, 75)
    X, Y, Z = (points / np.linalg.norm(points, axis=1, keepdims=True)).T
    x, y = X / (Z + xi), Y / (Z + xi)
    r2 = x**2 + y**2
    radial = 1 + k[0] * r2 + k[1] * r2**2
    u = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x**2)
    v = y * radial + k[2] * (r2 + 2 * y**2) + 2 * k[3] * x * y
    found, depth = pixels(camera(lens), points)
    seen = depth > 0
    assert seen.mean() > 0.9
    np.testing.assert_allclose(
        found[seen], np.column_stack([K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]])[seen], atol=1e-8
    )


@pytest.mark.parametrize(
    "lens",
    [
        *(Distortion(model="brown", coefficients=k) for k in BROWN.values()),
        *(Distortion(model="fisheye", coefficients=k) for k in FISHEYE.values()),
        Distortion(model="mei", coefficients=(0.0165, 1.66, 0.0004, 0.0006), xi=2.2134),
        Distortion(model="mei", coefficients=(-0.2, 0.05, 0.0, 0.0), xi=0.9),
    ],
)
def test_no_two_directions_are_in_one_pixel(lens: Distortion) -> None:
    """Along every direction from the centre of the image the angle to the axis grows, up to the last that is seen."""
    angle = np.radians(np.arange(0.05, 179.9, 0.05))
    limit = np.degrees(np.arccos(lens.least_cosine))
    for turn in np.linspace(0, 2 * np.pi, 17):
        rays = 1000 * np.column_stack(
            [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]
        )
        found, depth = pixels(camera(lens), rays)
        seen = depth > 0
        count = int(seen.sum())
        assert seen[:count].all()
        assert np.degrees(angle[count - 1]) == pytest.approx(limit, abs=0.1)
        out = np.hypot(*((found[:count] - K[:2, 2]) / (K[0, 0], K[1, 1])).T)
        assert (np.diff(out) > 0).all()


def test_a_lens_sees_as_far_as_its_polynomial_rises() -> None:
    """r (1 - 0.32 r² + 0.02 r⁴) rises up to r = 1.119; fisheye angles likewise."""
    brown = Distortion(model="brown", coefficients=(-0.32, 0.02, 0.0, 0.0))
    roots = np.roots([5 * 0.02, 0, 3 * -0.32, 0, 1])
    turning = min(root.real for root in roots if abs(root.imag) < 1e-12 and root.real > 0)
    assert np.degrees(np.arccos(brown.least_cosine)) == pytest.approx(
        np.degrees(np.arctan(turning)), abs=0.15
    )
    fisheye = Distortion(model="fisheye", coefficients=(-0.2, 0.0, 0.0, 0.0))
    assert np.degrees(np.arccos(fisheye.least_cosine)) == pytest.approx(
        np.degrees(np.sqrt(1 / 0.6)), abs=0.15
    )


def test_lenses_of_other_shapes_are_refused() -> None:
    with pytest.raises(ValidationError, match="found 3 coefficients, not 4 or 5 or 8: brown"):
        Distortion(model="brown", coefficients=(0.1, 0.2, 0.3))
    with pytest.raises(ValidationError, match="only mei has it"):
        Distortion(model="fisheye", coefficients=(0.1, 0.2, 0.3, 0.0), xi=1.0)
    with pytest.raises(DataError, match=r"found a camera '\.\./up'"):
        Camera(np.eye(4), K, (2, 2), name="../up")
    with pytest.raises(DataError, match="of camera left: T_camera_lidar is no rigid transform"):
        Camera(2 * np.eye(4), K, (2, 2), name="left")


@pytest.mark.parametrize(
    "lens",
    [
        *(Distortion(model="brown", coefficients=k) for k in BROWN.values()),
        *(Distortion(model="fisheye", coefficients=k) for k in FISHEYE.values()),
        Distortion(model="mei", coefficients=(0.017, 1.65, 4e-4, 4e-4), xi=2.21),
    ],
)
def test_a_pixel_is_straightened_to_the_ray_that_is_bent_to_it(lens: Distortion) -> None:
    """Up to a degree before the lens turns back."""
    widest = np.degrees(np.arccos(lens.least_cosine)) - 1.0
    points = np.vstack([around(7, widest), [[0.0, 0.0, 2.0]]])
    rays = points.T / np.linalg.norm(points, axis=1)
    found = np.array(lens.straightened(*lens.bent(rays)))
    np.testing.assert_allclose(found, rays, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(np.array(lens.straightened(*found[:2] * 50.0)), axis=0), 1.0)

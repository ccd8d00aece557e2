import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from factor_graphs.alignment import (
    CRUISE_NOISE_DENSITY,
    START_POSITION_STDDEV,
    START_SPEED_STDDEV,
    AttitudePrior,
    _between,
    first_guess,
    spline_through,
)
from factor_graphs.geodesy import LocalFrame
from factor_graphs.intervals import split
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.simulation import simulate_imu

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


def headings(T: np.ndarray) -> np.ndarray:
    return np.arctan2(T[:, 1, 0], T[:, 0, 0])


def wrapped(angle: np.ndarray) -> np.ndarray:
    return np.abs(np.angle(np.exp(1j * angle)))


@pytest.mark.parametrize("seed", range(4))
def test_the_first_guess_is_near_the_truth_though_the_gyroscope_drifts(simulate, seed):
    drive = simulate(20 + seed, noise=ImuNoise())
    cut = split(drive.imu, drive.fixes.stamps)
    T, velocities = first_guess(cut, drive.fixes, LEVER)
    truth = drive.motion.poses(cut.keyframes)
    assert np.median(wrapped(headings(T) - headings(truth))) < np.radians(10)
    assert np.linalg.norm(T[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 6.0
    assert np.linalg.norm(velocities - drive.motion.velocities(cut.keyframes), axis=1).max() < 5.0
    np.testing.assert_allclose(
        T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2), np.tile(np.eye(3), (len(T), 1, 1)), atol=1e-9
    )


def test_the_first_guess_is_what_a_kalman_smoother_finds(simulate):
    """White random acceleration, filtered forward and smoothed backward: filterpy's answer for every keyframe."""
    drive = simulate(24, noise=ImuNoise(), outages=[(20.0, 30.0)])
    fixes = drive.fixes[drive.fixes.stamps > 5.0]
    cut = split(drive.imu, fixes.stamps)
    kalman = KalmanFilter(dim_x=6, dim_z=3)
    kalman.x = np.concatenate([fixes.positions[0], np.zeros(3)])
    kalman.P = np.diag(np.repeat([START_POSITION_STDDEV**2, START_SPEED_STDDEV**2], 3))
    kalman.H = np.eye(3, 6)
    fix_at = dict(zip(cut.keyframe_of(fixes.stamps).tolist(), range(len(fixes)), strict=True))
    means, covariances, Fs, Qs = [], [], [], []
    for i, dt in enumerate(np.diff(cut.keyframes, prepend=cut.keyframes[0])):
        Fs.append(np.kron([[1, dt], [0, 1]], np.eye(3)))
        Qs.append(CRUISE_NOISE_DENSITY**2 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(3)))
        kalman.predict(F=Fs[-1], Q=Qs[-1])
        if i in fix_at:
            kalman.update(fixes.positions[fix_at[i]], R=np.diag(fixes.stddevs[fix_at[i]] ** 2))
        means.append(kalman.x)
        covariances.append(kalman.P)
    expected = kalman.rts_smoother(np.array(means), np.array(covariances), Fs, Qs)[0]
    positions, velocities = spline_through(fixes, cut)
    np.testing.assert_allclose(np.hstack([positions, velocities]), expected, atol=1e-4)


def test_an_imu_mounted_at_a_tilt_is_levelled(simulate):
    drive = simulate(30)
    mount = Rotation.from_euler("xyz", [8.0, -5.0, 0.0], degrees=True).as_matrix()
    exact = simulate_imu(drive.motion, drive.imu.stamps, FRAME)
    tilted = ImuSamples(exact.stamps, exact.specific_force @ mount, exact.angular_rate @ mount)
    T, _ = first_guess(split(tilted, drive.fixes.stamps), drive.fixes, LEVER)
    up = T[:, 2, :3]
    expected = (mount.T @ [0, 0, 1]) / np.linalg.norm(mount.T @ [0, 0, 1])
    assert np.degrees(np.arccos(up @ expected)).max() < 2.5


def test_an_outage_is_crossed_on_a_curve_with_the_speeds_at_its_ends(simulate):
    drive = simulate(31, noise=ImuNoise(), outages=[(50.0, 80.0)])
    cut = split(drive.imu, drive.fixes.stamps)
    T, velocities = first_guess(cut, drive.fixes, LEVER)
    inside = (cut.keyframes > 50) & (cut.keyframes < 80)
    p, v, t = T[inside, :3, 3], velocities[inside], cut.keyframes[inside]
    np.testing.assert_allclose(np.diff(p, axis=0) / np.diff(t)[:, None], (v[1:] + v[:-1]) / 2, atol=1.5)


def test_without_motion_the_heading_comes_from_what_is_known():
    stamps = np.arange(0.0, 20.0, 0.01)
    imu = ImuSamples(stamps, np.tile([0, 0, FRAME.gravity], (2000, 1)), np.zeros((2000, 3)))
    fixes = GnssFixes(np.arange(0.5, 19.0), np.zeros((19, 3)), np.ones((19, 3)))
    cut = split(imu, fixes.stamps)
    known = Rotation.from_euler("ZYX", [2.0, 0.1, -0.05]).as_matrix()
    T, _ = first_guess(cut, fixes, np.zeros(3), AttitudePrior(known, np.array([0.01, 0.01, 0.02])))
    np.testing.assert_allclose(T[:, :3, :3], np.tile(known, (len(T), 1, 1)), atol=1e-6)
    T, _ = first_guess(cut, fixes, np.zeros(3))
    np.testing.assert_allclose(headings(T), 0.0, atol=1e-9)


def test_between_knots_the_motion_is_the_cubic_of_scipy():
    rng = np.random.default_rng(0)
    knots, p, v = np.sort(rng.uniform(0, 9, 7)), rng.standard_normal((7, 3)), rng.standard_normal((7, 3))
    t = np.linspace(knots[0], knots[-1], 50)
    spline = CubicHermiteSpline(knots, p, v)
    positions, velocities = _between(t, knots, p, v)
    np.testing.assert_allclose(positions, spline(t), atol=1e-12)
    np.testing.assert_allclose(velocities, spline(t, 1), atol=1e-11)

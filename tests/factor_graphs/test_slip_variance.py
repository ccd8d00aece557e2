"""Slip by variance components: the variance of sums against the whole covariance, and slip that is known."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, M, V, X
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from factor_graphs.covariances import SIZE, SumVariance, keyframe_covariances
from factor_graphs.fitting import fit_noise
from factor_graphs.geodesy import LocalFrame
from factor_graphs.held_constraints import constrain
from factor_graphs.measurements import ImuNoise
from factor_graphs.problem import pose_problem
from factor_graphs.rigid_motion import FreeMotion
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import random_drive
from factor_graphs.smoothing import smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


def test_the_variance_of_sums_is_that_of_the_whole_covariance(simulate):
    drive = simulate(3, seconds=60.0, noise=ImuNoise())
    settings = SmootherSettings(vehicle_constraint="on")
    problem = pose_problem(drive.imu, drive.fixes, FRAME, settings, LEVER, None)
    fit, _, vehicle, _ = constrain(*fit_noise(problem))
    assert vehicle.held
    k, rng = len(problem.intervals.keyframes), np.random.default_rng(0)
    windows = np.repeat([-1, 0, 1, -1, 2], [5, 20, 10, 4, k - 39])
    windows[50:53] = -1
    rows, of_mounting = rng.standard_normal((k, 2, SIZE)), rng.standard_normal((3, 2, 5))
    rows[windows < 0] = 0.0
    sums = SumVariance(rows, windows, of_mounting)
    keyframe_covariances(fit.graph, fit.values, k, sums)

    ordering = gtsam.Ordering()
    for key in [key for i in range(k) for key in (X(i), V(i), B(i))] + [M(k)]:
        ordering.push_back(key)
    A, _ = fit.graph.linearize(fit.values).jacobian(ordering)
    root = np.linalg.inv(np.linalg.qr(A, mode="r"))
    for window in range(3):
        inside = rows * (windows == window)[:, None, None]
        G = np.hstack([inside.transpose(1, 0, 2).reshape(2, -1), of_mounting[window]])
        np.testing.assert_allclose(sums.found[window], np.sum((G @ root) ** 2, axis=1), rtol=1e-4)


def sliding(lateral: float, vertical: float, vertical_s: float = 1.0):
    """A drive that slides at random when it moves, m/s: sideways for a second at a time, vertically `vertical_s` s."""

    def moves(seconds: float, rng: np.random.Generator) -> FreeMotion:
        motion, step = random_drive(seconds, rng), 0.1
        stamps = np.arange(0.0, motion.end, step)
        T, speed = motion.poses(stamps), np.linalg.norm(motion.velocities(stamps), axis=1)
        white, widths = (
            rng.standard_normal((2, len(stamps))),
            0.5 / np.sqrt(np.pi) * np.array([1.0, vertical_s]),
        )
        noise = np.array(
            [gaussian_filter1d(row, width / step) for row, width in zip(white, widths, strict=True)]
        )
        noise *= np.tanh(speed / 2) / noise.std(axis=1, keepdims=True)
        slip = lateral * noise[0, :, None] * T[:, :3, 1] + vertical * noise[1, :, None] * T[:, :3, 2]
        way = np.concatenate([np.zeros((1, 3)), np.cumsum((slip[1:] + slip[:-1]) / 2 * step, axis=0)])
        euler = np.unwrap(Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX"), axis=0)
        return FreeMotion(
            make_interp_spline(stamps, T[:, :3, 3] + way, k=5), make_interp_spline(stamps, euler, k=5)
        )

    return moves


@pytest.mark.parametrize(
    ("lateral", "vertical"), [pytest.param(0.03, 0.03, marks=pytest.mark.slow), (0.06, 0.05)]
)
def test_slip_that_is_held_is_found_as_large_as_it_is(simulate, lateral, vertical):
    found = []
    for seed in range(4):
        drive = simulate(seed, seconds=400.0, noise=ImuNoise(), moves=sliding(lateral, vertical))
        found.append(smooth(drive.imu, drive.fixes, FRAME, None, LEVER).vehicle.density)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(found), axis=0)), [lateral, vertical], rtol=0.3)


def test_a_body_that_pitches_for_ten_seconds_is_not_held_level(simulate):
    found = []
    for seed in range(4):
        drive = simulate(seed, seconds=600.0, noise=ImuNoise(), moves=sliding(0.03, 0.06, 10.0))
        found.append(smooth(drive.imu, drive.fixes, FRAME, None, LEVER).vehicle.density)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(found), axis=0)), [0.03, 0.06 * 10**0.5], rtol=0.3)


def test_a_car_that_does_not_slide_is_believed_to_slide_less_than_at_first(simulate):
    drive = simulate(1, seconds=400.0, noise=ImuNoise())
    solution = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    assert (solution.vehicle.density < [0.01, 0.02]).all()
    assert solution.inflation == 1.0

"""Full covariances of positions: they reach the factor of every fix, and what is no covariance is found."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from factor_graphs.accuracy import errors
from factor_graphs.csv_log import read_csv
from factor_graphs.errors import MeasurementError, RepairWarning
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise
from factor_graphs.model import gnss_factors
from factor_graphs.position_covariances import covariances_of, split_covariances
from factor_graphs.problem import pose_problem
from factor_graphs.settings import SmootherSettings
from factor_graphs.smoothing import smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


def random_covariances(n: int, seed: int) -> np.ndarray:
    roots = np.random.default_rng(seed).normal(size=(n, 3, 3))
    return roots @ roots.swapaxes(1, 2) + 0.1 * np.eye(3)


def test_a_covariance_is_its_deviations_and_correlations():
    given = random_covariances(50, 0)
    stddevs, correlations, wrong = split_covariances(given)
    assert not wrong.any()
    np.testing.assert_allclose(covariances_of(stddevs, correlations), given, rtol=1e-12)


def test_the_cost_of_a_fix_is_its_mahalanobis_distance():
    """Against r' C^-1 r / 2 by numpy, for the factor and for the squares that decide who is an outlier."""
    rng, covariances = np.random.default_rng(1), random_covariances(20, 2)
    stddevs, correlations, _ = split_covariances(covariances)
    fixes = GnssFixes(np.arange(20.0), rng.normal(size=(20, 3)), stddevs, correlations)
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 1.0), np.array([1.0, 2.0, 3.0]))
    values = gtsam.Values()
    values.insert(X(0), pose)
    off = fixes.positions - pose.transformFrom(LEVER)
    expected = np.array([r @ np.linalg.solve(C, r) for r, C in zip(off, covariances, strict=True)])
    factors = gnss_factors(fixes, np.zeros(20, int), LEVER, None)
    np.testing.assert_allclose([2 * f.error(values) for f in factors], expected, rtol=1e-9)
    whitened = np.einsum("mij,mj->mi", fixes.whitening, off)
    np.testing.assert_allclose(np.sum(whitened**2, axis=1), expected, rtol=1e-9)


def test_what_makes_a_fix_weigh_less_keeps_its_correlations(simulate):
    drive = simulate(3, 40.0, ImuNoise())
    stretched = GnssFixes(
        drive.fixes.stamps,
        drive.fixes.positions,
        drive.fixes.stddevs,
        np.tile([0.9, 0.1, 0.05], (len(drive.fixes), 1)),
    )
    settings = SmootherSettings(min_fix_stddev_m=1.5)
    problem = pose_problem(drive.imu, stretched, FRAME, settings, LEVER, None).with_fix_noise(2.0)
    stddevs, correlations, _ = split_covariances(problem.fixes.covariances)
    np.testing.assert_allclose(stddevs, np.tile([3.0, 3.0, 4.0], (len(stddevs), 1)))
    np.testing.assert_allclose(correlations, stretched.correlations)


def test_correlated_errors_cost_less_accuracy_when_they_are_told(simulate):
    """Fixes are good across one diagonal, 0.3 m, and bad along it, 3 m: not as a circle of 2.1 m."""
    C = np.diag([0.0, 0.0, 1.0])
    C[:2, :2] = np.array([[1, 1], [1, 1]]) * 3.0**2 / 2 + np.array([[1, -1], [-1, 1]]) * 0.3**2 / 2
    across = np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    told, untold = [], []
    for seed in range(4):
        drive = simulate(seed, 100.0, ImuNoise())
        antennas = simulate(seed, 100.0).fixes
        noise = np.random.default_rng(seed).multivariate_normal(np.zeros(3), C, len(antennas))
        stddevs, correlations, _ = split_covariances(np.tile(C, (len(antennas), 1, 1)))
        for found, given in ((told, correlations), (untold, None)):
            fixes = GnssFixes(antennas.stamps, antennas.positions + noise, stddevs, given)
            solution = smooth(drive.imu, fixes, FRAME, None, LEVER).keyframes
            off = errors(solution, drive.motion.trajectory(solution.stamps)).position @ across
            found.append(float(np.sqrt(np.mean(off**2))))
    assert np.mean(told) < 0.5 * np.mean(untold)


def test_what_is_no_covariance_is_refused_and_rows_of_it_are_counted(tmp_path: Path, simulate):
    with pytest.raises(MeasurementError, match=r"correlations\[1\].*positive definite"):
        GnssFixes([0, 1], np.zeros((2, 3)), np.ones((2, 3)), [[0, 0, 0], [0.9, 0.9, -0.9]])
    asymmetric, negative = np.eye(3), np.eye(3)
    asymmetric[0, 1], negative[2, 2] = 0.5, -1.0
    _, correlations, wrong = split_covariances(np.array([np.eye(3), asymmetric, negative, np.eye(3) - 2]))
    assert wrong.tolist() == [False, True, True, True]
    assert not correlations.any()
    imu = np.column_stack([np.arange(0, 3, 0.1), *[np.zeros(30)] * 2, np.full(30, 9.8), *[np.zeros(30)] * 3])
    np.savetxt(tmp_path / "imu.csv", imu, delimiter=",", header="stamp_s,ax,ay,az,wx,wy,wz", comments="")
    (tmp_path / "gnss.csv").write_text(
        "stamp_s,lat_deg,lon_deg,alt_m,std_e_m,std_n_m,std_u_m,corr_en,corr_eu,corr_nu\n"
        "0,49,8,100,1,1,2,0.5,0,0\n1,49,8,100,1,1,2,1.5,0,0\n2,49,8,100,1,1,2,,,\n"
    )
    with pytest.warns(RepairWarning, match="1 rows: their covariance is not positive definite"):
        _, fixes, _ = read_csv(tmp_path)
    assert fixes.correlations is not None
    assert fixes.correlations[:, 0].tolist() == [0.5, 0.0, 0.0]

"""Forward-backward separation: that of two dense solutions of parts of the graph, and as large as it says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from factor_graphs.chi_square import quantile
from factor_graphs.elimination import split_key, state_keys
from factor_graphs.fitting import fit_noise
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise
from factor_graphs.model import from_values
from factor_graphs.problem import Problem
from factor_graphs.separation import LOOSE, separation_of
from factor_graphs.settings import SmootherSettings
from factor_graphs.smoothing import smooth
from factor_graphs.trajectory_plot import write_trajectory_plot

Array = NDArray[np.float64]

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
ASKED = SmootherSettings(forward_backward=True)


def dense(
    factors: list[gtsam.GaussianFactor], i: int, prior: tuple[int, Array, Array] | None
) -> tuple[Array, Array]:
    """Mean and covariance of keyframe i by all rows of these factors, and a prior (keyframe, mean, stddevs)."""
    numbers = sorted({split_key(key)[1] for factor in factors for key in list(factor.keys())} | {i})
    place = {
        key: 15 * n + at
        for n, j in enumerate(numbers)
        for key, at in zip(state_keys(j), (0, 6, 9), strict=True)
    }
    rows, right = [], []
    for factor in factors:
        A, b = factor.jacobian()
        wide, column = np.zeros((len(A), 15 * len(numbers))), 0
        for key in list(factor.keys()):
            size = 3 if key in {state_keys(j)[1] for j in numbers} else 6
            wide[:, place[key] : place[key] + size] = A[:, column : column + size]
            column += size
        rows.append(wide)
        right.append(b)
    if prior is not None:
        wide = np.zeros((15, 15 * len(numbers)))
        wide[:, place[state_keys(prior[0])[0]] :][:, :15] = np.diag(1 / prior[2])
        rows.append(wide)
        right.append(prior[1] / prior[2])
    Q, R = np.linalg.qr(np.vstack(rows))
    inverse = np.linalg.inv(R)
    at = place[state_keys(i)[0]]
    return (inverse @ Q.T @ np.concatenate(right))[at : at + 15], (inverse @ inverse.T)[
        at : at + 15, at : at + 15
    ]


def test_it_is_that_of_dense_solutions_of_both_parts_of_the_graph(bound: Problem) -> None:
    """Also where anchors of LiDAR odometry reach over several keyframes."""
    problem, fit = fit_noise(bound)
    stamps = problem.intervals.keyframes
    found = separation_of(fit.graph, fit.values, stamps, problem.noise)
    linear = fit.graph.linearize(fit.values)
    factors = [linear.at(n) for n in range(linear.size())]
    numbers = [{split_key(key)[1] for key in list(factor.keys())} for factor in factors]
    T, _, biases = from_values(fit.values, len(stamps))
    noise, last = problem.noise, len(stamps) - 1
    stddevs = np.repeat([*LOOSE, noise.accelerometer_bias_stddev, noise.gyroscope_bias_stddev], 3)
    end = last, np.concatenate([np.zeros(9), -biases[-1]]), stddevs
    for i in (0, 1, last // 3, last // 2, last - 1, last):
        before = [factor for factor, of in zip(factors, numbers, strict=True) if max(of) <= i]
        after = [factor for factor, of in zip(factors, numbers, strict=True) if min(of) >= i and of != {i}]
        (forward, P_forward), (backward, P_backward) = dense(before, i, None), dense(after, i, end)
        R, off, P = T[i, :3, :3], forward - backward, P_forward + P_backward
        expected = [*(R @ off[3:6]), R[2] @ off[:3]]
        variances = [*np.diag(R @ P[3:6, 3:6] @ R.T), R[2] @ P[:3, :3] @ R[2]]
        np.testing.assert_allclose(found.stddevs[i], np.sqrt(variances), rtol=1e-4)
        np.testing.assert_allclose(found.off[i] / found.stddevs[i], expected / np.sqrt(variances), atol=1e-3)


def test_it_scatters_as_much_as_it_says(simulate) -> None:
    """One keyframe in the middle of each drive: chi2 with four degrees of freedom each, at 99 %."""
    squares = []
    for seed in range(8):
        drive = simulate(seed, 80.0, ImuNoise())
        settings = replace_settings(vehicle_constraint="off", standing_stddev_mps=None)
        found = smooth(drive.imu, drive.fixes, FRAME, settings, LEVER).separation
        assert found is not None
        middle = len(found.stamps) // 2
        squares.append(np.sum((found.off[middle] / found.stddevs[middle]) ** 2))
    assert quantile(0.005, 4 * len(squares)) < np.sum(squares) < quantile(0.995, 4 * len(squares))


def replace_settings(**changes: object) -> SmootherSettings:
    return ASKED.model_copy(update=changes)


def test_it_has_a_panel_in_the_plot_and_changes_nothing_else(simulate, tmp_path: Path) -> None:
    """With the vehicle constraint, whose mounting all keyframes share."""
    drive = simulate(3, 120.0, ImuNoise())
    plain, asked = (smooth(drive.imu, drive.fixes, FRAME, settings, LEVER) for settings in (None, ASKED))
    assert plain.separation is None
    assert asked.vehicle is not None
    assert asked.vehicle.held
    assert asked.separation is not None
    np.testing.assert_array_equal(asked.trajectory.T_map_imu, plain.trajectory.T_map_imu)
    inner = slice(20, -20)
    assert np.isfinite(asked.separation.off).all()
    assert np.abs(asked.separation.off / asked.separation.stddevs)[inner].max() < 6
    for name, solution in (("plain", plain), ("asked", asked)):
        write_trajectory_plot(solution, drive.fixes, tmp_path / name)
    assert (tmp_path / "plain").read_bytes() != (tmp_path / "asked").read_bytes()
    empty = replace(asked, separation=None)
    write_trajectory_plot(empty, drive.fixes, tmp_path / "empty")
    assert (tmp_path / "plain").read_bytes() == (tmp_path / "empty").read_bytes()


@pytest.mark.parametrize("outage", [(40.0, 70.0)])
def test_in_an_outage_both_know_less(simulate, outage: tuple[float, float]) -> None:
    drive = simulate(2, 110.0, ImuNoise(), outages=[outage])
    found = smooth(
        drive.imu, drive.fixes, FRAME, replace_settings(vehicle_constraint="off"), LEVER
    ).separation
    assert found is not None
    inside = np.abs(found.stamps - 55.0) < 5
    outside = np.abs(found.stamps - 30.0) < 5
    assert found.stddevs[inside, :2].min() > 3 * found.stddevs[outside, :2].max()

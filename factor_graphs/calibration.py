"""Where the antenna is and how late the receiver's clock: found from the drive itself.

At the optimum, a fix that is `d` seconds later than its stamp and an antenna that is `dl` metres away from
its place move the residual by v d + R dl. One linear solve with these four unknowns beside the whole
trajectory gives the correction and its covariance; the smoother applies it and comes back until it is small.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X
from numpy.typing import NDArray

from factor_graphs.elimination import by_sections, eliminate, split
from factor_graphs.model import motion_from, relative_pose_factors
from factor_graphs.problem import RELATIVE_LOSSES, Fit, Problem

Array = NDArray[np.float64]

# What may be wrong before anything is estimated: clock s, antenna m.
CLOCK_STDDEV, ANTENNA_STDDEV = 0.5, 2.0
# Held, not estimated: as good as certain, and still well conditioned.
HELD = 1e-6


@dataclass(frozen=True, eq=False)
class Calibration:
    """How much later than its stamp a fix is, s, and where the antenna is, (3,) m, with standard deviations.

    A stddev is None for what was taken as given. `refused`: why an offset that was found is not applied, or nothing.
    """

    time_offset_s: float
    p_imu_antenna: Array
    time_offset_stddev_s: float | None = None
    p_imu_antenna_stddevs: Array | None = None
    refused: str = ""


def correct(
    problem: Problem, fit: Fit, now: Calibration, given: Array, with_time: bool, with_lever: bool
) -> tuple[Calibration, float]:
    """The better calibration, and how many standard deviations it is away from the present one.

    `given` (3,) m is the lever arm as the user gave it: the prior stays there, and at no time offset.
    """
    stddevs = np.array([CLOCK_STDDEV if with_time else HELD, *[ANTENNA_STDDEV if with_lever else HELD] * 3])
    moved = np.array([now.time_offset_s, *(now.p_imu_antenna - given)])
    linear = fit.motion.linearize(fit.values)
    for factor in relative_pose_factors(problem.relative, problem.relative_at, RELATIVE_LOSSES[fit.loss]):
        linear.push_back(factor.linearize(fit.values))
    for row in _fix_rows(problem, fit):
        linear.push_back(row)
    linear.push_back(
        gtsam.JacobianFactor(C(0), np.diag(1 / stddevs), -moved / stddevs, gtsam.noiseModel.Unit.Create(4))
    )
    groups = by_sections(fit.graph, len(problem.intervals.keyframes), (C(0),))
    (found,) = deque(eliminate(split(linear, groups), groups), maxlen=1)
    root = np.linalg.inv(found.R())
    step, sigma = root @ found.d(), np.sqrt(np.sum(root**2, axis=1))
    better = Calibration(
        now.time_offset_s + float(step[0]) if with_time else now.time_offset_s,
        now.p_imu_antenna + step[1:] if with_lever else now.p_imu_antenna,
        float(sigma[0]) if with_time else None,
        sigma[1:] if with_lever else None,
    )
    asked = np.array([with_time, *[with_lever] * 3])
    return better, float(np.max(np.abs(step / sigma)[asked]))


def _fix_rows(problem: Problem, fit: Fit) -> Iterator[gtsam.JacobianFactor]:
    T, velocities = motion_from(fit.values)
    unit, x, y, z = gtsam.noiseModel.Unit.Create(3), *problem.p_imu_antenna
    lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    W = problem.fixes.whitening * np.sqrt(fit.weights)[:, None, None]
    R, p = T[problem.at, :3, :3], T[problem.at, :3, 3]
    by_pose = W @ np.concatenate([-R @ lever, R], axis=2)
    by_calibration = W @ np.concatenate([velocities[problem.at, :, None], R], axis=2)
    off = np.einsum("mij,mj->mi", W, problem.antennas_found(T, velocities) - p - R @ problem.p_imu_antenna)
    for i, pose, calibration, right in zip(problem.at.tolist(), by_pose, by_calibration, off, strict=True):
        yield gtsam.JacobianFactor(X(i), pose, C(0), calibration, right, unit)

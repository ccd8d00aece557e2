"""Velocity of the antenna as the receiver measures it: its unit and axes found against the positions, then a factor.

The antenna moves with v + R (w x l), v the velocity of the imu in the map, l the lever arm. The turn's part is taken
from the solution that the factor is made at: a heading error of 1° changes it by less than 1 cm/s where the lever arm
is 1 m and the vehicle turns by 30°/s.
"""

from functools import partial

import gtsam
import numpy as np
from gtsam.symbol_shorthand import V
from numpy.typing import NDArray

from factor_graphs.chi_square import quantile
from factor_graphs.covariances import keyframe_covariances
from factor_graphs.measurements import UNMEASURED, GnssVelocities
from factor_graphs.model import from_values
from factor_graphs.problem import Fit, Problem
from factor_graphs.side_measurements import FEWEST_SEEN, Observed, Placed, noise_scale, placed
from factor_graphs.vehicle import MOVING_SPEED, beside_fixes

Array = NDArray[np.float64]

# Velocities that differ from those of the positions by more than this share of the speed are something else.
MOST_MISFIT = 0.1
# What they may be: matrices that make the velocity east, north of it in m/s.
MISTAKES = {
    "in knots, not m/s": np.eye(2) * 1852 / 3600,
    "in km/h, not m/s": np.eye(2) / 3.6,
    "in mph, not m/s": np.eye(2) * 0.44704,
    "north, east, not east, north": np.array([[0.0, 1.0], [1.0, 0.0]]),
    "backwards": -np.eye(2),
}
# One velocity in twenty of a good receiver has Huber's loss, and every wrong one.
LOSS = gtsam.noiseModel.mEstimator.Huber.Create(quantile(0.95, 3) ** 0.5)


def observe_velocities(velocities: GnssVelocities, problem: Problem, fit: Fit) -> Observed:
    """What a solution by the fixes shows of velocities, their stamps on the clock of the IMU."""
    place = placed(problem, velocities.stamps)
    kept = velocities[place.rows]
    off = kept.velocities - _antenna_velocities(problem, fit, place)
    seen = beside_fixes(problem, fit)[place.at]
    said = f"GNSS velocity: {len(kept)} of {len(velocities)} used"
    R = from_values(fit.values, len(problem.intervals.keyframes))[0][place.at, :3, :3]
    turned = np.einsum("kij,kj->ki", R, kept.velocities)
    if doubt := _mistake(kept.velocities[seen], (kept.velocities - off)[seen], turned[seen]):
        return Observed(f"GNSS velocity off: {doubt}", doubtful=True)
    scales = _noise_shown(problem, fit, place, off, kept.stddevs, seen)
    if scales.max() > 1:
        said += f", as if of {scales[0]:.1f} times (up {scales[1]:.1f} times) the noise that is stated"
    noisier = GnssVelocities(kept.stamps, kept.velocities, kept.stddevs * scales[[0, 0, 1]])
    return Observed(said, partial(_factors, noisier, problem, place), scales.max() > 1)


def _antenna_velocities(problem: Problem, fit: Fit, place: Placed) -> Array:
    """Velocities (r, 3) m/s of the antenna that a solution says."""
    stamps = problem.intervals.keyframes
    T, v, biases = from_values(fit.values, len(stamps))
    changes = np.gradient(v, stamps, axis=0)[place.at] * place.late[:, None]
    turning = np.cross(problem.intervals.rates - biases[:, 3:], problem.p_imu_antenna)[place.at]
    found: Array = v[place.at] + changes + np.einsum("kij,kj->ki", T[place.at, :3, :3], turning)
    return found


def _mistake(said: Array, known: Array, turned: Array) -> str:
    """What velocities (n, 3) are that do not agree with the positions'; empty where they do, or too few are seen.

    `turned` (n, 3) are they, were they along the axes of the imu.
    """
    moving = np.linalg.norm(known[:, :2], axis=1) > MOVING_SPEED
    said, known, turned = said[moving, :2], known[moving, :2], turned[moving, :2]
    if len(known) < FEWEST_SEEN or (share := _misfit(said, known)) <= MOST_MISFIT:
        return ""
    fitting = {what: _misfit(said @ turn.T, known) for what, turn in MISTAKES.items()}
    fitting["along the axes of the vehicle, not east, north"] = _misfit(turned, known)
    best = min(fitting, key=lambda what: fitting[what])
    asked = f"; are they {best}?" if fitting[best] <= MOST_MISFIT else ""
    ratio = float(np.median(np.linalg.norm(said, axis=1) / np.linalg.norm(known, axis=1)))
    return f"it differs from the positions' by {100 * share:.0f} % of the speed, {ratio:.2f} times as fast{asked}"


def _misfit(said: Array, known: Array) -> float:
    return float(np.median(np.linalg.norm(said - known, axis=1) / np.linalg.norm(known, axis=1)))


def _noise_shown(
    problem: Problem, fit: Fit, place: Placed, off: Array, stddevs: Array, seen: NDArray[np.bool_]
) -> Array:
    """As if of how many times more noise than stated velocities count, level and up, (2,): at least 1."""
    covariances, _ = keyframe_covariances(fit.graph, fit.values, len(problem.intervals.keyframes))
    own = np.diagonal(covariances[place.at, 6:9, 6:9], axis1=1, axis2=2)
    scales = np.ones(2)
    for row, axes in enumerate(([0, 1], [2])):
        rows = seen & (stddevs[:, axes] < UNMEASURED).all(axis=1)
        if rows.sum() < FEWEST_SEEN:
            continue
        stamps = problem.intervals.keyframes[place.at[rows]]
        scales[row] = noise_scale(stamps, off[rows][:, axes], stddevs[rows][:, axes], own[rows][:, axes])
    return scales


def _factors(
    velocities: GnssVelocities, problem: Problem, place: Placed, fit: Fit
) -> list[gtsam.NonlinearFactor]:
    """Every velocity holds that of its keyframe."""
    states = from_values(fit.values, len(problem.intervals.keyframes))[1]
    of_imu = velocities.velocities - (_antenna_velocities(problem, fit, place) - states[place.at])
    return [
        gtsam.PriorFactorVector(
            V(i), velocity, gtsam.noiseModel.Robust.Create(LOSS, gtsam.noiseModel.Diagonal.Sigmas(stddevs))
        )
        for i, velocity, stddevs in zip(place.at.tolist(), of_imu, velocities.stddevs, strict=True)
    ]

"""The batch smoother: IMU and GNSS in, the most probable trajectory out, with covariance.

The order is fixed. First the IMU noise is inflated until the residuals are as large as they should be,
then fixes that still do not fit are rejected: on a graph that is too stiff, good fixes would be.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import ArrayLike, NDArray

from factor_graphs.alignment import AttitudePrior
from factor_graphs.dense import densify
from factor_graphs.geodesy import LocalFrame
from factor_graphs.graph import from_values
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.problem import REJECTION, Fit, Problem, first_values, motion_graph, optimise, pose_problem
from factor_graphs.settings import SmootherSettings as SmootherSettings
from factor_graphs.trajectory import Trajectory

Array = NDArray[np.float64]

# Residuals fit their standard deviations when chi2 per degree of freedom is in this range.
FITTING_CHI2 = (0.8, 1.3)
# Once begun, inflation goes on until here. It ends where it no longer helps: then something else does not fit.
INFLATED_CHI2, MAX_INFLATION, WORTHWHILE = 1.1, 100.0, 0.98
# Heading is called unobservable when its standard deviation exceeds this, rad, everywhere.
UNKNOWN_HEADING = 0.35


@dataclass(frozen=True, eq=False)
class Solution:
    """What the smoother found, and how far to believe it.

    `trajectory`: dense, at every IMU stamp; `keyframes` (k): the graph's own states; `biases` (k, 6),
    accelerometer m/s² then gyroscope rad/s; `state_covariances` (k, 15, 15) of (pose tangent, velocity, biases).
    For every fix given (m,): `fix_weights`, from 0 to 1; `fix_residuals` (m, 3) m, fix minus antenna, NaN
    outside the IMU's span; `rejected`: does not fit or could not be used. `chi2_per_dof` is about 1 when the
    standard deviations are honest. `imu_noise` is the noise used, `inflation` times the one expected;
    `notes` says in words what was repaired and what is in doubt.
    """

    trajectory: Trajectory
    keyframes: Trajectory
    biases: Array
    state_covariances: Array
    fix_weights: Array
    fix_residuals: Array
    rejected: NDArray[np.bool_]
    chi2_per_dof: float
    inflation: float
    imu_noise: ImuNoise
    iterations: int
    notes: tuple[str, ...] = ()


def smooth(
    imu: ImuSamples,
    fixes: GnssFixes,
    frame: LocalFrame,
    settings: SmootherSettings | None = None,
    p_imu_antenna: ArrayLike = (0.0, 0.0, 0.0),
    initial_attitude: AttitudePrior | None = None,
) -> Solution:
    """Estimate the trajectory of a road vehicle from its IMU and GNSS fixes.

    `p_imu_antenna` (3,) m is the lever arm. `initial_attitude` is what is known of the attitude at the first
    IMU stamp; nothing need be given. Raises MeasurementError with fewer than three usable fixes, and
    EstimationError when the optimiser stops at its limit.
    """
    settings = settings or SmootherSettings()
    problem = pose_problem(
        imu, fixes, frame, settings, np.asarray(p_imu_antenna, np.float64), initial_attitude
    )
    fit = _fit_noise(problem)
    if settings.robust and fit.chi2_per_dof <= FITTING_CHI2[1]:
        fit = optimise(problem, fit.motion, fit.values, fit.inflation, "truncated")
    return _solution(problem, fit, fixes)


def _fit_noise(problem: Problem) -> Fit:
    """Inflate the IMU noise, starting from the sensor's own, until chi2 per degree of freedom fits."""
    loss = "huber" if problem.settings.robust else "quadratic"
    fit = optimise(problem, motion_graph(problem, 1.0), first_values(problem), 1.0, loss)
    if not problem.settings.inflate_imu_noise or fit.chi2_per_dof <= FITTING_CHI2[1]:
        return fit
    while fit.chi2_per_dof > INFLATED_CHI2 and fit.inflation < MAX_INFLATION:
        inflation = fit.inflation * float(np.clip(fit.chi2_per_dof, 1.25, 4.0))
        looser = optimise(problem, motion_graph(problem, inflation), fit.values, inflation, loss)
        if looser.chi2_per_dof > WORTHWHILE * fit.chi2_per_dof:
            break
        fit = looser
    return fit


def _solution(problem: Problem, fit: Fit, fixes: GnssFixes) -> Solution:
    T, velocities, biases = from_values(fit.values, len(problem.intervals.keyframes))
    covariances = _state_covariances(fit, len(T))
    keyframes = Trajectory(problem.intervals.keyframes, T, velocities, covariances[:, :6, :6])
    noise = problem.noise.scaled(fit.inflation)
    trajectory = densify(problem.intervals, keyframes, biases, problem.intervals.noise(noise), problem.frame)
    weights, rejected = np.zeros(len(fixes)), ~problem.used
    weights[problem.used], rejected[problem.used] = fit.weights, fit.squares > REJECTION
    return Solution(
        trajectory=trajectory,
        keyframes=keyframes,
        biases=biases,
        state_covariances=covariances,
        fix_weights=weights,
        fix_residuals=_residuals(trajectory, fixes, problem.p_imu_antenna),
        rejected=rejected,
        chi2_per_dof=fit.chi2_per_dof,
        inflation=fit.inflation,
        imu_noise=noise,
        iterations=fit.iterations,
        notes=(*problem.notes, *_doubts(fit, keyframes, rejected)),
    )


def _state_covariances(fit: Fit, k: int) -> Array:
    marginals = gtsam.Marginals(fit.graph, fit.values)
    blocks = [marginals.jointMarginalCovariance([X(i), V(i), B(i)]).fullMatrix() for i in range(k)]
    return np.array(blocks)


def _residuals(trajectory: Trajectory, fixes: GnssFixes, p_imu_antenna: Array) -> Array:
    inside = (fixes.stamps >= trajectory.start) & (fixes.stamps <= trajectory.end)
    T = trajectory.at(fixes.stamps[inside])
    off = np.full((len(fixes), 3), np.nan)
    off[inside] = fixes.positions[inside] - T[:, :3, 3] - T[:, :3, :3] @ p_imu_antenna
    return off


def _doubts(fit: Fit, keyframes: Trajectory, rejected: NDArray[np.bool_]) -> Iterator[str]:
    """What the user should know before believing the trajectory, in words."""
    low, high = FITTING_CHI2
    if fit.inflation > 1:
        yield f"the IMU fits with {fit.inflation:.1f} times the noise that was expected"
    if fit.chi2_per_dof > high:
        yield f"chi2 per degree of freedom is {fit.chi2_per_dof:.2f}, expected about 1: something fits worse than its stddev"
    if fit.chi2_per_dof < low:
        yield f"chi2 per degree of freedom is {fit.chi2_per_dof:.2f}, expected about 1: fixes scatter less than their stddevs"
    if rejected.any():
        yield f"{rejected.sum()} of {len(rejected)} fixes rejected"
    heading = heading_stddevs(keyframes)
    if heading.min() > UNKNOWN_HEADING:
        yield f"heading is unobservable (stddev {np.degrees(heading.min()):.0f}° at best): did the vehicle move?"


def heading_stddevs(trajectory: Trajectory) -> Array:
    """Standard deviation of the heading, (k,) rad: the tangent's rotation, turned to the map's up axis."""
    assert trajectory.covariances is not None
    up = trajectory.T_map_imu[:, 2, :3]
    variances: Array = np.einsum("ki,kij,kj->k", up, trajectory.covariances[:, :3, :3], up)
    return np.sqrt(variances)

"""The fixed order of a good fit: noise, calibration, constraints, rejection, each on what the one before left."""

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import M
from numpy.typing import NDArray

from factor_graphs.calibration import Calibration, correct
from factor_graphs.constraints import non_holonomic_factors, standing, zero_velocity_factors
from factor_graphs.problem import Fit, Problem, first_values, motion_graph, optimise
from factor_graphs.settings import SmootherSettings
from factor_graphs.vehicle import Vehicle, body_motion, observe, with_mounting

Array = NDArray[np.float64]

# Residuals fit their standard deviations when chi2 per degree of freedom is in this range.
FITTING_CHI2 = (0.8, 1.3)
# Once begun, inflation goes on until here. It ends where it no longer helps: then something else does not fit.
INFLATED_CHI2, MAX_INFLATION, INFLATION_ROUNDS, WORTHWHILE = 1.1, 1e4, 8, 0.98
# A correction is applied beyond so many of its standard deviations; unasked, only beyond doubt.
NEGLIGIBLE, BEYOND_DOUBT, CALIBRATION_ROUNDS = 0.1, 5.0, 6
# Unasked, a time offset is looked for only in a drive of this length: a short one hardly shows it.
LONG_ENOUGH_S = 120.0
# The constraints are linear enough when the velocity in the imu's axes moves less than this, m/s, slip by this share.
CONSTRAINT_ROUNDS, SETTLED_MPS, SETTLED_SLIP = 4, 0.3, 0.2
# Where relative poses span more than this share of the time, the axle adds nothing that they do not know better: on a
# drive of 480 s with LiDAR odometry it changes no digit of the error, and takes 70 % more time.
BOUND_SHARE = 0.5


def fit_noise(
    problem: Problem, start: Fit | None = None, constraints: list[gtsam.NonlinearFactor] | None = None
) -> Fit:
    """Inflate the IMU noise, from the sensor's own or from `start`, until chi2 per degree of freedom fits.

    The loss is Huber's already, or outliers would be taken for a bad IMU; chi2 counts good fixes only.
    """
    loss = "huber" if problem.settings.robust else "quadratic"
    inflation, motion, values = (
        (1.0, motion_graph(problem, 1.0), first_values(problem))
        if start is None
        else (start.inflation, start.motion, start.values)
    )
    fit = optimise(problem, motion, values, inflation, loss, constraints or [])
    if not problem.settings.inflate_imu_noise or fit.chi2_per_dof <= FITTING_CHI2[1]:
        return fit
    stiff, loosest = fit, MAX_INFLATION
    for _ in range(INFLATION_ROUNDS):
        step = float(np.clip(stiff.chi2_per_dof, 1.25, 8.0))
        inflation = min(stiff.inflation * step, float(np.sqrt(stiff.inflation * loosest)))
        fit = optimise(
            problem, motion_graph(problem, inflation), fit.values, inflation, loss, constraints or []
        )
        if FITTING_CHI2[0] <= fit.chi2_per_dof <= INFLATED_CHI2:
            return fit
        if fit.chi2_per_dof < FITTING_CHI2[0]:
            loosest = inflation
        elif fit.chi2_per_dof < WORTHWHILE * stiff.chi2_per_dof:
            stiff = fit
        else:
            return stiff
    return fit


def calibrate(
    fit_to: Callable[[Calibration], tuple[Problem, Fit]], settings: SmootherSettings, given: Array
) -> tuple[Problem, Fit, Calibration]:
    """Fit, correct time offset and lever arm, and fit again, until the correction is lost in its own noise.

    `fit_to` poses and fits the problem for a calibration; `given` (3,) m is the lever arm to start from.
    """
    with_time, with_lever = settings.estimate_time_offset, settings.estimate_lever_arm
    calibration = Calibration(0.0, given)
    problem, fit = fit_to(calibration)
    if with_time is None and problem.intervals.keyframes[-1] - problem.intervals.keyframes[0] < LONG_ENOUGH_S:
        with_time = False
    if with_time is False and not with_lever:
        return problem, fit, calibration
    least = BEYOND_DOUBT if with_time is None and not with_lever else NEGLIGIBLE
    for _ in range(CALIBRATION_ROUNDS):
        better, moved = correct(problem, fit, calibration, given, with_time is not False, with_lever)
        if moved < least:
            place = calibration.p_imu_antenna
            return problem, fit, replace(better, time_offset_s=calibration.time_offset_s, p_imu_antenna=place)
        calibration, least = better, NEGLIGIBLE
        problem, fit = fit_to(calibration)
    return problem, fit, calibration


def constrain(problem: Problem, fit: Fit) -> tuple[Fit, list[gtsam.NonlinearFactor], Vehicle | None]:
    """Add what a road vehicle cannot do, linearised at the solution, and again at the one that follows.

    Slip is looked at again as well, for a heading that drifts looks like slip until it is held; and the IMU's noise,
    which a vehicle that is known to stand shows better. The vehicle is None where the constraint is not wanted.
    """
    settings, motion = problem.settings, body_motion(problem, fit)
    wanted = settings.vehicle_constraint
    if wanted == "auto" and _bound_share(problem) > BOUND_SHARE:
        wanted = "off"
    vehicle = None if wanted == "off" else observe(problem, fit, motion)
    held = vehicle is not None and (wanted == "on" or not vehicle.doubt)
    factors: list[gtsam.NonlinearFactor] = []
    stood: NDArray[np.bool_] | None = None
    settled = not held
    for _ in range(CONSTRAINT_ROUNDS):
        stands = standing(problem.intervals, motion.velocity) & (settings.standing_stddev_mps is not None)
        if settled and stood is not None and np.array_equal(stands, stood):
            break
        stood = stands
        factors = [*zero_velocity_factors(stands, settings.standing_stddev_mps or 1.0)]
        if vehicle is not None and held:
            fit = with_mounting(problem, fit, vehicle.mounting)
            factors += non_holonomic_factors(fit.values, motion, vehicle.slip_stddevs(motion))
        if not factors:
            break
        fit = fit_noise(problem, fit, factors)
        before, motion = motion, body_motion(problem, fit)
        if vehicle is not None and held:
            mounting = fit.values.atVector(M(len(motion.velocity)))
            guessed, vehicle = (
                vehicle,
                replace(observe(problem, fit, motion, held=True), mounting=mounting, held=True),
            )
            settled = np.allclose(guessed.density, vehicle.density, rtol=SETTLED_SLIP) and bool(
                np.abs(motion.velocity - before.velocity).max() < SETTLED_MPS
            )
    return fit, factors, vehicle


def _bound_share(problem: Problem) -> float:
    """Share of the drive's time that relative poses span."""
    stamps = problem.intervals.keyframes
    first, last = problem.relative_at.T
    edges = np.bincount(first, minlength=len(stamps)) - np.bincount(last, minlength=len(stamps))
    spanned = np.cumsum(edges)[:-1] > 0
    return float(np.diff(stamps)[spanned].sum() / (stamps[-1] - stamps[0]))


def reject(problem: Problem, fit: Fit, constraints: list[gtsam.NonlinearFactor]) -> Fit:
    """Take fixes that do not fit out of the solution: only when the others do, and the fit is not too stiff."""
    if not problem.settings.robust or fit.chi2_per_dof > FITTING_CHI2[1]:
        return fit
    return optimise(problem, fit.motion, fit.values, fit.inflation, "truncated", constraints)

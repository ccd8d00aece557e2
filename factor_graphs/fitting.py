"""The fixed order of a good fit: noise, calibration, constraints, rejection, each on what the one before left."""

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import M, W
from numpy.typing import NDArray

from factor_graphs.calibration import Calibration, correct
from factor_graphs.constraints import (
    CREEPING_SPEED,
    creeping,
    non_holonomic_factors,
    quiet_intervals,
    standing,
    zero_velocity_factors,
)
from factor_graphs.covariances import keyframe_covariances
from factor_graphs.graph import from_values
from factor_graphs.measurements import WheelSpeeds
from factor_graphs.problem import (
    RELATIVE_TOLERANCE,
    ROUGH,
    Fit,
    Problem,
    fit_as_expected,
    motion_graph,
    optimise,
)
from factor_graphs.settings import SmootherSettings
from factor_graphs.slip import Slip
from factor_graphs.slip_variance import found_slip
from factor_graphs.variance import BiasSteps, fix_noise_shown, imu_noise_shown
from factor_graphs.vehicle import BodyMotion, Vehicle, body_motion, observe
from factor_graphs.wheels import Wheels, observe_wheels, wheel_factors

Array = NDArray[np.float64]

# Residuals fit their standard deviations when chi2 per degree of freedom is in this range.
FITTING_CHI2 = (0.8, 1.3)
# Once begun, inflation goes on until here. It ends where it no longer helps: then something else does not fit.
INFLATED_CHI2, MAX_INFLATION, INFLATION_ROUNDS, WORTHWHILE = 1.1, 1e4, 8, 0.98
# White noise and walk of the IMU are looked at so often.
NOISE_ROUNDS = 10
# Fixes are taken for worse than they say when they are so many times: below that, an inflated IMU does no harm.
NOTABLE_FIX_NOISE = 1.2
# A correction is applied beyond so many of its standard deviations; unasked, only beyond doubt.
NEGLIGIBLE, BEYOND_DOUBT, CALIBRATION_ROUNDS = 0.1, 5.0, 6
# Unasked, a time offset is looked for only in a drive of this length: a short one hardly shows it.
LONG_ENOUGH_S = 120.0
# A course that may be so far off the heading, rad, shows no slip: a boat that drifts looks like a car. Only a motion
# with less horizontal acceleration, m/s², nearly always, leaves the heading so unknown.
MOST_OF_HEADING, GENTLE = 0.05, 0.5
# The constraints are linear enough when the velocity in the imu's axes moves less than this, m/s, slip of wheels by
# this share. Until then a rough solution will do.
CONSTRAINT_ROUNDS, SETTLED_MPS, SETTLED_SLIP = 4, 0.3, 0.2


def fit_noise(problem: Problem) -> tuple[Problem, Fit]:
    """Fit, with more noise where the residuals show it: of the fixes, then the problem is another; else of the IMU.

    The loss is Huber's already, or outliers would be taken for a bad IMU; chi2 counts good fixes only. Fixes that are
    worse than they say would be followed by an IMU that is inflated without end. Only variance components tell one from
    the other. Not where relative poses bind the keyframes: they may not fit either. The first fit is a rough one, for
    all that follow begin there; where relative poses bind, a rough one may be centimetres away.
    """
    fit = fit_as_expected(problem, RELATIVE_TOLERANCE if problem.is_bound else ROUGH)
    if _fits(problem, fit):
        return problem, fit
    if not problem.is_bound:
        noisier, better = problem, fit
        for _ in range(NOISE_ROUNDS):
            covariances, steps = _covariances(problem, better)
            of_fixes = fix_noise_shown(noisier, better, covariances)
            noise = imu_noise_shown(noisier, better, covariances, steps)
            if of_fixes == noisier.of_fixes and noise == (better.inflation, better.of_walk):
                break
            noisier, motion = noisier.with_fix_noise(of_fixes), motion_graph(problem, *noise)
            better = optimise(noisier, motion, better.values, noise, fit.loss)
        if noisier.of_fixes > NOTABLE_FIX_NOISE:
            return noisier, better
    return problem, _inflated(problem, fit, [], RELATIVE_TOLERANCE, INFLATED_CHI2)


def fit_noise_from(
    start: Fit, problem: Problem, constraints: list[gtsam.NonlinearFactor], tolerance: float
) -> Fit:
    """Fit with constraints from a solution without, and inflate the IMU noise further until chi2 fits.

    `tolerance` as in `optimise`.
    """
    noise = start.inflation, start.of_walk
    fit = optimise(problem, start.motion, start.values, noise, problem.first_loss, constraints, tolerance)
    return fit if _fits(problem, fit) else _inflated(problem, fit, constraints, tolerance, FITTING_CHI2[1])


def _fits(problem: Problem, fit: Fit) -> bool:
    """Whether the noise is to stay as it is."""
    return not problem.settings.inflate_imu_noise or fit.chi2_per_dof <= FITTING_CHI2[1]


def _inflated(
    problem: Problem, fit: Fit, constraints: list[gtsam.NonlinearFactor], tolerance: float, enough: float
) -> Fit:
    """The solution with so much noise of the IMU that chi2 per degree of freedom is at most `enough`."""
    stiff, loosest = fit, MAX_INFLATION
    for _ in range(INFLATION_ROUNDS):
        step = float(np.clip(stiff.chi2_per_dof, 1.25, 8.0))
        inflation = min(stiff.inflation * step, float(np.sqrt(stiff.inflation * loosest)))
        noise = inflation, stiff.of_walk * inflation / stiff.inflation
        motion = motion_graph(problem, *noise)
        fit = optimise(problem, motion, fit.values, noise, fit.loss, constraints, tolerance)
        if FITTING_CHI2[0] <= fit.chi2_per_dof <= enough:
            return fit
        if fit.chi2_per_dof < FITTING_CHI2[0]:
            loosest = inflation
        elif fit.chi2_per_dof < WORTHWHILE * stiff.chi2_per_dof:
            stiff = fit
        else:
            return stiff
    return fit


def fit_noise_by_components(problem: Problem, fit: Fit) -> Fit:
    """The solution with white noise and bias walk of the IMU as their own residuals show them, by the fixes alone.

    A vehicle constraint would hide noise: where an axle slides less than it is believed to, residuals are small.
    """
    for _ in range(NOISE_ROUNDS):
        noise = imu_noise_shown(problem, fit, *_covariances(problem, fit))
        if noise == (fit.inflation, fit.of_walk):
            break
        fit = optimise(problem, motion_graph(problem, *noise), fit.values, noise, fit.loss)
    return fit


def _covariances(problem: Problem, fit: Fit) -> tuple[Array, BiasSteps]:
    """Covariances (k, 15, 15) of the keyframes, and variances of the steps of their biases."""
    k = len(problem.intervals.keyframes)
    steps = BiasSteps(k)
    covariances, _ = keyframe_covariances(fit.graph, fit.values, k, steps)
    return covariances, steps


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


def constrain(
    problem: Problem, fit: Fit, speeds: WheelSpeeds | None = None
) -> tuple[Fit, list[gtsam.NonlinearFactor], Vehicle | None, Wheels | None]:
    """Add what a road vehicle cannot do, and what its wheels say, linearised at the solution, and again at the next.

    Slip is looked at again once it is held, for a heading that drifts looks like slip until then; and the IMU's noise,
    which a vehicle that is known to stand shows better. Vehicle and wheels are None where they are not wanted.
    """
    settings, motion, key = problem.settings, body_motion(problem, fit), len(problem.intervals.keyframes)
    by_fixes, quiet = fit, _quiet(problem)
    vehicle, wheels, mounting = _observed(problem, fit, motion, speeds)
    axle = vehicle if vehicle and (settings.vehicle_constraint == "on" or not vehicle.doubt) else None
    rolling = wheels if wheels and (settings.wheel_speed == "on" or not wheels.doubt) else None
    settled = axle is None and rolling is None
    tolerance = RELATIVE_TOLERANCE if settled else ROUGH
    factors: list[gtsam.NonlinearFactor] = []
    stood: NDArray[np.bool_] | None = None
    slip: tuple[Slip, Slip] | None = None
    known: tuple[Slip, Slip] | None = None
    for n in range(CONSTRAINT_ROUNDS):
        stands = _standing(problem, fit, quiet, motion)
        if rolling is not None:
            stands &= ~rolling.readings.moving
        if settled and stood is not None and np.array_equal(stands, stood):
            break
        start, stood = _with_shared(problem, fit, axle, rolling), stands
        factors = _constraints(problem, start, motion, stands, axle, rolling, mounting)
        if not factors:
            break
        fit = fit_noise_from(start, problem, factors, tolerance)
        if axle is not None and known is not None and slip != known and _is_bent(fit, start):
            fit, slip, axle = start, known, replace(axle, slip=known)
            continue
        before, motion = motion, body_motion(problem, fit)
        if axle is not None or rolling is not None:
            settled = bool(np.abs(motion.velocity - before.velocity).max() < SETTLED_MPS)
        if axle is not None:
            mounting, guessed = fit.values.atVector(M(key)), axle
            axle = replace(observe(problem, fit, motion), mounting=mounting, held=True)
            if n > 0:  # held once, the axle is where it belongs
                if slip is None:
                    known = guessed.slip
                    slip = found_slip(problem, fit, replace(guessed, mounting=mounting))
                axle = replace(axle, slip=slip)
            settled &= axle.slip == guessed.slip
        if speeds is not None and rolling is not None:
            calibration, noise = fit.values.atVector(W(key)), rolling.noise.typical
            rolling = replace(observe_wheels(speeds, problem, fit, motion, mounting, calibration), held=True)
            settled &= np.allclose(noise, rolling.noise.typical, rtol=SETTLED_SLIP)
    # wheels that fitted only until they were held
    if rolling is not None and rolling.doubt and settings.wheel_speed != "on":
        return *constrain(problem, by_fixes)[:3], replace(rolling, held=False)
    return fit, factors, axle or vehicle, rolling or wheels


def _observed(
    problem: Problem, fit: Fit, motion: BodyMotion, speeds: WheelSpeeds | None
) -> tuple[Vehicle | None, Wheels | None, Array]:
    """Vehicle and wheels as the solution shows them, None where they are not wanted, and the mounting (4,) of the IMU.

    The axle adds nothing that LiDAR odometry does not know better: on a drive of 480 s it changes no digit of the
    error, and takes 70 % more time. So `auto` does not want it there.
    """
    wanted = problem.settings.vehicle_constraint
    with_axle = wanted == "on" or (wanted == "auto" and not problem.is_bound)
    with_wheels = speeds is not None and problem.settings.wheel_speed != "off"
    if not with_axle and not with_wheels:
        return None, None, np.zeros(4)
    shown = observe(problem, fit, motion)
    if not shown.doubt and (heading := _heading_if_gentle(problem, fit)) > MOST_OF_HEADING:
        doubt = (
            f"its heading is known to {np.degrees(heading):.0f}° only: it hardly turns or changes its speed"
        )
        shown = replace(shown, doubt=doubt)
    mounting = np.zeros(4) if shown.doubt and wanted != "on" else shown.mounting
    vehicle = shown if with_axle else None
    if speeds is None or not with_wheels:
        return vehicle, None, mounting
    return vehicle, observe_wheels(speeds, problem, fit, motion, mounting), mounting


def _heading_if_gentle(problem: Problem, fit: Fit) -> float:
    """Usual standard deviation of the heading, rad; 0 where it is certainly small, for turns and braking show it."""
    k = len(problem.intervals.keyframes)
    T, velocities, _ = from_values(fit.values, k)
    changes = np.diff(velocities[:, :2], axis=0) / np.diff(problem.intervals.keyframes)[:, None]
    if np.quantile(np.linalg.norm(changes, axis=1), 0.9) > GENTLE:
        return 0.0
    covariances, _ = keyframe_covariances(fit.graph, fit.values, k)
    up = T[:, 2, :3]
    return float(np.sqrt(np.median(np.einsum("ki,kij,kj->k", up, covariances[:, :3, :3], up))))


def _quiet(problem: Problem) -> NDArray[np.bool_]:
    """The intervals (k - 1,) in which the vehicle may be held still."""
    if problem.settings.standing_stddev_mps is None:
        return np.zeros(len(problem.intervals.keyframes) - 1, dtype=bool)
    return quiet_intervals(problem.intervals)


def _standing(problem: Problem, fit: Fit, quiet: NDArray[np.bool_], motion: BodyMotion) -> NDArray[np.bool_]:
    """The keyframes (k,) at which a solution stands, and the fixes that fit it, too."""
    slow, fits = standing(quiet, motion.velocity, CREEPING_SPEED), fit.weights > 0.5
    creeps = creeping(slow, problem.fixes[fits], problem.at[fits])
    return standing(quiet, motion.velocity) & ~creeps


def _with_shared(problem: Problem, fit: Fit, axle: Vehicle | None, rolling: Wheels | None) -> Fit:
    """The same solution with what all keyframes share among its values."""
    k, values, shared = len(problem.intervals.keyframes), gtsam.Values(fit.values), {}
    if axle is not None:
        shared[M(k)] = axle.mounting
    if rolling is not None:
        shared[W(k)] = rolling.calibration
    for key, value in shared.items():
        if values.exists(key):
            values.erase(key)
        values.insert(key, value)
    return replace(fit, values=values)


def _constraints(
    problem: Problem,
    fit: Fit,
    motion: BodyMotion,
    stands: NDArray[np.bool_],
    axle: Vehicle | None,
    rolling: Wheels | None,
    mounting: Array,
) -> list[gtsam.NonlinearFactor]:
    """What holds where it stands, and of axle and wheels, linearised at a solution."""
    factors: list[gtsam.NonlinearFactor] = [
        *zero_velocity_factors(stands, problem.settings.standing_stddev_mps or 1.0)
    ]
    if axle is not None:
        factors += non_holonomic_factors(fit.values, motion, axle.slip_stddevs(motion))
    if rolling is not None:
        factors += wheel_factors(fit.values, motion, mounting, rolling)
    return factors


def _is_bent(fit: Fit, start: Fit) -> bool:
    """Whether the IMU fits no longer: the constraint is stiffer than the axle."""
    return fit.inflation > start.inflation or fit.chi2_per_dof > FITTING_CHI2[1]


def reject(problem: Problem, fit: Fit, constraints: list[gtsam.NonlinearFactor]) -> Fit:
    """Take fixes that do not fit out of the solution: only when the others do, and the fit is not too stiff."""
    fits = problem.settings.robust and fit.chi2_per_dof <= FITTING_CHI2[1]
    loss = "truncated" if fits else fit.loss
    return optimise(problem, fit.motion, fit.values, (fit.inflation, fit.of_walk), loss, constraints)

"""Parts of a good fit: noise of IMU and fixes, calibration, rejection, each on what the one before left."""

from dataclasses import replace
from typing import Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from factor_graphs.calibration import QUESTIONABLE, Calibration, clock_errors, correct
from factor_graphs.chi_square import BEYOND_DOUBT
from factor_graphs.covariances import keyframe_covariances
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
from factor_graphs.variance import BiasSteps, fix_noise_shown, imu_noise_shown

Array = NDArray[np.float64]


class FitTo(Protocol):
    """Poses and fits the problem for a calibration; with `all_fixes` roughly, and with those that jump together."""

    def __call__(self, calibration: Calibration, all_fixes: bool = False) -> tuple[Problem, Fit]: ...


# Residuals fit their standard deviations when chi2 per degree of freedom is in this range.
FITTING_CHI2 = (0.8, 1.3)
# Once begun, inflation goes on until here. It ends where it no longer helps: then something else does not fit.
INFLATED_CHI2, MAX_INFLATION, INFLATION_ROUNDS, WORTHWHILE = 1.1, 1e4, 8, 0.98
# White noise and walk of the IMU are looked at so often.
NOISE_ROUNDS = 10
# Fixes are taken for worse than they say when they are so many times: below that, an inflated IMU does no harm.
NOTABLE_FIX_NOISE = 1.2
# A correction is applied beyond so many of its standard deviations.
NEGLIGIBLE, CALIBRATION_ROUNDS = 0.1, 6
# Unasked, a time offset is looked for only in a drive of this length: a short one hardly shows it.
LONG_ENOUGH_S = 120.0


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


def calibrate(fit_to: FitTo, settings: SmootherSettings, given: Array) -> tuple[Problem, Fit, Calibration]:
    """Fit, correct time offset and lever arm, and fit again, until the correction is lost in its own noise.

    `given` (3,) m is the lever arm to start from.
    """
    calibration, with_lever = Calibration(0.0, given), settings.estimate_lever_arm
    problem, fit = fit_to(calibration)
    is_long = problem.intervals.keyframes[-1] - problem.intervals.keyframes[0] >= LONG_ENOUGH_S
    looks = is_long if settings.estimate_time_offset is None else settings.estimate_time_offset
    with_time = looks and (with_lever or settings.estimate_time_offset is True)
    if not looks and not with_lever:
        return problem, fit, calibration
    if looks and problem.displaced:
        problem, fit, calibration = _by_clock(fit_to, given) or (problem, fit, calibration)
    for _ in range(CALIBRATION_ROUNDS):
        errors, calibration = clock_errors(problem, fit, calibration, looks)
        offset, sigma = errors.clock_offset(calibration.begins)
        with_time |= looks and abs(offset) > BEYOND_DOUBT * sigma
        better, moved = correct(errors, calibration, given, with_time, with_lever)
        if moved < NEGLIGIBLE:
            of_lever, of_clock = better.p_imu_antenna_stddevs, better.time_offset_stddev_s or sigma
            in_question = not looks or errors.scale_gain > QUESTIONABLE
            calibration = replace(calibration, p_imu_antenna_stddevs=of_lever, scale_in_question=in_question)
            return problem, fit, replace(calibration, time_offset_stddev_s=of_clock if looks else None)
        calibration = better
        problem, fit = fit_to(calibration)
    return problem, fit, calibration


def _by_clock(fit_to: FitTo, given: Array) -> tuple[Problem, Fit, Calibration] | None:
    """Problem and solution with a step of the clock that explains why fixes jump together; None where none does."""
    none = Calibration(0.0, given)
    errors, stepped = clock_errors(*fit_to(none, True), none, True)
    stepped, _ = correct(errors, stepped, given, False, False)
    problem, fit = fit_to(stepped)
    return (problem, fit, stepped) if stepped.clock_steps and not problem.displaced else None


def reject(problem: Problem, fit: Fit, constraints: list[gtsam.NonlinearFactor]) -> Fit:
    """Take fixes that do not fit out of the solution: only when the others do, and the fit is not too stiff."""
    fits = problem.settings.robust and fit.chi2_per_dof <= FITTING_CHI2[1]
    loss = "truncated" if fits else fit.loss
    return optimise(problem, fit.motion, fit.values, (fit.inflation, fit.of_walk), loss, constraints)

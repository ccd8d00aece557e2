"""What a user should know before believing a solution, in words."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from factor_graphs.calibration import Calibration
from factor_graphs.fitting import FITTING_CHI2
from factor_graphs.heading import stddevs_of_heading
from factor_graphs.measurements import GnssFixes
from factor_graphs.problem import GATE, REJECTION, RELATIVE_REJECTION, Fit, Problem
from factor_graphs.screening import are_drifting
from factor_graphs.trajectory import Trajectory
from factor_graphs.variance import correlation_time_shown

Array = NDArray[np.float64]

# Beyond 99.9 % of good relative poses one is rejected: so many in a hundred are ten times what chance takes.
NOTABLE_REJECTION = 0.01
# The usual specific force of any vehicle is gravity to some per cent; so many times more or less is another unit.
ANOTHER_UNIT = 2.0
# A correlation time of the fixes so many times that of the settings is worth a word.
NOTABLE_CORRELATION = 2.0
# Heading is called unobservable when its standard deviation exceeds this, rad, everywhere.
UNKNOWN_HEADING = 0.35


def doubts(problem: Problem, fit: Fit, keyframes: Trajectory, calibration: Calibration) -> Iterator[str]:
    """What the user should know before believing the trajectory, in words."""
    force = float(np.median(np.linalg.norm(problem.intervals.specific_force, axis=1)))
    gravity = problem.frame.gravity
    if not gravity / ANOTHER_UNIT < force < gravity * ANOTHER_UNIT:
        yield f"the usual specific force is {force:.2f} m/s², gravity {gravity:.2f}: is it in g, or without gravity?"
    if max(fit.inflation, fit.of_walk) > 1:
        yield (
            f"the IMU fits with {fit.inflation:.1f} times the noise that was expected,"
            f" {fit.of_walk:.1f} times the walk of its biases"
        )
    if problem.of_fixes > 1:
        yield (
            f"the fixes scatter {problem.of_fixes:.1f} times as much as they say: taken into account; do all come from"
            " one antenna, with its lever arm?"
        )
    if fit.chi2_per_dof > FITTING_CHI2[1]:
        yield f"chi2 per degree of freedom is {fit.chi2_per_dof:.2f}, expected about 1: something does not fit"
    if calibration.time_offset_s:
        yield f"every fix is of {calibration.time_offset_s:+.3f} s after its stamp: taken into account"
    for begin, step, _ in calibration.clock_steps:
        yield f"the clock of the fixes steps at {begin:.1f} s by {-step:+.3f} s: taken into account"
    if calibration.refused:
        yield (
            f"{calibration.refused}: not taken, a deviation of {calibration.time_offset_stddev_s:.2f} s in its place;"
            " check axes and units of the IMU, or correct the stamps of the fixes"
        )
    if rejected := np.count_nonzero(fit.squares > REJECTION):  # of others the problem's notes tell
        is_most = 2 * rejected > len(problem.used)
        asked = ": do all come from one antenna, with its lever arm and their true standard deviations?"
        yield f"{rejected} of {len(problem.used)} fixes rejected{asked if is_most else ''}"
    unfit = fit.relative_squares > RELATIVE_REJECTION
    if unfit.sum() > NOTABLE_REJECTION * len(unfit):
        yield f"{unfit.sum()} of {len(unfit)} relative poses rejected"
    assert keyframes.covariances is not None
    heading = stddevs_of_heading(keyframes.T_map_imu[:, :3, :3], keyframes.covariances)
    if heading.min() > UNKNOWN_HEADING:
        yield (
            f"heading is unobservable (stddev {np.degrees(heading.min()):.0f}° at best): it takes some seconds of"
            " driving, with turns or changes of speed"
        )


def correlation(problem: Problem, fit: Fit, fixes: GnssFixes, residuals: Array) -> Iterator[str]:
    """In words, whether the used fixes are less independent than they are taken for; an inertial unit's always are."""
    floor = problem.settings.min_fix_stddev_m
    if are_drifting(fixes) or any(problem.common_stddevs) or np.median(fixes.stddevs) <= floor:
        return  # what says less than the floor is not believed, whatever it scatters
    good, believed = fit.squares < GATE, problem.settings.fix_correlation_time_s
    stddevs = problem.of_fixes * np.maximum(fixes.stddevs, floor)
    shown = correlation_time_shown(fixes.stamps[good], (residuals / stddevs)[good])
    if shown > NOTABLE_CORRELATION * believed:
        yield (
            f"the fixes wander: those within {shown:.0f} s are wrong together, and the stated accuracy is too good; set"
            f" fix_correlation_time_s to {shown:.0f} (now {believed:g})"
        )

"""Heading between two antennas: its sign and its offset found against the motion, then a factor.

The azimuth of the baseline b from the main antenna to the second one, in the axes of the imu, is that of R b. The
solution without it knows the heading from the fixes and the IMU, where the vehicle moves; where it does not, the
antennas alone know it, and the solution is turned to them first.
"""

from functools import partial

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from factor_graphs.chi_square import BEYOND_DOUBT
from factor_graphs.covariances import keyframe_covariances
from factor_graphs.heading import stddevs_of_heading
from factor_graphs.measurements import AntennaHeadings
from factor_graphs.model import from_values
from factor_graphs.problem import Fit, Problem
from factor_graphs.side_measurements import FEWEST_SEEN, HUBER, Observed, Placed, noise_scale, placed

Array = NDArray[np.float64]

# A solution whose heading is known better than this, rad, judges that of the antennas.
SURE_HEADING = 0.1
# An offset is one beyond doubt of the heading of the solution, and beyond this, rad: the place of an
# antenna 1 m away is known to 1 cm.
LEAST_OFFSET = 0.01
# The heading of a solution is wrong by about the same for so long, s.
SLOW_S = 20.0
# A heading that scatters by more, rad, is of something else: one that scatters by three times less when it is mirrored,
# or in another unit, is that.
SCATTERED, MIRRORED = 0.3, 3.0


def observe_headings(headings: AntennaHeadings, problem: Problem, fit: Fit) -> Observed:
    """What a solution by the fixes shows of headings, their stamps on the clock of the IMU."""
    place = placed(problem, headings.stamps)
    kept = headings[place.rows]
    T = from_values(fit.values, len(problem.intervals.keyframes))[0]
    covariances, _ = keyframe_covariances(fit.graph, fit.values, len(T))
    own = stddevs_of_heading(T[:, :3, :3], covariances)[place.at]
    off = wrapped(kept.azimuths - _azimuths(problem, fit, place, kept.baseline))
    sure = own < (0.0 if problem.heading_in_doubt else SURE_HEADING)
    said = f"antenna heading: {len(kept)} of {len(headings)} used"
    if sure.sum() < FEWEST_SEEN:
        turn = _centre(off) if len(off) else 0.0
        return Observed(
            f"{said}, not judged by the motion", partial(_factors, kept, problem, place), True, -turn
        )
    if doubt := _mistake(kept[sure], off[sure], own[sure]):
        return Observed(f"antenna heading off: {doubt}", doubtful=True)
    stamps = problem.intervals.keyframes[place.at]
    scale = noise_scale(stamps[sure], _quick(stamps[sure], off[sure])[:, None], kept.stddevs[sure, None])
    if scale > 1:
        said += f", as if of {scale:.1f} times the noise that is stated"
    noisier = AntennaHeadings(kept.stamps, kept.azimuths, kept.stddevs * scale, kept.baseline)
    return Observed(said, partial(_factors, noisier, problem, place), scale > 1)


def wrapped(angles: Array) -> Array:
    """Angles rad between -pi and pi."""
    return np.asarray((angles + np.pi) % (2 * np.pi) - np.pi)


def _centre(angles: Array) -> float:
    """Middle of angles (n,) rad on the circle."""
    return float(np.angle(np.exp(1j * angles).mean()))


def _quick(stamps: Array, off: Array) -> Array:
    """What changes quickly of angles (n,) rad: the solution's own error, by the gyroscope, does not."""
    size = max(1, round(SLOW_S / float(np.median(np.diff(stamps)))))
    return np.asarray(off - uniform_filter1d(off, size, mode="nearest"))


def _scatter(angles: Array) -> float:
    return float(np.median(np.abs(wrapped(angles - _centre(angles)))))


def _mistake(headings: AntennaHeadings, off: Array, own: Array) -> str:
    """What is wrong with headings that are `off` (n,) rad, of a solution with stddevs `own`; empty where they fit."""
    said, known = headings.azimuths, headings.azimuths - off
    if (scatter := _scatter(off)) > max(SCATTERED, float(np.median(headings.stddevs))):
        if _scatter(-said - known) < scatter / MIRRORED:
            return "it turns against the vehicle; expected degrees clockwise from north: is it counter-clockwise?"
        if _scatter(np.degrees(said) - known) < scatter / MIRRORED:
            return "it turns less than the vehicle: is it in radians, not degrees?"
        return f"it does not follow the motion, and scatters by {np.degrees(scatter):.0f}° about the heading of that"
    centre = _centre(off)
    if abs(centre) > max(BEYOND_DOUBT * np.hypot(np.median(own), scatter / len(off) ** 0.5), LEAST_OFFSET):
        asked = "; are the two antennas exchanged?" if abs(centre) > np.pi - 0.2 else ""
        return (
            f"it is {np.degrees(centre):+.1f}° off the heading of the motion (clockwise), expected the direction from"
            f" p_imu_antenna to p_imu_antenna2{asked}; correct p_imu_antenna2"
        )
    return ""


def _azimuths(problem: Problem, fit: Fit, place: Placed, baseline: Array) -> Array:
    """Azimuth (r,) rad of the baseline that a solution says."""
    T = from_values(fit.values, len(problem.intervals.keyframes))[0][place.at, :3, :3]
    rates = np.einsum("kij,kj->ki", T, problem.intervals.rates[place.at])
    direction = T @ baseline
    return np.asarray(np.arctan2(direction[:, 0], direction[:, 1]) - rates[:, 2] * place.late)


def _factors(
    headings: AntennaHeadings, problem: Problem, place: Placed, fit: Fit
) -> list[gtsam.NonlinearFactor]:
    """Every heading turns the pose of its keyframe, linearised at the solution, with Huber's weights.

    With u = R b, azimuth a = atan2(u_e, u_n) and R perturbed on the right, d u = -R [b]x d theta.
    """
    R = from_values(fit.values, len(problem.intervals.keyframes))[0][place.at, :3, :3]
    u, (x, y, z) = R @ headings.baseline, headings.baseline
    by_turn = -R @ np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    level = np.sum(u[:, :2] ** 2, axis=1)
    rows = np.zeros((len(u), 1, 6))
    rows[:, 0, :3] = (u[:, 1, None] * by_turn[:, 0] - u[:, 0, None] * by_turn[:, 1]) / level[:, None]
    off = wrapped(headings.azimuths - _azimuths(problem, fit, place, headings.baseline)) / headings.stddevs
    weights = np.sqrt(np.minimum(1.0, HUBER / np.maximum(np.abs(off), 1e-9)))
    rows *= (weights / headings.stddevs)[:, None, None]
    unit = gtsam.noiseModel.Unit.Create(1)
    return [
        gtsam.LinearContainerFactor(gtsam.JacobianFactor(X(i), row, np.array([right]), unit), fit.values)
        for i, row, right in zip(place.at.tolist(), rows, (weights * off).tolist(), strict=True)
    ]

"""Response of an IMU to the track: angular rates against the course, forces against acceleration and curves.

Axes, signs and units need no attitude for this: a right accelerometer answers to one m/s² of speeding up with one m/s²
along x, and to one m/s² of a bend to the left with one along y; a right gyroscope turns as far as the course.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.measurements import ImuSamples
from gnss_sem_map.preflight.inertial_sums import SmoothedIntegral
from gnss_sem_map.preflight.track import MAD, Track

Array = NDArray[np.float64]

# Speed changes and bends are looked at over this long, s: brakes and bends last longer, steps and bumps do not.
LEAST_SPAN_S = 1.0
# A median of n values is so much less sure than their mean.
MEDIAN_LOSS = 1.2533
LEAST_INTERVALS = 4


@dataclass(frozen=True, eq=False)
class TurnGain:
    """By how much the course turned for every rad that the gyroscope says: 1 when all is right."""

    value: float
    stddev: float
    misfit: float
    """Mean absolute difference between the turns, rad."""
    intervals: int
    """Independent ones."""


@dataclass(frozen=True, eq=False)
class ForceResponse:
    """What the accelerometer says, (3,) each: unaccelerated, per m/s² of speeding up, and of a bend to the left.

    `stddevs` (3,) of each of them, per axis.
    """

    still: Array
    ahead: Array
    left: Array
    stddevs: Array


def turn_gain(turned: SmoothedIntegral, track: Track, lag_s: float = 0.0) -> TurnGain | None:
    """The gain that fits best, with fixes `lag_s` later than stamped; None: no course."""
    courses, stamps, moving = track.courses, track.stamps, track.is_moving
    if moving.sum() < LEAST_INTERVALS:
        return None
    span = _span(track)
    # a vehicle that drives backwards has turned as far: courses count up to half a turn
    steps = (np.diff(courses) + np.pi / 2) % np.pi - np.pi / 2
    known = moving[1:] & moving[:-1]
    course = np.concatenate([[0.0], np.cumsum(np.where(known, steps, 0.0))])
    gaps = np.concatenate([[0], np.cumsum(~known)])
    heading = turned.at(stamps + lag_s, track.width_s)
    first, last = _pairs(stamps, span)
    inside = (stamps[first] + lag_s >= turned.stamps[0]) & (stamps[last] + lag_s <= turned.stamps[-1])
    usable = inside & (gaps[first] == gaps[last])
    first, last = first[usable], last[usable]
    if len(first) < LEAST_INTERVALS:
        return None
    by_course, by_gyro = course[last] - course[first], heading[last] - heading[first]
    overlap = max(1.0, span / float(np.median(np.diff(stamps))))
    gain = _median_ratio(by_course, by_gyro)
    misfit = np.abs(by_course - gain * by_gyro)
    excited = float(np.sqrt(np.sum(by_gyro**2)))
    stddev = MEDIAN_LOSS * MAD * float(np.median(misfit)) * np.sqrt(overlap) / max(excited, 1e-12)
    return TurnGain(gain, stddev, float(misfit.mean()), int(len(first) / overlap))


def force_response(
    imu: ImuSamples, up_rate: Array, track: Track, gain: float = 1.0, lag_s: float = 0.0
) -> ForceResponse | None:
    """The accelerometer against the track; None: too few intervals.

    `up_rate` (n,) rad/s is the rate about the vertical, `gain` its sign and unit.
    """
    t, stamps, speeds = imu.stamps, track.stamps, track.speeds
    if len(stamps) < LEAST_INTERVALS:
        return None
    span = _span(track)
    first, last = _pairs(stamps, span)
    inside = (stamps[first] + lag_s >= t[0]) & (stamps[last] + lag_s <= t[-1])
    first, last = first[inside], last[inside]
    bend = np.interp(t, stamps + lag_s, speeds) * up_rate * gain
    sums = SmoothedIntegral.of(t, np.column_stack([imu.specific_force, bend])).at(
        stamps + lag_s, track.width_s
    )
    duration = stamps[last] - stamps[first]
    means = (sums[last] - sums[first]) / duration[:, None]
    faster = (speeds[last] - speeds[first]) / duration
    overlap = max(1.0, span / float(np.median(np.diff(stamps))))
    design = np.column_stack([np.ones(len(first)), faster, means[:, 3]])
    if len(first) / overlap < LEAST_INTERVALS:
        return None
    # a millionth of g holds what the track does not excite
    found, stddevs = regression(design, means[:, :3], 1e-10, overlap)
    return ForceResponse(found[0], found[1], found[2], stddevs)


def regression(design: Array, values: Array, damping: float, overlap: float) -> tuple[Array, Array]:
    """Least squares of `values` (n, k) by `design` (n, p): (p, k), and standard deviations (p,) of the worst column.

    So many rows as `overlap` share what they measure, and count as one; `damping` holds what no row excites.
    """
    normal = design.T @ design + damping * np.eye(design.shape[1])
    found = np.linalg.solve(normal, design.T @ values)
    rest = values - design @ found
    spread = np.sqrt(np.mean(rest**2, axis=0).max() * overlap)
    return np.asarray(found), np.asarray(spread * np.sqrt(np.diag(np.linalg.inv(normal))))


def _span(track: Track) -> float:
    return max(track.width_s, LEAST_SPAN_S)


def _pairs(stamps: Array, span_s: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Knots `span_s` apart; none over gaps."""
    first = np.arange(len(stamps))
    last = np.searchsorted(stamps, stamps + span_s - 1e-6)
    within = last < len(stamps)
    first, last = first[within], last[within]
    near = stamps[last] - stamps[first] <= 1.5 * span_s + 1e-6
    return first[near], last[near]


def _median_ratio(y: Array, x: Array) -> float:
    """The slope through zero with the least sum of absolute residuals: a weighted median of ratios."""
    safe = np.where(np.abs(x) < 1e-12, 1e-12, x)
    ratios, weights = y / safe, np.abs(safe)
    order = np.argsort(ratios)
    half = np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)
    return float(ratios[order][min(half, len(order) - 1)])

"""Noise of an IMU at rest by the Allan deviation (IEEE Std 952; Allan 1966), of overlapping clusters.

The variance over the cluster time tau is fitted by N²/tau + (2 ln 2/pi) B² + K² tau/3: white noise, flicker of the
bias, and its random walk. Each number is told only where its part of the curve was reached.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from factor_graphs.errors import MeasurementError
from factor_graphs.imu_noise import STANDARD_GRAVITY
from factor_graphs.measurements import ImuSamples

Array = NDArray[np.float64]

# Clusters up to this share of the record: ten of them; so many times per decade, and from so many samples on, as
# filters of the unit shape what is shorter.
LONGEST_SHARE, PER_DECADE, FEWEST_SAMPLES = 0.1, 8, 10
# The smallest of a flicker is so much of its bias instability.
FLICKER = 2 * np.log(2) / np.pi
# A part of the curve is reached where it is most of the variance in so many places, and the curve is off by no more
# than this share and so many standard deviations.
MOST, FEWEST_PLACES, OFF, BEYOND = 0.5, 3, 0.2, 4.0
# What scatters by less than this share of the step between its values is not resolved.
RESOLVED = 0.5
# How long a record would have to be is looked for up to so many times what there is.
FARTHEST = 100.0
TINY = 1e-3
PER_H, MG, ROOT_H = 3600.0, STANDARD_GRAVITY / 1000, 60.0
UNITS = {
    "gyroscope": (("rad/s/√Hz", "rad/s", "rad/s²/√Hz"), ("deg/√h", "deg/h", "deg/h/√h"),
                  tuple(np.degrees((ROOT_H, PER_H, PER_H * ROOT_H)).tolist())),
    "accelerometer": (("m/s²/√Hz", "m/s²", "m/s³/√Hz"), ("m/s/√h", "mg", "mg/√h"),
                      (ROOT_H, 1 / MG, ROOT_H / MG)),
}  # fmt: skip
"""Of density, instability and walk: in SI, on data sheets, and how many of these one of SI is."""
NAMES = {
    "gyroscope": ("angle random walk", "bias instability", "rate random walk"),
    "accelerometer": ("velocity random walk", "bias instability", "acceleration random walk"),
}


@dataclass(frozen=True, eq=False)
class AxisNoise:
    """Allan deviation of one axis, and the numbers that it shows.

    `taus`, `deviations`, `stddevs` (t,): cluster times s, deviations in SI units, and their standard deviations.
    `numbers` (3,): noise density, bias instability, random walk of the bias, SI units; NaN where not measured, and
    `why` (3) says why. `fit` (t,): the fitted deviations.
    """

    name: str
    sensor: str
    taus: Array
    deviations: Array
    stddevs: Array
    fit: Array
    numbers: Array
    why: tuple[str, ...]


def noise_of(imu: ImuSamples) -> list[AxisNoise]:
    """The noise of all six axes of samples at rest (`at_rest.span_at_rest`); gyroscope first, x to z.

    Raises MeasurementError for too few samples, and where no axis of a sensor shows any noise.
    """
    if len(imu) < (least := round(2 * FEWEST_SAMPLES / LONGEST_SHARE)):
        raise MeasurementError(f"{len(imu)} samples at rest, expected {least} or more")
    step = float(np.ptp(imu.stamps)) / (len(imu) - 1)
    found = []
    for sensor, letter, values in (
        ("gyroscope", "w", imu.angular_rate), ("accelerometer", "a", imu.specific_force)
    ):  # fmt: skip
        axes = [
            _of_axis(letter + axis, sensor, column, step)
            for axis, column in zip("xyz", values.T, strict=True)
        ]
        if not any(len(axis.taus) for axis in axes):
            raise MeasurementError(f"{sensor}: " + "; ".join(f"{axis.name} {axis.why[0]}" for axis in axes))
        found += axes
    return found


def worst(axes: Sequence[AxisNoise], sensor: str) -> tuple[Array, tuple[str, ...]]:
    """The largest of each number over the axes of a sensor, (3,), NaN where an axis lacks it, and why."""
    of = [axis for axis in axes if axis.sensor == sensor and len(axis.taus)]
    numbers = np.array([axis.numbers for axis in of])
    why = tuple(next((axis.why[k] for axis in of if axis.why[k]), "") for k in range(3))
    return numbers.max(axis=0), why


def _of_axis(name: str, sensor: str, values: Array, step: float) -> AxisNoise:
    if fault := _not_resolved(values):
        nothing = np.empty(0)
        return AxisNoise(name, sensor, nothing, nothing, nothing, nothing, np.full(3, np.nan), (fault,) * 3)
    from allantools import edf_simple, oadev

    n = len(values)
    first, last = FEWEST_SAMPLES * step, LONGEST_SHARE * n * step
    asked = np.geomspace(first, last, round(PER_DECADE * np.log10(last / first)) + 1)
    taus, deviations, *_ = oadev(values - values.mean(), 1 / step, "freq", asked)
    # of the variance, as a share of it
    spread = np.sqrt(2 / np.array([edf_simple(n + 1, round(tau / step), 0) for tau in taus]))
    squares = _fitted(terms(taus), deviations**2, spread)
    fit = np.sqrt(terms(taus) @ squares)
    numbers, why = _reached(squares, taus, deviations, spread, n * step)
    return AxisNoise(name, sensor, taus, deviations, deviations * spread / 2, fit, numbers, why)


def _not_resolved(values: Array) -> str:
    """Why an axis shows no noise, in words; empty where it does."""
    levels = np.unique(values)
    if len(levels) == 1:
        return f"is {levels[0]:g} all the time"
    resolution = float(np.median(np.diff(levels)))
    if values.std() < RESOLVED * resolution:
        return f"takes {len(levels)} values, {resolution:.2g} apart, and scatters by less"
    return ""


def _fitted(parts: Array, variances: Array, spread: Array) -> Array:
    """Squares of the three numbers, not below zero; first weighted by the variances, then by the fit of these."""
    expected = variances
    for _ in range(3):
        rows = parts / (expected * spread)[:, None]
        scales = np.linalg.norm(rows, axis=0)
        found = nnls(rows / scales, variances / (expected * spread))[0] / scales
        expected = np.maximum(parts @ found, TINY * variances)
    return np.asarray(found)


def terms(taus: Array) -> Array:
    """How the squares of density, instability and walk add up to the variance at cluster times (t,): (t, 3)."""
    return np.column_stack([1 / taus, np.full(len(taus), FLICKER), taus / 3])


def _reached(
    squares: Array, taus: Array, deviations: Array, spread: Array, span: float
) -> tuple[Array, tuple[str, ...]]:
    """The numbers whose part of the curve was reached, NaN for others, and why those are not."""
    shares, total = _shares(squares, taus)
    fits = np.abs(deviations**2 / total - 1) < OFF + BEYOND * spread
    numbers, why = np.sqrt(squares), ["", "", ""]
    numbers[1] = np.sqrt(total.min() / FLICKER)
    if ((shares[:, 0] > MOST) & fits).sum() < FEWEST_PLACES:
        why[0] = "no part of the curve is of white noise: shaken, or filtered"
    later = span * LONGEST_SHARE * np.geomspace(1, FARTHEST)
    of_later = _shares(squares, later)[0]
    for k, reached, at in (
        (1, shares[:, 0] < MOST, of_later[:, 0] < MOST),
        (2, shares[:, 2] > MOST, of_later[:, 2] > MOST),
    ):
        if not reached[-FEWEST_PLACES:].all():
            needed = 10 ** (FEWEST_PLACES / PER_DECADE) / LONGEST_SHARE * later[at.argmax()]
            why[k] = f"needs about {needed:.0f} s" if at.any() else f"needs more than {3 * span:.0f} s"
    return np.where([bool(one) for one in why], np.nan, numbers), tuple(why)


def _shares(squares: Array, taus: Array) -> tuple[Array, Array]:
    """What share of the fitted variance each part is, (t, 3), and the variance (t,)."""
    parts = terms(taus) * squares
    total = parts.sum(axis=1)
    return parts / total[:, None], total

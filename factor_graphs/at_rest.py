"""When an IMU is at rest: by its own scatter from window to window, and by its means."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.chi_square import BEYOND_DOUBT
from factor_graphs.errors import MeasurementError
from factor_graphs.measurements import ImuSamples
from factor_graphs.stamps import gaps

Array = NDArray[np.float64]

# What scatters no more than so many times as in the quietest seconds may stand; these are the quietest of fifty.
# Windows of a slow IMU are longer: the scatter of fewer samples is twice as large by chance.
QUIET, QUIETEST, FEWEST_IN_WINDOW = 2.0, 0.02, 50
# A record at rest is this long, s, or longer. Over so many parts of it, mean specific force, m/s², and angular rate,
# rad/s, stay within these: a bias that warms up does, a vehicle, whose road has slopes, does not.
LEAST_SPAN_S, PARTS = 60.0, 10
STEADY_FORCE, STEADY_RATE = 0.1, 0.01
# Gravity on Earth is within this share of 9.81 m/s², any accelerometer's bias included.
GRAVITY, OFF_GRAVITY = 9.81, 0.1
# The middle nine tenths of the steps of the stamps differ by less than this share of a step.
STEADY_STEPS = 0.5


@dataclass(frozen=True, eq=False)
class Windows:
    """Number, means (w, 3) and scatter (w,) of samples by windows; values scatter by their resolution at least."""

    count: NDArray[np.intp]
    force: Array
    rate: Array
    force_scatter: Array
    rate_scatter: Array

    @classmethod
    def of(cls, imu: ImuSamples, length_s: float = 1.0) -> "Windows":
        """Windows from the first stamp on; one without samples has means and scatter of zero."""
        window = window_of(imu, length_s)
        count = np.bincount(window)

        def means_of(columns: Array) -> Array:
            sums = np.column_stack([np.bincount(window, column) for column in columns.T])
            return np.asarray(sums / np.maximum(count, 1)[:, None])

        force, rate = means_of(imu.specific_force), means_of(imu.angular_rate)
        scatters = (
            np.sqrt(means_of((samples - means[window]) ** 2).sum(axis=1) + _resolution(samples) ** 2)
            for samples, means in ((imu.specific_force, force), (imu.angular_rate, rate))
        )
        return cls(count, force, rate, *scatters)

    def quiet(self, share: float) -> NDArray[np.bool_]:
        """The windows (w,) with samples in which both sensors scatter little against that share of all."""
        quiet = self.count > self.count.max() / 2
        for scatter in (self.force_scatter, self.rate_scatter):
            quiet &= scatter <= QUIET * np.quantile(scatter[quiet], share)
        return np.asarray(quiet)


def window_of(imu: ImuSamples, length_s: float) -> NDArray[np.intp]:
    """The window (n,) of each sample."""
    return np.asarray((imu.stamps - imu.stamps[0]) / length_s, np.intp)


def _resolution(values: Array) -> float:
    """The smallest change from one sample to the next; zero of a constant."""
    changes = np.abs(np.diff(values, axis=0))
    return float(changes.min(where=changes > 0, initial=np.inf)) if changes.any() else 0.0


def span_at_rest(imu: ImuSamples) -> ImuSamples:
    """The longest part of samples in which the IMU is at rest, without gaps and evenly sampled.

    Raises MeasurementError where there is none of a minute: for what moves, for gaps, and for stamps that vary.
    """
    least, most = np.quantile(np.diff(imu.stamps), (0.05, 0.95))
    if most - least > STEADY_STEPS * (step := float(np.median(np.diff(imu.stamps)))):
        raise MeasurementError(
            f"sampling varies: steps of {1e3 * least:.2f} to {1e3 * most:.2f} ms, usually {1e3 * step:.2f}; expected"
            " even ones: are these times of arrival, or of a sensor that changed its rate?"
        )
    samples = _longest_run(imu)
    span = float(np.ptp(samples.stamps))
    if span < LEAST_SPAN_S:
        raise MeasurementError(
            f"the IMU is at rest, without gaps, for {span:.0f} s at most of {np.ptp(imu.stamps):.0f} s, expected"
            f" {LEAST_SPAN_S:.0f} s or more (an hour is usual): record it while nothing moves it"
        )
    if moved := _moved(samples):
        raise MeasurementError(f"the IMU moves: {moved}; record it while nothing moves it, best for an hour")
    force = float(np.linalg.norm(samples.specific_force.mean(axis=0)))
    if abs(force - GRAVITY) > OFF_GRAVITY * GRAVITY:
        raise MeasurementError(
            f"the specific force at rest is {force:.3g} m/s², expected gravity, {GRAVITY}: set its unit (force_unit)"
        )
    return samples


def _longest_run(imu: ImuSamples) -> ImuSamples:
    """The samples of the longest run of quiet windows that no gap interrupts."""
    length_s = max(1.0, FEWEST_IN_WINDOW * float(np.median(np.diff(imu.stamps))))
    quiet = Windows.of(imu, length_s).quiet(QUIETEST)
    breaks = np.searchsorted(imu.stamps, gaps(imu.stamps)[:, 1])
    after_gap = np.zeros(len(imu), np.intp)
    after_gap[breaks] = 1
    good = quiet[window_of(imu, length_s)]
    run = np.cumsum(after_gap + np.append(False, good[1:] != good[:-1]))
    sizes = np.bincount(run, good)
    return imu[run == sizes.argmax()]


def _moved(samples: ImuSamples) -> str:
    """How it moves, in words; empty at rest."""
    for what, unit, values, steady in (
        ("mean specific force", "m/s²", samples.specific_force, STEADY_FORCE),
        ("mean angular rate", "rad/s", samples.angular_rate, STEADY_RATE),
    ):
        means = np.array([part.mean(axis=0) for part in np.array_split(values, PARTS)])
        noise = values.std(axis=0).max() / np.sqrt(len(samples) / PARTS)
        if (change := float(np.ptp(means, axis=0).max())) > steady + BEYOND_DOUBT * noise:
            return f"its {what} changes by {change:.2g} {unit} within {np.ptp(samples.stamps):.0f} s"
    return ""

"""Time offset of the fixes: the lag at which their positions and course agree best with the IMU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.dead_reckoning import WINDOW_S, Complex, Windows, agreement, way_of, windows_of
from factor_graphs.measurements import GnssFixes, ImuSamples
from gnss_sem_map.preflight.inertial_sums import SmoothedIntegral
from gnss_sem_map.preflight.response import turn_gain
from gnss_sem_map.preflight.track import Track

Array = NDArray[np.float64]

# Lags that are tried, s: coarsely as far as a receiver's message may be late, then finely around the best.
FARTHEST_S, COARSE_S, FINE_S = 3.0, 0.1, 0.02
# A shorter log has so few independent errors that chance finds a lag: in 2 of 48 simulated ones of 1.5 and 2.5 s.
SHORTEST_S = 5.0
# Twice the logarithm of the likelihood must gain so much: four standard deviations of one unknown.
FOUR_SIGMA = 16.0
# GPS time is so many seconds ahead of UTC (since 2017); what is off by as much has one in place of the other.
LEAP_S, LEAP_STEP_S = 18.0, 0.2
# Twice the logarithm of the likelihood, above all lags near zero, by which that is believed: ten standard deviations.
SURE_LEAP = 100.0


@dataclass(frozen=True)
class Lag:
    """By how much a fix is later than its stamp, s; `gain` is twice the logarithm of the likelihood against no lag."""

    seconds: float
    gain: float
    observable: bool
    """Whether another lag would have been noticed: half a second to either side fits clearly worse."""

    @property
    def is_certain(self) -> bool:
        """Whether chance alone would not find it."""
        return self.gain > FOUR_SIGMA


NO_LAG = Lag(0.0, 0.0, False)


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Fixes against the IMU, for any lag between the two."""

    stamps: Array
    windows: Windows | None
    ways: list[Complex]
    turned: SmoothedIntegral
    track: Track

    def likelihoods(self, lags: Array) -> Array:
        """Logarithms, up to a constant: of ways and turns."""
        return np.asarray(self.by_ways_and_turns(lags).sum(axis=0))

    def by_ways_and_turns(self, lags: Array) -> Array:
        """Logarithms, (2, n), up to a constant: normal errors of the ways, and Laplace's of the turns."""
        rests, free, turns, intervals = np.array([self._misfits(lag) for lag in lags]).T
        # as many independent errors as where the fit is best, for all: elsewhere the lag itself makes them alike
        at_best = int(np.argmin(rests * turns))
        return -np.array([free[at_best] * np.log(rests), intervals[at_best] * np.log(turns)])

    def _misfits(self, lag: float) -> tuple[float, float, float, int]:
        """Of the ways, and how many independent errors that is; of the courses, likewise."""
        windows = self.windows
        found = (
            [agreement(windows, self.stamps, way, lag) for way in self.ways] if windows is not None else []
        )
        best = min(found, key=lambda one: one.rest, default=None)
        gain = turn_gain(self.turned, self.track, lag)
        return (
            max(best.rest, 1e-9) if best is not None else 1.0,
            best.independent if best is not None else 0.0,
            max(gain.misfit, 1e-6) if gain is not None else 1.0,
            gain.intervals if gain is not None else 0,
        )


def lag_of(imu: ImuSamples, fixes: GnssFixes, track: Track, lever: complex = 0j) -> Lag:
    """The lag that fits best, whatever the axes in the plane: z of the IMU is up, its rate in rad/s.

    `lever` is where the antenna is said to be, m, ahead + i left. What a mistake in the axes would change is free:
    the sign of the turns, the heading, the hand.
    """
    start, end = float(imu.stamps[0]), float(imu.stamps[-1])
    if end - start < SHORTEST_S:
        return NO_LAG
    farthest = min(FARTHEST_S, (end - start) / 4)
    turned = SmoothedIntegral.of(imu.stamps, imu.angular_rate[:, 2])
    backwards = ImuSamples(imu.stamps, imu.specific_force, -imu.angular_rate)
    ways = [way_of(unit, lever, mirrored=hand) for unit in (imu, backwards) for hand in (False, True)]

    def compared(within: float) -> _Comparison:
        windows = windows_of(fixes, start + within, end - within)
        return _Comparison(imu.stamps, windows, ways, turned, track)

    if end - start >= 2 * (LEAP_S + FARTHEST_S) + WINDOW_S:
        leap = _leap_of(compared(LEAP_S + FARTHEST_S))
        if leap is not None:
            return leap
    return _near_lag(compared(farthest), farthest)


def _near_lag(compared: _Comparison, farthest: float) -> Lag:
    """The lag up to `farthest` s that fits best."""
    count = round(farthest / COARSE_S)
    coarse = np.linspace(-count, count, 2 * count + 1) * COARSE_S
    by_ways, by_turns = compared.by_ways_and_turns(coarse)
    if compared.windows is not None and 2 * np.ptp(by_ways) < FOUR_SIGMA:
        # who goes another way than the IMU feels is no vehicle: on foot a turn of the body is none of the course
        return NO_LAG
    scores = by_ways + by_turns
    best = float(coarse[int(np.argmax(scores))])
    fine = np.append(best + np.arange(-4, 5) * FINE_S, 0.0).astype(np.float64)
    around = compared.likelihoods(fine)
    found = float(fine[int(np.argmax(around))])
    beside = scores[np.abs(np.abs(coarse - found) - 0.5) < COARSE_S]
    observable = len(beside) > 0 and 2 * (scores.max() - beside.max()) > FOUR_SIGMA
    return Lag(found, float(2 * (around.max() - around[-1])), bool(observable))


def _leap_of(compared: _Comparison) -> Lag | None:
    """The lag where one clock has GPS time and the other UTC; None where one near zero fits about as well."""
    count = round(FARTHEST_S / LEAP_STEP_S)
    around = np.arange(-count, count + 1) * LEAP_STEP_S
    lags = np.concatenate([leap + around for leap in (0.0, LEAP_S, -LEAP_S)])
    scores = compared.likelihoods(lags)
    best = int(np.argmax(scores))
    gain = 2 * float(scores[best] - scores[: len(around)].max())
    if best < len(around) or gain < SURE_LEAP:
        return None
    fine = lags[best] + np.arange(-10, 11) * FINE_S
    found = float(fine[int(np.argmax(compared.likelihoods(fine)))])
    return Lag(found, gain, observable=True)

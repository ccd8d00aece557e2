"""How late the fixes are: the lag at which their way and their course agree best with the IMU's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.measurements import GnssFixes, ImuSamples
from gnss_sem_map.preflight.dead_reckoning import agreement, windows_of
from gnss_sem_map.preflight.inertial_sums import SmoothedIntegral, way_of
from gnss_sem_map.preflight.response import turn_gain
from gnss_sem_map.preflight.track import Track

Array = NDArray[np.float64]

# Lags that are tried, s: coarsely as far as a receiver's message may be late, then finely around the best.
FARTHEST_S, COARSE_S, FINE_S = 3.0, 0.1, 0.02
# Half of this is what the logarithm of the likelihood must gain: five standard deviations of one unknown.
FIVE_SIGMA = 25.0


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
        return self.gain > FIVE_SIGMA


NO_LAG = Lag(0.0, 0.0, False)


def lag_of(imu: ImuSamples, fixes: GnssFixes, track: Track) -> Lag:
    """The lag that fits best, whatever the axes in the plane: z of the IMU is up, its rate in rad/s.

    Both measures are free in what a mistake in the axes would change: the sign of the turns, the heading, the hand.
    """
    start, end = float(imu.stamps[0]), float(imu.stamps[-1])
    farthest = min(FARTHEST_S, (end - start) / 4)
    windows = windows_of(fixes, start + farthest, end - farthest)
    turned = SmoothedIntegral.of(imu.stamps, imu.angular_rate[:, 2])
    backwards = ImuSamples(imu.stamps, imu.specific_force, -imu.angular_rate)
    ways = [way_of(unit, mirrored=hand) for unit in (imu, backwards) for hand in (False, True)]

    def likelihood(lag: float) -> float:
        score = 0.0
        if windows is not None:
            rests = [agreement(windows, imu.stamps, way, lag).rest for way in ways]
            score -= windows.seconds * np.log(max(min(rests), 1e-9))
        gain = turn_gain(turned, track, lag)
        if gain is not None:
            score -= gain.intervals * np.log(max(gain.misfit, 1e-6))
        return float(score)

    coarse = np.arange(-round(farthest / COARSE_S), round(farthest / COARSE_S) + 1) * COARSE_S
    scores = np.array([likelihood(lag) for lag in coarse])
    best = float(coarse[int(np.argmax(scores))])
    fine = best + np.arange(-4, 5) * FINE_S
    around = np.array([likelihood(lag) for lag in fine])
    found, top = float(fine[int(np.argmax(around))]), float(max(around.max(), scores.max()))
    at_zero = float(scores[len(scores) // 2])
    beside = scores[np.abs(np.abs(coarse - found) - 0.5) < COARSE_S]
    observable = len(beside) > 0 and 2 * (top - float(beside.max())) > FIVE_SIGMA
    return Lag(found, 2 * (top - at_zero), bool(observable))

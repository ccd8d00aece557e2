"""Which fixes can be used at all, before any estimation, and how much a crowd of them weighs."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factor_graphs.measurements import GnssFixes, ImuSamples
from factor_graphs.settings import SmootherSettings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# However slow the vehicle, two good fixes may differ by this much, m.
ALLOWANCE_M = 50.0
# So many runs of fixes between impossible jumps are tried as the true one.
BELIEVED_RUNS = 20
# So many fixes make a drive.
FEWEST = 3
# Who reports positions more often than this, s, with less white noise than this share of what is claimed, reports what
# a filter makes of them.
DRIFTING_BELOW_S, FILTERED = 0.5, 0.5
# Fourth differences of white noise have 70 times its variance; those of a vehicle's way, ten times a second, are of
# millimetres. Steps are even when they differ by no more than this share.
FOURTH, EVEN = 70.0, 0.1
MEDIAN_OF_ABS = 0.6745


def inside(fixes: GnssFixes, imu: ImuSamples) -> Mask:
    """The fixes that the IMU can carry to: those inside its span, (m,)."""
    return np.asarray((fixes.stamps >= imu.stamps[0]) & (fixes.stamps <= imu.stamps[-1]))


def are_new(fixes: GnssFixes) -> Mask:
    """The fixes whose position is not that of the fix before, (m,); all where fewer than three positions differ.

    Noise alone moves a measured position, so rows that are the same are one measurement written again: by a logger
    faster than the receiver, or by a receiver that has none. Its moment is that of the first row. A receiver that
    holds its position while it stands writes hardly any other.
    """
    changed = np.append(True, np.any(np.diff(fixes.positions, axis=0) != 0, axis=1))[: len(fixes)]
    return changed if changed.sum() >= FEWEST else np.ones(len(fixes), dtype=bool)


def plausible(fixes: GnssFixes, max_speed_mps: float) -> Mask:
    """The fixes that a vehicle can have driven to from the others, (m,).

    The fixes fall into runs between impossible jumps. A run is believed, and from it outwards every other
    that can be reached at `max_speed_mps`; of the longest runs, the one that most fixes agree with wins.
    """
    if len(fixes) == 0:
        return np.zeros(0, dtype=bool)
    steps = np.linalg.norm(np.diff(fixes.positions, axis=0), axis=1)
    jumps = steps > max_speed_mps * np.diff(fixes.stamps) + ALLOWANCE_M
    runs = np.split(np.arange(len(fixes)), np.flatnonzero(jumps) + 1)
    longest = sorted(range(len(runs)), key=lambda i: -len(runs[i]))[:BELIEVED_RUNS]
    return max((_agreeing(fixes, runs, i, max_speed_mps) for i in longest), key=np.count_nonzero)


def _agreeing(fixes: GnssFixes, runs: list[NDArray[np.intp]], believed: int, max_speed_mps: float) -> Mask:
    keep = np.zeros(len(fixes), dtype=bool)
    keep[runs[believed]] = True
    for outwards, facing in ((runs[believed + 1 :], 0), (runs[:believed][::-1], -1)):
        edge = runs[believed][-1 - facing]
        for run in outwards:
            step = np.linalg.norm(fixes.positions[run[facing]] - fixes.positions[edge])
            if step <= max_speed_mps * abs(fixes.stamps[run[facing]] - fixes.stamps[edge]) + ALLOWANCE_M:
                keep[run] = True
                edge = run[-1 - facing]
    return keep


def are_drifting(fixes: GnssFixes) -> bool:
    """Whether they are an inertial unit's positions, whose errors last for a minute, not a receiver's."""
    return are_frequent(fixes) and white_share(fixes) < FILTERED


def are_frequent(fixes: GnssFixes) -> bool:
    """Whether they come so often that a vehicle's way between them is smooth."""
    return len(fixes) > 1 and float(np.median(np.diff(fixes.stamps))) < DRIFTING_BELOW_S


def white_share(fixes: GnssFixes) -> float:
    """Standard deviation of white noise in the fixes, as a share of what they claim, at most 1; 0 where it is not seen.

    From fourth differences, which no vehicle has: so for fixes at least twice a second.
    """
    steps = np.diff(fixes.stamps)
    if len(steps) < 4:
        return 0.0
    windows = np.lib.stride_tricks.sliding_window_view(steps, 4)
    even = np.ptp(windows, axis=1) < EVEN * windows.mean(axis=1)
    off = (np.diff(fixes.positions[:, :2], 4, axis=0) / fixes.stddevs[2:-2, :2])[even]
    scatter = np.median(np.abs(off)) / MEDIAN_OF_ABS if len(off) else 0.0
    return float(min(scatter / FOURTH**0.5, 1.0))


def correlation_times(fixes: GnssFixes, settings: SmootherSettings, relative_stamps: Array) -> Array:
    """How long the error of each fix lasts, (m,) s; `relative_stamps` (k, 2) s are those of the relative poses.

    An inertial unit's positions, ten a second, drift together for a minute. Where relative poses hold the shape of
    the track, they must not turn it: over a short way their drift looks like another heading. Elsewhere nothing but
    they and the IMU holds it.
    """
    times = np.full(len(fixes), settings.fix_correlation_time_s)
    if are_drifting(fixes):
        begun = np.searchsorted(np.sort(relative_stamps[:, 0]), fixes.stamps, side="right")
        ended = np.searchsorted(np.sort(relative_stamps[:, 1]), fixes.stamps, side="left")
        drift = max(settings.fix_correlation_time_s, settings.drift_correlation_time_s)
        times[begun > ended] = drift
    return times


def decorrelate(fixes: GnssFixes, correlation_times_s: Array | float, min_stddev_m: float) -> GnssFixes:
    """The same fixes with stddevs such that all within one correlation time, (m,) or one for all, weigh as one.

    An inertial unit that reports its filtered position ten times a second says the same thing ten times. Two fixes are
    correlated by what is left of the correlation time between them (Bartlett's triangle), so n evenly spaced fixes in
    such a time weigh as one exactly, and jitter of their stamps changes little. What is seen to be white noise is not
    correlated.
    """
    t = fixes.stamps - fixes.stamps[:1].sum()
    time = np.broadcast_to(np.maximum(correlation_times_s, 1e-9), t.shape)
    first, last = np.searchsorted(t, t - time), np.searchsorted(t, t + time)
    here, sums = np.arange(len(t)) + 1, np.append(0.0, np.cumsum(t))
    apart = (here - first) * t - (sums[here] - sums[first]) + (sums[last] - sums[here]) - (last - here) * t
    white = white_share(fixes) ** 2
    crowd = white + (1 - white) * np.maximum(last - first - apart / time, 1.0)[:, None]
    # what scatters as it claims needs no floor; of rare fixes the scatter is their way
    floor = min_stddev_m * (np.sqrt(1 - white) if are_frequent(fixes) else 1.0)
    return replace(fixes, stddevs=np.maximum(fixes.stddevs, floor) * np.sqrt(crowd))

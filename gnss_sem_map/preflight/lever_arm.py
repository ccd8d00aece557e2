"""Check of the lever arm of the antenna: in turns, its velocity differs from that of the IMU."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import FactorGraphError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuSamples
from factor_graphs.settings import SmootherSettings
from factor_graphs.smoothing import smooth
from gnss_sem_map.preflight.diagnosis import Diagnosis
from gnss_sem_map.preflight.findings import Finding, amber, green, red

Array = NDArray[np.float64]

# No vehicle is longer.
LONGEST_M = 20.0
# An antenna is told to be elsewhere from here, m, and from so many standard deviations.
NOTABLE_M, SURE = 1.4, 3.0
# What is less sure than this, m, says nothing about an antenna on a car.
OBSERVED_M = 0.9
# A stretch so long, s, that turns by so much, rad, left and right in all, shows where the antenna is.
STRETCH_S, LEAST_TURN_RAD = 40.0, 0.5
# More fixes a second say the same once more, and cost as much again.
FIXES_PER_S = 1.0


def check_lever_arm(
    given: Array, diagnosis: Diagnosis | None, fixes: GnssFixes, frame: LocalFrame, smoother: SmootherSettings
) -> Iterator[Finding]:
    """The lever arm as it is given, (3,) m, against any vehicle and against the fixes."""
    evidence = "p_imu_antenna is (" + " ".join(f"{value:.2f}" for value in given) + ") m"
    if float(np.linalg.norm(given)) > LONGEST_M:
        yield red("GNSS antenna", evidence, "the lever arm is in mm or cm", "give p_imu_antenna in metres")
        return
    found = None if diagnosis is None else found_lever_arm(given, diagnosis, fixes, frame, smoother)
    if found is None or found[1] > OBSERVED_M:
        yield green("GNSS antenna", f"{evidence}; not observable: too few turns for the noise")
        return
    lever, stddev = found
    off = float(np.linalg.norm(lever - given[:2]))
    evidence += f", the turns say ({lever[0]:.1f} {lever[1]:.1f}) ± {stddev:.1f} m horizontally"
    if off > max(NOTABLE_M, SURE * stddev):
        yield amber(
            "GNSS antenna",
            evidence,
            f"the antenna is {off:.1f} m from where p_imu_antenna says",
            f"measure it: p_imu_antenna is about [{lever[0]:.1f}, {lever[1]:.1f}, {given[2]:.1f}]",
        )
    else:
        yield green("GNSS antenna", evidence)


def found_lever_arm(
    given: Array, diagnosis: Diagnosis, fixes: GnssFixes, frame: LocalFrame, smoother: SmootherSettings
) -> tuple[Array, float] | None:
    """The horizontal lever arm, (2,) m, and its standard deviation, from one stretch smoothed; None: too few turns."""
    imu = diagnosis.imu
    start = _most_turning(imu)
    within = slice(*np.searchsorted(imu.stamps, [start, start + STRETCH_S]))
    stamps, rate = imu.stamps[within], imu.angular_rate[within]
    if diagnosis.mirrored or len(stamps) < 3 or _turned(stamps, rate) < LEAST_TURN_RAD:
        return None
    inside = (fixes.stamps >= stamps[0]) & (fixes.stamps <= stamps[-1])
    seconds = np.floor(fixes.stamps * FIXES_PER_S)
    first = np.diff(seconds, prepend=-np.inf) > 0
    settings = SmootherSettings(
        imu_noise=smoother.imu_noise,
        estimate_lever_arm=True,
        estimate_time_offset=diagnosis.lag.is_certain,
        robust=False,
    )
    try:
        part = ImuSamples(stamps, imu.specific_force[within], rate)
        found = smooth(part, fixes[inside & first], frame, settings, given).calibration
    except FactorGraphError:
        return None
    assert found.p_imu_antenna_stddevs is not None
    return found.p_imu_antenna[:2], float(found.p_imu_antenna_stddevs[:2].max())


def _most_turning(imu: ImuSamples) -> float:
    """Where the stretch begins that turns most, s."""
    first, step_s = imu.stamps[0], STRETCH_S / 4
    starts = first + step_s * np.arange(1 + max(imu.stamps[-1] - first - STRETCH_S, 0.0) // step_s)
    turned = np.concatenate([[0.0], np.cumsum(np.abs(imu.angular_rate[:-1, 2]) * np.diff(imu.stamps))])
    at = [np.interp(starts + shift, imu.stamps, turned) for shift in (0.0, STRETCH_S)]
    return float(starts[int(np.argmax(at[1] - at[0]))])


def _turned(stamps: Array, rate: Array) -> float:
    """By how much the heading turns, left and right in all, rad, without the noise and the bias of a gyroscope."""
    count = max(1, round(1.0 / float(np.median(np.diff(stamps)))))
    means = rate[: len(rate) // count * count, 2].reshape(-1, count).mean(axis=1)
    return float(np.sum(np.abs(means - np.median(means))))

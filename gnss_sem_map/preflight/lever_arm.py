"""Where the antenna is: in turns it goes another way than the IMU."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from factor_graphs.measurements import GnssFixes
from gnss_sem_map.preflight.dead_reckoning import beside_parabola, complex_at, independent_errors, windows_of
from gnss_sem_map.preflight.diagnosis import Diagnosis
from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.preflight.inertial_sums import integral, way_of

Array = NDArray[np.float64]

# No vehicle is longer.
LONGEST_M = 20.0
# An antenna is told to be elsewhere from here, m, and from so many standard deviations: one in a hundred by chance.
NOTABLE_M, SURE = 1.4, 3.0
# What is less sure than this, m, says nothing about an antenna on a car.
OBSERVED_M = 0.9
# An antenna alone explains the fixes as well as an antenna and a clock when it leaves so many times as much.
AS_WELL = 1.2


def check_lever_arm(given: Array, diagnosis: Diagnosis | None, fixes: GnssFixes) -> Iterator[Finding]:
    """The lever arm as it is given, (3,) m, against any vehicle and against the fixes."""
    evidence = "p_imu_antenna is (" + " ".join(f"{value:.2f}" for value in given) + ") m"
    if float(np.linalg.norm(given)) > LONGEST_M:
        yield red("GNSS antenna", evidence, "the lever arm is in mm or cm", "give p_imu_antenna in metres")
        return
    found = None if diagnosis is None else _simplest(diagnosis, fixes)
    off = np.zeros(2) if found is None else found[0] - given[:2]
    if found is None or (found[1] > OBSERVED_M and float(np.linalg.norm(off)) < SURE * found[1]):
        yield green("GNSS antenna", f"{evidence}; not observable: too few turns for the noise")
        return
    lever, stddev = found
    evidence += f", the turns say ({lever[0]:.1f} {lever[1]:.1f}) ± {stddev:.1f} m horizontally"
    if float(np.linalg.norm(off)) > max(NOTABLE_M, SURE * stddev):
        yield amber(
            "GNSS antenna",
            evidence,
            f"the antenna is {float(np.linalg.norm(off)):.1f} m from where p_imu_antenna says",
            f"measure it: p_imu_antenna is about [{lever[0]:.1f}, {lever[1]:.1f}, {given[2]:.1f}]",
        )
    else:
        yield green("GNSS antenna", evidence)


def _simplest(diagnosis: Diagnosis, fixes: GnssFixes) -> tuple[Array, float] | None:
    """The lever arm with the lag that was found, or without one where that explains the fixes as well."""
    without = found_lever_arm(diagnosis, fixes, 0.0)
    if not diagnosis.lag.is_certain:
        return None if without is None else without[:2]
    both = found_lever_arm(diagnosis, fixes, diagnosis.lag.seconds)
    if both is None or without is None or without[2] > AS_WELL * both[2]:
        return None if both is None else both[:2]
    return without[:2]


def found_lever_arm(diagnosis: Diagnosis, fixes: GnssFixes, late: float) -> tuple[Array, float, float] | None:
    """The horizontal lever arm, (2,) m, its standard deviation per axis, and what it leaves unexplained, m².

    `late` s is how much later than its stamp a fix is. None: nothing to find it by.

    In every window the fixes are a parabola, the IMU's way turned by a heading, and the lever arm turned by the same.
    The heading of a window follows from all windows' answers with the lever arm held; both are found in turns.
    """
    imu = diagnosis.imu
    windows = windows_of(fixes, float(imu.stamps[0]), float(imu.stamps[-1]))
    if windows is None:
        return None
    way, heading = way_of(imu), np.exp(1j * integral(imu.stamps, imu.angular_rate[:, 2]))
    x = beside_parabola(windows, complex_at(windows, imu.stamps, way, late))
    e = beside_parabola(windows, complex_at(windows, imu.stamps, heading, late))
    y = beside_parabola(windows, np.conj(windows.places) if diagnosis.mirrored else windows.places)
    lever, variance, left = 0j, np.inf, np.inf
    for _ in range(10):
        regressor = x + lever * e
        power = np.maximum(np.sum(np.abs(regressor) ** 2, axis=1), 1e-12)
        turn = np.sum(np.conj(regressor) * y, axis=1) / power
        turn = turn / np.maximum(np.abs(turn), 1e-12)
        rest = y * np.conj(turn)[:, None] - x
        # what the heading of a window takes up cannot speak for the lever arm: only what is across it is left
        seen = e - (np.sum(np.conj(regressor) * e, axis=1) / power)[:, None] * regressor
        information = float(np.sum(np.abs(seen) ** 2))
        if information < 1e-6:
            return None
        lever = complex(np.sum(np.conj(seen) * rest) / np.sum(np.conj(seen) * e))
        errors = rest - lever * e
        independent = independent_errors(windows, errors)
        left = float(np.sum(np.abs(errors) ** 2))
        variance = left / (2.0 * information * independent)
    return np.array([lever.real, lever.imag]), float(np.sqrt(variance)), left

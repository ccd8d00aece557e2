"""Where the antenna is: in turns it goes another way than the IMU."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from factor_graphs.measurements import GnssFixes
from gnss_sem_map.preflight.dead_reckoning import beside_parabola, complex_at, windows_of
from gnss_sem_map.preflight.diagnosis import Diagnosis
from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.preflight.inertial_sums import integral, way_of

Array = NDArray[np.float64]

# No vehicle is longer.
LONGEST_M = 20.0
# An antenna is told to be elsewhere from here, m, and from so many standard deviations.
NOTABLE_M, SURE = 1.0, 5.0
# What one is found with at best, m, to say that it is where it is said to be.
OBSERVED_M = 0.5
# Slopes and biases make the ways differ for so long, s.
CORRELATED_S = 5.0


def check_lever_arm(given: Array, diagnosis: Diagnosis | None, fixes: GnssFixes) -> Iterator[Finding]:
    """The lever arm as it is given, (3,) m, against any vehicle and against the fixes."""
    evidence = "p_imu_antenna is (" + " ".join(f"{value:.2f}" for value in given) + ") m"
    if float(np.linalg.norm(given)) > LONGEST_M:
        yield red("GNSS antenna", evidence, "the lever arm is in mm or cm", "give p_imu_antenna in metres")
        return
    found = None if diagnosis is None else found_lever_arm(diagnosis, fixes)
    if found is None or found[1] > OBSERVED_M:
        yield green("GNSS antenna", f"{evidence}; not observable: too few turns for the noise")
        return
    lever, stddev = found
    off = lever - given[:2]
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


def found_lever_arm(diagnosis: Diagnosis, fixes: GnssFixes) -> tuple[Array, float] | None:
    """The horizontal lever arm, (2,) m, and its standard deviation per axis; None: nothing to find it by.

    In every window the fixes are a parabola, the IMU's way turned by a heading, and the lever arm turned by the same.
    The heading of a window follows from all windows' answers with the lever arm held; both are found in turns.
    """
    imu = diagnosis.imu
    windows = windows_of(fixes, float(imu.stamps[0]), float(imu.stamps[-1]))
    if windows is None:
        return None
    late = diagnosis.lag.seconds if diagnosis.lag.is_certain else 0.0
    way, heading = way_of(imu), np.exp(1j * integral(imu.stamps, imu.angular_rate[:, 2]))
    x = beside_parabola(windows, complex_at(windows, imu.stamps, way, late))
    e = beside_parabola(windows, complex_at(windows, imu.stamps, heading, late))
    y = beside_parabola(windows, np.conj(windows.places) if diagnosis.mirrored else windows.places)
    lever, variance = 0j, np.inf
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
        independent = max(windows.seconds / 2 / CORRELATED_S, 1.0)  # windows overlap by a half
        variance = float(np.sum(np.abs(errors) ** 2)) / (2.0 * information * independent)
    return np.array([lever.real, lever.imag]), float(np.sqrt(variance))

"""Units of an IMU: gravity and what a vehicle can do tell m/s² from g, and rad/s from deg/s."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.preflight.inertial_sums import SmoothedIntegral
from gnss_sem_map.sensor_log.conventions import FORCE_UNITS, RATE_UNITS

Array = NDArray[np.float64]

# Of a drive, the median |f| is gravity to a few per cent, at rest and moving; a hand-held unit's to ten.
SAME_UNIT = 1.15
# Gravity is in the mean of f over a drive; without it, accelerating and braking cancel each other.
LEAST_MEAN = 0.5
# No road vehicle turns like this, rad/s, for a hundredth of its time, nor all the time; nor does who carries the unit.
RARE_RATE, USUAL_RATE = 6.0, 2.0
# Over so long, s, a body that the gyroscope leans by more than the first, rad, leans by the second by its force, too.
LEAN_S, LEAN_RATE, LEAN_FORCE = 5.0, 0.6, 0.2


def force_unit(force: Array, gravity: float) -> tuple[str, Finding]:
    """The probable unit of specific forces (n, 3), and what to say about it."""
    size = float(np.median(np.linalg.norm(force, axis=1)))
    evidence = f"median |f| is {size:.4g}, gravity here is {gravity:.3f} m/s²"
    unit = min(FORCE_UNITS, key=lambda name: _ratio(size * FORCE_UNITS[name], gravity))
    mean = float(np.linalg.norm(force.mean(axis=0)))
    if mean < LEAST_MEAN * size and _ratio(size, gravity) > SAME_UNIT:
        return "m/s2", red(
            "IMU force unit",
            f"{evidence}; the mean of f over the drive is {mean:.2g}",
            "gravity was taken out of the force, as of a linear acceleration",
            "give ax, ay, az as the accelerometer measures them: 9.81 m/s² upwards at rest",
        )
    if _ratio(size * FORCE_UNITS[unit], gravity) > SAME_UNIT:
        return "m/s2", red(
            "IMU force unit",
            evidence,
            "the force is in no unit that we know, or the accelerometer is not in these columns",
            "give ax, ay, az as specific force in m/s², g or mg (force_unit)",
        )
    if unit == "m/s2":
        return unit, green("IMU force unit", evidence)
    return unit, red("IMU force unit", evidence, f"the force is in {unit}", f"set force_unit: {unit}")


def rates_of_a_vehicle(stamps: Array, force: Array, rate: Array) -> Finding:
    """Whether rates (n, 3) rad/s are a vehicle's, and lean it no more than gravity does."""
    size = np.linalg.norm(rate, axis=1)
    rare, usual = float(np.quantile(size, 0.99)), float(np.sqrt(np.mean(size**2)))
    leans_by_rate, leans_by_force = _leans(stamps, force, rate)
    evidence = f"|rate| is {usual:.3g} rad/s (rms), {rare:.3g} for a hundredth of the time"
    if leans_by_rate > LEAN_RATE and leans_by_force < LEAN_FORCE:
        evidence += (
            f"; in {LEAN_S:g} s it leans by {np.degrees(leans_by_rate):.0f}°,"
            f" gravity moves by {np.degrees(leans_by_force):.0f}°"
        )
    elif rare <= RARE_RATE and usual <= USUAL_RATE:
        return green("IMU turn rates", evidence)
    return red("IMU turn rates", evidence, *in_degrees())


def in_degrees() -> tuple[str, str]:
    """The usual mistake, and what corrects it."""
    return "the gyroscope is in deg/s", "set rate_unit: deg/s"


def gain_of_turns(gain: float, stddev: float) -> Iterator[Finding]:
    """What the turns of the gyroscope against those of the course say about its unit."""
    size, degree = abs(gain), RATE_UNITS["deg/s"]
    evidence = f"the course turns by {gain:.3g} ± {stddev:.2g} rad for every rad of the gyroscope"
    if _ratio(size, degree) < 1.5:
        yield red("IMU rate unit", evidence, *in_degrees())
    elif _ratio(size, 1 / degree) < 1.5:
        yield red(
            "IMU rate unit",
            evidence,
            "the gyroscope is in rad/s, and is said to be in deg/s",
            "set rate_unit: rad/s",
        )
    elif abs(size - 1.0) > max(0.3, 5 * stddev):
        yield amber(
            "IMU rate unit",
            evidence,
            "the gyroscope has another scale, or the fixes are not of this vehicle",
            "check the unit of wx, wy, wz (rate_unit), and that both tables are of the same drive",
        )
    else:
        yield green("IMU rate unit", evidence)


def _leans(stamps: Array, force: Array, rate: Array) -> tuple[float, float]:
    """How far the body leans in `LEAN_S`, by its rates and by its force: the median over the drive, rad."""
    ends = np.arange(stamps[0], stamps[-1], LEAN_S)
    if len(ends) < 2:
        return 0.0, 0.0
    up = force.mean(axis=0) / max(float(np.linalg.norm(force.mean(axis=0))), 1e-12)
    level = np.eye(3) - np.outer(up, up)
    turns = np.diff(SmoothedIntegral.of(stamps, rate).at(ends, 0.1), axis=0)
    forces = np.diff(SmoothedIntegral.of(stamps, force).at(ends, 0.1), axis=0)
    directions = forces / np.maximum(np.linalg.norm(forces, axis=1, keepdims=True), 1e-12)
    by_force = np.linalg.norm(directions - up, axis=1)
    return float(np.median(np.linalg.norm(turns @ level, axis=1))), float(np.median(by_force))


def _ratio(a: float, b: float) -> float:
    """By what factor two positive numbers differ, at least 1."""
    low, high = sorted((max(a, 1e-300), max(b, 1e-300)))
    return high / low

"""Wheel speed as a measurement: its scale, offset and latency are unknowns of the graph, and slip is not believed.

The wheels say w at a stamp that is `latency` late. The axle moves forward at ±(scale w + offset), and the imu, `left`
of where the wheels are and `up`, at that less left times yaw rate and plus up times pitch rate. A wheel at rest says
zero: it has no offset. Slip that goes with acceleration cannot be told from latency.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import W
from numpy.typing import NDArray

from factor_graphs.measurements import WheelSpeeds
from factor_graphs.model import BodyVelocities, body_velocity_factors
from factor_graphs.problem import Fit, Problem
from factor_graphs.slip import LEAST_LASTING_S, Slip, explain, robust_stddev
from factor_graphs.vehicle import (
    LEAST_TIME_S,
    LEAST_WAY_M,
    MOVING_SPEED,
    UNSEEN_SLIP,
    BodyMotion,
    beside_fixes,
    direction,
)
from factor_graphs.wheel_readings import Readings, read

Array = NDArray[np.float64]

# Before anything is seen: scale, offset m/s, latency s, and how far left the imu is m.
UNKNOWN, STDDEVS = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.3, 0.5, 0.2, 1.0])
# Latency is found by so many corrections, none beyond this, s.
LATENCY_ROUNDS, MOST_LATENCY_S = 3, 1.0
# What differs from the speed by more than this share is no wheel, nor is one whose scale is beyond these.
MOST_MISFIT, SCALES = 0.1, (0.8, 1.25)
# How much m/s one unit is.
UNITS = {
    "km/h": 1 / 3.6,
    "mph": 0.44704,
    "cm/s": 0.01,
    "mm/s": 0.001,
    "0.01 km/h": 0.01 / 3.6,
    "0.1 km/h": 0.1 / 3.6,
}
# A wheel slips where it is so many standard deviations off; it is so many times less certain than it is fast.
CUT, SKID = 3.5, 3.0
# Without fixes a solution drifts: slip is then what differs from the median of so long, s. Where more than a share of
# that time slips, all of it does: wheels that are frozen agree with the speed now and then.
DRIFT_S, MOST_SLIP = 20.0, 1 / 3
# Once wheels hold it, it drifts no longer than this, s.
HELD_S = 1.0
# A wheel said to be at rest may creep, m/s; it is one value for so long, s.
CREEP, CREEP_S = 0.2, 10.0


@dataclass(frozen=True, eq=False)
class Wheels:
    """What is known of wheel speeds, and how far they are believed.

    `calibration` (4,): scale, offset m/s, latency s, and how far the imu is to the left of where they measure, m;
    `stddevs` (4,) once it was part of a graph. `noise`: what is left where they do not slip; `slip` (k,) m/s: zero
    where they do not. `doubt`: why they do not fit, or nothing. `held`: they take part.
    """

    readings: Readings
    calibration: Array
    noise: Slip
    slip: Array
    slip_share: float = 0.0
    doubt: str = ""
    held: bool = False
    stddevs: Array | None = None

    @property
    def scale(self) -> float:
        """True speed over wheel speed."""
        return float(self.calibration[0])

    @property
    def offset_mps(self) -> float:
        """True speed less scaled wheel speed, while the wheels roll."""
        return float(self.calibration[1])

    @property
    def latency_s(self) -> float:
        """How much later than the moment its stamp is."""
        return float(self.calibration[2])

    @property
    def verdict(self) -> str:
        """Whether wheel speed takes part, and why or how, in one line."""
        if not self.held:
            return f"wheel speed off: {self.doubt}"
        return f"wheel speed on: {self}" + (f"; in doubt, as {self.doubt}" if self.doubt else "")

    def noise_stddevs(self, spacing: Array) -> Array:
        """Standard deviation at every keyframe, (k,) m/s; `spacing` (k,) s."""
        usual = self.noise.stddevs(self.readings.grows_with(), spacing)
        at_rest = CREEP * np.sqrt(np.maximum(CREEP_S / spacing, 1.0))
        return np.asarray(np.hypot(np.where(self.readings.stopped, at_rest, usual), SKID * self.slip))

    def __str__(self) -> str:
        unsure = [""] * 4 if self.stddevs is None else [f" ± {s:.3f}" for s in self.stddevs]
        scale, offset, latency, _ = self.calibration
        return (
            f"scale {scale:.3f}{unsure[0]}, offset {offset:+.3f}{unsure[1]} m/s, {latency:+.3f}{unsure[2]} s late,"
            f" noise {self.noise.typical:.2f} m/s; slip {100 * self.slip_share:.1f} % of the time"
        )


def misfit(ahead: Array, yaw_rate: Array, readings: Readings, calibration: Array) -> tuple[Array, Array]:
    """Speed of the solution less that of the wheels, (k,) m/s, and its Jacobian by the calibration, (k, 4)."""
    scale, offset, _, left = calibration
    d, w = readings.directions, readings.speeds
    off: Array = ahead - d * (scale * w + offset) + left * yaw_rate
    return off, np.column_stack([-d * w, -d, -d * scale * readings.changes, yaw_rate])


def observe_wheels(
    wheels: WheelSpeeds,
    problem: Problem,
    fit: Fit,
    motion: BodyMotion,
    mounting: Array,
    known: Array | None = None,
) -> Wheels:
    """What a solution shows of the wheels where it is well determined: rolling, and beside a fix that fits.

    `known` (4,) is their calibration, where a graph found it already.
    """
    stamps, ahead = problem.intervals.keyframes, motion.ahead(mounting)
    calibration, beside = UNKNOWN if known is None else known, beside_fixes(problem, fit)
    for step in range(LATENCY_ROUNDS if known is None else 1):
        readings = read(wheels, stamps + calibration[2], ahead)
        where = readings.rolling & beside & (np.abs(ahead) > MOVING_SPEED)
        spacing = motion.spacing[where]
        time, way = spacing.sum(), np.abs(ahead[where]) @ spacing
        if time < LEAST_TIME_S or way < LEAST_WAY_M:
            unseen = Slip(np.array([UNSEEN_SLIP**2, 0.0, 0.0]), LEAST_LASTING_S, UNSEEN_SLIP)
            doubt = f"beside fixes they are seen to roll for {time:.0f} s and {way:.0f} m only"
            return Wheels(readings, calibration, unseen, np.zeros(len(stamps)), doubt=doubt)
        if known is None and step == 0:  # in whatever unit
            ratios = (ahead * readings.directions)[where] / readings.speeds[where]
            calibration = np.array([np.median(ratios), 0.0, 0.0, 0.0])
        off, by = misfit(ahead, motion.yaw_rate, readings, calibration)
        change, noise, _ = explain(
            off[where],
            -by[where],
            STDDEVS,
            np.zeros(len(spacing)),
            readings.grows_with()[where],
            spacing,
        )
        if known is None:
            calibration = calibration + change
            calibration[2] = np.clip(calibration[2], -MOST_LATENCY_S, MOST_LATENCY_S)
    seen = Wheels(readings, calibration, noise, np.zeros(len(stamps)))
    doubt = _doubt(seen, misfit(ahead, motion.yaw_rate, readings, calibration)[0][where], ahead[where])
    density = problem.noise.accelerometer_noise_density * fit.inflation
    drift = float(density * np.sqrt(DRIFT_S if known is None else HELD_S))
    return replace(_with_slip(seen, ahead, motion, beside, drift), doubt=doubt)


def _with_slip(
    wheels: Wheels, ahead: Array, motion: BodyMotion, beside: NDArray[np.bool_], drift: float
) -> Wheels:
    """The same wheels with what does not fit, also where no fix is: there a solution drifts, but slowly.

    `drift` m/s is how far it may be off its median.
    """
    readings = wheels.readings
    off, _ = misfit(ahead, motion.yaw_rate, readings, wheels.calibration)
    said = readings.rolling | readings.stopped
    window = (np.cumsum(motion.spacing) / DRIFT_S).astype(int)
    lost = said & ~beside
    for part in np.unique(window[lost]):
        off[lost & (window == part)] -= np.median(off[said & (window == part)])
    stddevs = np.sqrt(readings.grows_with() @ wheels.noise.parts)
    stddevs[readings.stopped] = CREEP
    stddevs[lost] = np.hypot(stddevs[lost], drift)
    slips = said & (np.abs(off) > CUT * stddevs)
    slip = np.where(slips, off, 0.0)
    for part in np.unique(window[slips]):
        its = said & (window == part)
        if slips[its].mean() > MOST_SLIP:
            slip[its] = np.sqrt(np.mean(off[its] ** 2))
    share = motion.spacing[slip != 0].sum() / max(motion.spacing[said].sum(), 1e-12)
    return replace(wheels, slip=slip, slip_share=float(share))


def _doubt(wheels: Wheels, off: Array, ahead: Array) -> str:
    """Why they are not the wheels of what moves, or in no unit of ours; empty when they fit."""
    scale = wheels.scale
    size = float(np.sqrt(np.mean(ahead**2)))
    share = robust_stddev(off) / size
    if share > MOST_MISFIT:
        return f"they differ from the speed by {100 * share:.0f} %: another clock or vehicle?"
    if SCALES[0] <= -scale <= SCALES[1]:
        return f"their scale is {scale:.3f}: they count backwards (change their sign), or the drive is all in reverse"
    if not SCALES[0] <= scale <= SCALES[1]:
        unit = next((name for name, value in UNITS.items() if abs(abs(scale) / value - 1) < 0.1), "")
        is_in = f": they are in {unit}, give m/s" if unit else ", expected about 1: give m/s"
        return f"their scale is {scale:.4g}{is_in}"
    return ""


def wheel_factors(
    values: gtsam.Values, motion: BodyMotion, mounting: Array, wheels: Wheels
) -> Iterator[gtsam.NonlinearFactor]:
    """Forward speed at every keyframe where the wheels say one, linearised at `values`, which `motion` is of.

    The calibration, W(k), is one unknown of all rows, and has a prior. A small turn of the direction of travel changes
    no speed along it.
    """
    where = np.flatnonzero(wheels.readings.rolling | wheels.readings.stopped)
    off, by_wheels = misfit(motion.ahead(mounting), motion.yaw_rate, wheels.readings, wheels.calibration)
    along = np.broadcast_to(direction(mounting), (len(off), 1, 3))
    known = BodyVelocities(
        where,
        off[where, None],
        motion.by_state(along)[where],
        by_wheels[where, None],
        wheels.noise_stddevs(motion.spacing)[where, None],
    )
    return body_velocity_factors(values, known, W(len(off)), UNKNOWN, STDDEVS)

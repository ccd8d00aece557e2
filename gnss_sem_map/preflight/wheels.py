"""Wheel speed against the trajectory: its clock and its unit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from factor_graphs.measurements import ImuSamples, WheelSpeeds
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.preflight.findings import Finding, amber, green
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.sensor_log.conventions import SPEED_UNITS

Array = NDArray[np.float64]

# Slower than this, m/s, or seen less often, wheels do not show their unit.
MOVING_SPEED, LEAST_SAMPLES = 3.0, 10
# Tyres are known, and speed shown, to so much; a unit is recognised so near.
MOST_SCALE, SAME_UNIT = 1.25, 1.15
# Wheels that are right differ from the speed by less than this share of it.
MOST_MISFIT = 0.1
REMEDY = "check wheels.csv, which has the clock of imu.csv; of a bag, topic and stamps of wheels in rig.yaml"


def check(sample: Sample) -> Iterator[Finding]:
    """Findings about the wheels; none where there are none, or poses are given."""
    wheels, imu, track = sample.log.wheels, sample.log.imu, sample.trajectory
    if wheels is None or imu is None or sample.log.given is not None:
        return
    yield _clock(wheels, imu)
    if track is not None and track.velocities is not None:
        yield _unit(wheels, track, track.velocities)


def _clock(wheels: WheelSpeeds, imu: ImuSamples) -> Finding:
    inside = (wheels.stamps >= imu.stamps[0]) & (wheels.stamps <= imu.stamps[-1])
    evidence = f"{inside.sum()} of {len(wheels)} wheel speeds lie in the time of the IMU"
    if inside.sum() > len(wheels) / 2:
        return green("wheel stamps", evidence)
    mistake = "the wheels have another clock, or are of another drive"
    return amber("wheel stamps", evidence, mistake, REMEDY)


def _unit(wheels: WheelSpeeds, track: Trajectory, velocities: Array) -> Finding:
    """The wheels over the speed of the trajectory: about 1."""
    inside = (wheels.stamps >= track.start) & (wheels.stamps <= track.end)
    speed = np.interp(wheels.stamps[inside], track.stamps, np.linalg.norm(velocities, axis=1))
    moving = speed > MOVING_SPEED
    speed, said = speed[moving], np.abs(wheels.speeds[inside][moving])
    if len(speed) < LEAST_SAMPLES:
        return green("wheel speed", "not observable: the vehicle hardly moves while the wheels are known")
    ratio = float(np.median(said / speed))
    evidence = f"the wheels say {ratio:.3g} times the speed, expected about 1"
    if ratio == 0.0 or np.median(np.abs(said / ratio - speed) / speed) > MOST_MISFIT:
        mistake = "they are of another clock or drive, or not in this column"
        return amber("wheel speed", evidence, f"{mistake}: they are left out", REMEDY)
    unit = next((name for name, size in SPEED_UNITS.items() if _factor(ratio * size) < SAME_UNIT), None)
    if _factor(ratio) < MOST_SCALE:
        return green("wheel speed", evidence)
    if unit is None:
        return amber(
            "wheel speed", evidence, "they are in no unit that we know: they are left out", "give m/s"
        )
    return amber("wheel speed", evidence, f"they are in {unit}: they are left out", f"set speed_unit: {unit}")


def _factor(ratio: float) -> float:
    return max(ratio, 1 / ratio)

"""Diagnosis of an IMU: tested against gravity, against the limits of a vehicle, and against the fixes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuSamples
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.preflight import axes, units
from gnss_sem_map.preflight.axes import AxesMistake, Seen
from gnss_sem_map.preflight.clocks import NO_LAG, Lag, lag_of
from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.preflight.inertial_sums import SmoothedIntegral
from gnss_sem_map.preflight.own_attitude import course_errors, rate_response
from gnss_sem_map.preflight.response import ForceResponse, TurnGain, force_response, turn_gain
from gnss_sem_map.preflight.track import Track, track_of
from gnss_sem_map.sensor_log.conventions import FORCE_UNITS, RATE_UNITS

Array = NDArray[np.float64]

# A unit is called askew from here, deg: no road is so steep, and no heading so far from the course.
DOUBTFUL_TILT, WRONG_TILT = 10.0, 20.0
DOUBTFUL_TURN, WRONG_TURN = 15.0, 30.0
# An answer counts when it is so many of its standard deviations, and these are below so much per m/s².
SURE, MOST_STDDEV = 5.0, 0.25
# The drive's own heading says that the track is mirrored: so far, rad, from the course, and so near when swapped.
NOT_THE_COURSE, THE_COURSE = np.radians(20.0), np.radians(8.0)
# Below this rate the smoother reads the noise off the samples.
SLOW_HZ = 50.0


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Probable mistakes of the IMU, and the corrected IMU for the checks that follow."""

    findings: tuple[Finding, ...]
    force: Array
    """(3, 3), takes the specific force to our axes and units, by the probable mistake."""
    rate: Array
    """(3, 3), the same of the angular rate."""
    imu: ImuSamples
    """What was looked at, corrected."""
    track: Track | None
    lag: Lag
    mirrored: bool
    """The track is."""
    ahead: Array | None
    """The direction (3,) that answers to speeding up; None where the drive does not show it."""

    @property
    def moves_untold(self) -> bool:
        """Whether it moves, and shows no speeding up: then nothing tells which axis points forward."""
        return self.ahead is None and self.track is not None and bool(self.track.is_moving.any())

    @property
    def is_right(self) -> bool:
        """Whether axes and units are as they should be."""
        return bool((self.force == np.eye(3)).all() and (self.rate == np.eye(3)).all())

    def corrected(self, imu: ImuSamples) -> ImuSamples:
        """Samples of the same IMU in our axes and units; the very same where it is right."""
        if self.is_right:
            return imu
        return ImuSamples(imu.stamps, imu.specific_force @ self.force.T, imu.angular_rate @ self.rate.T)


def diagnose(
    imu: ImuSamples, fixes: GnssFixes, frame: LocalFrame, attitude: Trajectory | None, lever: complex = 0j
) -> Diagnosis:
    """Test an IMU against usable fixes; `attitude` is what the drive's own navigation unit says, where it does.

    `lever` is where the antenna is said to be, m, ahead + i left of the IMU.
    """
    findings = [_sampling(imu)]
    unit, finding = units.force_unit(imu.specific_force, frame.gravity)
    findings.append(finding)
    force, rate = imu.specific_force * FORCE_UNITS[unit], imu.angular_rate
    track = track_of(fixes) if len(fixes) >= 4 else None
    up = force.mean(axis=0) / max(float(np.linalg.norm(force.mean(axis=0))), 1e-12)
    own = None if attitude is None else rate_response(ImuSamples(imu.stamps, force, rate), attitude)
    rate_findings, scale = _rate_unit(imu.stamps, force, rate, up, track, own)
    findings += rate_findings
    rate = rate * scale
    upright = ImuSamples(imu.stamps, *_upright(force, rate, up))
    lag = lag_of(upright, fixes, track, lever) if track is not None else NO_LAG
    late = lag.seconds if lag.is_certain else 0.0
    scaled = ImuSamples(imu.stamps, force, rate)
    gain, answer = _answers(scaled, up, track, late)
    seen = _seen(up, gain, answer, None if own is None else own / scale, _is_mirrored(attitude, track))
    axes_findings, mistake = _axes(seen, gain)
    findings += axes_findings
    probable = ImuSamples(imu.stamps, force @ mistake.force.T, rate @ mistake.rate.T)
    to_force, to_rate = mistake.force * FORCE_UNITS[unit], mistake.rate * scale
    return Diagnosis(tuple(findings), to_force, to_rate, probable, track, lag, mistake.mirrored, seen.ahead)


def _sampling(imu: ImuSamples) -> Finding:
    rate = 1.0 / float(np.median(np.diff(imu.stamps)))
    slow = ": noise is read off the samples" if rate < SLOW_HZ else ""
    return green("IMU rate", f"{rate:.0f} Hz{slow}")


def _rate_unit(
    stamps: Array, force: Array, rate: Array, up: Array, track: Track | None, own: Array | None
) -> tuple[list[Finding], float]:
    """What is said of the gyroscope's unit, and what makes it rad/s."""
    found = [units.rates_of_a_vehicle(stamps, force, rate)]
    gain = None if track is None else turn_gain(SmoothedIntegral.of(stamps, rate @ up), track)
    sizes = np.linalg.norm(own, axis=0) if own is not None else np.array([np.nan])
    if np.isfinite(sizes).any():
        size = float(np.nanmedian(sizes))
        found += units.gain_of_turns(1.0 / size, 0.2 / size)
    elif gain is not None and abs(gain.value) > SURE * gain.stddev:
        found += units.gain_of_turns(gain.value, gain.stddev)
    mistakes = " ".join(finding.mistake for finding in found)
    if "in deg/s" in mistakes and "said to be" not in mistakes:
        return found, RATE_UNITS["deg/s"]
    return found, 1.0 / RATE_UNITS["deg/s"] if "said to be" in mistakes else 1.0


def _upright(force: Array, rate: Array, up: Array) -> tuple[Array, Array]:
    """The same samples turned by the least angle that makes `up` the z axis."""
    z = np.array([0.0, 0.0, 1.0])
    if up @ z < -0.999:
        turn = np.diag([1.0, -1.0, -1.0])
    else:
        v = np.cross(up, z)
        K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
        turn = np.eye(3) + K + K @ K / (1.0 + up @ z)
    return force @ turn.T, rate @ turn.T


def _answers(
    imu: ImuSamples, up: Array, track: Track | None, lag: float
) -> tuple[TurnGain | None, ForceResponse | None]:
    """How the IMU answers to turns, and to speeding up and bends; only what is sure enough."""
    if track is None:
        return None, None
    about_up = imu.angular_rate @ up
    gain = turn_gain(SmoothedIntegral.of(imu.stamps, about_up), track, lag)
    if gain is not None and abs(gain.value) < SURE * gain.stddev:
        gain = None
    sign = float(np.sign(gain.value)) if gain is not None else 0.0
    return gain, force_response(imu, about_up, track, sign, lag)


def _is_mirrored(attitude: Trajectory | None, track: Track | None) -> bool | None:
    errors = course_errors(attitude, track) if attitude is not None and track is not None else None
    if errors is None:
        return None
    if errors[0] < NOT_THE_COURSE:
        return False
    return True if errors[1] < THE_COURSE else None


def _seen(
    up: Array,
    gain: TurnGain | None,
    answer: ForceResponse | None,
    rates: Array | None,
    mirrored: bool | None,
) -> Seen:
    if answer is not None and answer.stddevs[0] < MOST_STDDEV:
        up = answer.still / np.linalg.norm(answer.still)  # without what speeding up adds in a short drive
    if answer is None:
        return Seen(up, None, None, 0 if gain is None else int(np.sign(gain.value)), rates, mirrored)
    level = np.eye(3) - np.outer(up, up)
    directions: list[Array | None] = []
    for k, vector in ((1, level @ answer.ahead), (2, level @ answer.left)):
        size = float(np.linalg.norm(vector))
        is_sure = size > SURE * answer.stddevs[k] and answer.stddevs[k] < MOST_STDDEV
        directions.append(vector / size if is_sure else None)
    ahead, left = directions
    return Seen(
        up,
        ahead,
        left if gain is not None else None,
        int(np.sign(gain.value)) if gain else 0,
        rates,
        mirrored,
    )


def _axes(seen: Seen, gain: TurnGain | None) -> tuple[list[Finding], AxesMistake]:
    evidence = _evidence(seen, gain)
    fitting = axes.probable(seen)
    if not fitting:
        return [
            amber(
                "IMU axes",
                evidence,
                "the IMU answers to the track in no way that we know: odd axes, or fixes of another vehicle",
                "check imu_axes, and that both tables are of the same drive and clock",
            )
        ], axes.RIGHT
    mistake = fitting[0]
    if len(ways := axes.told_by_gravity_alone(seen, fitting)) > 1:
        up = "xyz"[int(np.abs(seen.up).argmax())]
        sure = f"its {up} axis points {'up' if seen.up.sum() > 0 else 'down'}"
        settings = [f'"{axes.axes_of(way.force)}"' for way in ways]
        return [
            red(
                "IMU axes",
                evidence,
                f"the IMU is mounted on its side: {sure}, and nothing in this drive tells which axis points forward",
                f"set imu_axes: {', '.join(settings[:-1])} or {settings[-1]}, as it is mounted",
            )
        ], mistake
    if mistake is not axes.RIGHT:
        alternatives = _alternatives(fitting)
        check = "GNSS track" if mistake.mirrored else "IMU axes"
        words = " or ".join(m.name for m in alternatives)
        return [red(check, evidence, words, "; or ".join(m.remedy for m in alternatives))], mistake
    return [green("IMU axes", evidence), *_mounting(seen)], mistake


def _alternatives(fitting: tuple[AxesMistake, ...]) -> tuple[AxesMistake, ...]:
    """The first, and a second one where what was seen leaves the choice to habit."""
    return fitting[:2] if len(fitting) > 1 and fitting[1] in axes.USUAL else fitting[:1]


def _evidence(seen: Seen, gain: TurnGain | None) -> str:
    parts = [f"at rest the force points along {_vector(seen.up)}"]
    parts.append(_answer("speeding up", seen.ahead))
    parts.append(_answer("a bend to the left", seen.left))
    turn = (
        "are not observable"
        if gain is None
        else f"are {gain.value:.2f} ± {gain.stddev:.2f} of the gyroscope's"
    )
    parts.append(f"turns of the course {turn}")
    return ", ".join(parts)


def _answer(what: str, direction: Array | None) -> str:
    return f"{what} is {'not observable' if direction is None else 'felt along ' + _vector(direction)}"


def _vector(direction: Array) -> str:
    return "(" + " ".join(f"{value:.2f}" for value in direction + 0.0) + ")"


def _mounting(seen: Seen) -> Iterator[Finding]:
    """Tilt and turn of a unit whose axes are right to the next right angle."""
    tilt = float(np.degrees(np.arccos(np.clip(seen.up[2], -1.0, 1.0))))
    roll, pitch, yaw = axes.askew(seen, axes.RIGHT)
    heading = f", its heading from the course by {yaw:.1f}°" if seen.ahead is not None else ""
    evidence = f"the IMU is tilted by {tilt:.1f}°{heading}"
    level = None
    if tilt > DOUBTFUL_TILT or abs(yaw) > DOUBTFUL_TURN:
        level = red if tilt > WRONG_TILT or abs(yaw) > WRONG_TURN else amber
    if level is None:
        yield green("IMU mounting", evidence)
        return
    turned = f"turned by {yaw:.0f}° about z" if abs(yaw) > DOUBTFUL_TURN else "tilted"
    yield level(
        "IMU mounting",
        evidence,
        f"the IMU is mounted askew: {turned}",
        f"set imu_rotation_deg: [{roll:.1f}, {pitch:.1f}, {yaw:.1f}]",
    )

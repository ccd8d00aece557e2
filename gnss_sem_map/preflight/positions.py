"""Check of GNSS fixes and given poses against the dynamics of a vehicle, and of the fixes against the IMU."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuSamples
from factor_graphs.problem import usable_fixes
from factor_graphs.settings import SmootherSettings
from factor_graphs.stamps import BREAK_S
from gnss_sem_map.preflight import poses
from gnss_sem_map.preflight.clocks import FARTHEST_S, LEAP_S
from gnss_sem_map.preflight.diagnosis import Diagnosis
from gnss_sem_map.preflight.findings import NOTABLE_LAG_S, ONE_CLOCK, Finding, amber, green, red
from gnss_sem_map.preflight.fixes import Fixes
from gnss_sem_map.preflight.lever_arm import check_lever_arm
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.preflight.track import scatter_of
from gnss_sem_map.sensor_log import SensorLog

Array = NDArray[np.float64]

# Land that can be driven on, m above the ellipsoid: the Dead Sea, and the highest roads of the Himalaya.
LOWEST_M, HIGHEST_M = -600.0, 7000.0
# Climbing more than this per metre driven is no road's, beyond so many metres that heights may be wrong by.
STEEPEST, HEIGHT_ALLOWANCE_M = 0.5, 60.0
# Few streets are steeper for so long; beside so many standard deviations of the heights, and so many m.
STEEP_STREET, OF_HEIGHTS, LEAST_CLIMB_M = 0.2, 3.0, 3.0
# A share of the fixes that is odd enough to be told of.
NOTABLE_SHARE = 0.05
# The data sheet of every RTK receiver says 8 mm + 1 ppm; none measures a moving vehicle better.
BEST_RECEIVER_M = 0.008
# Heights of a road change slowly: a scatter of so many claimed deviations, and this much, m, is the fixes' own.
SCATTER_RATIO, SCATTER_M = 5.0, 0.1
# A lag makes a wrong map when it moves the vehicle by so much, m.
WRONG_LAG_M = 2.0
# What stops a run is surer than what is told: twice the logarithm of the likelihood.
FIVE_SIGMA = 25.0
# At a constant speed an antenna ahead is a clock that is early: up to here, m, it may be either.
LEVER_ARM_M = 5.0
# Positions that are rounded to more are told.
COARSE_M = 0.5


def check(sample: Sample) -> Iterator[Finding]:
    """Where the fixes are, how they move, what they claim, and their clock; or the poses that are given."""
    log, found = sample.log, sample.fixes
    if log.given is not None:
        yield from poses.check(log.given, log)
        return
    if found is None or log.gnss is None or log.frame is None:
        return
    yield from _place(log.gnss, log.frame, found)
    yield from _heights(log.gnss, log.frame)
    yield _movement(log.gnss, found)
    if log.imu is not None:
        yield from _with_imu(log.gnss, log.imu, sample.settings.trajectory.max_speed_mps)
        yield from _break(log.gnss, log.imu)
    yield _frozen(log.gnss, found)
    yield _accuracy(log, log.gnss)
    if sample.diagnosis is not None:
        yield _clock(sample.diagnosis)
    smoother: SmootherSettings = sample.settings.trajectory
    if smoother.imu_noise is None:
        smoother = smoother.model_copy(update={"imu_noise": log.imu_noise})
    lever = log.calibration.p_imu_antenna
    yield from check_lever_arm(lever, sample.diagnosis, found.usable, log.frame, smoother)


def _place(fixes: GnssFixes, frame: LocalFrame, found: Fixes) -> Iterator[Finding]:
    evidence = f"the drive begins at {frame.lat_deg:.5f}°, {frame.lon_deg:.5f}°"
    if found.are_radians:
        yield red(
            "GNSS place",
            f"{evidence}, at sea, and so are all fixes",
            "latitude and longitude are in radians",
            "give lat_deg and lon_deg in degrees",
        )
    else:
        yield green("GNSS place", evidence)


def _heights(fixes: GnssFixes, frame: LocalFrame) -> Iterator[Finding]:
    if len(fixes) == 0:
        return
    heights = frame.to_geodetic(fixes.positions)[2]
    low, high = (float(h) for h in np.quantile(heights, [0.02, 0.98]))
    way = float(np.linalg.norm(np.ptp(fixes.positions[:, :2], axis=0)))
    evidence = f"heights from {low:.1f} to {high:.1f} m, over {way:.0f} m of ground"
    doubt = float(np.median(fixes.stddevs[:, 2]))
    if low < LOWEST_M or high > HIGHEST_M or high - low > STEEPEST * way + HEIGHT_ALLOWANCE_M + 6 * doubt:
        yield red(
            "GNSS height",
            evidence,
            "the altitude is in mm (or cm, or feet)",
            "give alt_m in metres above the ellipsoid",
        )
    elif high - low > STEEP_STREET * way + OF_HEIGHTS * doubt + LEAST_CLIMB_M:
        yield amber(
            "GNSS height",
            f"{evidence}, which is steeper than streets are, and more than their {doubt:.2g} m explain",
            "the heights wander: reflections, or a receiver without differential corrections",
            "give larger stddevs of the heights, or fixes without those of few satellites",
        )
    else:
        yield green(
            "GNSS height", f"{evidence}; alt_m is taken as height above the ellipsoid, not above the sea"
        )


def _movement(fixes: GnssFixes, found: Fixes) -> Finding:
    duration = float(np.ptp(fixes.stamps)) if len(fixes) else 0.0
    evidence = f"{len(fixes)} fixes in {duration:.1f} s, {found.implausible} out of a vehicle's reach"
    if found.implausible > NOTABLE_SHARE * len(fixes):
        return amber(
            "GNSS track",
            evidence,
            "many fixes jump: outliers, or stamps or positions in another unit",
            "check the stamps (s) and the positions (degrees) of these rows; they will not be used",
        )
    return green("GNSS track", evidence)


def _with_imu(fixes: GnssFixes, imu: ImuSamples, max_speed_mps: float) -> Iterator[Finding]:
    """A finding where too few fixes belong to the IMU's time, so that there is no trajectory."""
    try:
        usable_fixes(fixes, imu, max_speed_mps)
    except MeasurementError as error:
        times = f"{fixes.stamps.min():.3f}..{fixes.stamps.max():.3f} s" if len(fixes) else "none"
        yield red(
            "GNSS with IMU",
            f"{error}; stamps of fixes: {times}",
            "fixes and IMU have other clocks, other units of stamps, or are of other drives",
            ONE_CLOCK,
        )


def _break(fixes: GnssFixes, imu: ImuSamples) -> Iterator[Finding]:
    """A finding where nothing was measured for so long that what follows is another drive."""
    # fixes outside of the IMU's span may be of another clock
    within = (fixes.stamps > imu.stamps[0]) & (fixes.stamps < imu.stamps[-1])
    stamps = np.sort(np.concatenate([fixes.stamps[within], imu.stamps]))
    steps = np.diff(stamps)
    if not (steps > BREAK_S).any():
        return
    k = int(steps.argmax())
    yield red(
        "break",
        f"there is neither a fix nor an IMU sample for {steps[k]:.0f} s, from {stamps[k]:.1f} to {stamps[k + 1]:.1f} s;"
        f" expected at most {BREAK_S:g} s",
        "the log holds several drives, and nothing tells the motion between them",
        "give each of them a folder or file of its own, and map them together: gnss-sem-map run DRIVE DRIVE -o OUT",
    )


def _frozen(fixes: GnssFixes, found: Fixes) -> Finding:
    if len(found.frozen) == 0 and found.grain_m > COARSE_M:
        return amber(
            "GNSS frozen",
            f"positions come in steps of {found.grain_m:.2g} m",
            "latitude and longitude were rounded: the vehicle jumps from step to step",
            "write them with 8 decimals of degrees",
        )
    if len(found.frozen) == 0:
        return green("GNSS frozen", "no position is repeated while the vehicle drives")
    first, last = found.frozen[int(np.argmax(np.ptp(found.frozen, axis=1)))]
    total = float(np.ptp(found.frozen, axis=1).sum())
    return red(
        "GNSS frozen",
        f"one position from {first:.1f} to {last:.1f} s while the vehicle drives, {total:.1f} s in all",
        "the GNSS is frozen: the receiver repeats its last position",
        "drop these fixes: an outage is bridged, a repeated position is believed",
    )


def _accuracy(log: SensorLog, fixes: GnssFixes) -> Finding:
    refused = [skip for skip in log.skips if _is_of_accuracy(skip.reason)]
    across = float(np.median(fixes.stddevs[:, :2])) if len(fixes) else np.inf
    evidence = f"the fixes claim {across:.3g} m (median, horizontal)"
    if refused:
        return amber(
            "GNSS accuracy",
            f"{evidence}; {refused[0].where}: {refused[0].reason}",
            "the accuracy of fixes is zero or negative: a mark for unknown, or a wrong column",
            "give positive standard deviations in metres",
        )
    if across < BEST_RECEIVER_M:
        return amber(
            "GNSS accuracy",
            f"{evidence}, better than any receiver",
            "standard deviations are too small: variances, or another unit",
            "give standard deviations in metres, or set trajectory.min_fix_stddev_m",
        )
    scatter, claimed = (
        scatter_of(fixes.positions[:, 2]),
        float(np.median(fixes.stddevs[:, 2])) if len(fixes) else np.inf,
    )
    evidence += f", and their heights scatter by {scatter:.2g} of {claimed:.2g} m claimed"
    if scatter > max(SCATTER_RATIO * claimed, SCATTER_M):
        return amber(
            "GNSS accuracy",
            evidence,
            f"standard deviations are too small, by about {scatter / claimed:.0f} times",
            "give standard deviations in metres, or set trajectory.min_fix_stddev_m",
        )
    return green("GNSS accuracy", evidence)


def _is_of_accuracy(reason: str) -> bool:
    return any(word in reason for word in ("accuracy", "stddev", "standard deviation", "std_"))


def _time_system(lag_s: float) -> str:
    """What a lag near the leap seconds tells."""
    if abs(abs(lag_s) - LEAP_S) > FARTHEST_S:
        return ""
    given, expected = ("GPS time", "UTC") if lag_s < 0 else ("UTC", "GPS time")
    return f": they are {given} where {expected} is expected"


def _clock(diagnosis: Diagnosis) -> Finding:
    lag, track = diagnosis.lag, diagnosis.track
    if not lag.is_certain or abs(lag.seconds) < NOTABLE_LAG_S:
        seen = (
            f"fixes agree best with the IMU {lag.seconds:+.2f} s after their stamps" if lag.observable else ""
        )
        return green("GNSS clock", seen or "not observable: too little speeding up and turning")
    fast = float(np.quantile(track.speeds, 0.9)) if track is not None and len(track.speeds) else 0.0
    late = "late" if lag.seconds < 0 else "early"
    level = red if fast * abs(lag.seconds) > WRONG_LAG_M and lag.gain > FIVE_SIGMA else amber
    usual = (
        float(np.median(track.speeds[track.is_moving]))
        if track is not None and track.is_moving.any()
        else 0.0
    )
    off, side = usual * abs(lag.seconds), "behind" if lag.seconds < 0 else "ahead of"
    antenna = f", or the antenna is {off:.1f} m {side} where p_imu_antenna says" if off < LEVER_ARM_M else ""
    return level(
        "GNSS clock",
        f"fixes agree best with the IMU {lag.seconds:+.2f} s after their stamps, at up to {fast:.0f} m/s",
        f"the stamps of the GNSS are {abs(lag.seconds):.2f} s {late}{antenna}{_time_system(lag.seconds)}",
        f"set gnss_time_offset_s: {lag.seconds:.2f}",
    )

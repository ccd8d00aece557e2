"""Check of given poses against the dynamics of a vehicle, the gyroscope and the fixes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.given_poses import do_fit, misses, turns_seen
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.preflight.clocks import LEAP_S
from gnss_sem_map.preflight.findings import ONE_CLOCK, Finding, amber, green, red
from gnss_sem_map.sensor_log import SensorLog

Array = NDArray[np.float64]

# No road vehicle is faster, m/s, nor turns faster, rad/s: a skid is 2.
FASTEST, FASTEST_TURN = 85.0, 3.0
# Nor does its speed change like this, m/s²; noise of poses adds up to so many m from one to the next.
HARDEST, POSE_NOISE_M = 15.0, 0.3
# A vehicle drives where it looks, or backwards: so far, rad, it may look aside all the time.
ASIDE = np.radians(45.0)
DRIVING_MPS = 2.0
# A clock that is off by less, s, is not told of: turns do not show it.
NOTABLE_LATE_S = 0.1
# A way that bends more than this between two poses, m, blurs a map.
BENT_M = 0.05


def check(given: Trajectory, log: SensorLog) -> Iterator[Finding]:
    """Checks of jumps, speeds and turns, of the direction of the x axis, and against gyroscope and fixes."""
    if log.given_how:
        yield green("Given poses", log.given_how)
    yield from _with_gyroscope(given, log)
    yield from _with_fixes(given, log)
    if len(given) < 3:
        yield green("Poses", f"{len(given)} poses: too few to judge")
        return
    steps, durations = np.diff(given.positions, axis=0), np.diff(given.stamps)
    yield _jumps(given, steps, durations)
    if given.velocities is None:
        yield _straight(steps, durations)
    yield _turns(given, durations)
    yield from _looks_ahead(given, steps, durations)


def _with_gyroscope(given: Trajectory, log: SensorLog) -> Iterator[Finding]:
    """The vehicle turns as its gyroscope says, and at the same time."""
    seen = None if log.imu is None else turns_seen(given, log.imu, (-LEAP_S, LEAP_S))
    if seen is None:
        return
    off, turning, then = np.degrees([seen.off, seen.turning, seen.off_then])
    evidence = f"turns differ from the gyroscope's by {off:.2f} of {turning:.2f} °/s"
    if not seen.is_known:
        yield green("Poses with IMU", f"{evidence}: too little turning to judge")
    elif seen.fits(seen.off_then) and abs(seen.late_s) >= NOTABLE_LATE_S and not seen.fits(2 * seen.off):
        late = f"{abs(seen.late_s):.2f} s {'late' if seen.late_s > 0 else 'early'}"
        system = ": GPS time and UTC" if abs(seen.late_s) == LEAP_S else ""
        yield (amber if seen.fits(seen.off) else red)(
            "Poses with IMU",
            f"{evidence}, and by {then:.2f} with stamps {late}",
            f"the stamps of the poses are {late}{system}",
            ONE_CLOCK,
        )
    elif not seen.fits(seen.off):
        yield red(
            "Poses with IMU",
            evidence,
            "the poses are of another drive, or of a body with other axes than the IMU",
            "give T_map_imu of this drive: x forward, y left, z up of its IMU",
        )
    else:
        yield green("Poses with IMU", evidence)


def _with_fixes(given: Trajectory, log: SensorLog) -> Iterator[Finding]:
    """The antenna is where the fixes are."""
    if log.gnss is None or log.frame is None:
        return
    off, claimed = misses(given, log.gnss, log.calibration.p_imu_antenna)
    if not len(off):
        return
    evidence = f"the usual fix is {np.median(off):.2f} m off, and claims {np.median(claimed):.2f} m"
    if do_fit(off, claimed):
        yield green("Poses with GNSS", evidence)
    else:
        yield (amber if do_fit(off, 2 * claimed) else red)(
            "Poses with GNSS",
            evidence,
            "the poses are of another drive, in another frame or scale, or the fixes are worse than they claim",
            "give poses in metres of this drive, in its frame or any that is turned about up, and check p_imu_antenna",
        )


def _jumps(given: Trajectory, steps: Array, durations: Array) -> Finding:
    sizes = np.linalg.norm(steps, axis=1)
    speeds = sizes / durations
    usual = float(np.median(speeds))
    # a single step that neither of its neighbours has, in any direction: a jump there, and mostly back again
    velocities = steps / durations[:, None]
    change = np.linalg.norm(np.diff(velocities, axis=0), axis=1)
    pause = (durations[1:] + durations[:-1]) / 2
    allowed = HARDEST * pause + 2 * POSE_NOISE_M / np.minimum(durations[1:], durations[:-1])
    worst = int(np.argmax(speeds))
    evidence = f"speeds up to {speeds[worst]:.1f} m/s, usually {usual:.1f}"
    if usual > FASTEST:
        return red(
            "Poses",
            evidence,
            "the poses are in another unit than metres, or the times than seconds",
            "give translations in metres and times in seconds",
        )
    if speeds[worst] > FASTEST:
        return red(
            "Poses",
            f"{evidence}: {_counted(speeds > FASTEST)}, the largest of {sizes[worst]:.1f} m at"
            f" {given.stamps[worst + 1]:.2f} s (pose {worst + 1})",
            "the poses jump: a damaged row, or two drives in one file",
            "correct or drop the poses after the jump",
        )
    if np.any(change > allowed):
        k = int(np.argmax(change - allowed)) + 1
        return amber(
            "Poses",
            f"{evidence}; {_counted(change > allowed)}, the hardest at {given.stamps[k]:.2f} s (pose {k}), where the"
            f" velocity changes by {change[k - 1]:.1f} m/s",
            "the poses jump there",
            "correct the poses around it",
        )
    return green("Poses", evidence)


def _straight(steps: Array, durations: Array) -> Finding:
    """How far a curve of constant acceleration is from the straight line between two poses: an eighth of its bend."""
    bends = np.linalg.norm(np.diff(steps, axis=0), axis=1) / 8
    bent, apart = float(np.quantile(bends, 0.9)), float(np.median(durations))
    evidence = f"{apart:.3g} s apart, and between them up to {bent:.3f} m off the straight line (nine in ten)"
    if bent > BENT_M:
        return amber(
            "Pose rate",
            evidence,
            "too few poses for such a motion, or noisy ones",
            "give ten or more in a second",
        )
    return green("Pose rate", evidence)


def _turns(given: Trajectory, durations: Array) -> Finding:
    R = given.T_map_imu[:, :3, :3]
    turned = np.linalg.norm(Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).as_rotvec(), axis=1)
    worst = int(np.argmax(turned / durations))
    evidence = f"turns up to {np.degrees(turned[worst] / durations[worst]):.0f} °/s"
    if turned[worst] / durations[worst] > FASTEST_TURN and turned[worst] > np.radians(10.0):
        return red(
            "Pose turns",
            f"{evidence} at {given.stamps[worst + 1]:.2f} s (pose {worst + 1})",
            "the rotations jump: a damaged row, or rows that are not rotations",
            "correct these poses",
        )
    return green("Pose turns", evidence)


def _counted(jumps: NDArray[np.bool_]) -> str:
    count = int(jumps.sum())
    return f"{count} jump{'' if count == 1 else 's'}"


def _looks_ahead(given: Trajectory, steps: Array, durations: Array) -> Iterator[Finding]:
    """Steps in the vehicle's own axes lie along x, forwards or backwards."""
    driving = np.linalg.norm(steps, axis=1) / durations > DRIVING_MPS
    if not driving.any():
        yield green("Pose heading", "not observable: it hardly moves")
        return
    own = np.einsum("kji,kj->ki", given.T_map_imu[:-1, :3, :3], steps)[driving]
    sizes = np.linalg.norm(own, axis=1)
    median = np.median(own / sizes[:, None], axis=0)
    aside = float(np.arccos(np.clip(abs(median[0]) / max(float(np.linalg.norm(median)), 1e-9), 0.0, 1.0)))
    evidence = f"it drives along ({median[0]:.2f} {median[1]:.2f} {median[2]:.2f}) of its own axes"
    if aside > ASIDE:
        yield amber(
            "Pose heading",
            evidence,
            "the rotations are of other axes: not x forward, y left, z up of the LiDAR",
            "check the poses' frame (KITTI odometry: Tr in calib.txt)",
        )
    else:
        yield green("Pose heading", evidence)

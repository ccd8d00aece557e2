"""Check of given poses against the dynamics of a vehicle."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.evaluation.preflight.findings import Finding, amber, green, red

Array = NDArray[np.float64]

# No road vehicle is faster, m/s, nor turns faster, rad/s: a skid is 2.
FASTEST, FASTEST_TURN = 85.0, 3.0
# Nor does its speed change like this, m/s²; noise of poses adds up to so many m from one to the next.
HARDEST, POSE_NOISE_M = 15.0, 0.3
# A vehicle drives where it looks, or backwards: so far, rad, it may look aside all the time.
ASIDE = np.radians(45.0)
DRIVING_MPS = 2.0


def check(given: Trajectory) -> Iterator[Finding]:
    """Checks of jumps, speeds and turns, and whether the vehicle drives in the direction of its x axis."""
    if len(given) < 3:
        yield green("Poses", f"{len(given)} poses: too few to judge")
        return
    steps, durations = np.diff(given.positions, axis=0), np.diff(given.stamps)
    yield _jumps(given, steps, durations)
    yield _turns(given, durations)
    yield from _looks_ahead(given, steps, durations)


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
            f"{evidence}: a step of {sizes[worst]:.1f} m at {given.stamps[worst + 1]:.2f} s (pose {worst + 1})",
            "the poses jump: a damaged row, or two drives in one file",
            "correct or drop the poses after the jump (poses.txt)",
        )
    if np.any(change > allowed):
        k = int(np.argmax(change - allowed)) + 1
        return amber(
            "Poses",
            f"{evidence}; at {given.stamps[k]:.2f} s (pose {k}) the velocity changes by {change[k - 1]:.1f} m/s",
            "the poses jump there",
            "correct the poses around it (poses.txt)",
        )
    return green("Poses", evidence)


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
            "correct these poses (poses.txt)",
        )
    return green("Pose turns", evidence)


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
            "check the poses' frame and Tr in calib.txt",
        )
    else:
        yield green("Pose heading", evidence)

"""Clock of the scans against that of the trajectory: both see the vehicle move alike, at the same moments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.preflight.findings import Finding, red
from gnss_sem_map.preflight.lidar_motion import TURN_STDDEV_RAD, WAY_STDDEV_M
from gnss_sem_map.preflight.sample import Sample

Array = NDArray[np.float64]
SHIFTS_S = np.arange(-20, 21) * 0.1
LATE_S, SURE_LATE = 0.25, 5.0
"""Less is the smoother's at 10 Hz; five standard deviations stop a run, as for a late clock of the fixes."""
LEAST_STEPS, MOST_MISFIT = 5, 4.0
"""Motions that must be compared; and their mean squared error where clocks agree, two standard deviations."""


def check(sample: Sample, p_imu_lidar: Array) -> Finding | None:
    """Red where the trajectory moves clearly as the scans see, but at other times; `p_imu_lidar` (3,) m."""
    shift, surer = _time_shift(sample, p_imu_lidar)
    if abs(shift) <= LATE_S or surer <= SURE_LATE:
        return None
    word = "early" if shift > 0 else "late"
    return red(
        "motion",
        f"the trajectory moves as the scans see {abs(shift):.1f} s {'later' if shift > 0 else 'earlier'}"
        f" ({surer:.0f} standard deviations better)",
        f"scan stamps are {abs(shift):.1f} s {word} against {sample.track_from}: another clock",
        "correct the stamps of the scans, or set the time offset of the LiDAR",
    )


def _time_shift(sample: Sample, p: Array) -> tuple[float, float]:
    """By how much later the trajectory moves as the scans see, s, and by how many standard deviations that is surer.

    Ways and angles of turn are compared, from sweep to sweep: wrong axes do not change them.
    """
    trajectory = sample.trajectory
    assert trajectory is not None
    stamps, T = [], []
    for seen in sample.stretches:
        matched = sample.deskewed(seen)[0]  # of all but the second sweep
        at = np.delete(seen.stamps, 1)
        stamps.append(np.column_stack([at[:-1], at[1:]]))
        T.append(np.linalg.inv(matched[:-1]) @ matched[1:])
    ends = np.concatenate(stamps)
    ways, turns = _magnitudes(np.concatenate(T))
    moved = SHIFTS_S[:, None, None] + ends
    inside = (moved[:, :, 0] >= trajectory.start) & (moved[:, :, 1] <= trajectory.end)
    within = np.clip(moved, trajectory.start, trajectory.end)
    of_imu = np.linalg.inv(trajectory.at(within[:, :, 0].ravel())) @ trajectory.at(within[:, :, 1].ravel())
    of_imu[:, :3, 3] += (of_imu[:, :3, :3] - np.eye(3)) @ p
    w, t = (values.reshape(inside.shape) for values in _magnitudes(of_imu))
    squares = ((w - ways) / np.hypot(WAY_STDDEV_M, 0.02 * ways)) ** 2 + ((t - turns) / TURN_STDDEV_RAD) ** 2
    counts = inside.sum(axis=1)
    means = np.where(inside, squares, 0.0).sum(axis=1) / np.maximum(counts, 1)
    means[counts < max(LEAST_STEPS, 0.6 * len(ends))] = np.inf
    zero, best = len(SHIFTS_S) // 2, int(np.argmin(means))
    if not means[best] < MOST_MISFIT or not np.isfinite(means[zero]):
        return 0.0, 0.0
    surer = counts[best] * (means[zero] - means[best]) / max(float(means[best]), 1.0)
    return float(SHIFTS_S[best]), float(np.sqrt(max(surer, 0.0)))


def _magnitudes(T: Array) -> tuple[Array, Array]:
    """Ways (n,) m and angles (n,) rad of motions."""
    return np.linalg.norm(T[:, :3, 3], axis=1), np.asarray(Rotation.from_matrix(T[:, :3, :3]).magnitude())

"""IMU against physics and against the course of the fixes: units, turn rates, axes, mounting."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factor_graphs.smoothing import heading_stddevs
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.preflight.diagnosis import SURE, WRONG_TURN
from gnss_sem_map.preflight.findings import Finding, amber
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.preflight.track import MIN_COURSE_SPEED_MPS

# A heading that is off the course by the same angle nearly all the time, this long, s, is that of the mounting.
STEADY, LEAST_S = 0.9, 10.0


def check(sample: Sample) -> Iterator[Finding]:
    """Findings about the IMU; none where poses are given."""
    if sample.diagnosis is not None:
        yield from sample.diagnosis.findings
        if sample.diagnosis.is_right and sample.diagnosis.moves_untold and sample.trajectory is not None:
            yield from _against_course(sample.trajectory)


def _against_course(track: Trajectory) -> Iterator[Finding]:
    """A finding where the smoothed heading is surely not the course."""
    if track.velocities is None:
        return
    east, north = track.velocities[:, :2].T
    moving = np.hypot(east, north) > MIN_COURSE_SPEED_MPS
    if np.median(np.diff(track.stamps)) * moving.sum() < LEAST_S:
        return
    heading = np.arctan2(track.T_map_imu[moving, 1, 0], track.T_map_imu[moving, 0, 0])
    mean = np.mean(np.exp(1j * (heading - np.arctan2(north, east)[moving])))
    off, stddev = np.degrees(np.angle(mean)), np.degrees(np.median(heading_stddevs(track)[moving]))
    if np.abs(mean) > STEADY and np.abs(off) > max(WRONG_TURN, SURE * stddev):
        side = "left" if off > 0 else "right"
        yield amber(
            "IMU mounting",
            f"x of the IMU points {abs(off):.0f} ± {stddev:.0f}° to the {side} of the course, nearly all the time",
            "imu_axes name another axis as forward, or the unit is turned about z, or all of the drive is in reverse",
            f"set imu_axes, or imu_rotation_deg: [0, 0, {off:.0f}]",
        )

"""Check of the attitude of a drive's own navigation unit (KITTI raw) against its gyroscope and the course."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.measurements import ImuSamples
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.preflight.inertial_sums import SmoothedIntegral
from gnss_sem_map.preflight.response import regression
from gnss_sem_map.preflight.track import Track

Array = NDArray[np.float64]

# A column of the regression is used when it is this sure.
MOST_STDDEV = 0.15
# Turns over this long, s: shorter ones are noise at 10 Hz, longer ones drift.
SPAN_S = 0.5


def rate_response(imu: ImuSamples, attitude: Trajectory) -> Array:
    """What the gyroscope says per rad/s about the attitude's x, y, z: columns of (3, 3), NaN where not sure."""
    unseen = np.full((3, 3), np.nan)
    inside = (attitude.stamps >= imu.stamps[0]) & (attitude.stamps <= imu.stamps[-1])
    stamps, R = attitude.stamps[inside], attitude.T_map_imu[inside, :3, :3]
    count = max(1, round(SPAN_S / float(np.median(np.diff(attitude.stamps)))))
    if len(stamps) < 4 * count + 4:
        return unseen
    turned = Rotation.from_matrix(np.swapaxes(R[:-count], 1, 2) @ R[count:]).as_rotvec()
    duration = (stamps[count:] - stamps[:-count])[:, None]
    sums = SmoothedIntegral.of(imu.stamps, imu.angular_rate).at(stamps, 0.0)
    design, said = turned / duration, (sums[count:] - sums[:-count]) / duration
    design = np.column_stack([design, np.ones(len(design))])
    found, stddevs = regression(design, said, 1e-12, count)
    columns = found[:3].T
    size = np.linalg.norm(columns, axis=0)
    return np.where(stddevs[:3] < MOST_STDDEV * size, columns, np.nan)


def course_errors(attitude: Trajectory, track: Track) -> tuple[float, float] | None:
    """Mean angle, rad, between heading and course, as the track is and with east and north swapped; None: it stands."""
    moving = track.is_moving & (track.stamps >= attitude.start) & (track.stamps <= attitude.end)
    if moving.sum() < 4:
        return None
    T = attitude.at(track.stamps[moving])
    heading, course = np.arctan2(T[:, 1, 0], T[:, 0, 0]), track.courses[moving]
    # driving backwards is allowed: angles count up to a quarter turn
    errors = [np.abs((c - heading + np.pi / 2) % np.pi - np.pi / 2) for c in (course, np.pi / 2 - course)]
    return float(np.mean(errors[0])), float(np.mean(errors[1]))

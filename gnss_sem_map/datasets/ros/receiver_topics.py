"""Velocity and heading of a receiver in topics of their own, as rows like those of its fixes; speed of the wheels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.csv_log import NOT_DEFINITE
from factor_graphs.measurements import WheelSpeeds, clean_wheels
from factor_graphs.position_covariances import split_covariances
from factor_graphs.receiver_rows import with_more
from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.datasets.ros.decoding import decode
from gnss_sem_map.datasets.ros.kinds import IMU
from gnss_sem_map.datasets.ros.rig import HeadingTopic, VelocityTopic, WheelTopic
from gnss_sem_map.datasets.ros.stamps import stamps_of
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import Skip

Array = NDArray[np.float64]

ENU_OF_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def velocity_rows(bag: Bag, about: VelocityTopic, fixes: Array, epoch_ns: int) -> tuple[Array, list[Skip]]:
    """Rows (n, 18) of `receiver_rows.ROW_COLUMNS` with the velocities of a topic, at places near; and what was skipped.

    Variances that are not above zero are of a deviation that the driver does not know. An upward velocity that is
    always zero is one that it does not know, either.
    """
    messages = bag.messages(about.topic)
    stamps, found, skips = _read(bag, messages, about.stamps, _twist)
    turn = ENU_OF_NED if about.axes == "ned" else np.eye(3)
    velocities, covariances = found[:, :3] @ turn.T, turn @ found[:, 3:].reshape(-1, 3, 3) @ turn.T
    if not velocities[:, 2].any():
        velocities[:, 2] = np.nan
    stddevs, _, wrong = split_covariances(covariances)
    if count := int((wrong & (stddevs > 0).all(axis=1)).sum()):
        skips.append(Skip("covariance", messages.topic, f"{count} velocities: {NOT_DEFINITE}", count))
    stddevs = np.where(stddevs > 0, stddevs, np.nan)
    return _rows(stamps, epoch_ns, fixes, velocities=velocities, velocity_stddevs=stddevs), skips


def heading_rows(bag: Bag, about: HeadingTopic, fixes: Array, epoch_ns: int) -> tuple[Array, list[Skip]]:
    """Rows (n, 18) as `velocity_rows`, with headings in degrees clockwise from north.

    A variance of pi² rad² or more says that there is no heading; one that is not above zero, that it is not known.
    """
    messages = bag.messages(about.topic)
    stamps, found, skips = _read(bag, messages, about.stamps, _yaw)
    is_enu = messages.kind == IMU if about.axes is None else about.axes == "enu"
    headings, variances = 90 - found[:, 0] if is_enu else found[:, 0], found[:, 1]
    headings[variances >= np.pi**2] = np.nan
    if count := int(np.isnan(headings).sum()):
        skips.append(Skip("heading", messages.topic, f"{count} messages: no heading", count))
    stddevs = np.degrees(np.sqrt(np.where(variances > 0, variances, np.nan)))
    return _rows(stamps, epoch_ns, fixes, headings_deg=headings, heading_stddevs_deg=stddevs), skips


def wheels_of(bag: Bag, about: WheelTopic | None, epoch_ns: int) -> tuple[WheelSpeeds | None, list[Skip]]:
    """The speed along x that a topic tells, in its unit, and what was skipped; None where the rig names none."""
    if about is None:
        return None, []
    messages = bag.messages(about.topic)
    stamps, found, skips = _read(bag, messages, about.stamps, _speed)
    wheels, repairs = clean_wheels((stamps - epoch_ns) * 1e-9, found[:, 0])
    if repairs.dropped:
        skips.append(Skip("samples", messages.topic, str(repairs)))
    return wheels, skips


def _speed(message: Any) -> list[float]:
    """Of a float, a report, a twist with or without a header and covariance, or the twist of an Odometry."""
    if hasattr(message, "data"):
        return [message.data]
    if hasattr(message, "longitudinal_velocity"):
        return [message.longitudinal_velocity]
    while hasattr(message, "twist"):
        message = message.twist
    return [message.linear.x]


def _read(
    bag: Bag, messages: Messages, clock: Any, read: Callable[[Any], list[float]]
) -> tuple[NDArray[np.int64], Array, list[Skip]]:
    """Unix times (n,) ns, what `read` takes from each message (n, c), and the skipped ones."""
    said, believed, skips = stamps_of(bag, messages, clock)
    if not believed.any():
        raise DataError(f"rig.yaml: {messages.topic} has no messages; remove it")
    rows = [read(decode(bag, messages, k)) for k in np.flatnonzero(believed).tolist()]
    return said[believed], np.array(rows, np.float64), skips


def _rows(stamps_ns: NDArray[np.int64], epoch_ns: int, fixes: Array, **more: Array) -> Array:
    """Rows at the place of the fix before, or of the first one."""
    stamps, fixes = (stamps_ns - epoch_ns) * 1e-9, fixes[np.argsort(fixes[:, 0], kind="stable")]
    before = np.searchsorted(fixes[:, 0], stamps, side="right").clip(1) - 1
    return with_more(np.column_stack([stamps, fixes[before, 1:7]]), **more)


def _twist(message: Any) -> list[float]:
    """Velocity, and its covariance row by row; zeros where it is not told."""
    twist, covariance = message.twist, np.zeros((6, 6))
    if hasattr(twist, "covariance"):
        twist, covariance = twist.twist, np.asarray(twist.covariance, np.float64).reshape(6, 6)
    v = twist.linear
    return [v.x, v.y, v.z, *covariance[:3, :3].ravel()]


def _yaw(message: Any) -> list[float]:
    """Turn about the vertical in degrees, and its variance in rad²; NaN where it is not told."""
    if hasattr(message, "data"):
        return [message.data, np.nan]
    is_imu = hasattr(message, "orientation_covariance")
    q = message.orientation if is_imu else message.quaternion
    quaternion = np.array([q.x, q.y, q.z, q.w])
    if not abs(np.linalg.norm(quaternion) - 1) < 1e-3:
        return [np.nan, np.nan]
    yaw = Rotation.from_quat(quaternion).as_euler("ZYX", degrees=True)[0]
    return [yaw, message.orientation_covariance[8] if is_imu else np.nan]

"""The IMU of a bag: one topic of both its sensors, or one of the gyroscope and one of the accelerometer."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.alignment import AttitudePrior
from factor_graphs.errors import MeasurementError
from factor_graphs.measurements import ImuSamples, clean_imu
from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.datasets.ros.kinds import VECTOR, decode
from gnss_sem_map.datasets.ros.rig import ImuTopic
from gnss_sem_map.datasets.ros.stamps import stamps_of
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.sensor_log import Skip

Array = NDArray[np.float64]

RATE, FORCE = "angular_velocity", "linear_acceleration"
"""Of Imu."""
LOOKED_AT = 20
"""Messages of an Imu topic that tell which of its numbers are measured."""
MOST_APART_S = 0.1
"""Between two forces that are farther apart none is interpolated."""


def part_of(bag: Bag, topic: str) -> str:
    """What a topic of Imu measures: drivers leave zeros where another topic has the rest, or say -1."""
    messages = bag.messages(topic)
    try:
        found = [decode(bag, messages, k) for k in messages.some(LOOKED_AT)]
    except DataError:
        return "IMU"
    if any(m.angular_velocity_covariance[0] == m.linear_acceleration_covariance[0] == -1 for m in found):
        return "heading"
    has_rate, has_force = (any(any(_vector(m, name)) for m in found) for name in (RATE, FORCE))
    return "IMU" if has_rate == has_force else "gyroscope" if has_rate else "accelerometer"


def samples_of(
    bag: Bag, about: ImuTopic | None, epoch_ns: int, with_all: bool
) -> tuple[ImuSamples | None, AttitudePrior | None, list[Skip]]:
    """The samples, the attitude at the first of them where the rig believes it, and what was skipped.

    Without `with_all`, only the first and the last message are read. Raises DataError.
    """
    if about is None:
        return None, None, []
    messages = bag.messages(about.topic)
    said, believed, skips = stamps_of(bag, messages, about.stamps) if with_all else _ends(messages)
    stamps = np.asarray((said[believed] - epoch_ns) * 1e-9, np.float64)
    if about.force_topic is None:
        forces, rates = np.hsplit(_rows(bag, messages, believed, FORCE, RATE), 2)
    else:
        others = bag.messages(about.force_topic)
        theirs, trusted, lost = stamps_of(bag, others, about.stamps) if with_all else _ends(others)
        measured = np.asarray((theirs[trusted] - epoch_ns) * 1e-9, np.float64)
        forces, inside = _interpolated(stamps, measured, _rows(bag, others, trusted, FORCE))
        inside |= not with_all  # only their ends were read
        skips += lost
        if count := int((~inside).sum()):
            reason = f"{count} turn rates without a force of {about.force_topic} near them"
            skips.append(Skip("samples", messages.topic, reason, count))
        rates = _rows(bag, messages, believed, RATE)[inside]
        stamps, forces = stamps[inside], forces[inside]
    try:
        samples, repairs = clean_imu(stamps, forces, rates)
    except MeasurementError as error:
        raise refused(messages.topic, f"{error}") from None
    if repairs.dropped:
        skips.append(Skip("samples", messages.topic, str(repairs)))
    attitude = None
    if about.attitude and believed.any():
        attitude = _attitude(decode(bag, messages, int(believed.argmax())), messages.topic)
    return samples, attitude, skips


def _rows(bag: Bag, messages: Messages, believed: NDArray[np.bool_], *names: str) -> Array:
    """Vectors of those names (n, 3 for each)."""
    rows = []
    for k in np.flatnonzero(believed).tolist():
        message = decode(bag, messages, k)
        rows.append([number for name in names for number in _vector(message, name)])
    return np.array(rows, np.float64).reshape(-1, 3 * len(names))


def _vector(message: Any, name: str) -> tuple[float, float, float]:
    v = getattr(message, "vector" if message.__msgtype__ == VECTOR else name)
    return v.x, v.y, v.z


def _interpolated(stamps: Array, theirs: Array, measured: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Forces (n, 3) at the stamps, linear between those that were measured, and which stamps lie near such (n,)."""
    order = np.argsort(theirs, kind="stable")
    theirs, measured = theirs[order], measured[order]
    if len(theirs) < 2:
        return np.zeros((len(stamps), 3)), np.zeros(len(stamps), np.bool_)
    after = np.searchsorted(theirs, stamps).clip(1, len(theirs) - 1)
    inside = (stamps >= theirs[0]) & (stamps <= theirs[-1]) & (np.diff(theirs)[after - 1] <= MOST_APART_S)
    return np.column_stack([np.interp(stamps, theirs, column) for column in measured.T]), inside


def _ends(messages: Messages) -> tuple[NDArray[np.int64], NDArray[np.bool_], list[Skip]]:
    """The first and the last message of a topic, for those who have a trajectory already."""
    is_end = np.zeros(len(messages), np.bool_)
    is_end[:1] = is_end[-1:] = True
    return messages.received_ns, is_end, []


def _attitude(message: Any, topic: str) -> AttitudePrior:
    """The orientation of the first message: body to east, north, up (REP 145), with its covariance."""
    q, variances = message.orientation, np.asarray(message.orientation_covariance)[[0, 4, 8]]
    quaternion = np.array([q.x, q.y, q.z, q.w])
    if not (variances > 0).all() or not abs(np.linalg.norm(quaternion) - 1) < 1e-3:
        raise refused(
            topic,
            f"found orientation {quaternion.tolist()}, variances {variances.tolist()}, expected length 1"
            " and above 0; set imu.attitude: false in rig.yaml",
        )
    return AttitudePrior(np.asarray(Rotation.from_quat(quaternion).as_matrix()), np.sqrt(variances))

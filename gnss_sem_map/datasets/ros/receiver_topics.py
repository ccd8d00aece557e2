"""A receiver in topics: its fixes, or NMEA sentences, velocity and heading, as rows of a table; and speed of wheels."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.csv_log import NOT_DEFINITE
from factor_graphs.measurements import WheelSpeeds, clean_wheels
from factor_graphs.position_covariances import split_covariances
from factor_graphs.receiver_rows import with_more
from gnss_sem_map.datasets.gnss_files import nmea
from gnss_sem_map.datasets.gnss_files.positions import FLAT_STDDEV_M, rows_of, without_heights
from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.datasets.ros.kinds import IMU, SENTENCE, STRING, decode
from gnss_sem_map.datasets.ros.rig import GnssTopic, HeadingTopic, VelocityTopic, WheelTopic
from gnss_sem_map.datasets.ros.stamps import JUMP_NS, stamps_of
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.sensor_log import Skip, skipped

Array = NDArray[np.float64]

ENU_OF_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
Ints = NDArray[np.int64]
NO_FIX = -1
"""NavSatStatus.status, and GPSStatus.status."""
UNKNOWN_COVARIANCE, DIAGONAL_COVARIANCE = 0, 2
"""position_covariance_type."""
OF_95_PERCENT = 1.96
"""GPSFix tells errors that are smaller in 95 of 100 cases: so many standard deviations."""


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


def fix_rows(bag: Bag, topic: str, about: GnssTopic) -> tuple[Array, Ints, list[Skip]]:
    """Rows (n, 18) as `receiver_rows.ROW_COLUMNS`, their Unix times ns, and the skipped fixes; raises DataError."""
    messages = bag.messages(topic)
    said, believed, skips = stamps_of(bag, messages, about.stamps)
    if messages.kind in (SENTENCE, STRING):
        rows, ns, lost = _of_sentences(bag, messages, said, about)
        return rows, ns, skips + lost
    places, stamps, covariances = [], [], []
    counts = Counter[str]()
    for k in np.flatnonzero(believed).tolist():
        fix = decode(bag, messages, k)
        why, covariance = covariance_of(fix)
        if why and about.stddevs_m is not None:
            covariance = np.diag(np.square(about.stddevs_m))
        if fix.status.status == NO_FIX:
            counts["no fix"] += 1
        elif covariance is None:
            counts[why] += 1
        else:
            places.append([fix.latitude, fix.longitude, fix.altitude])
            covariances.append(covariance)
            stamps.append(int(said[k]))
    if not places:
        raise refused(
            messages.topic,
            f"not one of {len(messages)} messages is a fix"
            f" ({', '.join(f'{count}: {why}' for why, count in counts.items()) or 'no messages'});"
            " where only covariances are unknown or zero, set gnss.stddevs_m in rig.yaml",
        )
    skips += skipped("fix", messages.topic, "messages", counts)
    if np.isnan(np.array(places)[:, 2]).all():
        skips.append(without_heights(messages.topic, len(places)))
        places = [[lat, lon, 0.0] for lat, lon, _ in places]
        covariances = [_flat(covariance) for covariance in covariances]
    ns = np.array(stamps, np.int64)
    stddevs, correlations, wrong = split_covariances(np.array(covariances))
    if count := int((wrong & (stddevs > 0).all(axis=1)).sum()):  # others are no fixes
        skips.append(Skip("covariance", messages.topic, f"{count} fixes: {NOT_DEFINITE}", count))
    table = np.column_stack([(ns - ns[0]) * 1e-9, np.array(places), stddevs])
    return with_more(table, correlations=correlations), ns, skips


def _flat(covariance: Array) -> Array:
    """Of a fix without height: what is told of east and north, and a height that nobody knows."""
    whole = np.diag([0.0, 0.0, FLAT_STDDEV_M**2])
    whole[:2, :2] = covariance[:2, :2]
    return whole


def covariance_of(fix: Any) -> tuple[str, Array | None]:
    """Why a fix has no covariance, or nothing; and the covariance (3, 3) m² that its message tells."""
    covariance = np.array(fix.position_covariance, np.float64).reshape(3, 3)
    kind = fix.position_covariance_type
    if kind != UNKNOWN_COVARIANCE and (covariance.diagonal() > 0).all():
        return "", covariance * np.eye(3) if kind == DIAGONAL_COVARIANCE else covariance
    across, up = getattr(fix, "err_horz", 0.0), getattr(fix, "err_vert", 0.0)
    if across > 0 and up > 0:
        return "", np.diag(np.square(np.array([across, across, up]) / OF_95_PERCENT))
    return f"its covariance is {'unknown' if kind == UNKNOWN_COVARIANCE else 'not above zero'}", None


def _of_sentences(
    bag: Bag, messages: Messages, said: Ints, about: GnssTopic
) -> tuple[Array, Ints, list[Skip]]:
    """The fixes of NMEA sentences at their own time, UTC; on the clock of their stamps where that is another one."""
    name = "sentence" if messages.kind == SENTENCE else "data"
    lines = [str(getattr(decode(bag, messages, k), name)) for k in range(len(messages))]
    near_ns = int(np.median(said)) if len(said) else None
    found = nmea.read(Path(messages.topic), lines, near_ns)
    stamps, skips = found.stamps_ns, found.skips
    are_fixes = [re.search(r"GGA(,[^,]*){5},[1-9]", line) is not None for line in lines]
    off_ns = round(float(np.median(said[are_fixes])) - float(np.median(stamps))) if any(are_fixes) else 0
    if abs(off_ns) > JUMP_NS:
        stamps = stamps + off_ns
        reason = f"the stamps are {off_ns * 1e-9:+.1f} s off the times in the sentences: their clock is taken"
        skips.append(Skip("clock", messages.topic, reason))
    return rows_of(found, int(stamps[0]), stamps, about.stddevs_m), stamps, skips

"""ROS 1 bags and ROS 2 bags (MCAP or sqlite3), as one file or as the folder of files that they were split into.

rig.yaml, in the folder of the bag or beside it, says which topic is which sensor; `gnss-sem-map inspect` writes it.
Without it, a topic is taken where there is but one of its type. Clouds and images are read when they are needed, by
their place in the bag: memory does not grow with it, and nothing is copied. Frame numbers count the messages of a
topic from 0. Stamp zero is that of the first fix.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.alignment import AttitudePrior
from factor_graphs.csv_log import NOT_DEFINITE
from factor_graphs.errors import MeasurementError
from factor_graphs.measurements import ImuSamples, clean_imu
from factor_graphs.position_covariances import split_covariances
from factor_graphs.receiver_rows import with_more
from factor_graphs.valid_fixes import valid_fixes
from gnss_sem_map.datasets.gnss_files import read_gnss_file
from gnss_sem_map.datasets.receiver import Receiver, measured
from gnss_sem_map.datasets.ros import clouds, pictures, receiver_topics, roles
from gnss_sem_map.datasets.ros.bag import METADATA, SUFFIXES, Bag, Messages, bag_files
from gnss_sem_map.datasets.ros.calibration import calibration_of, other_poses
from gnss_sem_map.datasets.ros.decoding import decode, header_ns
from gnss_sem_map.datasets.ros.rig import (
    GnssTopic,
    ImuTopic,
    LidarTopic,
    Rig,
    read_rig,
    rig_file,
)
from gnss_sem_map.datasets.ros.stamps import Clock, stamps_of
from gnss_sem_map.datasets.stamps import in_order
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import shown
from gnss_sem_map.sensor_log import Image, Lidar, Points, Scan, SensorLog, Skip
from gnss_sem_map.sensor_log.cameras import Camera
from gnss_sem_map.sensor_log.conventions import SensorConventions

Array = NDArray[np.float64]

FORMAT, SIGNS = "rosbag", "a ROS bag (.bag, .mcap, .db3)"
FILES = SUFFIXES
"""Endings of drives that are one file."""
NO_FIX = -1
"""NavSatStatus.status."""


def is_drive(drive: Path) -> bool:
    """Whether a path looks like a bag."""
    return bool(bag_files(drive))


def read(drive: Path, with_imu: bool = True) -> SensorLog:
    """Open a bag; raises DataError for a bag that is damaged, and for sensors that are not unique.

    Without `with_imu`, only the first and last message of the IMU are read.
    """
    bag, file, rig = _opened(drive)
    lost = [Skip("part of the bag", name, f"{METADATA} lists it, and it is not there") for name in bag.lost]
    calibration, calibration_skips = calibration_of(bag, rig)
    epoch_ns, receiver, skips = _receiver(bag, rig, file or drive, calibration.p_imu_antenna)
    skips += roles.missing(bag, rig)
    samples, attitude, imu_skips = _imu(bag, rig.imu, epoch_ns, with_imu)
    scans: list[tuple[Scan, ...]] = []
    for one in rig.lidars.values():
        found, scan_skips = _scans(bag, one, epoch_ns)
        scans.append(found)
        skips += scan_skips
    names = list(rig.lidars) if len(scans) > 1 else [""]
    others = zip(names[1:], other_poses(bag, rig), scans[1:], strict=True)
    images, image_skips = _images(bag, rig, epoch_ns, calibration.cameras)
    return SensorLog(
        name=shown(drive.name or drive.resolve().name),
        epoch_ns=epoch_ns,
        calibration=calibration,
        scans=scans[0] if scans else (),
        lidar=names[0],
        others=tuple(Lidar(*other) for other in others),
        images=images,
        frame=receiver.frame,
        imu=samples,
        gnss=receiver.gnss,
        velocities=receiver.velocities,
        headings=receiver.headings,
        imu_noise=None if rig.imu is None else rig.imu.noise,
        imu_sample_instant=None if rig.imu is None else rig.imu.sample_instant,
        initial_attitude=attitude,
        attitude_of_unit=True,
        conventions=rig.conventions,
        skips=(*lost, *skips, *imu_skips, *calibration_skips, *image_skips),
    )


def _receiver(bag: Bag, rig: Rig, place: Path, p_imu_antenna: Array) -> tuple[int, Receiver, list[Skip]]:
    """The epoch of the log, what its receiver measured, and the skipped fixes; `place`: rig.yaml, or the bag."""
    if rig.gnss is None:
        return _first_ns(bag, rig), Receiver(), []
    fixes, fix_ns, skips = _fixes(bag, rig.gnss, place.parent, rig.imu)
    where, second = shown(bag.path), rig.gnss.p_imu_antenna2
    valid, invalid = valid_fixes(fixes[:, 0], fixes[:, 1:4], fixes[:, 4:7])
    if not valid.any():
        raise DataError(
            f"{where}: not one of {len(fixes)} fixes of the receiver is usable ({next(iter(invalid), 'none')})"
        )
    skips += [Skip("fix", where, f"{n} fixes: {why}", n) for why, n in invalid.items()]
    rows = of_velocity = of_heading = fixes[valid]
    if rig.gnss.velocity is not None:
        of_velocity, lost = receiver_topics.velocity_rows(bag, rig.gnss.velocity, rows, int(fix_ns[0]))
        skips += lost
    if rig.gnss.heading is not None:
        of_heading, lost = receiver_topics.heading_rows(bag, rig.gnss.heading, rows, int(fix_ns[0]))
        skips += lost
    try:
        baseline = None if second is None else np.subtract(second, p_imu_antenna)
        found, lost = measured(rows, where, baseline, of_velocity, of_heading)
    except MeasurementError as error:
        raise DataError(f"rig.yaml: gnss: {error}") from None
    return int(fix_ns[0]), found, skips + lost


def _first_ns(bag: Bag, rig: Rig) -> int:
    """The first moment of the first sensor there is, Unix ns; raises DataError without any."""
    sensor = rig.imu or next(iter(rig.lidars.values()), None)
    if sensor is None:
        raise DataError(f"{shown(bag.path)}: found no topic of an IMU, a receiver or a LiDAR")
    said, believed, _ = stamps_of(bag, bag.messages(sensor.topic), sensor.stamps)
    return int(said[believed][0]) if believed.any() else 0


def read_imu(drive: Path) -> tuple[ImuSamples, SensorConventions]:
    """The samples of a bag's IMU and their conventions; it needs no other sensor. Raises DataError."""
    bag, _, rig = _opened(drive)
    imu, *_ = _imu(bag, rig.imu, _first_ns(bag, rig), True)
    if imu is None:
        missing = roles.missing(bag, rig)[0]
        raise DataError(f"{missing.where}: {missing.reason}")
    return imu, rig.conventions


def _opened(drive: Path) -> tuple[Bag, Path | None, Rig]:
    """The bag, its rig.yaml, if there is one, and the rig that it tells, completed."""
    bag, file = Bag(drive), rig_file(drive)
    return bag, file, roles.completed(bag, Rig() if file is None else read_rig(file))


def _fixes(
    bag: Bag, about: GnssTopic, folder: Path, imu: ImuTopic | None
) -> tuple[Array, NDArray[np.int64], list[Skip]]:
    """Rows (n, 18) as `receiver_rows.ROW_COLUMNS`; their Unix times; and the skipped fixes."""
    if about.file is not None:
        drive_ns = None if imu is None else _span_ns(bag, bag.messages(imu.topic), imu.stamps)
        found = read_gnss_file(about.file, folder, None, drive_ns)
        return found.rows, found.stamps_ns, found.skips
    assert about.topic is not None
    messages = bag.messages(about.topic)
    said, believed, skips = stamps_of(bag, messages, about.stamps)
    rows, stamps, covariances = [], [], []
    lost = {"no fix": 0, "its covariance is unknown": 0}
    for k in np.flatnonzero(believed).tolist():
        fix = decode(bag, messages, k)
        covariance = None if about.stddevs_m is None else np.diag(np.square(about.stddevs_m))
        if fix.position_covariance_type != roles.UNKNOWN_COVARIANCE:
            covariance = np.asarray(fix.position_covariance, np.float64).reshape(3, 3)
            if fix.position_covariance_type == roles.DIAGONAL_COVARIANCE:
                covariance = covariance * np.eye(3)
        if fix.status.status == NO_FIX:
            lost["no fix"] += 1
        elif covariance is None:
            lost["its covariance is unknown"] += 1
        else:
            rows.append([fix.latitude, fix.longitude, fix.altitude])
            covariances.append(covariance)
            stamps.append(int(said[k]))
    told = {why: count for why, count in lost.items() if count}
    if not rows:
        raise DataError(
            f"{messages.topic}: not one of {len(messages)} messages is a fix"
            f" ({', '.join(f'{count}: {why}' for why, count in told.items()) or 'no messages'});"
            " where only covariances are unknown, set gnss.stddevs_m in rig.yaml"
        )
    skips += [Skip("fix", messages.topic, f"{count} messages: {why}", count) for why, count in told.items()]
    ns = np.array(stamps, np.int64)
    stddevs, correlations, wrong = split_covariances(np.array(covariances))
    if count := int((wrong & (stddevs > 0).all(axis=1)).sum()):  # others are no fixes
        skips.append(Skip("covariance", messages.topic, f"{count} fixes: {NOT_DEFINITE}", count))
    table = np.column_stack([(ns - ns[0]) * 1e-9, np.array(rows), stddevs])
    return with_more(table, correlations=correlations), ns, skips


def _span_ns(bag: Bag, messages: Messages, clock: Clock) -> tuple[int, int] | None:
    """First and last moment of a topic, Unix ns."""
    if len(messages) == 0:
        return None
    if clock == "received":
        return int(messages.received_ns[0]), int(messages.received_ns[-1])
    return header_ns(bag, messages, 0), header_ns(bag, messages, len(messages) - 1)


def _imu(
    bag: Bag, about: ImuTopic | None, epoch_ns: int, with_all: bool
) -> tuple[ImuSamples | None, AttitudePrior | None, list[Skip]]:
    if about is None:
        return None, None, []
    messages = bag.messages(about.topic)
    said, believed, skips = stamps_of(bag, messages, about.stamps) if with_all else _ends(messages)
    rows, attitude = [], None
    for k in np.flatnonzero(believed).tolist():
        one = decode(bag, messages, k)
        force, rate = one.linear_acceleration, one.angular_velocity
        rows.append([force.x, force.y, force.z, rate.x, rate.y, rate.z])
        if about.attitude and len(rows) == 1:
            attitude = _attitude(one, messages.topic)
    table = np.array(rows, np.float64).reshape(-1, 6)
    try:
        samples, repairs = clean_imu((said[believed] - epoch_ns) * 1e-9, table[:, :3], table[:, 3:])
    except MeasurementError as error:
        raise DataError(f"{messages.topic}: {error}") from None
    if repairs.dropped:
        skips.append(Skip("samples", messages.topic, str(repairs)))
    return samples, attitude, skips


def _ends(messages: Messages) -> tuple[NDArray[np.int64], NDArray[np.bool_], list[Skip]]:
    """The first and the last message of a topic, for those who have a trajectory already."""
    is_end = np.zeros(len(messages), np.bool_)
    is_end[:1] = is_end[-1:] = True
    return messages.received_ns, is_end, []


def _attitude(message: object, topic: str) -> AttitudePrior:
    """The orientation of the first message: body to east, north, up (REP 145), with its covariance."""
    q, variances = message.orientation, np.asarray(message.orientation_covariance)[[0, 4, 8]]  # type: ignore[attr-defined]
    quaternion = np.array([q.x, q.y, q.z, q.w])
    if not (variances > 0).all() or not abs(np.linalg.norm(quaternion) - 1) < 1e-3:
        raise DataError(
            f"{topic}: found orientation {quaternion.tolist()} with variances {variances.tolist()}, expected a unit"
            " quaternion and variances above 0; set imu.attitude: false in rig.yaml"
        )
    return AttitudePrior(np.asarray(Rotation.from_quat(quaternion).as_matrix()), np.sqrt(variances))


def _scans(bag: Bag, about: LidarTopic, epoch_ns: int) -> tuple[tuple[Scan, ...], list[Skip]]:
    messages = bag.messages(about.topic)
    said, believed, skips = stamps_of(bag, messages, about.stamps)
    _check_times(bag, messages, about)
    scans = []
    for k in np.flatnonzero(believed).tolist():
        ns, stamp = int(said[k]), (int(said[k]) - epoch_ns) * 1e-9
        read_it = partial(_read_scan, bag.file_of(messages, k), bag, messages, k, stamp, ns, about)
        scans.append(Scan(f"{k:010d}", k, stamp, read_it))
    return in_order("scan", scans, skips), skips


def _check_times(bag: Bag, messages: Messages, about: LidarTopic) -> None:
    """Raise DataError when the clouds have no times of points, before hours are spent."""
    if len(messages) == 0 or about.point_times == clouds.COMPENSATED:
        return
    names = clouds.fields_of(decode(bag, messages, 0))
    if clouds.time_field(names, about.point_times) is None:
        raise clouds.no_times(messages.topic, names)


def _read_scan(
    _file: Path, bag: Bag, messages: Messages, k: int, stamp: float, stamp_ns: int, about: LidarTopic
) -> Points:
    return clouds.read_cloud(bag, messages, k, stamp, stamp_ns, about.point_times, about.intensity_max)


def _images(
    bag: Bag, rig: Rig, epoch_ns: int, cameras: tuple[Camera, ...]
) -> tuple[tuple[Image, ...], list[Skip]]:
    images: list[Image] = []
    skips: list[Skip] = []
    # without a LiDAR there is no camera
    for about, camera in zip(rig.cameras.values(), cameras, strict=False):
        messages = bag.messages(about.topic)
        said, believed, lost = stamps_of(bag, messages, about.stamps)
        of_camera = [
            Image(
                k,
                (int(said[k]) - epoch_ns) * 1e-9,
                partial(_read_image, bag.file_of(messages, k), bag, messages, k, camera.image_size),
                camera.name,
            )
            for k in np.flatnonzero(believed).tolist()
        ]
        images += in_order("image", of_camera, lost)
        skips += lost
    return tuple(sorted(images, key=lambda image: image.stamp)), skips


def _read_image(
    _file: Path, bag: Bag, messages: Messages, k: int, size: tuple[int, int]
) -> NDArray[np.uint8]:
    return pictures.read_image(bag, messages, k, size)

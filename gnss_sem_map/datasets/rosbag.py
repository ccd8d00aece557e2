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

from factor_graphs.errors import MeasurementError
from factor_graphs.measurements import ImuSamples
from factor_graphs.valid_fixes import valid_fixes
from gnss_sem_map.datasets.gnss_files import read_gnss_file
from gnss_sem_map.datasets.gnss_files.positions import Receiver, measured
from gnss_sem_map.datasets.ros import clouds, pictures, receiver_topics, roles
from gnss_sem_map.datasets.ros.bag import METADATA, SUFFIXES, Bag, Messages, bag_files
from gnss_sem_map.datasets.ros.calibration import calibration_of, other_poses
from gnss_sem_map.datasets.ros.imu_topics import samples_of
from gnss_sem_map.datasets.ros.receiver_topics import fix_rows
from gnss_sem_map.datasets.ros.rig import (
    GnssTopic,
    ImuTopic,
    LidarTopic,
    Rig,
    read_rig,
    rig_file,
)
from gnss_sem_map.datasets.ros.stamps import Clock, header_ns, stamps_of
from gnss_sem_map.datasets.stamps import in_order
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import refused, shown
from gnss_sem_map.sensor_log import Image, Lidar, Scan, SensorLog, Skip
from gnss_sem_map.sensor_log.cameras import Camera
from gnss_sem_map.sensor_log.conventions import SensorConventions

Array = NDArray[np.float64]

FORMAT, SIGNS = "rosbag", "a ROS bag (.bag, .mcap, .db3)"
FILES = SUFFIXES
"""Endings of drives that are one file."""


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
    samples, attitude, imu_skips = samples_of(bag, rig.imu, epoch_ns, with_imu)
    wheels, wheel_skips = receiver_topics.wheels_of(bag, rig.wheels, epoch_ns)
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
        wheels=wheels,
        imu_noise=None if rig.imu is None else rig.imu.noise,
        imu_sample_instant=None if rig.imu is None else rig.imu.sample_instant,
        initial_attitude=attitude,
        attitude_of_unit=True,
        conventions=rig.conventions,
        skips=(*lost, *skips, *imu_skips, *wheel_skips, *calibration_skips, *image_skips),
    )


def _receiver(bag: Bag, rig: Rig, place: Path, p_imu_antenna: Array) -> tuple[int, Receiver, list[Skip]]:
    """The epoch of the log, what its receiver measured, and the skipped fixes; `place`: rig.yaml, or the bag."""
    if rig.gnss is None:
        return _first_ns(bag, rig), Receiver(), []
    fixes, fix_ns, skips = _fixes(bag, rig.gnss, place.parent, rig.imu)
    where, second = shown(bag.path), rig.gnss.p_imu_antenna2
    valid, invalid = valid_fixes(fixes[:, 0], fixes[:, 1:4], fixes[:, 4:7])
    if not valid.any():
        raise refused(where, f"not one of {len(fixes)} fixes is usable ({next(iter(invalid), 'none')})")
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
        raise roles.nothing_read(bag)
    said, believed, _ = stamps_of(bag, bag.messages(sensor.topic), sensor.stamps)
    return int(said[believed][0]) if believed.any() else 0


def read_imu(drive: Path) -> tuple[ImuSamples, SensorConventions]:
    """The samples of a bag's IMU and their conventions; it needs no other sensor. Raises DataError."""
    bag, _, rig = _opened(drive)
    imu, *_ = samples_of(bag, rig.imu, _first_ns(bag, rig), True)
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
    return fix_rows(bag, about.topic, about)


def _span_ns(bag: Bag, messages: Messages, clock: Clock) -> tuple[int, int] | None:
    """First and last moment of a topic, Unix ns."""
    if len(messages) == 0:
        return None
    if clock == "received":
        return int(messages.received_ns[0]), int(messages.received_ns[-1])
    return header_ns(bag, messages, 0), header_ns(bag, messages, len(messages) - 1)


def _scans(bag: Bag, about: LidarTopic, epoch_ns: int) -> tuple[tuple[Scan, ...], list[Skip]]:
    messages = bag.messages(about.topic)
    said, believed, skips = stamps_of(bag, messages, about.stamps)
    steps = np.diff(said[believed]) * 1e-9
    interval_s = float(np.median(steps[steps > 0])) if (steps > 0).any() else None
    times, is_unusual = clouds.times_of(bag, messages, about.point_times, about.point_times_unit, interval_s)
    if is_unusual:
        reason = f"taken as {times.unit}, as sweeps then fill the time between them; point_times_unit says it"
        skips.append(Skip("point times", messages.topic, reason))
    scans = []
    for k in np.flatnonzero(believed).tolist():
        ns, stamp = int(said[k]), (int(said[k]) - epoch_ns) * 1e-9
        of_cloud = bag.file_of(messages, k), bag, messages, k, stamp, ns, times, about.intensity_max
        scans.append(Scan(f"{k:010d}", k, stamp, partial(clouds.read_cloud, *of_cloud)))
    return in_order("scan", scans, skips), skips


def _images(
    bag: Bag, rig: Rig, epoch_ns: int, cameras: tuple[Camera, ...]
) -> tuple[tuple[Image, ...], list[Skip]]:
    images: list[Image] = []
    skips: list[Skip] = []
    # without a LiDAR there is no camera
    for about, camera in zip(rig.cameras.values(), cameras, strict=False):
        messages = bag.messages(about.topic)
        said, believed, lost = stamps_of(bag, messages, about.stamps)
        of_camera = []
        for k in np.flatnonzero(believed).tolist():
            read_it = partial(
                pictures.read_image, bag.file_of(messages, k), bag, messages, k, camera.image_size
            )
            of_camera.append(Image(k, (int(said[k]) - epoch_ns) * 1e-9, read_it, camera.name))
        images += in_order("image", of_camera, lost)
        skips += lost
    return tuple(sorted(images, key=lambda image: image.stamp)), skips

"""Digests of what decides a result: an interrupted run may be resumed where they are the same.

A file stands in them with its size and its time of change, and the values that were read from small files as they are;
poses of sensors to the nanometre, because their last digits depend on the type of the processor.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.labels import sensor_model
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.sensor_log import Image, Scan, SensorLog, file_of
from gnss_sem_map.voxels.reuse import VERSION


def of_log(log: SensorLog, labels_from: str = "", label_set: LabelSet | None = None) -> str:
    """Digest of all that is read of a drive, of the labels of its images and of their classes, and of this version."""
    said = [
        VERSION, log.name, log.epoch_ns, log.frame, log.imu_noise, log.imu_sample_instant, log.conventions, _scans(log),
        _images(log), _cameras(log), labels_from, _states(labels_from),
        None if label_set is None else _classes_of_map(label_set),
        None if log.points is None else log.points.names,
    ]  # fmt: skip
    tables = (
        log.imu, log.gnss, log.velocities, log.headings, log.points, log.wheels, log.given, log.initial_attitude,
    )  # fmt: skip
    values = (
        getattr(table, column.name)
        for table in tables
        if table is not None
        for column in fields(table)
        if column.name != "names"
    )
    arrays = [np.asarray(value, np.float64) for value in values if value is not None]
    return _digest(said, [*_calibration(log), log.calibration.p_imu_antenna, *arrays])


def of_matches(log: SensorLog, trajectory: Trajectory, settings: Settings) -> str:
    """Digest of everything that decides the matches of LiDAR odometry, this version too."""
    said = [
        VERSION, log.name, settings.trajectory.scan_matching.model_dump_json(),
        [(scan.name, scan.number, scan.stamp, _state(scan)) for scan in log.scans],
    ]  # fmt: skip
    return _digest(said, [trajectory.stamps, trajectory.T_map_imu, log.calibration.T_imu_lidar])


def of_map(drive: Drive, labels_from: str) -> str:
    """Digest of everything that decides the map, this version too."""
    log, settings, trajectory = drive.log, drive.settings, drive.trajectory
    said = [
        VERSION, log.name, log.epoch_ns, labels_from, _classes(drive),
        settings.mapping.model_dump_json(), settings.labelling.model_dump_json(),
        settings.dynamics.model_dump_json(),
        _scans(log), _images(log), _states(labels_from), _cameras(log),
    ]  # fmt: skip
    learnt = sensor_model.opened(settings.calibration, open_label_set(settings.classes))
    arrays = [] if learnt is None else [learnt.log_likelihoods]
    arrays += [trajectory.stamps, trajectory.T_map_imu, *_calibration(log)]
    return _digest(said, arrays if trajectory.velocities is None else [*arrays, trajectory.velocities])


def of_probabilities(drive: Drive, labels_from: str) -> str:
    """Digest of the network, the images and the classes: they decide the class probabilities."""
    said = [
        drive.log.name, labels_from, _classes(drive),
        drive.log.calibration.image_sizes, _images(drive.log), _states(labels_from),
    ]  # fmt: skip
    return _digest(said, [])


def _digest(said: list[Any], arrays: Iterable[NDArray[Any]]) -> str:
    digest = hashlib.sha256(repr(said).encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _classes(drive: Drive) -> list[Any]:
    network = [] if drive.segmenter is None else list(drive.segmenter.class_names)
    return [network, *_classes_of_map(drive.label_set)]


def _classes_of_map(label_set: LabelSet) -> list[Any]:
    """The classes of the map, their roles, and which those of a network are; their file may be changed."""
    return [label_set.names, label_set.sources, label_set.roles]


def _scans(log: SensorLog) -> list[Any]:
    return [
        (one.lidar, scan.name, scan.number, scan.stamp, _state(scan))
        for one in log.by_lidar
        for scan in one.scans
    ]


def _images(log: SensorLog) -> list[Any]:
    return [(image.camera, image.number, image.stamp, _state(image)) for image in log.images]


def _cameras(log: SensorLog) -> list[Any]:
    return [(camera.name, camera.image_size, camera.time_offset_s) for camera in log.calibration.cameras]


def _calibration(log: SensorLog) -> Iterator[NDArray[Any]]:
    """Of all LiDARs and cameras."""
    poses = [one.calibration.T_imu_lidar for one in log.by_lidar]
    for camera in log.calibration.cameras:
        poses.append(camera.T_camera_lidar)
        yield from (camera.K, camera.lens)
    yield from (pose.round(9) + 0.0 for pose in poses)  # + 0.0 makes -0.0 a 0.0


def _state(item: Scan | Image) -> tuple[int, int] | None:
    path = file_of(item)
    return None if path is None else _size_and_time(path)


def _states(labels_from: str) -> list[Any]:
    """Of the files that a segmenter's description names, label files or those of a network, or of its code."""
    kind, _, named = labels_from.partition("?")[0].partition(":")
    if kind == "python":
        return _contents_of_code(named.partition(".")[0].partition(":")[0])
    place = Path(named)
    if not named or not place.exists():
        return []
    folders = [place, *sorted(path for path in place.iterdir() if path.is_dir())] if place.is_dir() else []
    files = [path for folder in folders for path in sorted(folder.iterdir()) if path.is_file()] or [place]
    return [(str(path.relative_to(place)), _size_and_time(path)) for path in files]


def _contents_of_code(package: str) -> list[tuple[str, str]]:
    """Names and digests of the files of a top-level module or package, which is not imported.

    Each machine of a cluster may have installed it at its own time, and place.
    """
    try:
        found = find_spec(package)
    except ValueError:  # no name of a module; who imports it says so
        found = None
    if found is None or found.origin is None:
        return []
    folder = Path(found.origin).parent
    files = sorted(folder.rglob("*.py")) if found.submodule_search_locations else [Path(found.origin)]
    return [(str(one.relative_to(folder)), hashlib.sha256(one.read_bytes()).hexdigest()) for one in files]


def _size_and_time(path: Path) -> tuple[int, int] | None:
    try:
        about = path.stat()
    except OSError:  # the reader reports it
        return None
    return about.st_size, about.st_mtime_ns

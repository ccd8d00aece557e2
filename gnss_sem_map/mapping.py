"""From scans to voxels: every point at its own stamp, labelled by the image of its moment, fused (eq. 1 to 7)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map import labels
from gnss_sem_map.account import Account, Progress, silent
from gnss_sem_map.config import Settings
from gnss_sem_map.deskew import usable_points_in_map
from gnss_sem_map.errors import DataError
from gnss_sem_map.labelling import ClassImage, class_image, exposure_stamp, pixels_seen
from gnss_sem_map.segmentation import MissingLabels, Segmenter
from gnss_sem_map.sensor_log import Image, Points, Scan, SensorLog, Skip
from gnss_sem_map.voxel_map import MappingSettings, SemanticMap, State, VoxelMap, VoxelTable, keys_of

READ_AHEAD = 4


def build_map(
    log: SensorLog,
    trajectory: Trajectory,
    segmenter: Segmenter | None,
    settings: Settings,
    account: Account,
    progress: Progress = silent,
) -> VoxelMap:
    """Every point of every scan, at its own stamp, labelled by the image of its moment, fused (eq. 1 to 7)."""
    label_set = labels.label_set(settings.classes)
    table = VoxelTable(settings.mapping.voxel_size_m, label_set, settings.labelling.probability_floor)
    look = _Look(log, segmenter, settings, account)
    for done, (scan, points, classes) in enumerate(_read_ahead(log.scans, look)):
        if points is not None:
            _fuse_scan(table, scan, points, classes, log, trajectory, settings, account)
        progress("mapping", done + 1, len(log.scans))
    if not account.counts["scans"]:
        why = f"; first reason: {account.skips[0].where}: {account.skips[0].reason}" if account.skips else ""
        raise DataError(f"{log.name}: none of {len(log.scans)} scans can be used{why}")
    if not account.counts["points labelled"]:
        account.warnings.append("no point got a label: the map shows geometry only")
    return table.to_map()


def _fuse_scan(
    table: VoxelTable,
    scan: Scan,
    points: Points,
    classes: tuple[Image, ClassImage] | None,
    log: SensorLog,
    trajectory: Trajectory,
    settings: Settings,
    account: Account,
) -> None:
    try:
        p_map, valid = map_points(points, scan, trajectory, log, settings.mapping)
    except MeasurementError as error:
        account.skips.append(Skip("scan", f"frame {scan.number}", str(error)))
        return
    pixels = None
    if classes is not None:
        image, class_pixels = classes
        stamp = exposure_stamp(image, log.calibration, settings.labelling)
        pixels = pixels_seen(p_map, stamp, trajectory, log.calibration, class_pixels, settings.labelling)
        account.counts["points labelled"] += int(np.count_nonzero(pixels >= 0))
    table.add(table.keys_of(p_map), pixels, classes[1].rows if classes is not None else None)
    account.counts["scans"] += 1
    account.counts["points"] += len(valid)
    account.counts["points left out"] += len(valid) - len(p_map)


def map_points(
    points: Points, scan: Scan, trajectory: Trajectory, log: SensorLog, settings: MappingSettings
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The points of a sweep that are finite and in range, in the map (m, 3) m, and which of all those are (n,)."""
    return usable_points_in_map(
        points, scan.stamp, trajectory, log.calibration.T_imu_lidar, settings.nearest_m, settings.farthest_m
    )


@dataclass(frozen=True, eq=False)
class PointLabels:
    """What a map says of every original point of one scan."""

    labels: NDArray[np.int8]
    """(n,) class index, -1 where nothing is known."""
    confidence: NDArray[np.float32]
    """(n,) probability of that class, 0 where nothing is known."""
    removed: NDArray[np.bool_]
    """(n,) part of a moving vehicle."""


def label_points(
    log: SensorLog, trajectory: Trajectory, maps: Sequence[SemanticMap], settings: Settings
) -> Iterator[tuple[Scan, list[PointLabels]]]:
    """For every usable scan, what each of the maps says of its original points."""
    for scan in log.scans:
        try:
            points = scan.read()
            p_map, valid = map_points(points, scan, trajectory, log, settings.mapping)
        except (DataError, MeasurementError):
            continue  # counted when the map was built
        keys = keys_of(p_map, settings.mapping.voxel_size_m)
        yield scan, [_look_up(semantic_map, keys, valid) for semantic_map in maps]


def _look_up(semantic_map: SemanticMap, keys: NDArray[np.int64], valid: NDArray[np.bool_]) -> PointLabels:
    places = semantic_map.voxels.places(keys)
    known = valid.copy()
    known[valid] = places >= 0
    places = places[places >= 0]
    found = PointLabels(
        labels=np.full(len(valid), labels.UNLABELLED, np.int8),
        confidence=np.zeros(len(valid), np.float32),
        removed=np.zeros(len(valid), np.bool_),
    )
    found.labels[known] = semantic_map.labels[places]
    found.confidence[known] = semantic_map.confidence[places]
    found.removed[known] = semantic_map.states[places] == State.REMOVED
    return found


class _Look:
    """What a scan's image shows: read, segmented, and counted when there is nothing to see."""

    def __init__(
        self, log: SensorLog, segmenter: Segmenter | None, settings: Settings, account: Account
    ) -> None:
        self._log, self._segmenter, self._account = log, segmenter, account
        self._within_s = settings.labelling.image_within_s
        self._label_set = labels.label_set(settings.classes)
        if segmenter is None:
            account.warnings.append("no segmenter: the map shows geometry only")
        elif not log.images or not log.calibration.has_camera:
            account.warnings.append(f"{log.name} has no images: the map shows geometry only")

    def __call__(self, scan: Scan) -> tuple[Points | None, tuple[Image, ClassImage] | None]:
        try:
            points = scan.read()
        except DataError as error:
            self._account.skips.append(Skip("scan", f"frame {scan.number}", str(error)))
            return None, None
        size = self._log.calibration.image_size
        if self._segmenter is None or size is None or not self._log.images:
            return points, None
        image = self._log.image_at(scan.stamp, self._within_s)
        if image is None:
            self._account.skips.append(Skip("labels", f"frame {scan.number}", "no image near its stamp"))
            return points, None
        try:
            where = f"labels of image {image.number}"
            seen = self._segmenter(image)
            return points, (
                image,
                class_image(seen, self._segmenter.class_names, self._label_set, size, where),
            )
        except MissingLabels as error:
            self._account.skips.append(Skip("labels", f"frame {image.number}", str(error)))
            return points, None


def _read_ahead(
    scans: tuple[Scan, ...], look: _Look
) -> Iterator[tuple[Scan, Points | None, tuple[Image, ClassImage] | None]]:
    """Scans with what they and their images hold, in order; files are read and decoded a few ahead, in a thread."""
    with ThreadPoolExecutor(max_workers=1) as thread:
        waiting = iter(scans)
        ahead: list[tuple[Scan, Future[tuple[Points | None, tuple[Image, ClassImage] | None]]]] = [
            (scan, thread.submit(look, scan)) for scan in islice(waiting, READ_AHEAD)
        ]
        while ahead:
            scan, reading = ahead.pop(0)
            points, classes = reading.result()
            ahead.extend((later, thread.submit(look, later)) for later in islice(waiting, 1))
            yield scan, points, classes

"""The whole flow on one page: a drive in, a trajectory and a semantic map out (Fig. 1 of the paper).

trajectory          GNSS and IMU, smoothed in batch (or the poses that came with the drive)
for every scan      deskew into the map, label from its image, fuse into the voxels
refine              buildings against vegetation, moving vehicles
"""

from __future__ import annotations

import resource
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.smoothing import Solution, smooth
from factor_graphs.trajectory import Trajectory
from gnss_sem_map import labels
from gnss_sem_map.config import Settings
from gnss_sem_map.deskew import points_in_map
from gnss_sem_map.errors import DataError
from gnss_sem_map.labelling import ClassImage, class_image, exposure_stamp, pixels_seen
from gnss_sem_map.refinement import RefinementReport, refine
from gnss_sem_map.segmentation import MissingLabels, Segmenter
from gnss_sem_map.sensor_log import Image, Points, Scan, SensorLog, Skip
from gnss_sem_map.voxel_map import MappingSettings, SemanticMap, State, VoxelMap, VoxelTable, keys_of

Progress = Callable[[str, int, int], None]
"""Called with the stage, how much of it is done, and how much there is."""

READ_AHEAD = 4


def _silent(stage: str, done: int, total: int) -> None:
    pass


@dataclass
class Account:
    """What a run did: counts, skips, and the cost of every stage."""

    counts: Counter[str] = field(default_factory=Counter)
    skips: list[Skip] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory_mb: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time everything inside as one stage."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        self.peak_memory_mb[name] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@dataclass(frozen=True, eq=False)
class Result:
    """Everything that a run made."""

    trajectory: Trajectory
    solution: Solution | None
    """How the smoother came to the trajectory; None when the poses came with the drive."""
    raw: SemanticMap
    refined: SemanticMap
    refinement: RefinementReport
    account: Account


def run(
    log: SensorLog, segmenter: Segmenter | None, settings: Settings, progress: Progress = _silent
) -> Result:
    """Trajectory, raw map and refined map of one drive.

    Without a segmenter, or without images, the map has no labels. Raises DataError when not one scan can be used,
    MeasurementError and EstimationError from the smoother.
    """
    account = Account(skips=list(log.skips))
    with account.stage("trajectory"):
        progress("trajectory", 0, 1)
        trajectory, solution = estimate_trajectory(log, settings)
        progress("trajectory", 1, 1)
    with account.stage("mapping"):
        voxels = build_map(log, trajectory, segmenter, settings, account, progress)
    with account.stage("refinement"):
        progress("refinement", 0, 1)
        refined, refinement = refine(voxels, settings.refinement)
        progress("refinement", 1, 1)
    return Result(trajectory, solution, SemanticMap.of(voxels), refined, refinement, account)


def estimate_trajectory(log: SensorLog, settings: Settings) -> tuple[Trajectory, Solution | None]:
    """The poses that came with the drive, or GNSS and IMU smoothed."""
    if log.given is not None:
        return log.given, None
    if log.imu is None or log.gnss is None or log.frame is None:
        raise DataError(f"{log.name}: found neither poses nor IMU with GNSS; expected one of them")
    solution = smooth(
        log.imu, log.gnss, log.frame, settings.trajectory, p_imu_antenna=log.calibration.p_imu_antenna
    )
    return solution.trajectory, solution


def build_map(
    log: SensorLog,
    trajectory: Trajectory,
    segmenter: Segmenter | None,
    settings: Settings,
    account: Account,
    progress: Progress = _silent,
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
    ranges = np.sqrt(np.einsum("ij,ij->i", points.xyz, points.xyz))
    valid = (ranges >= settings.nearest_m) & (ranges <= settings.farthest_m)  # False for NaN
    return points_in_map(points[valid], scan.stamp, trajectory, log.calibration.T_imu_lidar), valid


def label_points(
    log: SensorLog, trajectory: Trajectory, semantic_map: SemanticMap, settings: Settings
) -> Iterator[tuple[Scan, NDArray[np.int8], NDArray[np.bool_]]]:
    """For every usable scan, the label of each original point (-1 unknown), and whether it was removed."""
    for scan in log.scans:
        try:
            points = scan.read()
            p_map, valid = map_points(points, scan, trajectory, log, settings.mapping)
        except (DataError, MeasurementError):
            continue  # counted when the map was built
        places = semantic_map.voxels.places(keys_of(p_map, settings.mapping.voxel_size_m))
        known = valid.copy()
        known[valid] = places >= 0
        places = places[places >= 0]
        point_labels = np.full(len(valid), labels.UNLABELLED, np.int8)
        point_labels[known] = semantic_map.labels[places]
        removed = np.zeros(len(valid), np.bool_)
        removed[known] = semantic_map.states[places] == State.REMOVED
        yield scan, point_labels, removed


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

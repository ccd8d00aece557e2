"""Scans with labels: every point in the map at its own stamp, and what the images say that show it.

A thread reads and decodes files a few scans ahead.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.dynamics.image_rows import Rows
from gnss_sem_map.dynamics.visibility import share_seen_through
from gnss_sem_map.errors import DataError, WriteError
from gnss_sem_map.labels.label_set import UNLABELLED, LabelSet, open_label_set
from gnss_sem_map.labels.probabilities import KeepsLabels
from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.scans import kernels
from gnss_sem_map.scans.deskew import KNOTS_PER_S, knots_of, usable_points_in_map
from gnss_sem_map.scans.own_vehicle import reach_of_vehicle
from gnss_sem_map.scans.projection import (
    ClassImage,
    View,
    class_image,
    exposure_stamp,
    image_exposed_at,
    view_at,
    visible,
)
from gnss_sem_map.scans.thinned_sweeps import ThinnedSweeps
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import Image, Points, Scan, SensorLog, Skip
from gnss_sem_map.sensor_log.cameras import Camera
from gnss_sem_map.voxels.attribute_table import seen_of
from gnss_sem_map.voxels.voxel_map import keys_of

READ_AHEAD = 4
SAMPLED_SCANS = 8
"""So many scans tell the rows in which a LiDAR measures."""
LEAST_SEEN_THROUGH = 0.3
"""With a smaller share of returns that the scan sees up to, its points are too far apart for an image: rings have more
than 0.85, a pattern without rings 0.4 with 9000 points all around, and 0.2 with 4000."""


@dataclass(frozen=True, eq=False)
class Drive:
    """Input of the mapping; any process can work on a part of it."""

    log: SensorLog
    trajectory: Trajectory
    segmenter: Segmenter | None
    settings: Settings
    saved: Path | None = None
    """The folder of sweeps that were saved when they were read, see `pattern_sweeps`."""

    @cached_property
    def label_set(self) -> LabelSet:
        """The classes of the map."""
        return open_label_set(self.settings.classes)

    @cached_property
    def by_lidar(self) -> tuple[Drive, ...]:
        """The drive once for each of its LiDARs, with its scans alone."""
        first, *others = self.log.by_lidar
        if not others:
            return (self,)
        # the sweeps that are saved are of the first one, as all of the odometry
        return replace(self, log=first), *(replace(self, log=other, saved=None) for other in others)

    @property
    def image_rows(self) -> Rows:
        """Rows of the range images of its LiDAR, by some scans of the whole drive: for every chunk the same."""
        return self._pattern.rows

    @property
    def is_too_sparse(self) -> bool:
        """Whether points are too far apart to tell what a scan sees through, so that nothing is found to have moved."""
        return self._pattern.seen_through < LEAST_SEEN_THROUGH

    @property
    def nearest_m(self) -> float:
        """Returns nearer to its LiDAR are left out: they may be of the vehicle."""
        said = self.settings.mapping.nearest_m
        return self._pattern.reach_m if said is None else said

    @cached_property
    def _pattern(self) -> _Pattern:
        sweeps, scans = pattern_sweeps(self.log, self.saved), []
        for number in sorted(sweeps.numbers):
            with suppress(DataError):  # reported where all scans are read
                scans.append(sweeps[number].xyz)
        rows = Rows.of(scans)
        return _Pattern(rows, share_seen_through(scans, rows), reach_of_vehicle(scans))


@dataclass(frozen=True, eq=False)
class _Pattern:
    """What some scans of the whole drive tell of a LiDAR."""

    rows: Rows
    """Of the range images."""
    seen_through: float
    """The share of returns that scans see up to."""
    reach_m: float
    """How far the vehicle itself reaches."""


def pattern_sweeps(log: SensorLog, folder: Path | None = None) -> ThinnedSweeps:
    """Some sweeps of the whole drive, with all their points: they tell how a LiDAR measures."""
    numbers = range(0, len(log.scans), max(len(log.scans) // SAMPLED_SCANS, 1))
    return ThinnedSweeps(log, "pattern", _without_stamps, frozenset(numbers), folder)


def _without_stamps(points: Points) -> Points:
    return replace(points, stamps=None)


@dataclass(frozen=True, eq=False)
class LabelledScan:
    """The usable points of one scan (m of n) in the map, with the labels of its images."""

    drive: Drive
    scan: Scan
    points: Points
    """All n."""
    valid: NDArray[np.bool_]
    """(n,) mask of the usable ones."""
    keys: NDArray[np.int64]
    """(m,) the voxel of each."""
    heights: NDArray[np.uint8]
    """(m,) how high each lies in its voxel, see `VoxelMap.heights`."""
    levels: NDArray[np.int16]
    """(m,) intensities, see `voxels.attribute_table`."""
    moments_us: NDArray[np.int64]
    """(m,) when each was measured, Unix time in us; of a scan that is motion-compensated, its stamp."""
    p_map: NDArray[np.float64]
    """(m, 3) m."""
    pixels: NDArray[np.int32]
    """(m,) row of `classes` for each point, -1 if no image shows it."""
    classes: NDArray[np.uint8]
    """(p, c + 1) class probabilities, `other` last."""

    @property
    def labels(self) -> NDArray[np.int8]:
        """(m,) class that the images give each point, c for `other`, -1 if none shows it or its pixel is void."""
        of_pixel = np.append(self.classes.argmax(axis=1), UNLABELLED).astype(np.int8)  # -1 is the last
        of_pixel[:-1][~self.classes.any(axis=1)] = UNLABELLED
        return of_pixel.take(self.pixels)


def labelled_scans(drive: Drive, stats: RunStats | None = None) -> Iterator[LabelledScan]:
    """Every usable scan in time order, with its points in the map and their labels."""
    stats = stats or RunStats()
    return (seen for seen in label_each_scan(drive, drive.log.scans, stats) if seen is not None)


def label_each_scan(drive: Drive, scans: Sequence[Scan], stats: RunStats) -> Iterator[LabelledScan | None]:
    """Every scan, or None for one that cannot be used; the reason is in `stats`."""
    read, looks = _Read(drive.log, drive.segmenter, drive.settings), Looks(drive, stats)
    for scan, (points, images, skips) in prefetch(read, scans, under_way=READ_AHEAD):
        stats.skips += skips  # here, so that their order is that of the scans
        yield None if points is None else _see(drive, scan, points, images, looks, stats)


def _see(
    drive: Drive, scan: Scan, points: Points, images: Sequence[Labelled], looks: Looks, stats: RunStats
) -> LabelledScan | None:
    """Deskew one scan, find its voxels and its labels."""
    log, n, mapping = drive.log, len(points.xyz), drive.settings.mapping
    nearest_m = drive.nearest_m
    valid, keys, heights = np.zeros(n, np.bool_), np.empty(n, np.int64), np.empty(n, np.uint8)
    at = np.empty(3 * n)
    try:
        stamps, knots = knots_of(
            points, scan.stamp, drive.trajectory, log.calibration.T_imu_lidar, nearest_m, mapping.farthest_m
        )  # fmt: skip
    except MeasurementError as error:
        stats.skips.append(Skip("scan", f"frame {log.frame_of(scan)}", str(error)))
        return None
    count = kernels.place(
        points.rows, stamps, nearest_m, mapping.farthest_m, KNOTS_PER_S, knots.first, knots.poses,
        mapping.voxel_size_m, valid, keys, heights, at,
    )  # fmt: skip
    if count == 0:
        stats.skips.append(Skip("scan", f"frame {log.frame_of(scan)}", f"no usable point of {n}"))
        return None
    p_map = at[: 3 * count].reshape(-1, 3)
    pixels, classes = pooled(
        [looks.of(image, p_map) for image in images], count, len(drive.label_set.names) + 1
    )
    stats.counts["scans"] += 1
    stats.counts["points"] += n
    stats.counts["points left out"] += n - count
    stats.counts["points labelled"] += len(classes)
    stats.counts["points unlabelled"] += count - len(classes)
    if not keys[:count].all():
        keys_of(p_map, mapping.voxel_size_m)  # its error names the point
    levels, moments_us = seen_of(
        points.intensity, stamps if len(stamps) else np.array([scan.stamp]), valid, log.epoch_ns // 1000
    )
    return LabelledScan(
        drive, scan, points, valid, keys[:count], heights[:count], levels, moments_us, p_map, pixels, classes
    )


Labelled = tuple[Image, ClassImage]
Look = tuple[NDArray[np.int32], NDArray[np.uint8]]
"""The points that an image shows (p,), and their class probabilities (p, c + 1)."""


def pooled(looks: Sequence[Look], count: int, channels: int) -> Look:
    """Row of the class probabilities of each point (count,), -1 where no image shows it, and these rows.

    What several cameras show of one point is one observation, the mean of what they say: they look at one surface at
    one moment, and a network is wrong about it in all of them. Void pixels say nothing.
    """
    rows = np.full(count, -1, np.int32)
    for points, _ in looks:
        rows[points] = 0
    shown = np.flatnonzero(rows == 0)
    rows[shown] = np.arange(len(shown))
    if len(looks) == 1:
        return rows, looks[0][1]
    sums, voices = np.zeros((len(shown), channels), np.uint16), np.zeros((len(shown), 1), np.uint16)
    for points, classes in looks:
        sums[rows[points]] += classes
        voices[rows[points]] += classes.any(axis=1, keepdims=True)
    voices = np.maximum(voices, 1)
    return rows, np.asarray((sums + voices // 2) // voices, np.uint8)


class Looks:
    """What the images of a drive show of scans; each look of a camera reuses the memory of its last one."""

    def __init__(self, drive: Drive, stats: RunStats) -> None:
        self._drive, self._stats = drive, stats
        self._last: dict[str, View] = {}

    def of(self, labelled: Labelled, p_map: NDArray[np.float64]) -> Look:
        """The points in the map (m, 3) that an image shows; none for one that was exposed outside the trajectory."""
        image, classes = labelled
        calibration, labelling = self._drive.log.calibration, self._drive.settings.labelling
        exposed = exposure_stamp(image, calibration, labelling)
        try:
            view = view_at(
                exposed, self._drive.trajectory, calibration.T_imu_lidar, calibration.camera(image.camera),
                len(p_map), self._last.get(image.camera),
            )  # fmt: skip
        except MeasurementError as error:
            self._stats.skips.append(Skip("labels", f"frame {image.frame}", str(error)))
            return np.empty(0, np.int32), classes.at(np.empty(0, np.int32))
        self._last[image.camera] = view
        points, seen = visible(p_map, view, classes, labelling)
        return points, classes.at(seen)


def map_points(points: Points, scan: Scan, drive: Drive) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The finite points in range of a sweep, in the map (m, 3) m, and their mask among all points (n,)."""
    return usable_points_in_map(
        points,
        scan.stamp,
        drive.trajectory,
        drive.log.calibration.T_imu_lidar,
        drive.nearest_m,
        drive.settings.mapping.farthest_m,
    )


class _Read:
    """Reads a scan and segments its images; what is missing is returned as skips."""

    def __init__(self, log: SensorLog, segmenter: Segmenter | None, settings: Settings) -> None:
        self._log, self._segmenter = log, segmenter
        self._labelling = settings.labelling
        self._label_set = open_label_set(settings.classes)

    def __call__(self, scan: Scan) -> tuple[Points | None, list[Labelled], list[Skip]]:
        try:
            points = scan.read()
        except DataError as error:
            return None, [], [Skip("scan", f"frame {self._log.frame_of(scan)}", str(error))]
        if self._segmenter is None:
            return points, [], []
        seen = [self._labelled(camera, scan, self._segmenter) for camera in self._log.cameras]
        skips = [one for one in seen if isinstance(one, Skip)]
        return points, [one for one in seen if not isinstance(one, Skip)], skips

    def _labelled(self, camera: Camera, scan: Scan, segmenter: Segmenter) -> Labelled | Skip:
        image = image_exposed_at(scan.stamp, self._log, camera, self._labelling)
        if image is None:
            of = f" of {camera.name}" if camera.name else ""
            return Skip("labels", f"frame {self._log.frame_of(scan)}", f"no image{of} near its stamp")
        try:
            seen = segmenter.kept(image) if isinstance(segmenter, KeepsLabels) else segmenter(image)
            where = f"labels of image {image.frame}"
            return image, class_image(seen, segmenter.class_names, self._label_set, camera.image_size, where)
        except WriteError:
            raise
        except DataError as error:  # only this image has no labels
            return Skip("labels", f"frame {image.frame}", str(error))

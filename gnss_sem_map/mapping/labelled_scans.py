"""Scans with labels: every point in the map at its own stamp, and the pixel that shows it.

A thread reads and decodes files a few scans ahead.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

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
from gnss_sem_map.run_stats import RunStats
from gnss_sem_map.scans import kernels
from gnss_sem_map.scans.deskew import KNOTS_PER_S, knots_of, usable_points_in_map
from gnss_sem_map.scans.kept_sweeps import KeptSweeps
from gnss_sem_map.scans.prefetch import prefetch
from gnss_sem_map.scans.projection import (
    NEAREST_DEPTH_M,
    NO_VIEW,
    ClassImage,
    View,
    class_image,
    exposure_stamp,
    view_at,
    visible,
)
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import Image, Points, Scan, SensorLog, Skip
from gnss_sem_map.voxels.voxel_map import MappingSettings, keys_of

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
    from_lidar_odometry: bool = False
    """Whether the poses come from LiDAR odometry, so that static objects are not blurred."""

    @cached_property
    def label_set(self) -> LabelSet:
        """The classes of the map."""
        return open_label_set(self.settings.classes)

    @property
    def image_rows(self) -> Rows:
        """Rows of the range images of its LiDAR, by some scans of the whole drive: for every chunk the same."""
        return self._pattern[0]

    @property
    def is_too_sparse(self) -> bool:
        """Whether points are too far apart to tell what a scan sees through, so that nothing is found to have moved."""
        return self._pattern[1] < LEAST_SEEN_THROUGH

    @cached_property
    def scans(self) -> tuple[Scan, ...]:
        """Those of the log; what told the rows is not read again."""
        return self._kept.taking(self.log).scans

    @cached_property
    def _pattern(self) -> tuple[Rows, float]:
        """Rows of the range images, and the share of returns that scans see up to."""
        scans = _sample(self._kept.keeping(self.log).scans)
        rows = Rows.of(scans)
        return rows, share_seen_through(scans, rows)

    @cached_property
    def _kept(self) -> KeptSweeps:
        return KeptSweeps()


def _sample(scans: Sequence[Scan]) -> list[NDArray[np.float32]]:
    """The points of some scans; those that cannot be read are reported elsewhere."""
    found = []
    for scan in scans[:: max(len(scans) // SAMPLED_SCANS, 1)]:
        with suppress(DataError):
            found.append(scan.read().xyz)
    return found


@dataclass(frozen=True, eq=False)
class LabelledScan:
    """The usable points of one scan (m of n) in the map, with the labels of its image."""

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
    pixels: NDArray[np.int32]
    """(m,) row of `classes` for each point, -1 if the image does not show it."""
    classes: NDArray[np.uint8]
    """(p, c + 1) class probabilities, `other` last."""
    kept: NDArray[np.float64] | None = None
    """(m, 3) m, `p_map` if it was computed beforehand (`keep_points`)."""

    @cached_property
    def p_map(self) -> NDArray[np.float64]:
        """Positions (m, 3) m, computed on first use: the map needs only the voxel."""
        drive = self.drive
        if self.kept is not None:
            return self.kept
        return map_points(self.points, self.scan, drive.trajectory, drive.log, drive.settings.mapping)[0]

    @property
    def labels(self) -> NDArray[np.int8]:
        """(m,) class of the pixel of each point, c for `other`, -1 if the image does not show it."""
        of_pixel = np.append(self.classes.argmax(axis=1), UNLABELLED).astype(np.int8)  # -1 is the last
        return of_pixel.take(self.pixels)


def labelled_scans(
    drive: Drive, stats: RunStats | None = None, keep_points: bool = False
) -> Iterator[LabelledScan]:
    """Every usable scan in time order, with its points in the map and their labels.

    `keep_points` computes every `p_map` in the same pass, which takes less time than computing it later.
    """
    stats = stats or RunStats()
    return (seen for seen in label_each_scan(drive, drive.log.scans, stats, keep_points) if seen is not None)


def label_each_scan(
    drive: Drive, scans: Sequence[Scan], stats: RunStats, keep_points: bool = False
) -> Iterator[LabelledScan | None]:
    """Every scan, or None for one that cannot be used; the reason is in `stats`."""
    read, views = _Read(drive.log, drive.segmenter, drive.settings, stats), Views(drive, stats)
    for scan, (points, classes) in prefetch(read, scans, under_way=READ_AHEAD):
        yield None if points is None else _see(drive, scan, points, classes, views, stats, keep_points)


def _see(
    drive: Drive,
    scan: Scan,
    points: Points,
    image: tuple[Image, ClassImage] | None,
    views: Views,
    stats: RunStats,
    keep_points: bool = False,
) -> LabelledScan | None:
    """Deskew one scan, find its voxels and its labels, in one pass over its points."""
    log, n = drive.log, len(points.xyz)
    mapping, labelling = drive.settings.mapping, drive.settings.labelling
    valid, keys, heights = np.zeros(n, np.bool_), np.empty(n, np.int64), np.empty(n, np.uint8)
    p_map = np.empty(3 * n if keep_points else 0)
    try:
        stamps, knots = knots_of(
            points, scan.stamp, drive.trajectory, log.calibration.T_imu_lidar, mapping.nearest_m, mapping.farthest_m
        )  # fmt: skip
    except MeasurementError as error:
        stats.skips.append(Skip("scan", f"frame {scan.number}", str(error)))
        return None
    view = views.of(image, n)
    count, inside = kernels.place(
        points.rows, stamps, mapping.nearest_m, mapping.farthest_m, KNOTS_PER_S, knots.first, knots.poses,
        mapping.voxel_size_m, view.P, NEAREST_DEPTH_M, labelling.occlusion_columns_px // 2,
        valid, keys, heights, p_map, *view.inside, view.nearest,
    )  # fmt: skip
    if count == 0:
        stats.skips.append(Skip("scan", f"frame {scan.number}", f"no usable point of {n}"))
        return None
    pixels = np.full(count, -1, np.int32)
    classes = np.empty((0, len(drive.label_set.names) + 1), np.uint8)
    if image is not None and view is not NO_VIEW:
        looking, seen = visible(view, inside, image[1], labelling)
        classes = image[1].at(seen)
        pixels[looking] = np.arange(len(looking))
    stats.counts["scans"] += 1
    stats.counts["points"] += n
    stats.counts["points left out"] += n - count
    stats.counts["points labelled"] += len(classes)
    stats.counts["points unlabelled"] += count - len(classes)
    kept = p_map[: 3 * count].reshape(-1, 3) if keep_points else None
    seen_scan = LabelledScan(drive, scan, points, valid, keys[:count], heights[:count], pixels, classes, kept)
    if not seen_scan.keys.all():
        keys_of(seen_scan.p_map, mapping.voxel_size_m)  # its error names the point
    return seen_scan


class Views:
    """Camera views of the images of a drive, one after another; each view reuses the memory of the last."""

    def __init__(self, drive: Drive, stats: RunStats) -> None:
        self._drive, self._stats, self._last = drive, stats, NO_VIEW

    def of(self, image: tuple[Image, ClassImage] | None, n: int) -> View:
        """Camera view of an image for n points; NO_VIEW without an image, or outside the trajectory."""
        if image is None:
            return NO_VIEW
        log, trajectory = self._drive.log, self._drive.trajectory
        exposed = exposure_stamp(image[0], log.calibration, self._drive.settings.labelling)
        try:
            self._last = view_at(exposed, trajectory, log.calibration, n, over=self._last)
        except MeasurementError as error:
            self._stats.skips.append(Skip("labels", f"frame {image[0].number}", str(error)))
            return NO_VIEW
        return self._last


def map_points(
    points: Points, scan: Scan, trajectory: Trajectory, log: SensorLog, settings: MappingSettings
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The finite points in range of a sweep, in the map (m, 3) m, and their mask among all points (n,)."""
    return usable_points_in_map(
        points, scan.stamp, trajectory, log.calibration.T_imu_lidar, settings.nearest_m, settings.farthest_m
    )


class _Read:
    """Reads a scan and segments its image; what is missing is counted."""

    def __init__(
        self, log: SensorLog, segmenter: Segmenter | None, settings: Settings, stats: RunStats
    ) -> None:
        self._log, self._segmenter, self._stats = log, segmenter, stats
        self._within_s = settings.labelling.image_within_s
        self._label_set = open_label_set(settings.classes)

    def __call__(self, scan: Scan) -> tuple[Points | None, tuple[Image, ClassImage] | None]:
        try:
            points = scan.read()
        except DataError as error:
            self._stats.skips.append(Skip("scan", f"frame {scan.number}", str(error)))
            return None, None
        size = self._log.calibration.image_size
        if self._segmenter is None or size is None or not self._log.images:
            return points, None
        image = self._log.image_at(scan.stamp, self._within_s)
        if image is None:
            self._stats.skips.append(Skip("labels", f"frame {scan.number}", "no image near its stamp"))
            return points, None
        try:
            where = f"labels of image {image.number}"
            seen = (
                self._segmenter.kept(image)
                if isinstance(self._segmenter, KeepsLabels)
                else self._segmenter(image)
            )
            names = self._segmenter.class_names
            return points, (image, class_image(seen, names, self._label_set, size, where))
        except WriteError:
            raise
        except DataError as error:  # only this image has no labels
            self._stats.skips.append(Skip("labels", f"frame {image.number}", str(error)))
            return points, None

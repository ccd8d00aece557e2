"""Scans with what their images show of them: every point in the map at its own stamp, and the pixel that saw it.

Files are read and decoded a few scans ahead, in a thread.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError, WriteError
from gnss_sem_map.labels.label_set import UNLABELLED, LabelSet, open_label_set
from gnss_sem_map.labels.probabilities import KeepsLabels
from gnss_sem_map.run_stats import RunStats
from gnss_sem_map.scans import kernels
from gnss_sem_map.scans.deskew import KNOTS_PER_S, knots_of, usable_points_in_map
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


@dataclass(frozen=True, eq=False)
class Drive:
    """Everything that mapping needs to know; any process can work on a part of it."""

    log: SensorLog
    trajectory: Trajectory
    segmenter: Segmenter | None
    settings: Settings
    moving: Mapping[int, NDArray[np.int64]] | None = None
    """Frame number -> places, among the points that `map_points` gives, that belong to something that moved."""
    matched: bool = False
    """Whether the trajectory was bound by matching these scans: what stands, then stands still in the map."""

    @cached_property
    def label_set(self) -> LabelSet:
        """The classes of the map."""
        return open_label_set(self.settings.classes)


@dataclass(frozen=True, eq=False)
class LabelledScan:
    """The usable points of one scan (m of n), in the map, with what its image shows of them."""

    drive: Drive
    scan: Scan
    points: Points
    """All n."""
    valid: NDArray[np.bool_]
    """(n,) which of them are used."""
    keys: NDArray[np.int64]
    """(m,) the voxel of each."""
    pixels: NDArray[np.int32]
    """(m,) row of `classes` that each point saw, -1 for none."""
    classes: NDArray[np.uint8]
    """(p, c + 1) class probabilities, `other` last."""
    kept: NDArray[np.float64] | None = None
    """(m, 3) m, `p_map` if it was asked for beforehand."""

    @cached_property
    def p_map(self) -> NDArray[np.float64]:
        """(m, 3) m, where each is: found when it is asked for, for the map needs no more than the voxel."""
        drive = self.drive
        if self.kept is not None:
            return self.kept
        return map_points(self.points, self.scan, drive.trajectory, drive.log, drive.settings.mapping)[0]

    @property
    def labels(self) -> NDArray[np.int8]:
        """(m,) class of the pixel that each point saw, c for `other`, -1 where it saw none."""
        of_pixel = np.append(self.classes.argmax(axis=1), UNLABELLED)  # -1 is the last
        return np.asarray(of_pixel[self.pixels], np.int8)


def labelled_scans(
    drive: Drive, account: RunStats | None = None, keep_points: bool = False
) -> Iterator[LabelledScan]:
    """Every usable scan in time order, with its points in the map and what its image shows of them.

    `keep_points` finds every `p_map` on the way, which takes less time than asking for it later.
    """
    account = account or RunStats()
    return (seen for seen in look_at(drive, drive.log.scans, account, keep_points) if seen is not None)


def look_at(
    drive: Drive, scans: Sequence[Scan], account: RunStats, keep_points: bool = False
) -> Iterator[LabelledScan | None]:
    """Every scan, or None for one that cannot be used; why is in the account."""
    look, views = _Look(drive.log, drive.segmenter, drive.settings, account), Views(drive, account)
    for scan, (points, classes) in prefetch(look, scans, under_way=READ_AHEAD):
        yield None if points is None else _see(drive, scan, points, classes, views, account, keep_points)


def _see(
    drive: Drive,
    scan: Scan,
    points: Points,
    image: tuple[Image, ClassImage] | None,
    views: Views,
    account: RunStats,
    keep_points: bool = False,
) -> LabelledScan | None:
    """Everything between reading a scan and fusing it, in one pass over its points."""
    log, n = drive.log, len(points.xyz)
    mapping, labelling = drive.settings.mapping, drive.settings.labelling
    valid, keys, p_map = np.zeros(n, np.bool_), np.empty(n, np.int64), np.empty(3 * n if keep_points else 0)
    try:
        stamps, knots = knots_of(
            points, scan.stamp, drive.trajectory, log.calibration.T_imu_lidar, mapping.nearest_m, mapping.farthest_m
        )  # fmt: skip
    except MeasurementError as error:
        account.skips.append(Skip("scan", f"frame {scan.number}", str(error)))
        return None
    view = views.of(image, n)
    count, inside = kernels.place(
        points.rows, stamps, mapping.nearest_m, mapping.farthest_m, KNOTS_PER_S, knots.first, knots.poses,
        mapping.voxel_size_m, view.P, NEAREST_DEPTH_M, labelling.occlusion_columns_px // 2,
        valid, keys, p_map, *view.inside, view.nearest,
    )  # fmt: skip
    if count == 0:
        account.skips.append(Skip("scan", f"frame {scan.number}", f"no usable point of {n}"))
        return None
    pixels = np.full(count, -1, np.int32)
    classes = np.empty((0, len(drive.label_set.names) + 1), np.uint8)
    if image is not None and view is not NO_VIEW:
        looking, seen = visible(view, inside, image[1], labelling)
        classes = image[1].at(seen)
        pixels[looking] = np.arange(len(looking))
    account.counts["scans"] += 1
    account.counts["points"] += n
    account.counts["points left out"] += n - count
    account.counts["points labelled"] += len(classes)
    account.counts["points unlabelled"] += count - len(classes)
    kept = p_map[: 3 * count].reshape(-1, 3) if keep_points else None
    seen_scan = LabelledScan(drive, scan, points, valid, keys[:count], pixels, classes, kept)
    if not seen_scan.keys.all():
        keys_of(seen_scan.p_map, mapping.voxel_size_m)  # says which point it is
    return seen_scan


class Views:
    """From where the images of a drive looked at its scans, one after another: each view is written over the last."""

    def __init__(self, drive: Drive, account: RunStats) -> None:
        self._drive, self._account, self._last = drive, account, NO_VIEW

    def of(self, image: tuple[Image, ClassImage] | None, n: int) -> View:
        """From where an image looked at n points; NO_VIEW without one, or where the trajectory does not reach."""
        if image is None:
            return NO_VIEW
        log, trajectory = self._drive.log, self._drive.trajectory
        exposed = exposure_stamp(image[0], log.calibration, self._drive.settings.labelling)
        try:
            self._last = view_at(exposed, trajectory, log.calibration, n, over=self._last)
        except MeasurementError as error:
            self._account.skips.append(Skip("labels", f"frame {image[0].number}", str(error)))
            return NO_VIEW
        return self._last


def map_points(
    points: Points, scan: Scan, trajectory: Trajectory, log: SensorLog, settings: MappingSettings
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The points of a sweep that are finite and in range, in the map (m, 3) m, and which of all those are (n,)."""
    return usable_points_in_map(
        points, scan.stamp, trajectory, log.calibration.T_imu_lidar, settings.nearest_m, settings.farthest_m
    )


class _Look:
    """What a scan's image shows: read, segmented, and counted when there is nothing to see."""

    def __init__(
        self, log: SensorLog, segmenter: Segmenter | None, settings: Settings, account: RunStats
    ) -> None:
        self._log, self._segmenter, self._account = log, segmenter, account
        self._within_s = settings.labelling.image_within_s
        self._label_set = open_label_set(settings.classes)

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
            seen = (
                self._segmenter.kept(image)
                if isinstance(self._segmenter, KeepsLabels)
                else self._segmenter(image)
            )
            names = self._segmenter.class_names
            return points, (image, class_image(seen, names, self._label_set, size, where))
        except WriteError:
            raise
        except DataError as error:  # of this one image; the others have theirs
            self._account.skips.append(Skip("labels", f"frame {image.number}", str(error)))
            return points, None

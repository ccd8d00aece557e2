"""Scans as evidence for motion: what `dynamics` needs to know of a scan with labels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError
from gnss_sem_map.dynamics.observation import NearPoints, Observation, observe
from gnss_sem_map.dynamics.sweep_delays import SweepDelays
from gnss_sem_map.dynamics.visibility import THREADS, RangeImage
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.labels.roles import MOVABLE
from gnss_sem_map.mapping.labelled_scans import Drive, LabelledScan, map_points
from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.scans.deskew import EXTRAPOLATE_S
from gnss_sem_map.sensor_log import Scan


def movable_and_known(
    shown: NDArray[np.int8], label_set: LabelSet
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of the points that the image labels as movable (n,), and of those that it labels at all (n,).

    `shown` (n,) as `LabelledScan.labels`. The class `other` may be a pole or a pedestrian, so it counts as unknown.
    """
    count = len(label_set.names)
    # of every class, of `other`, and, as the last, of what is not in an image
    is_movable = np.isin(np.arange(count + 2), label_set.having(*MOVABLE))
    return is_movable.take(shown), (shown >= 0) & (shown < count)


def observe_scan(seen: LabelledScan) -> tuple[Observation, NearPoints]:
    """A scan as evidence for motion.

    Objects outside of all images are tracked too, but count as moving only if they were displaced.
    """
    drive, scan, stamps = seen.drive, seen.scan, seen.points.stamps
    T_map_lidar = _lidar_pose(drive, scan)
    delays = None
    if stamps is not None:
        delays = SweepDelays.of(seen.points.xyz, stamps, seen.valid, T_map_lidar[:3, :3], scan.stamp)
    return observe(
        scan.number, scan.stamp, seen.p_map, T_map_lidar,
        *movable_and_known(seen.labels, drive.label_set), drive.settings.dynamics, drive.image_rows, delays,
    )  # fmt: skip


def range_images(drive: Drive, scans: Sequence[Scan]) -> list[RangeImage]:
    """Range images of all usable scans; the others are counted where they are mapped."""

    def draw(scan: Scan) -> RangeImage | None:
        try:
            points = scan.read()
            p_map, _ = map_points(points, scan, drive)
        except (DataError, MeasurementError):
            return None
        return RangeImage.of(p_map, _lidar_pose(drive, scan), drive.image_rows) if len(p_map) else None

    return [image for _, image in prefetch(draw, scans, THREADS) if image is not None]


def _lidar_pose(drive: Drive, scan: Scan) -> NDArray[np.float64]:
    T_map_imu = drive.trajectory.at(np.array([scan.stamp]), EXTRAPOLATE_S)[0]
    return np.asarray(T_map_imu @ drive.log.calibration.T_imu_lidar, np.float64)

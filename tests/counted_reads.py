"""Logs that count how often each of their scans is read."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import Calibration, Points, Scan, SensorLog

TIMED, DAMAGED = 3, 4
"""Of `five_sweeps`, the one whose points have stamps, and the one that cannot be read."""


def counted(log: SensorLog) -> tuple[SensorLog, Counter[int]]:
    """The log, and how often each of its scans was read, by number."""
    reads: Counter[int] = Counter()

    def read(scan: Scan) -> Points:
        reads[scan.number] += 1
        return scan.read()

    return replace(log, scans=tuple(replace(scan, read=partial(read, scan)) for scan in log.scans)), reads


def five_sweeps() -> tuple[SensorLog, Counter[int]]:
    """A log of five small sweeps, the first coordinate of each its number, and how often each was read."""
    scans = tuple(Scan(f"{i}", i, 0.1 * i, partial(points_of, i)) for i in range(5))
    standing = Trajectory(np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)))
    return counted(SensorLog("drive", 0, Calibration(np.eye(4)), scans, (), given=standing))


def points_of(number: int) -> Points:
    """What one of them holds; raises DataError for the damaged one."""
    if number == DAMAGED:
        raise DataError(f"{number}.bin: truncated scan")
    random = np.random.default_rng(number)
    rows = random.uniform(-80.0, 80.0, (60, 4)).astype(np.float32)
    rows[0, 0] = number
    stamps = np.sort(random.uniform(0.0, 0.1, 60)) if number == TIMED else None
    return Points(rows[:, :3], rows[:, 3], stamps)

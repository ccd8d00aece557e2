"""Sweeps that two stages of a run need: what the first one has read, the second one takes, so each is read once."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from threading import Lock

from gnss_sem_map.sensor_log import Points, Scan, SensorLog

MOST_KEPT = 64
"""Sweeps in memory: 160 MB of an HDL-64E; others are read again."""


class KeptSweeps:
    """Sweeps by their stamp; threads may read at the same time."""

    def __init__(self) -> None:
        self._kept: dict[float, Points] = {}
        self._locks: defaultdict[float, Lock] = defaultdict(Lock)

    def keeping(self, log: SensorLog) -> SensorLog:
        """The log, with sweeps that are kept when they are read."""
        return _with_reader(log, self._keep)

    def taking(self, log: SensorLog) -> SensorLog:
        """The log, with sweeps that are read only if they are not kept; afterwards they are kept no longer."""
        return _with_reader(log, self._take)

    def forget(self) -> None:
        """Let go of those that nobody has taken."""
        self._kept.clear()

    def _keep(self, scan: Scan) -> Points:
        with self._locks[scan.stamp]:
            points = self._kept.get(scan.stamp)
            if points is None:
                points = scan.read()
                if len(self._kept) < MOST_KEPT:
                    self._kept[scan.stamp] = points
            return points

    def _take(self, scan: Scan) -> Points:
        points = self._kept.pop(scan.stamp, None)
        return scan.read() if points is None else points


def _with_reader(log: SensorLog, read: Callable[[Scan], Points]) -> SensorLog:
    return replace(log, scans=tuple(replace(scan, read=partial(read, scan)) for scan in log.scans))

"""What a run will take, before it is started: the constants of docs/scale.md, for the scans of this drive."""

from __future__ import annotations

from dataclasses import dataclass

CPU_MS_PER_SCAN = 90.4
"""Of a core, with labels from files, for the points of `POINTS_PER_SCAN`."""
POINTS_PER_SCAN = 105_000
PEAK_MB = 841
"""Of a process that maps."""
TRAJECTORY_MB_PER_HOUR = 1100
"""Of the process that smooths, beside that."""


@dataclass(frozen=True)
class Expected:
    """Time and memory that a run is expected to take."""

    seconds: float
    memory_mb: float
    """Of all its processes."""


def expected_cost(scans: int, points_per_scan: float, hours: float, workers: int) -> Expected:
    """Cost of mapping so many scans; the time of a network that segments images is not in it."""
    seconds = scans * CPU_MS_PER_SCAN / 1000 * points_per_scan / POINTS_PER_SCAN / workers
    processes = 1 if workers == 1 else 1 + workers
    return Expected(seconds, processes * PEAK_MB + hours * TRAJECTORY_MB_PER_HOUR)

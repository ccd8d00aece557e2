"""LiDAR sweeps: stamps, points, times of points, and the motion that they see against the trajectory."""

from __future__ import annotations

from collections.abc import Iterator

from gnss_sem_map.preflight import extrinsics, point_times, sweep_stamps
from gnss_sem_map.preflight.findings import Finding
from gnss_sem_map.preflight.sample import Sample


def check(sample: Sample) -> Iterator[Finding]:
    """Stamps first, which cost nothing; then a few seconds of scans."""
    if not sample.log.scans:
        return
    yield from sweep_stamps.check(sample)
    yield from point_times.check(sample)
    yield from extrinsics.check(sample)

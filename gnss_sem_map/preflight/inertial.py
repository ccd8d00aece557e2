"""IMU against physics and against the course of the fixes."""

from __future__ import annotations

from collections.abc import Iterator

from gnss_sem_map.preflight.findings import Finding
from gnss_sem_map.preflight.sample import Sample


def check(sample: Sample) -> Iterator[Finding]:
    """Nothing is checked yet."""
    yield from ()

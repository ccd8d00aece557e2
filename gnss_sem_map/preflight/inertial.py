"""IMU against physics and against the course of the fixes: units, turn rates, axes, mounting."""

from __future__ import annotations

from collections.abc import Iterator

from gnss_sem_map.preflight.findings import Finding
from gnss_sem_map.preflight.sample import Sample


def check(sample: Sample) -> Iterator[Finding]:
    """Findings about the IMU; none where poses are given."""
    if sample.diagnosis is not None:
        yield from sample.diagnosis.findings

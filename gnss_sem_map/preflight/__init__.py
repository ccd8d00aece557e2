"""The pre-flight: a log tested against physics, and its sensors against each other, before any work.

`check` runs every check of this folder on a small sample of the drive. Every wrong sensor convention that we know makes
one of them amber or red, and the finding names the probable mistake and the line that mends it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

from gnss_sem_map.config import Settings
from gnss_sem_map.preflight import camera, inertial, positions, sweeps
from gnss_sem_map.preflight.findings import Finding, Preflight, page_of
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import SensorLog


def check(log: SensorLog, settings: Settings, segmenter: Segmenter | None = None) -> Preflight:
    """Every check that the sensors of a drive allow; raises nothing for what it finds wrong."""
    start = time.perf_counter()
    findings = tuple(_findings(Sample(log.in_our_conventions(settings.sensors), settings, segmenter)))
    return page_of(findings, time.perf_counter() - start)


def _findings(sample: Sample) -> Iterator[Finding]:
    yield from inertial.check(sample)
    yield from positions.check(sample)
    yield from sweeps.check(sample)
    yield from camera.check(sample)

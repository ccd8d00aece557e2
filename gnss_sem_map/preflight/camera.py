"""The camera: its matrix, its images' size and clock, then depth edges against image edges, and labels likewise."""

from __future__ import annotations

from collections.abc import Iterator

from gnss_sem_map.preflight import camera_matrix, camera_pose, image_files, labels
from gnss_sem_map.preflight.findings import Finding
from gnss_sem_map.preflight.sample import Sample


def check(sample: Sample) -> Iterator[Finding]:
    """What costs nothing first; a camera that cannot be used is not looked through."""
    log = sample.log
    if not log.images or not log.calibration.has_camera:
        return
    matrix = camera_matrix.check(log.calibration)
    yield matrix
    files = image_files.check(sample)
    yield from files
    if not any(finding.mistake for finding in files):
        yield from camera_pose.check(sample)
    yield from labels.check(sample)

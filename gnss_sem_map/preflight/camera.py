"""Checks of the cameras: matrix, image size, clock; then depth edges against edges of images and labels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.preflight import camera_matrix, camera_pose, image_files, labels
from gnss_sem_map.preflight.camera_sample import CameraSample
from gnss_sem_map.preflight.findings import Finding, Level
from gnss_sem_map.preflight.sample import Sample


def check(sample: Sample) -> Iterator[Finding]:
    """Every camera that has images; with several, findings name theirs."""
    if sample.log.cameras:
        yield from labels.check_names(sample.segmenter, open_label_set(sample.settings.classes))
    for camera in sample.log.cameras:
        for finding in _check(CameraSample(sample, camera)):
            yield replace(finding, check=f"{camera.name}: {finding.check}") if camera.name else finding


def _check(sample: CameraSample) -> Iterator[Finding]:
    """Cheap checks first; the images of an unusable camera are not checked."""
    size, files = image_files.check(sample)
    matrix = camera_matrix.check(sample.camera, size)
    yield from (matrix, *files)
    if any(finding.level is Level.RED for finding in (matrix, *files)):
        return  # what is wrong there is wrong all over the image
    pose = tuple(camera_pose.check(sample))
    yield from pose
    # where the camera is wrong, right labels do not fit the scans either
    yield from labels.check(sample, against_lidar=all(finding.level is Level.GREEN for finding in pose))

"""Checks of image files: size as in the calibration, stamps close to those of the scans."""

from __future__ import annotations

import numpy as np

from gnss_sem_map.errors import DataError, ImageSizeError
from gnss_sem_map.preflight.camera_sample import CameraSample
from gnss_sem_map.preflight.findings import ONE_CLOCK, Finding, amber, green, red

SIZE, CLOCK = "image size", "image stamps"
LOOKED_AT = 3


def check(sample: CameraSample) -> tuple[tuple[int, int], tuple[Finding, ...]]:
    """A few files, all stamps; and the (width, height) that the images really have."""
    size, found = _size(sample)
    return size, (found, _clock(sample))


def _size(sample: CameraSample) -> tuple[tuple[int, int], Finding]:
    size = sample.camera.image_size
    errors: list[DataError] = []
    images = sample.images[:: max(1, len(sample.images) // LOOKED_AT)][:LOOKED_AT]
    for image in images:
        try:
            sample.pixels(image)
        except DataError as error:
            errors.append(error)
    wrong = next((error for error in errors if isinstance(error, ImageSizeError)), None)
    if wrong is not None:
        width, height = wrong.found
        ratio = width / size[0]
        return wrong.found, red(
            SIZE,
            f"images are {width} x {height}, the calibration is of {size[0]} x {size[1]} pixels",
            f"the calibration's image size (S_rect, image_size) is {1 / ratio:.3g} times that of the images:"
            " every image would be left out",
            f"set S_rect_02 or image_size to {width} {height}, or give the images that were calibrated",
        )
    if errors:
        return size, (red if len(errors) == len(images) else amber)(
            SIZE, f"{len(errors)} of {len(images)} images cannot be read: {errors[0]}", "image files are damaged",
            "copy the images again",
        )  # fmt: skip
    return size, green(SIZE, f"{size[0]} x {size[1]} pixels")


def _clock(sample: CameraSample) -> Finding:
    """Whether there are images at the time of the scans."""
    log, images, settings = sample.drive.log, sample.images, sample.drive.settings.labelling
    if not log.scans:
        return green(CLOCK, f"{len(images)} images, no scans")
    scans = np.array([scan.stamp for scan in log.scans])
    exposed = np.array([sample.exposed(image) for image in images])
    after = np.searchsorted(exposed, scans)
    nearest = np.minimum(
        np.abs(exposed[np.maximum(after - 1, 0)] - scans),
        np.abs(exposed[np.minimum(after, len(exposed) - 1)] - scans),
    )
    share = float((nearest <= settings.image_within_s).mean())
    found = (
        f"{share:.0%} of the scans have an image within {settings.image_within_s:g} s;"
        f" images are of {exposed[0]:.1f} to {exposed[-1]:.1f} s, scans of {scans[0]:.1f} to {scans[-1]:.1f} s"
    )
    overlap = min(exposed[-1], scans[-1]) - max(exposed[0], scans[0])
    shorter = min(np.ptp(exposed), np.ptp(scans))
    if share == 0.0 or overlap < 0.5 * shorter:
        return red(
            CLOCK, found,
            f"image stamps are of another clock, about {exposed[0] - scans[0]:+.1f} s off, or of another drive",
            ONE_CLOCK,
        )  # fmt: skip
    inside = (scans >= exposed[0] - 0.1) & (scans <= exposed[-1] + 0.1)
    if inside.any() and float((nearest[inside] <= 2 * settings.image_within_s).mean()) < 0.5:
        return amber(
            CLOCK, found, "few images are of the time of a scan: images are rare, or their clock drifts",
            "set labelling.image_within_s, or correct the image stamps",
        )  # fmt: skip
    return green(CLOCK, found)

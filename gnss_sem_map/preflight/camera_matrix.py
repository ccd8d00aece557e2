"""Check of the camera matrix K: plausible, and for images of this size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.sensor_log.cameras import Camera

Array = NDArray[np.float64]
NAME = "K"
SAME_FOCAL = 0.1
"""Pixels are square to a few percent: fx and fy differ by no more than this part."""
MOST_SKEW = 0.02
CENTRE, FAR_OFF = (0.3, 0.7), (0.15, 0.85)
"""Where the principal point lies in an image, as parts of its width and height; cropped images reach the second."""
VIEW_DEG = (15.0, 150.0)
"""Widths of view of a camera that is no fisheye."""


def check(camera: Camera, size: tuple[int, int]) -> Finding:
    """Figures of K, for images of (width, height)."""
    bends = camera.distortion is not None and camera.distortion.model != "brown"
    return _form(camera.K) or _of_images(camera.K, size, bends)


def _form(K: Array) -> Finding | None:
    """What is wrong with K as a camera matrix, whatever the images; None if nothing is."""
    fx, fy = float(K[0, 0]), float(K[1, 1])
    if not np.allclose(K[2], (0, 0, 1), atol=1e-6) or abs(K[1, 0]) > MOST_SKEW * fx:
        return red(
            NAME,
            f"found {np.round(K, 4).tolist()}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
            "K is not a camera matrix: transposed, or its numbers in another order",
            "give K as [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], px",
        )
    if abs(K[0, 1]) > MOST_SKEW * fx:
        return amber(
            NAME,
            f"found a skew of {K[0, 1]:.4g} px at fx {fx:.4g}",
            "K has a skew, cameras have none",
            "set the skew in K to 0",
        )
    if abs(np.log(fx / fy)) > SAME_FOCAL:
        return red(
            NAME,
            f"found fx {fx:.4g} and fy {fy:.4g} px, expected about the same",
            "fx and fy of K differ: pixels are square",
            "check fx and fy of K",
        )
    return None


def _of_images(K: Array, size: tuple[int, int], bends: bool) -> Finding:
    """Whether focal length and principal point are those of images of (width, height).

    Where the lens `bends`, the focal length is that of its axis, and tells no width of view.
    """
    fx = float(K[0, 0])
    centre = np.array([K[0, 2] / size[0], K[1, 2] / size[1]])
    view = float(np.degrees(2 * np.arctan(size[0] / (2 * fx))))
    sees = "" if bends else f" sees {view:.0f} deg"
    found = (
        f"fx {fx:.4g} px{sees}; the principal point is at {centre[0]:.2f} of the width,"
        f" {centre[1]:.2f} of the height"
    )
    if ((centre < CENTRE[0]) | (centre > CENTRE[1])).all() and centre.max() - centre.min() < 0.1 * max(
        1.0, centre.max()
    ):
        factor = 0.5 / float(centre.mean())
        what = "half the size (K halved)" if 1.6 < factor < 2.5 else f"{1 / factor:.2g} times the size"
        return red(
            NAME,
            found,
            f"principal point off the centre: K is of images of {what}",
            f"multiply fx, fy, cx and cy by {factor:.2g}",
        )
    if ((centre < FAR_OFF[0]) | (centre > FAR_OFF[1])).any():
        return amber(
            NAME,
            found,
            "principal point at the edge: K is of other images, or its numbers in another order",
            "check cx and cy of K, and the size of the images",
        )
    if not bends and not VIEW_DEG[0] <= view <= VIEW_DEG[1]:
        return amber(
            NAME,
            found,
            "the focal length is of another image size, or not in pixels",
            "give fx and fy in pixels",
        )
    return green(NAME, found)

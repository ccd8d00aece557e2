"""A small renderer for voxels: every cube is drawn exactly, its edges darkened by eye-dome lighting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

NEAREST_M = 0.5
"""What is nearer to the eye is not drawn."""
FAR = 1e6
"""Stands for infinitely far where differences are taken."""
FACE_LIGHT = np.array([0.80, 0.68, 1.0], np.float32)
"""How bright faces across x, y and z are: light from above and a little from the side."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera that stands at `eye` and looks at `target`, both (3,) m in the map frame, head up."""

    eye: NDArray[np.float64]
    target: NDArray[np.float64]
    width_px: int
    height_px: int
    field_of_view_deg: float
    """Across the width."""

    @property
    def focal_px(self) -> float:
        """Distance from the eye to the image plane, in pixels."""
        return 0.5 * self.width_px / float(np.tan(np.radians(self.field_of_view_deg) / 2))

    @property
    def axes(self) -> NDArray[np.float64]:
        """Rows: right, down, forward; unit vectors in the map frame. Looking straight up or down has no right."""
        forward = (self.target - self.eye) / np.linalg.norm(self.target - self.eye)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])


@dataclass(frozen=True, eq=False)
class Picture:
    """What every pixel (h, w) sees."""

    depth: NDArray[np.float32]
    """m along the viewing axis, infinite where there is nothing."""
    cube: NDArray[np.int32]
    """Number of the cube, -1 where there is nothing."""
    face: NDArray[np.int8]
    """The axis across which the visible face lies: 0 x, 1 y, 2 z."""


def draw_cubes(centres: NDArray[np.float64], half_m: NDArray[np.float64], camera: Camera) -> Picture:
    """Draw axis-aligned cubes: centres (n, 3) m, half edges (n,) m; the nearest wins every pixel."""
    shape = (camera.height_px, camera.width_px)
    picture = Picture(
        np.full(shape, np.inf, np.float32), np.full(shape, -1, np.int32), np.zeros(shape, np.int8)
    )
    seen = centres - camera.eye
    near_first = np.argsort(seen @ camera.axes[2], kind="stable")  # what is hidden then costs little
    buffers = (picture.depth, picture.cube, picture.face)
    _draw(seen, half_m, near_first, camera.axes, camera.focal_px, *buffers)
    return picture


@njit(cache=True, nogil=True)
def _draw(centres, half, order, axes, focal, depth, cube, face):
    """Ray against box (slabs) for all pixels of every cube's bounding square; rays have forward component 1."""
    height, width = depth.shape
    for i in order:
        c, h = centres[i], half[i]
        forward = axes[2, 0] * c[0] + axes[2, 1] * c[1] + axes[2, 2] * c[2]
        reach = 1.7320508 * h
        if forward < NEAREST_M + reach:
            continue
        right = axes[0, 0] * c[0] + axes[0, 1] * c[1] + axes[0, 2] * c[2]
        down = axes[1, 0] * c[0] + axes[1, 1] * c[1] + axes[1, 2] * c[2]
        scale, spread = focal / forward, reach * focal / (forward - reach)
        u, v = 0.5 * width + scale * right, 0.5 * height + scale * down
        for row in range(max(0, int(v - spread)), min(height, int(v + spread) + 1)):
            for column in range(max(0, int(u - spread)), min(width, int(u + spread) + 1)):
                if depth[row, column] <= forward - reach:
                    continue
                x, y = (column + 0.5 - 0.5 * width) / focal, (row + 0.5 - 0.5 * height) / focal
                enter, leave, side = 0.0, np.inf, 0
                for k in range(3):
                    ray = x * axes[0, k] + y * axes[1, k] + axes[2, k]
                    if ray == 0.0:
                        if abs(c[k]) > h:
                            leave = -1.0
                        continue
                    a, b = (c[k] - h) / ray, (c[k] + h) / ray
                    if a > b:
                        a, b = b, a
                    if a > enter:
                        enter, side = a, k
                    leave = min(leave, b)
                if enter <= leave and enter < depth[row, column]:
                    depth[row, column], cube[row, column], face[row, column] = enter, i, side


def hollows(depth: NDArray[np.float32], reach: int, most: float) -> NDArray[np.float32]:
    """How much nearer to the eye the four neighbours at `reach` pixels are, on average, each from 0 to `most`.

    The measure behind eye-dome lighting (Boucheny 2009), with one ring of four. `depth` (h, w) is infinite or NaN
    where nothing is.
    """
    found = np.empty(depth.shape, np.float32)
    _hollows(np.nan_to_num(depth, nan=FAR, posinf=FAR), reach, np.float32(most), found)
    return found


def lit(
    picture: Picture,
    rgb: NDArray[np.float32],
    sky: NDArray[np.float32],
    distance: float,
    hollow: NDArray[np.float32],
    supersampling: int,
) -> NDArray[np.float32]:
    """The picture in colour, (h / s, w / s, 3) from 0 to 255: every pixel the mean of s x s, s for `supersampling`.

    `rgb` (n, 3) are the cubes' colours, lit by their faces and darker in hollows; `sky` (h, 3) is what every row fades
    into from `distance` m on. Rows of `hollow` (k, 3): reach in pixels, strength, and the most that counts, all in log
    depth.
    """
    height, width = picture.depth.shape
    image = np.zeros((height // supersampling, width // supersampling, 3), np.float32)
    log_depth = np.log(np.minimum(picture.depth, np.float32(FAR)))
    _light(
        picture.depth, log_depth, picture.cube, picture.face, rgb, sky, np.float32(distance), hollow, image
    )
    image /= supersampling**2
    return image


@njit(cache=True, nogil=True)
def _hollows(depth, reach, most, found):
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            found[row, column] = _hollow(depth, row, column, reach, most)


@njit(cache=True, nogil=True)
def _hollow(depth, row, column, reach, most):
    """What `hollows` says of one pixel; beyond the edges the outermost pixels repeat."""
    here, total = depth[row, column], np.float32(0)
    total += min(max(here - depth[max(row - reach, 0), column], np.float32(0)), most)
    total += min(max(here - depth[min(row + reach, depth.shape[0] - 1), column], np.float32(0)), most)
    total += min(max(here - depth[row, max(column - reach, 0)], np.float32(0)), most)
    total += min(max(here - depth[row, min(column + reach, depth.shape[1] - 1)], np.float32(0)), most)
    return total / np.float32(4)


@njit(cache=True, nogil=True)
def _light(depth, log_depth, cube, face, rgb, sky, distance, hollow, image):
    """Compiled, and all of a pixel at once: whole arrays of each step would take eight times as long."""
    supersampling = depth.shape[0] // image.shape[0]
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            shadow = np.float32(0)
            for k in range(len(hollow)):
                reach, strength, most = hollow[k]
                shadow += strength * _hollow(log_depth, row, column, int(reach), most)
            light = FACE_LIGHT[face[row, column]] * np.exp(-shadow)
            clear = np.exp(min(distance - depth[row, column], np.float32(0)) / (4 * distance))
            for channel in range(3):
                colour = light * rgb[cube[row, column], channel]
                seen = sky[row, channel] + clear * (colour - sky[row, channel])
                image[row // supersampling, column // supersampling, channel] += seen

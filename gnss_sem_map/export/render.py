"""A small renderer for voxels: every cube is drawn exactly, its edges darkened by eye-dome lighting."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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

    @cached_property
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

    @classmethod
    def empty(cls, camera: Camera) -> Picture:
        """The picture of a camera that sees nothing yet."""
        shape = (camera.height_px, camera.width_px)
        return cls(np.full(shape, np.inf, np.float32), np.full(shape, -1, np.int32), np.zeros(shape, np.int8))


def draw_cubes(
    picture: Picture,
    camera: Camera,
    centres: NDArray[np.float64],
    half_m: float,
    numbers: NDArray[np.int32],
    middle: NDArray[np.float64],
    reach_m: float,
) -> None:
    """Draw axis-aligned cubes into a picture of the camera; the nearest of all that are drawn wins every pixel.

    `centres` (n, 3) m, half an edge, and `numbers` (n,) for the picture; centres as far as `reach_m` from `middle`,
    (3,) m, are left out.
    """
    buffers = (picture.depth, picture.cube, picture.face)
    _draw(
        centres - camera.eye,
        half_m,
        numbers,
        middle - camera.eye,
        reach_m,
        camera.axes,
        camera.focal_px,
        *buffers,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(centres, h, numbers, middle, reach_m, axes, focal, depth, cube, face):
    """Ray against box (slabs) for all pixels that a cube may cover; rays have forward component 1."""
    height, width = depth.shape
    # half the extent of a cube to the right, down and forward
    half_right = h * (abs(axes[0, 0]) + abs(axes[0, 1]) + abs(axes[0, 2]))
    half_down = h * (abs(axes[1, 0]) + abs(axes[1, 1]) + abs(axes[1, 2]))
    half_forward = h * (abs(axes[2, 0]) + abs(axes[2, 1]) + abs(axes[2, 2]))
    across = (np.arange(width) + 0.5 - 0.5 * width) / focal
    for i in range(len(centres)):
        cx, cy, cz = centres[i, 0], centres[i, 1], centres[i, 2]
        forward = axes[2, 0] * cx + axes[2, 1] * cy + axes[2, 2] * cz
        near, far = forward - half_forward, forward + half_forward
        if near < NEAREST_M:
            continue
        if (cx - middle[0]) ** 2 + (cy - middle[1]) ** 2 + (cz - middle[2]) ** 2 >= reach_m**2:
            continue
        right = axes[0, 0] * cx + axes[0, 1] * cy + axes[0, 2] * cz
        down = axes[1, 0] * cx + axes[1, 1] * cy + axes[1, 2] * cz
        left_column, right_column = _pixels(right, half_right, near, far, focal, width)
        upper_row, lower_row = _pixels(down, half_down, near, far, focal, height)
        for row in range(upper_row, lower_row):
            y = (row + 0.5 - 0.5 * height) / focal
            for column in range(left_column, right_column):
                if depth[row, column] <= near:
                    continue
                x = across[column]
                enter_x, leave_x = _slab(cx, h, x * axes[0, 0] + y * axes[1, 0] + axes[2, 0])
                enter_y, leave_y = _slab(cy, h, x * axes[0, 1] + y * axes[1, 1] + axes[2, 1])
                enter_z, leave_z = _slab(cz, h, x * axes[0, 2] + y * axes[1, 2] + axes[2, 2])
                enter, side = enter_x, 0
                if enter_y > enter:
                    enter, side = enter_y, 1
                if enter_z > enter:
                    enter, side = enter_z, 2
                if enter <= min(leave_x, leave_y, leave_z) and enter < depth[row, column]:
                    depth[row, column], cube[row, column], face[row, column] = enter, numbers[i], side


@njit(cache=True, nogil=True, error_model="numpy")
def _slab(centre, h, ray):
    """Where a ray enters and leaves the space between two faces; infinite for a ray along them."""
    a, b = (centre - h) / ray, (centre + h) / ray
    return min(a, b), max(a, b)


@njit(cache=True, nogil=True)
def _pixels(across, half, near, far, focal, count):
    """First and end of the pixels whose rays may meet a cube that reaches `half` around `across`, from near to far."""
    low, high = across - half, across + half
    first = 0.5 * count - 0.5 + focal * low / (far if low > 0 else near)
    last = 0.5 * count - 0.5 + focal * high / (near if high > 0 else far)
    margin = 1e-6  # of rounding
    return max(0, int(np.ceil(first - margin))), min(count, int(np.floor(last + margin)) + 1)


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

    `rgb` (n, 3) are the colours of the cubes' numbers, lit by their faces and darker in hollows; `sky` (h, 3) is what
    every row fades into from `distance` m on. Rows of `hollow` (k, 3): reach in pixels, strength, and the most that
    counts, all in log depth.
    """
    height, width = picture.depth.shape
    image = np.zeros((height // supersampling, width // supersampling, 3), np.float32)
    log_depth = np.minimum(picture.depth, np.float32(FAR))
    np.log(log_depth, out=log_depth)
    _light(
        picture.depth, log_depth, picture.cube, picture.face, rgb, sky, np.float32(distance), hollow, image
    )
    image /= supersampling**2
    return image


@njit(cache=True, nogil=True)
def _hollows(depth, reach, most, found):
    found[:] = 0
    for row in range(depth.shape[0]):
        _add_hollows(depth, row, reach, np.float32(1), most, found[row])


@njit(cache=True, nogil=True)
def _add_hollows(depth, row, reach, strength, most, found):
    """Add to `found` (w,) what `hollows` says of a row, so many times; beyond the edges the outermost pixels repeat.

    The row is copied between what repeats: without a test for edges the compiler can use SIMD instructions.
    """
    height, width = depth.shape
    here, upper, lower = depth[row], depth[max(row - reach, 0)], depth[min(row + reach, height - 1)]
    beside = np.empty(width + 2 * reach, np.float32)
    beside[:reach], beside[reach : reach + width], beside[reach + width :] = here[0], here, here[-1]
    for column in range(width):
        total = min(max(here[column] - upper[column], np.float32(0)), most)
        total += min(max(here[column] - lower[column], np.float32(0)), most)
        total += min(max(here[column] - beside[column], np.float32(0)), most)
        total += min(max(here[column] - beside[column + 2 * reach], np.float32(0)), most)
        found[column] += strength * (total / np.float32(4))


@njit(cache=True, nogil=True)
def _light(depth, log_depth, cube, face, rgb, sky, distance, hollow, image):
    """Compiled, and all of a row at once: whole arrays of each step would take eight times as long."""
    supersampling, width = depth.shape[0] // image.shape[0], depth.shape[1]
    shadow = np.empty(width, np.float32)
    for row in range(depth.shape[0]):
        shadow[:] = 0
        for k in range(len(hollow)):
            reach, strength, most = hollow[k]
            _add_hollows(log_depth, row, int(reach), strength, most, shadow)
        for column in range(width):
            pixel, number = image[row // supersampling, column // supersampling], cube[row, column]
            light = FACE_LIGHT[face[row, column]] * np.exp(-shadow[column])
            beyond = depth[row, column] - distance
            clear = np.exp(-beyond / (4 * distance)) if beyond > 0 else 1.0
            for channel in range(3):
                behind = sky[row, channel]
                colour = behind if number < 0 else light * rgb[number, channel]
                pixel[channel] += behind + clear * (colour - behind)

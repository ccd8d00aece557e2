"""Compiled loops over the points of a scan: deskewing, voxel keys and projection into images (eq. 1, 3, 4).

The tests hold a numpy version of each loop.
"""

from __future__ import annotations

import numpy as np
from numba import int64, njit

from gnss_sem_map.sensor_log.cameras import ANGLE, PINHOLE
from gnss_sem_map.voxels.kernels import height_in_voxel, pack_key

COLUMNS = 4
"""Columns of a scan: x, y, z, intensity."""


@njit(cache=True, nogil=True, error_model="numpy")
def to_map(rows, stamps, nearest_m, farthest_m, knots_per_s, first_knot, poses, valid, p_map):
    """Transform the usable points of a scan into the map; returns their number m.

    `rows` (4 n,) are the points as in the file; `stamps` (n,) s, or empty for a sweep with one pose; `poses` (k, 3, 8)
    are those of knots with the rate `knots_per_s`, numbered from stamp zero: the pose (3, 4), and its difference to the
    next, of which the time since the knot tells the part. Writes `valid` (n,), the mask of the usable points, see
    `is_usable`, and `p_map` (3 m,) m, their positions.
    """
    count = 0
    for i in range(len(valid)):
        x, y, z = coordinates(rows, i)
        stamp = stamps[i] if len(stamps) > 0 else 0.0
        valid[i] = is_usable(x, y, z, stamp, nearest_m, farthest_m)
        if not valid[i]:
            continue
        knot = stamp * knots_per_s - first_knot
        k = min(max(int64(knot), 0), len(poses) - 1)
        part = knot - k
        for axis in range(3):
            T = poses[k, axis]
            moved = T[0] * x + T[1] * y + T[2] * z + T[3]
            p_map[3 * count + axis] = moved + part * (T[4] * x + T[5] * y + T[6] * z + T[7])
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def place(
    rows, stamps, nearest_m, farthest_m, knots_per_s, first_knot, poses, voxel_size_m, valid, keys, heights, p_map
):  # fmt: skip
    """Transform the usable points of a scan into the map, and find their voxels; returns their number m.

    As `to_map`, and writes the voxel `keys` (m,), 0 for a point outside of the addressable volume, and the `heights`
    (m,) of the points in their voxels.
    """
    count = to_map(rows, stamps, nearest_m, farthest_m, knots_per_s, first_knot, poses, valid, p_map)
    for i in range(count):
        x, y, z = p_map[3 * i], p_map[3 * i + 1], p_map[3 * i + 2]
        keys[i] = pack_key(x, y, z, voxel_size_m)
        heights[i] = height_in_voxel(z, voxel_size_m)
    return count


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def coordinates(rows, i):
    return np.float64(rows[COLUMNS * i]), np.float64(rows[COLUMNS * i + 1]), np.float64(rows[COLUMNS * i + 2])


@njit(cache=True, nogil=True, error_model="numpy")
def mark_usable(rows, stamps, nearest_m, farthest_m, valid):
    """Mark the usable points (n,), see `is_usable`; `stamps` (n,) s, or empty."""
    for i in range(len(valid)):
        x, y, z = coordinates(rows, i)
        valid[i] = is_usable(x, y, z, stamps[i] if len(stamps) > 0 else 0.0, nearest_m, farthest_m)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def is_usable(x, y, z, stamp, nearest_m, farthest_m):
    """Whether a point is finite and in range, and its stamp is finite.

    A point at zero is no return, whatever the range: so some drivers write that nothing came back.
    """
    square = x * x + y * y + z * z
    in_range = (square >= nearest_m * nearest_m) & (square <= farthest_m * farthest_m)
    return (square > 0) & in_range & np.isfinite(stamp)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def pixel_of(x, y, z, P, lens, nearest_depth_m):
    """Pixel u, v of a map point and its depth m; depth 0 for a point that is behind, too near, or aside of the lens.

    `P` and `lens` are those of `sensor_log.cameras.Camera`. Depth is along the axis, but for lenses that see to the
    side, where it is the distance.
    """
    a = P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]
    b = P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]
    c = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    if lens[0] == PINHOLE:
        return (a / c, b / c, c) if c > nearest_depth_m else (0.0, 0.0, 0.0)
    far, xi = np.sqrt(a * a + b * b + c * c), lens[2]
    depth = c if lens[0] != ANGLE and xi == 0.0 else far
    if not (depth > nearest_depth_m and c > lens[1] * far):
        return 0.0, 0.0, 0.0
    k1, k2, k3, k4 = lens[8], lens[9], lens[10], lens[11]
    if lens[0] == ANGLE:
        r = np.sqrt(a * a + b * b)
        angle = np.arctan2(r, c)
        q = angle * angle
        out = angle * (1.0 + q * (k1 + q * (k2 + q * (k3 + q * k4))))
        scale = out / r if r > 0.0 else 0.0
        a, b = a * scale, b * scale
    else:
        a, b = a / (c + xi * far), b / (c + xi * far)
        q = a * a + b * b
        out = 1.0 + q * (k1 + q * (k2 + q * lens[12]))
        out /= 1.0 + q * (lens[13] + q * (lens[14] + q * lens[15]))
        aside = 2.0 * a * b
        a, b = a * out + k3 * aside + k4 * (q + 2.0 * a * a), b * out + k3 * (q + 2.0 * b * b) + k4 * aside
    return lens[3] * a + lens[4] * b + lens[5], lens[6] * b + lens[7], depth


@njit(cache=True, nogil=True, error_model="numpy")
def pixels(points, P, lens, nearest_depth_m, found):
    """Pixel and depth of every point (n, 3): writes u, v, depth into `found` (n, 3), see `pixel_of`."""
    for i in range(len(points)):
        u, v, depth = pixel_of(points[i, 0], points[i, 1], points[i, 2], P, lens, nearest_depth_m)
        found[i, 0], found[i, 1], found[i, 2] = u, v, depth


@njit(cache=True, nogil=True, error_model="numpy")
def project(p_map, P, lens, nearest_depth_m, half_columns, points, columns, lines, depths, nearest):
    """Project points (3 m,) into an image (eq. 3, 4); returns the number of those inside.

    Writes the point numbers `points`, their pixels `columns` and `lines`, and `depths` m. A pixel extends from its
    number to the next. With pixel centres at integers, as in KITTI's calibration, points would move by half a pixel;
    with the labels of a real network this makes no difference (accuracy 80.22 and 80.20 %).
    `nearest` (h, w) m is the depth buffer: a point writes into its own line, `half_columns` to either side; `visible`
    takes the minimum along the columns. The window minimum is separable, so this costs only its edges.
    """
    (height, width), inside = nearest.shape, 0
    for i in range(len(p_map) // 3):
        u, v, w = pixel_of(p_map[3 * i], p_map[3 * i + 1], p_map[3 * i + 2], P, lens, nearest_depth_m)
        if not (w > 0 and u >= 0 and u < width and v >= 0 and v < height):
            continue
        column, line, depth = int64(u), int64(v), np.float32(w)
        points[inside], columns[inside], lines[inside], depths[inside] = i, column, line, depth
        inside += 1
        for c in range(max(column - half_columns, 0), min(column + half_columns + 1, width)):
            nearest[line, c] = min(nearest[line, c], depth)
    return inside


@njit(cache=True, nogil=True, error_model="numpy")
def visible(
    points, columns, lines, depths, nearest, half_lines, ratio, slack_m, line_of, column_of, class_width, pixels
):  # fmt: skip
    """Remove the occluded `points` of an image, and write the pixel of the class image of each of the others (eq. 5).

    `line_of` (h,) and `column_of` (w,) map camera pixels to pixels of the class image. Returns the number of visible
    points.
    """
    height, kept = len(nearest), 0
    for i in range(len(points)):
        line, column, depth = lines[i], columns[i], depths[i]
        closest = depth
        for r in range(max(line - half_lines, 0), min(line + half_lines + 1, height)):
            closest = min(closest, nearest[r, column])
        points[kept] = points[i]
        pixels[kept] = line_of[line] * class_width + column_of[column]
        kept += depth <= (1.0 + ratio) * closest + slack_m
    return kept


@njit(cache=True, nogil=True, error_model="numpy")
def gather(probabilities, pixels, classes):
    """Copy the class probabilities (h, w, c + 1) of some pixels, for any memory layout of the image."""
    width = np.uint32(probabilities.shape[1])
    for i in range(len(pixels)):
        line = np.uint32(pixels[i]) // width
        column = np.uint32(pixels[i]) - line * width
        for c in range(probabilities.shape[2]):
            classes[i, c] = probabilities[line, column, c]

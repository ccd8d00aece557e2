"""Ray against shape: tapered blocks, ellipsoids, cylinders, and volumes of leaves.

A shape is a row of SHAPE_COLUMNS numbers in its model's own axes (x forward, y left, z up). Every function wants
the ray in those axes and answers in the ray's own parameter. Kernels take the whole table and a row's number: a view
of a row costs more than the arithmetic.
"""

from enum import IntEnum
from typing import Final

import numpy as np

from gnss_sem_map.simulation.compiled import Floats, Triple, inlined, kernel
from gnss_sem_map.simulation.ground import FAR
from gnss_sem_map.simulation.noise import hash_bits
from gnss_sem_map.simulation.surfaces import Surface

# 0 centre, 3 half sizes, 6 tapers at the top (front, rear, each side), 9 share of leaf cells that hold leaves,
# 10 cell size, 11 form, 12 surface, 13 kind, 14 radius of the sphere around it
SHAPE_COLUMNS: Final = 15


class Form(IntEnum):
    """The forms a shape can have."""

    BLOCK = 0  # a box, whose top may be narrower than its bottom
    ELLIPSOID = 1
    UPRIGHT = 2  # a cylinder along z
    AXLE = 3  # a cylinder along y


_BLOCK, _ELLIPSOID, _UPRIGHT = int(Form.BLOCK), int(Form.ELLIPSOID), int(Form.UPRIGHT)
_FENCE, _LEAVES = int(Surface.FENCE), int(Surface.LEAVES)


@inlined
def _clip(t0: float, t1: float, distance: float, rate: float) -> tuple[float, float]:
    """The part of [t0, t1] where distance + t rate <= 0."""
    if rate > 1e-12:
        return t0, min(t1, -distance / rate)
    if rate < -1e-12:
        return max(t0, -distance / rate), t1
    return (t0, t1) if distance <= 0.0 else (FAR, -FAR)


@kernel
def _block_span(
    shapes: Floats, row: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, float]:
    hx, hy, hz = shapes[row, 3], shapes[row, 4], shapes[row, 5]
    front, rear, side = shapes[row, 6], shapes[row, 7], shapes[row, 8]
    rise = 0.5 / hz
    up = (oz + hz) * rise
    t0, t1 = _clip(-FAR, FAR, oy - hy + side * up, dy + side * rise * dz)
    t0, t1 = _clip(t0, t1, -oy - hy + side * up, -dy + side * rise * dz)
    if t0 > t1:
        return t0, t1
    t0, t1 = _clip(t0, t1, ox - hx + front * up, dx + front * rise * dz)
    t0, t1 = _clip(t0, t1, -ox - hx + rear * up, -dx + rear * rise * dz)
    if t0 > t1:
        return t0, t1
    t0, t1 = _clip(t0, t1, oz - hz, dz)
    return _clip(t0, t1, -oz - hz, -dz)


@inlined
def _round_span(a: float, b: float, c: float) -> tuple[float, float]:
    """Where a t^2 + 2 b t + c <= 0."""
    if a < 1e-14:
        return (-FAR, FAR) if c <= 0.0 else (FAR, -FAR)
    discriminant = b * b - a * c
    if discriminant <= 0.0:
        return FAR, -FAR
    root = np.sqrt(discriminant)
    return (-b - root) / a, (-b + root) / a


@kernel
def _span(
    shapes: Floats, row: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, float]:
    """Where the ray (already relative to the shape's centre) is inside the shape."""
    form = int(shapes[row, 11])
    if form == _BLOCK:
        return _block_span(shapes, row, ox, oy, oz, dx, dy, dz)
    px, py, pz = ox / shapes[row, 3], oy / shapes[row, 4], oz / shapes[row, 5]
    qx, qy, qz = dx / shapes[row, 3], dy / shapes[row, 4], dz / shapes[row, 5]
    if form == _ELLIPSOID:
        return _round_span(
            qx * qx + qy * qy + qz * qz, px * qx + py * qy + pz * qz, px * px + py * py + pz * pz - 1.0
        )
    if form == _UPRIGHT:
        t0, t1 = _round_span(qx * qx + qy * qy, px * qx + py * qy, px * px + py * py - 1.0)
        t0, t1 = _clip(t0, t1, pz - 1.0, qz)
        return _clip(t0, t1, -pz - 1.0, -qz)
    t0, t1 = _round_span(qx * qx + qz * qz, px * qx + pz * qz, px * px + pz * pz - 1.0)
    t0, t1 = _clip(t0, t1, py - 1.0, qy)
    return _clip(t0, t1, -py - 1.0, -qy)


@kernel
def leaf(thing: int, i: int, j: int, k: int, share: float) -> tuple[bool, float, float, float, float]:
    """The clump of leaves of one cell: whether it is there, its radius and centre in parts of the cell."""
    bits = hash_bits(thing, i, j, k)
    if np.float64(bits & np.uint64(0xFFFF)) >= share * 65536.0:
        return False, 0.0, 0.0, 0.0, 0.0
    scale = 1.0 / 256.0
    radius = 0.27 + 0.22 * scale * np.float64((bits >> np.uint64(16)) & np.uint64(0xFF))
    room = 0.5 - radius
    cx = 0.5 + room * (2.0 * scale * np.float64((bits >> np.uint64(24)) & np.uint64(0xFF)) - 1.0)
    cy = 0.5 + room * (2.0 * scale * np.float64((bits >> np.uint64(32)) & np.uint64(0xFF)) - 1.0)
    cz = 0.5 + room * (2.0 * scale * np.float64((bits >> np.uint64(40)) & np.uint64(0xFF)) - 1.0)
    return True, radius, cx, cy, cz


@kernel
def _first_leaf(
    thing: int,
    size: float,
    share: float,
    t0: float,
    t1: float,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> float:
    """The first clump of leaves between t0 and t1: a walk through the cells (Amanatides and Woo 1987)."""
    ox, oy, oz = ox / size, oy / size, oz / size
    dx, dy, dz = dx / size, dy / size, dz / size
    i = int(np.floor(ox + t0 * dx))
    j = int(np.floor(oy + t0 * dy))
    k = int(np.floor(oz + t0 * dz))
    step_x, step_y, step_z = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1), (1 if dz > 0.0 else -1)
    every_x = abs(1.0 / dx) if dx != 0.0 else FAR
    every_y = abs(1.0 / dy) if dy != 0.0 else FAR
    every_z = abs(1.0 / dz) if dz != 0.0 else FAR
    next_x = (i + (dx > 0.0) - ox) / dx if dx != 0.0 else FAR
    next_y = (j + (dy > 0.0) - oy) / dy if dy != 0.0 else FAR
    next_z = (k + (dz > 0.0) - oz) / dz if dz != 0.0 else FAR
    norm = dx * dx + dy * dy + dz * dz
    t = t0
    while t < t1:
        there, radius, cx, cy, cz = leaf(thing, i, j, k, share)
        if there:
            px, py, pz = ox - i - cx, oy - j - cy, oz - k - cz
            enter, leave = _round_span(
                norm, px * dx + py * dy + pz * dz, px * px + py * py + pz * pz - radius**2
            )
            if enter < leave and t0 < enter < t1:
                return enter
        if next_x < next_y and next_x < next_z:
            t, i, next_x = next_x, i + step_x, next_x + every_x
        elif next_y < next_z:
            t, j, next_y = next_y, j + step_y, next_y + every_y
        else:
            t, k, next_z = next_z, k + step_z, next_z + every_z
    return FAR


@kernel
def hit_shape(
    shapes: Floats,
    row: int,
    thing: int,
    best: float,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> float:
    """Distance to the first point of the shape in front of the ray's start and nearer than `best`, else FAR."""
    ox, oy, oz = ox - shapes[row, 0], oy - shapes[row, 1], oz - shapes[row, 2]
    t0, t1 = _span(shapes, row, ox, oy, oz, dx, dy, dz)
    if t0 >= t1 or t1 <= 0.0 or t0 >= best:
        return FAR
    surface = int(shapes[row, 12])
    if surface == _LEAVES:
        return _first_leaf(
            thing, shapes[row, 10], shapes[row, 9], max(t0, 0.0), min(t1, best), ox, oy, oz, dx, dy, dz
        )
    if t0 <= 0.0:
        return FAR
    if surface == _FENCE:  # upright slats and two rails, air between them
        along, z = (ox + t0 * dx + shapes[row, 3]) / 0.16, (oz + t0 * dz) / shapes[row, 5]
        if along - np.floor(along) > 0.55 and abs(z - 0.55) > 0.08 and abs(z + 0.5) > 0.08:
            return FAR
    return t0


@kernel
def shape_normal(
    shapes: Floats, row: int, thing: int, px: float, py: float, pz: float, dx: float, dy: float, dz: float
) -> tuple[float, float, float, float]:
    """Outward unit normal at a point that a ray of direction d hit, and a number for the clump of leaves."""
    px, py, pz = px - shapes[row, 0], py - shapes[row, 1], pz - shapes[row, 2]
    form, clump = int(shapes[row, 11]), 0.5
    if int(shapes[row, 12]) == _LEAVES:
        size, nudge = shapes[row, 10], 1e-7
        ax, ay, az = (px + nudge * dx) / size, (py + nudge * dy) / size, (pz + nudge * dz) / size
        i, j, k = int(np.floor(ax)), int(np.floor(ay)), int(np.floor(az))
        _, _, cx, cy, cz = leaf(thing, i, j, k, shapes[row, 9])
        nx, ny, nz = ax - i - cx, ay - j - cy, az - k - cz
        clump = np.float64(hash_bits(thing, i, j, k) >> np.uint64(48)) / 65536.0
    elif form == _BLOCK:
        nx, ny, nz = _block_normal(shapes, row, px, py, pz)
    elif form == _ELLIPSOID:
        nx, ny, nz = px / shapes[row, 3] ** 2, py / shapes[row, 4] ** 2, pz / shapes[row, 5] ** 2
    elif form == _UPRIGHT:
        cap = abs(abs(pz) - shapes[row, 5]) < 1e-6
        nx, ny, nz = (0.0, 0.0, pz) if cap else (px, py, 0.0)
    else:
        cap = abs(abs(py) - shapes[row, 4]) < 1e-6
        nx, ny, nz = (0.0, py, 0.0) if cap else (px, 0.0, pz)
    length = np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-300
    return nx / length, ny / length, nz / length, clump


@kernel
def _block_normal(shapes: Floats, row: int, x: float, y: float, z: float) -> Triple:
    """The normal of the face that the point lies on: the plane that it is nearest to."""
    hx, hy, hz = shapes[row, 3], shapes[row, 4], shapes[row, 5]
    rise = 0.5 / hz
    up = (z + hz) * rise
    front, rear, side = shapes[row, 6], shapes[row, 7], shapes[row, 8]
    nx, ny, nz, best = 0.0, 0.0, 1.0, abs(z - hz)
    if abs(z + hz) < best:
        nx, ny, nz, best = 0.0, 0.0, -1.0, abs(z + hz)
    if abs(x - hx + front * up) < best:
        nx, ny, nz, best = 1.0, 0.0, front * rise, abs(x - hx + front * up)
    if abs(-x - hx + rear * up) < best:
        nx, ny, nz, best = -1.0, 0.0, rear * rise, abs(-x - hx + rear * up)
    if abs(y - hy + side * up) < best:
        nx, ny, nz, best = 0.0, 1.0, side * rise, abs(y - hy + side * up)
    if abs(-y - hy + side * up) < best:
        nx, ny, nz, best = 0.0, -1.0, side * rise, abs(-y - hy + side * up)
    return nx, ny, nz

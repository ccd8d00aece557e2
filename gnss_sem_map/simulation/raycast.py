"""One ray through the town: the ground in closed form, everything else through a grid of cells.

A *thing* is an object in the map (position, heading, shear that lets it follow a slope, and their change during one
sweep); it consists of a range of shapes. A 2D grid lists the things of every cell; a ray traverses the cells and stops
at the first cell that it enters behind its nearest hit. Moving things are in linked lists, rebuilt for every frame.
"""

from typing import Final, NamedTuple

import numpy as np

from gnss_sem_map.simulation.compiled import Floats, Integers, inlined, kernel
from gnss_sem_map.simulation.ground import FAR, Ground, hit_ground
from gnss_sem_map.simulation.shapes import hit_shape

CELL_M = 4.0
STEEPEST = 0.1  # no street is as steep as this
GROUND, KERB = -1, -2  # what a ray hit, when it is no thing

# 0 x, y, z; 3 yaw, its cosine and sine; 6 shear along, across; 8 change per sweep of x, y, z, yaw; 12 whether it moves;
# 13 smallest and 16 largest x, y, z of its shapes; 19 reach in the plane; 20 first shape, 21 the one after its last
THING_COLUMNS: Final = 22


class Scene(NamedTuple):
    """All things that a ray may hit during one sweep."""

    ground: Ground
    things: Floats  # (things, THING_COLUMNS)
    shapes: Floats  # (shapes, SHAPE_COLUMNS)
    colours: Floats  # (things, 3)
    corner: Floats  # (2,) m, the map position of cell (0, 0)
    start: Integers  # (nx * ny + 1,) where a cell's members begin
    members: Integers
    top: Floats  # (nx, ny) m, the height below which something that stands may be hit
    chain: Integers  # (nx, ny) first link of the moving things in a cell, or -1
    links: Integers  # (links, 2) thing, next link


@inlined
def from_thing(
    things: Floats, k: int, fraction: float, x: float, y: float, z: float
) -> tuple[float, float, float, float, float]:
    """A point as seen from a thing's origin, in the map's axes, and the cosine and sine of the thing's heading.

    Both at this fraction of the sweep (0.5 is the frame's stamp).
    """
    px, py, pz, c, s = x - things[k, 0], y - things[k, 1], z - things[k, 2], things[k, 4], things[k, 5]
    if things[k, 12] != 0.0:
        late = fraction - 0.5
        px, py, pz = px - late * things[k, 8], py - late * things[k, 9], pz - late * things[k, 10]
        yaw = things[k, 3] + late * things[k, 11]
        c, s = np.cos(yaw), np.sin(yaw)
    return px, py, pz, c, s


@inlined
def turned(
    things: Floats, k: int, c: float, s: float, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """A vector in the axes of a thing of this heading."""
    ax, ay = c * x + s * y, c * y - s * x
    return ax, ay, z - things[k, 6] * ax - things[k, 7] * ay


@inlined
def into_thing(
    things: Floats, k: int, fraction: float, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, float, float, float, float, float]:
    """A ray in a thing's own axes, at this fraction of the sweep."""
    px, py, pz, c, s = from_thing(things, k, fraction, ox, oy, oz)
    ax, ay, az = turned(things, k, c, s, px, py, pz)
    bx, by, bz = turned(things, k, c, s, dx, dy, dz)
    return ax, ay, az, bx, by, bz


@inlined
def _clip_slab(t0: float, t1: float, low: float, high: float, o: float, d: float) -> tuple[float, float]:
    if abs(d) < 1e-12:
        return (t0, t1) if low <= o <= high else (FAR, -FAR)
    inverse = 1.0 / d
    a, b = (low - o) * inverse, (high - o) * inverse
    return max(t0, min(a, b)), min(t1, max(a, b))


@kernel
def hit_thing(
    things: Floats,
    shapes: Floats,
    k: int,
    best: float,
    fraction: float,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> tuple[float, int]:
    """The nearest shape of one thing that is closer than `best`: distance and shape, or `best` and -1."""
    which, reach = -1, things[k, 19]
    px, py, level = things[k, 0] - ox, things[k, 1] - oy, dx * dx + dy * dy
    beside = px * dy - py * dx
    if beside * beside > reach * reach * level:
        return best, which
    if level > 1e-12:  # the stretch of the ray above the circle around it, and how high it runs there
        middle, half = (px * dx + py * dy) / level, reach / np.sqrt(level)
        enter, leave = max(middle - half, 0.0), min(middle + half, best)
        low, high = oz + dz * enter - things[k, 2], oz + dz * leave - things[k, 2]
        if low > high:
            low, high = high, low
        lean = STEEPEST * reach
        if enter > leave or high < things[k, 15] - lean or low > things[k, 18] + lean:
            return best, which
    ox, oy, oz, dx, dy, dz = into_thing(things, k, fraction, ox, oy, oz, dx, dy, dz)
    t0, t1 = _clip_slab(0.0, best, things[k, 13], things[k, 16], ox, dx)
    t0, t1 = _clip_slab(t0, t1, things[k, 14], things[k, 17], oy, dy)
    t0, t1 = _clip_slab(t0, t1, things[k, 15], things[k, 18], oz, dz)
    if t0 > t1:
        return best, which
    inverse = 1.0 / (dx * dx + dy * dy + dz * dz)
    scale = np.sqrt(inverse)
    for row in range(int(things[k, 20]), int(things[k, 21])):
        px, py, pz = shapes[row, 0] - ox, shapes[row, 1] - oy, shapes[row, 2] - oz
        ahead = px * dx + py * dy + pz * dz
        radius = shapes[row, 14]
        if px * px + py * py + pz * pz - ahead * ahead * inverse > radius * radius:
            continue  # the ray passes beside the sphere around it
        if ahead * inverse - radius * scale > best:
            continue  # the sphere is farther than what was hit
        t = hit_shape(shapes, row, k, best, ox, oy, oz, dx, dy, dz)
        if t < best:
            best, which = t, row
    return best, which


@kernel
def cast_ray(
    scene: Scene,
    reach: float,
    shadow: bool,
    fraction: float,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> tuple[float, int, int]:
    """First hit of a ray within `reach`: distance (FAR if none), thing (GROUND or KERB for these), shape.

    A shadow ray tests whether any thing is in its way; the ground does not count.
    """
    things, shapes, top, chain = scene.things, scene.shapes, scene.top, scene.chain
    start, members, links = scene.start, scene.members, scene.links
    best, kerb = (FAR, False) if shadow else hit_ground(scene.ground, reach, ox, oy, oz, dx, dy, dz)
    thing, shape = (KERB if kerb else GROUND), -1
    found = best < reach
    best = min(best, reach)
    nx, ny = top.shape
    x, y = (ox - scene.corner[0]) / CELL_M, (oy - scene.corner[1]) / CELL_M
    ux, uy = dx / CELL_M, dy / CELL_M
    i, j = int(np.floor(x)), int(np.floor(y))
    step_i, step_j = (1 if ux > 0.0 else -1), (1 if uy > 0.0 else -1)
    every_i = abs(1.0 / ux) if ux != 0.0 else FAR
    every_j = abs(1.0 / uy) if uy != 0.0 else FAR
    next_i = (i + (ux > 0.0) - x) / ux if ux != 0.0 else FAR
    next_j = (j + (uy > 0.0) - y) / uy if uy != 0.0 else FAR
    last, before = -1, -1  # a thing in many cells need not be tried again and again
    t = 0.0
    while t < best and 0 <= i < nx and 0 <= j < ny:
        leave = min(next_i, next_j)
        low = oz + dz * (t if dz > 0.0 else min(leave, best))
        if low < top[i, j]:
            cell = i * ny + j
            for m in range(start[cell], start[cell + 1]):
                candidate = int(np.int64(members[m]))  # else all that it calls is compiled for two types
                if candidate in (last, before):
                    continue
                before, last = last, candidate
                closer, which = hit_thing(things, shapes, candidate, best, fraction, ox, oy, oz, dx, dy, dz)
                if which >= 0:
                    best, thing, shape, found = closer, candidate, which, True
        link = chain[i, j]
        while link >= 0:
            candidate = int(np.int64(links[link, 0]))
            closer, which = hit_thing(things, shapes, candidate, best, fraction, ox, oy, oz, dx, dy, dz)
            if which >= 0:
                best, thing, shape, found = closer, candidate, which, True
            link = links[link, 1]
        if shadow and found:
            break
        t = leave
        if next_i < next_j:
            i, next_i = i + step_i, next_i + every_i
        else:
            j, next_j = j + step_j, next_j + every_j
    return (best, thing, shape) if found else (FAR, GROUND, -1)

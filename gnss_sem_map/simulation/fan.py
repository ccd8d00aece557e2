"""All rays of one LiDAR column at once: they leave one point in one plane, like the ribs of a fan.

What the plane does not cut, none of them hits; what it cuts lies between two slopes, and only the rays between these
need to look. So most of the town is turned down once for a column instead of once for a ray, and the nearest things
hide the others before these are tried. Every ray hits what `cast_ray` finds, at the same distance to the last bit.

Coordinates in a fan: s off its plane, u ahead, v up; the rays run along u + slope v.
"""

from typing import NamedTuple

import numpy as np

from gnss_sem_map.simulation.compiled import Floats, Integers, Triple, inlined, kernel
from gnss_sem_map.simulation.ground import FAR, hit_ground
from gnss_sem_map.simulation.raycast import GROUND, KERB, STEEPEST, Scene, from_thing, turned
from gnss_sem_map.simulation.shapes import hit_shape

SECTOR = 32  # neighbouring columns share one list of what may be near their planes
_SLACK = 1e-6  # m: far more than rounding, far less than anything there is
_BESIDE = 0.01  # m: what begins nearer than this may stand at any slope


class Sweep(NamedTuple):
    """The rays of a sweep, the LiDAR's own axes being placed anew for every column."""

    T: Floats  # (columns, 4, 4) T_map_lidar
    fans: Floats  # (columns, 3, 3) s, u, v of every column's plane, in the map's axes
    fractions: Floats  # (columns,) of the sweep
    directions: Floats  # (columns, rings, 3) in the LiDAR's axes
    slopes: Floats  # (rings,) falling
    reach: float  # m


class Work(NamedTuple):
    """Room for what one column needs."""

    around: (
        Floats  # (n, 6) what the sweep may meet: its number, middle x, y, z, reach in the plane, half height
    )
    listed: Integers  # (n,) what the sector may meet
    cuts: Floats  # (n, 3) where the plane cuts that: how near, lowest and highest slope
    order: Integers  # (n,) of the cuts, from the nearest
    axes: Floats  # (4, 3) s, u, v of a thing's origin and axes
    rays: Floats  # (rings, 3) directions in the map
    distance: (
        Floats  # (rings,) what they hit: how far (FAR for nothing), thing (GROUND and KERB as well), shape
    )
    things: Integers
    shapes: Integers


def room_for(scene: Scene, sweep: Sweep) -> Work:
    """Everything within reach of a sweep, and room to work with it."""
    places, things = sweep.T[:, :3, 3], scene.things
    middle, moved = 0.5 * (places.min(axis=0) + places.max(axis=0)), np.linalg.norm(np.ptp(places, axis=0))
    gone = np.hypot(things[:, 0] - middle[0], things[:, 1] - middle[1])
    near = np.flatnonzero(gone < sweep.reach + moved + things[:, 19])
    x, y, z, low, high, reach = things[near][:, [0, 1, 2, 15, 18, 19]].T
    tall = 0.5 * (high - low) + STEEPEST * reach
    around = np.column_stack([near, x, y, z + 0.5 * (low + high), reach, tall])
    n, rings = len(near), len(sweep.slopes)
    return Work(
        around, np.empty(n, np.int32), np.empty((n, 3)), np.empty(n, np.int32),
        np.empty((4, 3)), np.empty((rings, 3)), np.empty(rings), np.empty(rings, np.int32), np.empty(rings, np.int32),
    )  # fmt: skip


@inlined
def _cut_edges(
    box: Triple,
    e: Triple,
    f: Triple,
    g: Triple,
    found: tuple[float, float, float, float],
) -> tuple[float, float, float, float]:
    """The nearest and farthest u, lowest and highest slope, once the box's four edges along e are cut as well.

    The box is its centre +- e +- f +- g.
    """
    near, far, low, high = found
    inverse = 1.0 / e[0] if e[0] != 0.0 else 0.0
    for corner in range(4):
        a, b = 1.0 - 2.0 * (corner & 1), 1.0 - (corner & 2)
        apart = box[0] + a * f[0] + b * g[0]
        if abs(apart) <= abs(e[0]) + _SLACK:
            at = min(1.0, max(-1.0, -apart * inverse))
            u, v = box[1] + at * e[1] + a * f[1] + b * g[1], box[2] + at * e[2] + a * f[2] + b * g[2]
            slope = v / u
            near, far, low, high = min(near, u), max(far, u), min(low, slope), max(high, slope)
    return near, far, low, high


@kernel
def _cut(axes: Floats, x: float, y: float, z: float, hx: float, hy: float, hz: float) -> Triple:
    """Where a box of a thing meets the fan's plane: how near (FAR if nowhere), its lowest and highest slope.

    `axes` (4, 3) are the s, u, v of the thing's origin and of its axes; the box is given along these.
    """
    e0, f0, g0 = hx * axes[1, 0], hy * axes[2, 0], hz * axes[3, 0]
    s = axes[0, 0] + x * axes[1, 0] + y * axes[2, 0] + z * axes[3, 0]
    if abs(s) > abs(e0) + abs(f0) + abs(g0) + _SLACK:
        return FAR, 0.0, 0.0
    u = axes[0, 1] + x * axes[1, 1] + y * axes[2, 1] + z * axes[3, 1]
    v = axes[0, 2] + x * axes[1, 2] + y * axes[2, 2] + z * axes[3, 2]
    box = (s, u, v)
    e, f, g = (
        (e0, hx * axes[1, 1], hx * axes[1, 2]),
        (f0, hy * axes[2, 1], hy * axes[2, 2]),
        (g0, hz * axes[3, 1], hz * axes[3, 2]),
    )
    found = _cut_edges(box, e, f, g, (FAR, -FAR, FAR, -FAR))
    found = _cut_edges(box, f, g, e, found)
    near, far, low, high = _cut_edges(box, g, e, f, found)
    if far < 0.0:
        return FAR, 0.0, 0.0
    if near < _BESIDE:
        return 0.0, -FAR, FAR
    slack = 4.0 * _SLACK / near
    return near - _SLACK, low - slack, high + slack


@kernel
def _first_below(slopes: Floats, high: float) -> int:
    """The first of the falling slopes that is not above `high`."""
    first, last = 0, slopes.shape[0]
    while first < last:
        middle = (first + last) // 2
        if slopes[middle] > high:
            first = middle + 1
        else:
            last = middle
    return first


@kernel
def list_near(sweep: Sweep, first: int, last: int, work: Work) -> int:
    """List what the planes of columns first to last may cut; returns how much that is.

    What the middle one clears by more than the others are shifted and turned against it, these clear as well.
    """
    T, fans, around = sweep.T, sweep.fans, work.around
    m = (first + last) // 2
    shift, turn = 0.0, 0.0
    for column in range(first, last):
        moved, tilted, panned = 0.0, 0.0, 0.0
        for axis in range(3):
            moved += (T[column, axis, 3] - T[m, axis, 3]) ** 2
            tilted += (fans[column, 0, axis] - fans[m, 0, axis]) ** 2
            panned += (fans[column, 1, axis] - fans[m, 1, axis]) ** 2
        shift, turn = max(shift, np.sqrt(moved)), max(turn, np.sqrt(max(tilted, panned)))
    count = 0
    for n in range(around.shape[0]):
        x, y, z = around[n, 1] - T[m, 0, 3], around[n, 2] - T[m, 1, 3], around[n, 3] - T[m, 2, 3]
        reach, tall = around[n, 4], around[n, 5]
        size = reach + tall
        room = reach + shift + turn * (np.sqrt(x * x + y * y + z * z) + size) + _SLACK
        s = fans[m, 0, 0] * x + fans[m, 0, 1] * y + fans[m, 0, 2] * z
        u = fans[m, 1, 0] * x + fans[m, 1, 1] * y + fans[m, 1, 2] * z
        if abs(s) < room + tall * abs(fans[m, 0, 2]) and u > -(room + tall):
            work.listed[count] = int(around[n, 0])
            count += 1
    return count


@kernel
def _lay_out(things: Floats, k: int, fraction: float, fan: Floats, o: Triple, axes: Floats) -> None:
    """Fill the s, u, v of a thing's origin and axes, (4, 3)."""
    px, py, pz, c, s = from_thing(things, k, fraction, o[0], o[1], o[2])
    along, across = things[k, 6], things[k, 7]
    for i in range(3):
        axes[0, i] = -(fan[i, 0] * px + fan[i, 1] * py + fan[i, 2] * pz)
        axes[1, i] = fan[i, 0] * c + fan[i, 1] * s + fan[i, 2] * along
        axes[2, i] = fan[i, 1] * c - fan[i, 0] * s + fan[i, 2] * across
        axes[3, i] = fan[i, 2]


@kernel
def _cut_things(things: Floats, sweep: Sweep, column: int, o: Triple, count: int, work: Work) -> int:
    """Cut what is listed with the plane of a column and sort it from the nearest; returns how much is cut."""
    axes, cuts, order, slopes = work.axes, work.cuts, work.order, sweep.slopes
    met = 0
    for n in range(count):
        k = work.listed[n]
        _lay_out(things, k, sweep.fractions[column], sweep.fans[column], o, axes)
        near, low, high = _cut(
            axes, 0.5 * (things[k, 13] + things[k, 16]), 0.5 * (things[k, 14] + things[k, 17]),
            0.5 * (things[k, 15] + things[k, 18]), 0.5 * (things[k, 16] - things[k, 13]),
            0.5 * (things[k, 17] - things[k, 14]), 0.5 * (things[k, 18] - things[k, 15]),
        )  # fmt: skip
        if near < sweep.reach and low <= slopes[0] and high >= slopes[-1]:
            cuts[n, 0], cuts[n, 1], cuts[n, 2] = near, low, high
            at = met
            while at > 0 and cuts[order[at - 1], 0] > near:
                order[at] = order[at - 1]
                at -= 1
            order[at] = n
            met += 1
    return met


@kernel
def _hit_shapes(scene: Scene, k: int, sweep: Sweep, column: int, o: Triple, work: Work) -> None:
    """Let the rays of a column look at the shapes of one thing."""
    things, shapes, slopes, rays, axes = scene.things, scene.shapes, sweep.slopes, work.rays, work.axes
    fraction = sweep.fractions[column]
    _lay_out(things, k, fraction, sweep.fans[column], o, axes)
    px, py, pz, c, s = from_thing(things, k, fraction, o[0], o[1], o[2])
    px, py, pz = turned(things, k, c, s, px, py, pz)
    for row in range(int(things[k, 20]), int(things[k, 21])):
        near, low, high = _cut(
            axes,
            shapes[row, 0],
            shapes[row, 1],
            shapes[row, 2],
            shapes[row, 3],
            shapes[row, 4],
            shapes[row, 5],
        )
        if near >= FAR:
            continue
        for ring in range(_first_below(slopes, high), len(slopes)):
            if slopes[ring] < low:
                break
            best = work.distance[ring]
            if near < best:
                dx, dy, dz = turned(things, k, c, s, rays[ring, 0], rays[ring, 1], rays[ring, 2])
                t = hit_shape(shapes, row, k, best, px, py, pz, dx, dy, dz)
                if t < best:
                    work.distance[ring], work.things[ring], work.shapes[ring] = t, k, row


@kernel
def _hidden(near: float, low: float, high: float, slopes: Floats, distance: Floats) -> bool:
    """Whether all rays between two slopes have hit something nearer."""
    for ring in range(_first_below(slopes, high), len(slopes)):
        if slopes[ring] < low:
            break
        if near < distance[ring]:
            return False
    return True


@kernel
def look(scene: Scene, sweep: Sweep, column: int, count: int, work: Work) -> None:
    """What the rays of a column hit, into `work`, where `count` things are listed."""
    T, directions, rays, reach = sweep.T, sweep.directions, work.rays, sweep.reach
    distance, things, shapes = work.distance, work.things, work.shapes
    o = (T[column, 0, 3], T[column, 1, 3], T[column, 2, 3])
    for ring in range(len(distance)):
        x, y, z = directions[column, ring, 0], directions[column, ring, 1], directions[column, ring, 2]
        for axis in range(3):
            rays[ring, axis] = T[column, axis, 0] * x + T[column, axis, 1] * y + T[column, axis, 2] * z
        distance[ring], things[ring], shapes[ring] = reach, GROUND, -1
    for n in work.order[: _cut_things(scene.things, sweep, column, o, count, work)]:
        if not _hidden(work.cuts[n, 0], work.cuts[n, 1], work.cuts[n, 2], sweep.slopes, distance):
            _hit_shapes(scene, work.listed[n], sweep, column, o, work)
    for ring in range(len(distance)):
        best, dx, dy, dz = distance[ring], rays[ring, 0], rays[ring, 1], rays[ring, 2]
        t, kerb = hit_ground(scene.ground, best, o[0], o[1], o[2], dx, dy, dz)
        if t <= best and t < reach:
            distance[ring], things[ring], shapes[ring] = t, (KERB if kerb else GROUND), -1
        elif best >= reach:
            distance[ring] = FAR

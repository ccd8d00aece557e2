"""The ground of the town: a gently curved sheet with streets, and blocks raised by a kerb.

Town axes (u, v) are the map's east and north turned by `heading`. Streets run along lines u = const and
v = const; what they leave are the blocks, rectangles with rounded corners. The height is a quadratic form, so that a
ray meets it in closed form.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gnss_sem_map.simulation.compiled import Floats, inlined, kernel
from gnss_sem_map.simulation.noise import uniform
from gnss_sem_map.simulation.surfaces import Surface

FAR = 1e9
_OUTSKIRTS_M = 5000.0  # the outermost blocks go on to here
_ASPHALT, _MARKING, _PAVING = int(Surface.ASPHALT), int(Surface.MARKING), int(Surface.PAVING)
_KERB, _GRASS, _SKY = int(Surface.KERB), int(Surface.GRASS), int(Surface.SKY)


class Ground(NamedTuple):
    """Streets, blocks and heights, as the compiled kernels want them."""

    origin: tuple[float, float]  # m, town (0, 0) in the map
    heading: tuple[float, float]  # cosine and sine of the angle from east to u
    slope: tuple[float, float]  # gradient of the height at the map's origin
    curvature: tuple[float, float, float]  # 1/m: xx, xy, yy of the height's second derivative
    streets_u: Floats  # (m, 2) m, the streets along v: centre line and half width between the kerbs
    streets_v: Floats  # (n, 2) m, the streets along u
    corner_radius: float
    kerb_height: float
    sidewalk_width: float
    patch_start: npt.NDArray[np.int32]  # (blocks + 1,) where the patches of a block begin
    patches: Floats  # (p, 5) u0, u1, v0, v1, surface: what covers a part of a block instead of grass


@inlined
def to_town(ground: Ground, x: float, y: float) -> tuple[float, float]:
    """Town coordinates (u, v) of a point of the map."""
    a, b = x - ground.origin[0], y - ground.origin[1]
    return ground.heading[0] * a + ground.heading[1] * b, ground.heading[0] * b - ground.heading[1] * a


@inlined
def street_height(ground: Ground, x: float, y: float) -> float:
    """Height of the street surface, without kerbs."""
    q = ground.curvature
    return (
        ground.slope[0] * x + ground.slope[1] * y + 0.5 * (q[0] * x * x + 2.0 * q[1] * x * y + q[2] * y * y)
    )


@inlined
def height_gradient(ground: Ground, x: float, y: float) -> tuple[float, float]:
    """Slope of the sheet along x and y."""
    q = ground.curvature
    return ground.slope[0] + q[0] * x + q[1] * y, ground.slope[1] + q[1] * x + q[2] * y


@inlined
def _span(streets: Floats, x: float) -> tuple[int, float, float]:
    """The gap between streets that x falls in: its number, and where its kerbs are."""
    n = 0
    while n < streets.shape[0] and streets[n, 0] <= x:
        n += 1
    low = streets[n - 1, 0] + streets[n - 1, 1] if n > 0 else -_OUTSKIRTS_M
    high = streets[n, 0] - streets[n, 1] if n < streets.shape[0] else _OUTSKIRTS_M
    return n, low, high


@inlined
def inside_block(ground: Ground, u: float, v: float) -> tuple[float, int]:
    """Signed distance to the kerb, positive on the block; also the block's number."""
    i, u0, u1 = _span(ground.streets_u, u)
    j, v0, v1 = _span(ground.streets_v, v)
    r = ground.corner_radius
    a = abs(u - 0.5 * (u0 + u1)) - (0.5 * (u1 - u0) - r)
    b = abs(v - 0.5 * (v0 + v1)) - (0.5 * (v1 - v0) - r)
    outer_a, outer_b = max(a, 0.0), max(b, 0.0)
    distance = np.sqrt(outer_a * outer_a + outer_b * outer_b) + min(max(a, b), 0.0) - r
    return -distance, i * (ground.streets_v.shape[0] + 1) + j


@kernel
def ground_height(ground: Ground, x: float, y: float) -> float:
    """Height of the ground, kerbs included."""
    u, v = to_town(ground, x, y)
    inside, _ = inside_block(ground, u, v)
    return street_height(ground, x, y) + (ground.kerb_height if inside > 0.0 else 0.0)


@inlined
def _sheet_hit(
    ground: Ground, lift: float, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> float:
    """Distance along the ray to the sheet raised by `lift` (the smaller positive root of a quadratic)."""
    q = ground.curvature
    gx, gy = height_gradient(ground, ox, oy)
    a = -0.5 * (q[0] * dx * dx + 2.0 * q[1] * dx * dy + q[2] * dy * dy)
    b = dz - gx * dx - gy * dy
    c = oz - lift - street_height(ground, ox, oy)
    if abs(a) < 1e-12:
        return -c / b if b < 0.0 else FAR
    discriminant = b * b - 4.0 * a * c
    if discriminant < 0.0:
        return FAR
    root = float(np.sqrt(discriminant))
    half = -0.5 * (b + (root if b >= 0.0 else -root))
    first, second = half / a, (c / half if half != 0.0 else FAR)
    if first > second:
        first, second = second, first
    if first > 0.0:
        return first
    return second if second > 0.0 else FAR


@inlined
def hit_ground(
    ground: Ground, best: float, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, bool]:
    """Where a ray from above meets the ground: distance, and whether it is the kerb's face.

    What is farther than `best` may be said to be at FAR.

    Over the block's level the ray either lands on the block or goes on to the road, and on this stretch it may run
    into the kerb: the distance to the block steps towards it (sphere tracing, Hart 1996).
    """
    top = _sheet_hit(ground, ground.kerb_height, ox, oy, oz, dx, dy, dz)
    if top > best or top >= FAR:
        return FAR, False
    u, v = to_town(ground, ox + top * dx, oy + top * dy)
    gap = -inside_block(ground, u, v)[0]
    if gap < 0.0:
        return top, False
    bottom = _sheet_hit(ground, 0.0, ox, oy, oz, dx, dy, dz)
    speed = np.sqrt(dx * dx + dy * dy)
    if speed < 1e-9:
        return bottom, False
    t = top
    for _ in range(64):
        if gap < 1e-4:
            return t, True
        t += gap / speed
        if t >= bottom:
            break
        u, v = to_town(ground, ox + t * dx, oy + t * dy)
        gap = -inside_block(ground, u, v)[0]
    return bottom, False


@kernel
def _nearest(streets: Floats, x: float) -> int:
    """The street whose centre line is nearest."""
    nearest = 0
    for k in range(streets.shape[0]):
        if abs(x - streets[k, 0]) < abs(x - streets[nearest, 0]):
            nearest = k
    return nearest


@kernel
def _marked(along: float, across: float, half: float, crossing: Floats) -> bool:
    """Whether paint covers a point of a street: along it, and across from its centre line (right is negative)."""
    nearest = _nearest(crossing, along)
    to_crossing = abs(along - crossing[nearest, 0]) - crossing[nearest, 1]
    if to_crossing < 4.2:
        return False
    lateral = abs(across)
    if to_crossing < 7.2:  # the zebra
        return lateral < half - 0.4 and across - float(np.floor(across)) < 0.5
    if to_crossing < 8.0:
        return False
    if to_crossing < 8.4:  # the stop line, for those who come towards the crossing on the right
        towards = along < crossing[nearest, 0]
        return (across < -0.15 if towards else across > 0.15) and lateral < half - 2.2
    if lateral < 0.07:
        return to_crossing < 22.0 or along / 6.0 - float(np.floor(along / 6.0)) < 0.5
    # the edge of the parking lane, worn in places
    return abs(lateral - (half - 2.15)) < 0.06 and uniform(7, int(np.floor(along / 0.7)), nearest, 0) < 0.9


@inlined
def ground_surface(ground: Ground, x: float, y: float, kerb_face: bool) -> int:
    """Material of the ground at the hit point of a ray."""
    if kerb_face:
        return _KERB
    u, v = to_town(ground, x, y)
    inside, block = inside_block(ground, u, v)
    if inside > 0.0:
        if inside < 0.16:
            return _KERB
        if inside < ground.sidewalk_width:
            return _PAVING
        for p in range(ground.patch_start[block], ground.patch_start[block + 1]):
            inside_u = ground.patches[p, 0] <= u < ground.patches[p, 1]
            if inside_u and ground.patches[p, 2] <= v < ground.patches[p, 3]:
                return int(ground.patches[p, 4])
        return _GRASS
    i, j = _nearest(ground.streets_u, u), _nearest(ground.streets_v, v)
    from_u, from_v = u - ground.streets_u[i, 0], v - ground.streets_v[j, 0]
    half_u, half_v = ground.streets_u[i, 1], ground.streets_v[j, 1]
    on_u, on_v = abs(from_u) < half_u, abs(from_v) < half_v
    # u to the right of v's direction is negative "across", as v to the right of u's
    if on_u and not on_v and _marked(v, -from_u, half_u, ground.streets_v):
        return _MARKING
    if on_v and not on_u and _marked(u, from_v, half_v, ground.streets_u):
        return _MARKING
    return _ASPHALT

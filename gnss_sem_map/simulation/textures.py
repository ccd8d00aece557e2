"""Procedural textures: the albedo (red, green, blue) of a point of a surface."""

import numpy as np

from gnss_sem_map.simulation.compiled import Floats, Triple, inlined, kernel
from gnss_sem_map.simulation.noise import uniform, value_noise
from gnss_sem_map.simulation.surfaces import Surface

Colour = tuple[float, float, float, float]  # red, green, blue, and the share of mirrored sky

_ASPHALT, _MARKING, _PAVING = int(Surface.ASPHALT), int(Surface.MARKING), int(Surface.PAVING)
_KERB, _PARKING, _GRASS, _FACADE = (
    int(Surface.KERB),
    int(Surface.PARKING),
    int(Surface.GRASS),
    int(Surface.FACADE),
)
_ROOF, _STONE, _WALL, _FENCE = int(Surface.ROOF), int(Surface.STONE), int(Surface.WALL), int(Surface.FENCE)
_LEAVES, _BARK, _STEEL, _SIGN = int(Surface.LEAVES), int(Surface.BARK), int(Surface.STEEL), int(Surface.SIGN)
_LIGHT, _PAINT, _CABIN, _RUBBER = (
    int(Surface.LIGHT),
    int(Surface.PAINT),
    int(Surface.CABIN),
    int(Surface.RUBBER),
)
_HEADLAMP, _TAILLAMP, _CLOTH = int(Surface.HEADLAMP), int(Surface.TAILLAMP), int(Surface.CLOTH)
_SKIN, _CARGO = int(Surface.SKIN), int(Surface.CARGO)


@inlined
def _part(x: float, size: float) -> float:
    return float(x / size - np.floor(x / size))


@inlined
def window_at(x: float, z: float) -> tuple[float, float]:
    """Where a facade's point lies in its window: two numbers in [0, 1] inside the pane, negative outside."""
    a, b = (_part(x, 2.4) - 0.26) / 0.48, (_part(z - 1.0, 3.1) - 0.27) / 0.52
    return (a, b) if 0.0 <= a <= 1.0 and 0.0 <= b <= 1.0 and z > 1.0 else (-1.0, -1.0)


@kernel
def _bricks(x: float, z: float, width: float, height: float) -> tuple[float, float]:
    """1 on a brick, 0 in a joint, and a number for the brick."""
    row = np.floor(z / height)
    shifted = x + 0.5 * width * (row % 2.0)
    joint = _part(shifted, width) < 0.04 or _part(z, height) < 0.10
    return (0.0 if joint else 1.0), uniform(11, int(np.floor(shifted / width)), int(row), 0)


@kernel
def ground_colour(surface: int, u: float, v: float, near: float) -> Triple:
    """Colour of the ground at town coordinates; `near` in [0, 1] fades what is too fine to be seen."""
    broad = value_noise(1, u * 0.25, v * 0.25)
    if surface in (_ASPHALT, _MARKING):
        speckle = (value_noise(2, u * 18.0, v * 18.0) - 0.5) * near if near > 0.05 else 0.0
        patch = 0.86 if value_noise(3, u * 0.11 + 7.0, v * 0.11) > 0.66 else 1.0
        crack = abs(value_noise(4, u * 0.55, v * 0.55) - 0.5) if near > 0.05 else 1.0
        grey = (0.155 + 0.05 * broad + 0.07 * speckle) * patch * (0.6 if crack < 0.010 * near else 1.0)
        if surface == _MARKING:
            worn = value_noise(5, u * 3.0, v * 3.0)
            grey = grey + (0.62 - grey) * min(1.0, 0.55 + 0.75 * worn)
        return grey * 1.02, grey, grey * 0.98
    if surface == _PAVING:
        solid, tint = _bricks(u, v, 0.5, 0.5)
        grey = 0.33 + 0.07 * broad + 0.05 * (tint - 0.5) * near - 0.11 * (1.0 - solid) * near
        return grey * 1.05, grey, grey * 0.93
    if surface == _KERB:
        joint = min(_part(u, 1.0), _part(v, 1.0)) < 0.02
        grey = 0.46 + 0.06 * broad - (0.15 * near if joint else 0.0)
        return grey, grey, grey * 0.97
    if surface == _PARKING:
        solid, tint = _bricks(u, v, 0.22, 0.11)
        grey = 0.26 + 0.05 * broad + 0.08 * (tint - 0.5) * near - 0.08 * (1.0 - solid) * near
        return grey * 1.15, grey * 0.92, grey * 0.80
    blades = value_noise(6, u * 9.0, v * 9.0) * near + 0.5 * (1.0 - near)
    dry = value_noise(8, u * 0.6, v * 0.6)
    light = 0.55 + 0.65 * blades
    return (0.13 + 0.10 * dry) * light, (0.21 + 0.06 * dry) * light, 0.07 * light


@kernel
def _facade(
    r: float, g: float, b: float, thing: int, x: float, y: float, z: float, nx: float, ny: float, near: float
) -> Colour:
    """Plaster or brick with rows of windows on the long sides and a door."""
    front = abs(ny) > abs(nx)
    along = x if front else y
    style = uniform(21, thing, 0, 0)
    if style < 0.35:
        solid, tint = _bricks(along, z, 0.25, 0.075)
        light = 0.86 + 0.25 * (tint - 0.5) * near + 0.12 * (solid - 1.0) * near
    else:
        light = 0.90 + 0.18 * (value_noise(22, along * 1.3, z * 0.7) - 0.5)
    if front and abs(x + 2.4 * (np.floor(3.0 * style) - 1.0)) < 0.55 and z < 2.35:
        panel = 0.8 if _part(x, 0.36) < 0.08 or _part(z, 0.8) < 0.05 else 1.0
        return 0.16 * panel, 0.10 * panel, 0.07 * panel, 0.0
    a, c = window_at(along, z) if front else (-1.0, -1.0)
    if a >= 0.0:
        if min(a, 1.0 - a) < 0.07 or min(c, 1.0 - c) < 0.05 or abs(a - 0.5) < 0.03:
            return 0.70, 0.69, 0.66, 0.0
        curtain = uniform(23, thing, int(np.floor(x / 2.4)), int(np.floor(z / 3.1)))
        dark = 0.30 if curtain < 0.35 and c > 0.35 else 0.045
        return dark, dark, dark * 1.05, 0.30
    sill = front and z > 1.0 and abs((_part(z - 1.0, 3.1) - 0.25) * 3.1) < 0.07 and 0.2 < _part(x, 2.4) < 0.8
    if sill:
        light = 1.2
    return min(0.9, r * light), min(0.9, g * light), min(0.9, b * light), 0.0


@kernel
def _cabin(
    shapes: Floats, row: int, r: float, g: float, b: float, x: float, y: float, z: float, nx: float, ny: float
) -> Colour:
    """Panes between pillars in the colour of the car."""
    x, y, up = (
        x - shapes[row, 0],
        y - shapes[row, 1],
        (z - shapes[row, 2] + shapes[row, 5]) * 0.5 / shapes[row, 5],
    )
    front, rear = shapes[row, 3] - shapes[row, 6] * up, -shapes[row, 3] + shapes[row, 7] * up
    beside = shapes[row, 4] - shapes[row, 8] * up
    if abs(nx) > abs(ny):
        pillar = beside - abs(y) < 0.07
    else:
        pillar = front - x < 0.09 or x - rear < 0.14 or abs(x - 0.5 * (front + rear) + 0.1) < 0.045
    if pillar or up > 0.93:
        return r, g, b, 0.08
    return 0.025, 0.03, 0.035, 0.40


@kernel
def _wheel(shapes: Floats, row: int, x: float, z: float, ny: float) -> Colour:
    """A tyre around a rim with spokes; bumpers are of the same rubber."""
    dx, dz = x - shapes[row, 0], z - shapes[row, 2]
    radius = np.sqrt(dx * dx + dz * dz) / shapes[row, 3]
    if shapes[row, 11] == 3.0 and abs(ny) > 0.5 and radius < 0.66:
        spoke = abs(abs(dx * dz) / (dx * dx + dz * dz + 1e-9) - 0.25) < 0.16
        grey = 0.42 if spoke or radius < 0.2 or radius > 0.58 else 0.08
        return grey, grey, grey * 1.02, 0.1
    return 0.035, 0.035, 0.037, 0.0


@kernel
def _sign(thing: int, y: float, z: float, nx: float) -> Colour:
    """A round or square face with a rim; grey from behind."""
    if nx > 0.5:
        return 0.35, 0.36, 0.37, 0.05
    z = z - 2.45
    style, edge = uniform(31, thing, 0, 0), max(abs(y), abs(z))
    if style < 0.4:  # parking
        letter = (-0.12 < y < -0.04 and abs(z) < 0.18) or (0.0 < z < 0.18 and abs(y) < 0.12)
        return (0.8, 0.8, 0.8, 0.1) if letter or edge > 0.27 else (0.02, 0.10, 0.45, 0.1)
    if style < 0.7:  # warning
        return (0.60, 0.03, 0.03, 0.1) if abs(y) + abs(z) > 0.24 else (0.82, 0.80, 0.76, 0.1)
    return (0.82, 0.80, 0.76, 0.1) if edge > 0.22 else (0.70, 0.52, 0.04, 0.1)


@kernel
def thing_colour(
    shapes: Floats,
    row: int,
    thing: int,
    r: float,
    g: float,
    b: float,
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
    clump: float,
    near: float,
) -> Colour:
    """Colour at a point of a thing's model (coordinates and normal in its axes), and how much it reflects the sky."""
    surface = int(shapes[row, 12])
    if surface == _LEAVES:
        light = 0.50 + 0.75 * clump + 1.5 * (value_noise(41, (x + z) * 16.0, (y - z) * 16.0) - 0.45) * near
        light = max(0.15, light)
        dry = 1.0 + 0.35 * max(0.0, clump - 0.7)
        return r * light * dry, g * light, b * light, 0.0
    if surface == _FACADE:
        return _facade(r, g, b, thing, x, y, z, nx, ny, near)
    if surface == _PAINT:
        seam = abs(ny) > 0.5 and (abs(x - 0.12) < 0.012 or abs(x + 0.85) < 0.012)
        return (0.4 * r, 0.4 * g, 0.4 * b, 0.05) if seam else (r, g, b, 0.10)
    if surface == _CABIN:
        return _cabin(shapes, row, r, g, b, x, y, z, nx, ny)
    if surface == _RUBBER:
        return _wheel(shapes, row, x, z, ny)
    if surface == _ROOF:
        tile = 0.75 + 0.35 * _part(z, 0.25) * near + 0.2 * (uniform(51, thing, 0, 0) - 0.5)
        return (0.36 * tile, 0.17 * tile, 0.12 * tile, 0.0) if uniform(52, thing, 0, 0) < 0.7 else (
            0.16 * tile, 0.16 * tile, 0.17 * tile, 0.0)  # fmt: skip
    if surface == _WALL:
        solid, tint = _bricks(x + y, z, 0.42, 0.14)
        light = 0.62 + 0.3 * (tint - 0.5) * near - 0.2 * (1.0 - solid) * near
        return r * light, g * light, b * light, 0.0
    if surface == _STONE:
        light = 0.46 + 0.10 * value_noise(61, (x + y) * 2.0, z * 2.0)
        return light * 1.03, light, light * 0.94, 0.0
    if surface == _FENCE:
        light = 0.7 + 0.5 * uniform(71, int(np.floor(x / 0.16)), thing, 0)
        return 0.27 * light, 0.18 * light, 0.11 * light, 0.0
    if surface == _BARK:
        light = 0.5 + 0.8 * value_noise(81, (x - y) * 25.0, z * 3.0)
        return 0.20 * light, 0.16 * light, 0.12 * light, 0.0
    return _small_part(surface, thing, r, g, b, y, z, nx)


@kernel
def _small_part(
    surface: int, thing: int, r: float, g: float, b: float, y: float, z: float, nx: float
) -> Colour:
    """Colours of small things without a pattern."""
    if surface == _SIGN:
        return _sign(thing, y, z, nx)
    if surface == _LIGHT:
        red = y * y + (z - 3.28) ** 2 < 0.011 and nx < -0.5
        return (0.95, 0.05, 0.03, 0.0) if red else (0.03, 0.03, 0.03, 0.05)
    if surface == _MARKING:  # a number plate
        return (
            (0.05, 0.05, 0.05, 0.0)
            if abs(_part(y, 0.07) - 0.5) < 0.22 and abs(y) < 0.2
            else (0.8, 0.8, 0.78, 0.0)
        )
    if surface == _HEADLAMP:
        return 0.80, 0.82, 0.85, 0.25
    if surface == _TAILLAMP:
        return 0.52, 0.02, 0.02, 0.12
    if surface == _CLOTH:
        if z < 0.9:
            return 0.06, 0.07, 0.12, 0.0
        return r, g, b, 0.0
    if surface == _SKIN:
        return (0.10, 0.07, 0.05, 0.0) if z > 1.68 or nx < -0.3 else (0.55, 0.38, 0.30, 0.0)
    if surface == _CARGO:
        band = 1.2 < z < 1.5
        return (0.08, 0.16, 0.42, 0.05) if band else (0.72, 0.73, 0.74, 0.05)
    return r, g, b, 0.05

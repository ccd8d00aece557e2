"""Surface at the hit point of a ray: material, kind, normal."""

import numpy as np

from gnss_sem_map.simulation.compiled import Triple, inlined
from gnss_sem_map.simulation.ground import ground_surface, height_gradient
from gnss_sem_map.simulation.raycast import GROUND, KERB, Scene, into_thing
from gnss_sem_map.simulation.shapes import shape_normal
from gnss_sem_map.simulation.surfaces import Kind, Surface

_GROUND_KINDS = np.zeros(len(Surface), np.int64)
for _surface, _kind in {
    Surface.ASPHALT: Kind.ROAD,
    Surface.MARKING: Kind.MARKING,
    Surface.PAVING: Kind.SIDEWALK,
    Surface.KERB: Kind.SIDEWALK,
    Surface.PARKING: Kind.PARKING,
    Surface.GRASS: Kind.TERRAIN,
}.items():
    _GROUND_KINDS[_surface] = _kind


@inlined
def surface_at(
    scene: Scene,
    thing: int,
    shape: int,
    fraction: float,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    t: float,
) -> tuple[int, int, Triple, Triple, float]:
    """Surface hit at distance t: material, kind, normal in the map, position in the model, clump of leaves."""
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    if thing in (GROUND, KERB):
        surface = ground_surface(scene.ground, x, y, thing == KERB)
        gx, gy = height_gradient(scene.ground, x, y)
        nx, ny, nz = -gx, -gy, 1.0
        if thing == KERB:
            length = np.sqrt(dx * dx + dy * dy) + 1e-12
            nx, ny, nz = -dx / length, -dy / length, 0.0
        return surface, _GROUND_KINDS[surface], (nx, ny, nz), (x, y, z), 0.5
    px, py, pz, ax, ay, az = into_thing(scene.things, thing, fraction, ox, oy, oz, dx, dy, dz)
    px, py, pz = px + t * ax, py + t * ay, pz + t * az
    nx, ny, nz, clump = shape_normal(scene.shapes, shape, thing, px, py, pz, ax, ay, az)
    c, s = scene.things[thing, 4], scene.things[thing, 5]
    surface, kind = int(scene.shapes[shape, 12]), int(scene.shapes[shape, 13])
    return surface, kind, (c * nx - s * ny, s * nx + c * ny, nz), (px, py, pz), clump

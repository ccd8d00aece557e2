"""ID buffer: the visible shape of every pixel, and its distance."""

from gnss_sem_map.simulation.compiled import Floats, Numbers, inlined, kernel
from gnss_sem_map.simulation.ground import FAR, hit_ground
from gnss_sem_map.simulation.raycast import GROUND, KERB, Scene, cast_ray, into_thing
from gnss_sem_map.simulation.shapes import hit_shape
from gnss_sem_map.simulation.surfaces import Surface

_REACH_M = 260.0
_LEAVES, _FENCE = int(Surface.LEAVES), int(Surface.FENCE)


@inlined
def pixel_ray(T: Floats, rays: Floats, u: int, v: int) -> tuple[float, float, float, float]:
    """Direction (3) in the map of a pixel's ray, and the cosine of its angle to the optical axis.

    `rays` (h, w, 4): the ray in the camera's axes, and the factor that makes its length 1.
    """
    x, y, z, scale = rays[v, u, 0], rays[v, u, 1], rays[v, u, 2], rays[v, u, 3]
    dx = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z) * scale
    dy = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z) * scale
    dz = (T[2, 0] * x + T[2, 1] * y + T[2, 2] * z) * scale
    return dx, dy, dz, z * scale


@kernel
def _on_same(
    scene: Scene, thing: int, shape: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, int]:
    """Distance to one given shape, or to the ground; FAR if the ray misses it or may pass (leaves, fences)."""
    if thing in (GROUND, KERB):
        t, kerb = hit_ground(scene.ground, FAR, ox, oy, oz, dx, dy, dz)
        return (t if t < _REACH_M else FAR), (KERB if kerb else GROUND)
    surface = int(scene.shapes[shape, 12])
    if surface in (_LEAVES, _FENCE):
        return FAR, thing
    ax, ay, az, bx, by, bz = into_thing(scene.things, thing, 0.5, ox, oy, oz, dx, dy, dz)
    return hit_shape(scene.shapes, shape, thing, FAR, ax, ay, az, bx, by, bz), thing


@kernel
def see(scene: Scene, T: Floats, rays: Floats, distance: Floats, things: Numbers, shapes: Numbers) -> None:
    """Fill distance (FAR in the sky), thing and shape of every pixel; see `pixel_ray` for `rays`.

    Every second pixel of every second row is cast into the whole scene. Where the four of them around a pixel agree,
    only their shape is intersected: objects thinner than two pixels may be lost there.
    """
    height, width = distance.shape
    ox, oy, oz = T[0, 3], T[1, 3], T[2, 3]
    for coarse in (True, False):
        for v in range(height):
            above, below = v - v % 2, v + v % 2
            below = above if below >= height else below
            for u in range(width):
                left, right = u - u % 2, u + u % 2
                right = left if right >= width else right
                if (u == left and v == above) != coarse:
                    continue
                dx, dy, dz, _ = pixel_ray(T, rays, u, v)
                if not coarse:
                    thing, shape, far = things[above, left], shapes[above, left], distance[above, left] >= FAR
                    agree = True
                    for row, column in ((above, right), (below, left), (below, right)):
                        agree = agree and things[row, column] == thing and shapes[row, column] == shape
                        agree = agree and (distance[row, column] >= FAR) == far
                    if agree and far:
                        distance[v, u], things[v, u], shapes[v, u] = FAR, GROUND, -1
                        continue
                    if agree:
                        t, thing = _on_same(scene, thing, shape, ox, oy, oz, dx, dy, dz)
                        if t < FAR:
                            distance[v, u], things[v, u], shapes[v, u] = t, thing, shape
                            continue
                t, thing, shape = cast_ray(scene, _REACH_M, False, 0.5, ox, oy, oz, dx, dy, dz)
                distance[v, u], things[v, u], shapes[v, u] = t, thing, shape

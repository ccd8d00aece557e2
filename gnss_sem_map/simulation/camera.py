"""A simulated colour camera: sun, shadows, textures, haze, and a sensor with noise and automatic exposure."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from gnss_sem_map.sensor_log.cameras import Distortion
from gnss_sem_map.simulation.compiled import Bytes, Floats, Numbers, Singles, Triple, kernel
from gnss_sem_map.simulation.ground import FAR, to_town
from gnss_sem_map.simulation.id_buffer import pixel_ray, see
from gnss_sem_map.simulation.noise import gaussian, value_noise
from gnss_sem_map.simulation.raycast import GROUND, KERB, Scene, cast_ray
from gnss_sem_map.simulation.surface_at import surface_at
from gnss_sem_map.simulation.surfaces import TRAIN_IDS
from gnss_sem_map.simulation.textures import ground_colour, thing_colour
from gnss_sem_map.simulation.world import World

_NEAR_M = 12.0
_TALLEST_M = 22.0  # no shadow is longer than this height's
_SUN = (1.75, 1.62, 1.42)
_SKY = (0.50, 0.58, 0.72)
_TONES = np.linspace(0.0, 1.0, 4096) ** (1.0 / 2.2)
_DISPLAY = np.round(255.0 * (0.55 * _TONES + 0.45 * _TONES**2 * (3.0 - 2.0 * _TONES))).astype(np.uint8)


@dataclass(frozen=True)
class Camera:
    """A camera; the defaults are KITTI's rectified colour camera (focal length and centre in pixels)."""

    width: int = 1242
    height: int = 375
    focal_px: float = 721.5377
    centre_u_px: float = 609.5593
    centre_v_px: float = 172.854
    distortion: Distortion | None = None
    """None: a pinhole."""

    @property
    def K(self) -> Floats:
        """(3, 3) px."""
        f = self.focal_px
        return np.array([[f, 0.0, self.centre_u_px], [0.0, f, self.centre_v_px], [0.0, 0.0, 1.0]])

    @cached_property
    def rays(self) -> Floats:
        """The ray of every pixel in the camera's axes, and the factor that makes its length 1: (h, w, 4)."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        x, y = (u - self.centre_u_px) / self.focal_px, (v - self.centre_v_px) / self.focal_px
        z = np.ones(x.shape)
        if self.distortion is not None:
            x, y, z = self.distortion.straightened(np.asarray(x, np.float64), np.asarray(y, np.float64))
        return np.stack([x, y, z, 1.0 / np.sqrt(x * x + y * y + z * z)], axis=-1)


@dataclass(frozen=True, eq=False)
class SimulatedImage:
    """One image: `rgb` (h, w, 3) uint8, `train_ids` (h, w) Cityscapes classes with 255 void, `depth` (h, w) metres
    along the optical axis (0 in the sky), `instances` (h, w) as in the scans' labels (0: none)."""

    rgb: npt.NDArray[np.uint8]
    train_ids: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32]
    instances: npt.NDArray[np.uint16]


@kernel
def _sky(dx: float, dy: float, dz: float, sx: float, sy: float, sz: float) -> Triple:
    """Colour of the sky: blue, paler towards the horizon, with a few clouds and a glow around the sun."""
    up = max(dz, 0.02)
    pale = 1.0 / (1.0 + 6.0 * up)
    r, g, b = 0.28 + 0.62 * pale, 0.45 + 0.47 * pale, 0.80 + 0.14 * pale
    x, y = dx / (up + 0.12), dy / (up + 0.12)
    cloud = 0.6 * value_noise(91, x * 1.3, y * 1.3) + 0.4 * value_noise(92, x * 3.7, y * 3.7)
    cover = min(1.0, max(0.0, 4.0 * (cloud - 0.52)))
    r, g, b = r + (1.05 - r) * cover, g + (1.05 - g) * cover, b + (1.07 - b) * cover
    glow = max(0.0, dx * sx + dy * sy + dz * sz) ** 24
    return r + 0.7 * glow, g + 0.65 * glow, b + 0.5 * glow


@kernel
def _openness(
    scene: Scene, thing: int, x: float, y: float, z: float, nx: float, ny: float, nz: float, sun: Triple
) -> int:
    """1 if the sun is visible, plus 2 if the sky is visible: a car above the ground occludes it."""
    x, y, z = x + 0.02 * nx, y + 0.02 * ny, z + 0.02 * nz
    open_sky = thing >= 0 or cast_ray(scene, 1.3, True, 0.5, x, y, z, 0.0, 0.0, 1.0)[0] >= FAR
    facing = nx * sun[0] + ny * sun[1] + nz * sun[2]
    sunny = (
        facing > 0.0
        and cast_ray(scene, _TALLEST_M / sun[2], True, 0.5, x, y, z, sun[0], sun[1], sun[2])[0] >= FAR
    )
    return (1 if sunny else 0) + (2 if open_sky else 0)


@kernel
def _light(openness: int, nx: float, ny: float, nz: float, sun: Triple) -> Triple:
    """Light at a point: from the sky, reflected by the ground, and from the sun."""
    sky = 0.5 + 0.5 * nz
    bounce = 0.16 * (1.0 - sky)
    r, g, b = _SKY[0] * sky + bounce * 1.1, _SKY[1] * sky + bounce, _SKY[2] * sky + bounce * 0.9
    if openness < 2:
        r, g, b = 0.35 * r, 0.35 * g, 0.35 * b
    if openness % 2 == 1:
        facing = max(0.0, nx * sun[0] + ny * sun[1] + nz * sun[2])
        r, g, b = r + facing * _SUN[0], g + facing * _SUN[1], b + facing * _SUN[2]
    return r, g, b


@kernel
def _expose(
    scene: Scene,
    T: Floats,
    rays: Floats,
    sun: Triple,
    distance: Floats,
    things: Numbers,
    shapes: Numbers,
    linear: Singles,
    kinds: Bytes,
    depth: Singles,
    light: npt.NDArray[np.int8],
) -> None:
    """Compute the colour of every pixel. `rays` as in `pixel_ray`; `sun`: direction towards it.

    Shadows are traced once for two neighbouring pixels where these show the same shape, near the camera for four.
    """
    ox, oy, oz = T[0, 3], T[1, 3], T[2, 3]
    for v in range(linear.shape[0]):
        for u in range(linear.shape[1]):
            dx, dy, dz, cosine = pixel_ray(T, rays, u, v)
            t, thing, shape = distance[v, u], things[v, u], shapes[v, u]
            if t >= FAR:
                r, g, b = _sky(dx, dy, dz, sun[0], sun[1], sun[2])
                linear[v, u, 0], linear[v, u, 1], linear[v, u, 2] = r, g, b
                continue
            surface, kind, n, p, clump = surface_at(scene, thing, shape, 0.5, ox, oy, oz, dx, dy, dz, t)
            near = 1.0 / (1.0 + (t / 18.0) ** 2)
            mirror, on_ground = 0.0, thing in (GROUND, KERB)
            if on_ground:
                a, c = to_town(scene.ground, p[0], p[1])
                r, g, b = ground_colour(surface, a, c, near)
            else:
                c, s = scene.things[thing, 4], scene.things[thing, 5]
                local_x, local_y = c * n[0] + s * n[1], c * n[1] - s * n[0]
                r, g, b, mirror = thing_colour(
                    scene.shapes, shape, thing, scene.colours[thing, 0], scene.colours[thing, 1],
                    scene.colours[thing, 2], p[0], p[1], p[2], local_x, local_y, n[2], clump, near,
                )  # fmt: skip
            row, column = (v - v % 2 if t < _NEAR_M else v), u - u % 2
            same = things[row, column] == thing and shapes[row, column] == shape
            if same and light[row, column] >= 0:
                light[v, u] = light[row, column]
            else:
                x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
                light[v, u] = _openness(scene, thing, x, y, z, n[0], n[1], n[2], sun)
            lr, lg, lb = _light(light[v, u], n[0], n[1], n[2], sun)
            r, g, b = r * lr, g * lg, b * lb
            if mirror > 0.0:
                facing = dx * n[0] + dy * n[1] + dz * n[2]
                mx, my, mz = dx - 2.0 * facing * n[0], dy - 2.0 * facing * n[1], dz - 2.0 * facing * n[2]
                share = mirror + (1.0 - mirror) * 0.7 * (1.0 - min(1.0, abs(facing))) ** 5
                sr, sg, sb = _sky(mx, my, mz, sun[0], sun[1], sun[2]) if mz > 0.08 else (0.16, 0.15, 0.14)
                r, g, b = r + share * (sr - r), g + share * (sg - g), b + share * (sb - b)
            haze = 1.0 - np.exp(-t / 700.0)
            linear[v, u, 0] = r + haze * (0.78 - r)
            linear[v, u, 1] = g + haze * (0.83 - g)
            linear[v, u, 2] = b + haze * (0.90 - b)
            kinds[v, u], depth[v, u] = kind, t * cosine


@kernel
def _develop(linear: Singles, gain: float, key: int, display: Bytes, rgb: Bytes) -> None:
    """From radiance to bytes: optical blur, vignetting, shot and read noise, gamma curve."""
    height, width, _ = linear.shape
    for v in range(height):
        above, below = max(v - 1, 0), min(v + 1, height - 1)
        for u in range(width):
            left, right = max(u - 1, 0), min(u + 1, width - 1)
            x, y = (u - 0.5 * width) / width, (v - 0.5 * height) / width
            scale = gain * (1.0 - 0.45 * (x * x + y * y))
            for c in range(3):
                middle = linear[above, u, c] + 4.0 * linear[v, u, c] + linear[below, u, c]
                before = linear[above, left, c] + 4.0 * linear[v, left, c] + linear[below, left, c]
                behind = linear[above, right, c] + 4.0 * linear[v, right, c] + linear[below, right, c]
                light = max(0.0, scale * (before + 4.0 * middle + behind) / 36.0)
                light += gaussian(key, v, u, c) * (0.0025 + 0.012 * np.sqrt(light))
                rgb[v, u, c] = display[int(min(4095.0, max(0.0, light * 4095.0)))]


def sun_direction(seed: int) -> Triple:
    """Unit vector towards the sun of a seed, in the map's axes."""
    rng = np.random.default_rng([seed, 2])
    azimuth, height = float(rng.uniform(0, 2 * np.pi)), float(np.radians(rng.uniform(38.0, 58.0)))
    level = math.cos(height)
    return math.cos(azimuth) * level, math.sin(azimuth) * level, math.sin(height)


def render_image(
    world: World,
    T_map_camera: Floats,
    stamp: float,
    *,
    camera: Camera | None = None,
    seed: int = 0,
    frame: int = 0,
) -> SimulatedImage:
    """What the camera at `T_map_camera` (4, 4; x right, y down, z forward) sees at a moment (s).

    The same arguments give the same bytes, in any order of frames and with any number of threads.
    """
    camera = camera or Camera()
    size = (camera.height, camera.width)
    linear, kinds = np.zeros((*size, 3), np.float32), np.zeros(size, np.uint8)
    depth, light = np.zeros(size, np.float32), np.full(size, -1, np.int8)
    distance, things, shapes = np.zeros(size), np.zeros(size, np.int64), np.zeros(size, np.int64)
    scene, sun = world.scene(stamp, stamp), sun_direction(seed)
    see(scene, T_map_camera, camera.rays, distance, things, shapes)
    _expose(scene, T_map_camera, camera.rays, sun, distance, things, shapes, linear, kinds, depth, light)
    # exposure is metered on the lower half; it follows slow changes of light, with some oscillation
    brightness = max(float(linear[size[0] // 3 :: 4, ::4].mean()), 0.05)
    gain = 0.62 * (0.42 / brightness) ** 0.7 * (1.0 + 0.10 * np.sin(0.9 * stamp) + 0.05 * np.sin(2.3 * stamp))
    rgb = np.zeros((*size, 3), np.uint8)
    _develop(linear, gain, seed * 1_000_003 + frame + 500_009, _DISPLAY, rgb)
    instances = np.where(things >= 0, world.instances[things], 0).astype(np.uint16)
    return SimulatedImage(rgb, TRAIN_IDS[kinds], depth, instances)

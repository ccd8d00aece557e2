"""A simulated Velodyne HDL-64E: one sweep, every column at its own time.

Conventions of KITTI's raw scans: the sweep begins behind the car (azimuth 180 degrees) and runs clockwise; a point of
azimuth a has the stamp start + (0.5 - a / 2 pi) (end - start), a in (-pi, pi]; the file holds ring after ring from the
top, azimuth increasing from 0 in each; coordinates are raw (not motion-compensated), in whole millimetres.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from gnss_sem_map.simulation.compiled import Bytes, Floats, Integers, Singles, Triple, kernel
from gnss_sem_map.simulation.ground import FAR
from gnss_sem_map.simulation.noise import gaussian, uniform
from gnss_sem_map.simulation.raycast import Scene, cast_ray
from gnss_sem_map.simulation.surface_at import surface_at
from gnss_sem_map.simulation.surfaces import RAW_IDS, REFLECTANCES, Surface
from gnss_sem_map.simulation.textures import window_at
from gnss_sem_map.simulation.world import World

_CABIN, _FACADE = int(Surface.CABIN), int(Surface.FACADE)
_NOTHING = 255  # the kind of a ray without a return


def _hdl_64e() -> Floats:
    return np.asarray(
        np.radians(np.concatenate([np.linspace(2.0, -8.33, 32), np.linspace(-8.87, -24.9, 32)]))
    )


@dataclass(frozen=True, eq=False)
class Lidar:
    """A spinning LiDAR; the defaults are the HDL-64E's."""

    elevations: Floats = field(default_factory=_hdl_64e)
    columns: int = 2083
    range_m: float = 120.0
    blind_m: float = 2.3
    range_stddev_m: float = 0.02
    dropout: float = 0.015

    @cached_property
    def azimuths(self) -> Floats:
        """Azimuth of every column, rad in (-pi, pi], in file order (none lies on the seam)."""
        a = (np.arange(self.columns) + 0.25) * (2 * np.pi / self.columns)
        return np.where(a > np.pi, a - 2 * np.pi, a)

    @cached_property
    def fractions(self) -> Floats:
        """When every column is measured, as a part of the sweep."""
        return 0.5 - self.azimuths / (2 * np.pi)

    @cached_property
    def directions(self) -> Floats:
        """Unit vectors of all rays in the LiDAR's axes, (columns, rings, 3)."""
        a, e = self.azimuths[:, None], self.elevations[None, :]
        parts = np.broadcast_arrays(np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e))
        return np.stack(parts, axis=-1)


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """One sweep: `points` (n, 4) float32 x y z reflectance in the LiDAR's axes, `labels` (n,) uint32 SemanticKITTI
    ids with the instance in the high half, `fractions` (n,) of the sweep at which each was measured."""

    points: npt.NDArray[np.float32]
    labels: npt.NDArray[np.uint32]
    fractions: Floats


@kernel
def _sweep(
    scene: Scene,
    T: Floats,
    fractions: Floats,
    directions: Floats,
    reach: float,
    reflectances: Floats,
    lidar: Triple,
    key: int,
    points: Singles,
    kinds: Bytes,
    things: Integers,
) -> None:
    """Cast all rays of a sweep, column by column; a return is written to the ray's row, ring by ring.

    `T` (columns, 4, 4) T_map_lidar, `fractions` (columns,) of the sweep, `directions` (columns, rings, 3) in LiDAR
    axes. `lidar`: blind range, range noise, dropout. Coordinates are whole millimetres; `kinds` of rays without a
    return stay.
    """
    blind, noise, dropout = lidar
    count = directions.shape[0]
    for column in range(count):
        ox, oy, oz, fraction = T[column, 0, 3], T[column, 1, 3], T[column, 2, 3], fractions[column]
        for ring in range(directions.shape[1]):
            x, y, z = directions[column, ring, 0], directions[column, ring, 1], directions[column, ring, 2]
            dx = T[column, 0, 0] * x + T[column, 0, 1] * y + T[column, 0, 2] * z
            dy = T[column, 1, 0] * x + T[column, 1, 1] * y + T[column, 1, 2] * z
            dz = T[column, 2, 0] * x + T[column, 2, 1] * y + T[column, 2, 2] * z
            t, thing, shape = cast_ray(scene, reach, False, fraction, ox, oy, oz, dx, dy, dz)
            if t >= FAR or t < blind or uniform(key, ring, column, 1) < dropout:
                continue
            surface, kind, n, p, _ = surface_at(scene, thing, shape, fraction, ox, oy, oz, dx, dy, dz, t)
            slant = abs(n[0] * dx + n[1] * dy + n[2] * dz)
            chance = uniform(key, ring, column, 2)
            # glass mirrors the beam away, and little comes back from dark ground at a grazing angle
            if surface == _CABIN and chance < 0.75:
                continue
            if surface == _FACADE and chance < 0.5 and window_at(p[0], p[2])[0] >= 0.0:
                continue
            echo = reflectances[surface] * (0.25 + 0.75 * np.sqrt(slant))
            if chance > 4000.0 * echo * (0.02 + slant) / (t * t):
                continue
            measured = 1000.0 * (t + noise * gaussian(key, ring, column, 3))
            bright = min(0.99, max(0.0, echo + 0.05 * gaussian(key, ring, column, 4)))
            row = ring * count + column
            for axis in range(3):
                points[row, axis] = np.float32(np.rint(measured * directions[column, ring, axis]) / 1000.0)
            points[row, 3] = np.float32(np.rint(100.0 * bright) / 100.0)
            kinds[row], things[row] = kind, thing


@kernel
def _close_up(fractions: Floats, points: Singles, kinds: Bytes, things: Integers, measured: Floats) -> int:
    """Move the rows with a return to the front, in order, and write their times `measured`; returns their number."""
    count = 0
    for row in range(len(kinds)):
        if kinds[row] != _NOTHING:
            for axis in range(4):
                points[count, axis] = points[row, axis]
            kinds[count], things[count] = kinds[row], things[row]
            measured[count] = fractions[row % len(fractions)]
            count += 1
    return count


def render_scan(
    world: World,
    T_imu_lidar: Floats,
    start: float,
    end: float,
    *,
    lidar: Lidar | None = None,
    seed: int = 0,
    frame: int = 0,
) -> SimulatedScan:
    """What the LiDAR measures in a sweep from `start` to `end` (s) while the vehicle drives.

    The same arguments give the same bytes, in any order of frames and with any number of threads.
    """
    lidar = lidar or Lidar()
    scene, fractions = world.scene(start, end), lidar.fractions
    T = world.ego.poses(start + fractions * (end - start)) @ T_imu_lidar
    rays = lidar.columns * len(lidar.elevations)
    points, measured = np.empty((rays, 4), np.float32), np.empty(rays)
    kinds, things = np.full(rays, _NOTHING, np.uint8), np.empty(rays, np.int32)
    _sweep(
        scene, T, fractions, lidar.directions, lidar.range_m, REFLECTANCES,
        (lidar.blind_m, lidar.range_stddev_m, lidar.dropout), seed * 1_000_003 + frame, points, kinds, things,
    )  # fmt: skip
    count = _close_up(fractions, points, kinds, things, measured)
    labels = hit_labels(world, kinds[:count], things[:count])
    return SimulatedScan(points[:count].copy(), labels, measured[:count].copy())


def hit_labels(
    world: World, kinds: npt.NDArray[np.uint8], things: npt.NDArray[np.int32]
) -> npt.NDArray[np.uint32]:
    """SemanticKITTI labels of hits: the kind, moving or not, and the instance in the high 16 bits."""
    n = len(world.town.things)
    # GROUND and KERB are negative, and so count from the end: two more rows for them
    ids = np.concatenate([world.instances, [0, 0]]).astype(np.uint32) << np.uint32(16)
    moving = (things >= n).view(np.uint8)
    labels: npt.NDArray[np.uint32] = RAW_IDS[moving, kinds] | ids[things]
    return labels

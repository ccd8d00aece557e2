"""Motion of the LiDAR from registration of a few sweeps: uses points only, no calibration and no clock.

A stretch is five sweeps over about a second: the first two tell the speed, the others are matched with the first, each
started where that speed takes it. With times for the points every sweep is deskewed by this motion, not by the
trajectory, and matched once more: what the trajectory, the extrinsics or the times have wrong stays out of the match.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.preflight.planes import Planes, jacobians, normals_of
from gnss_sem_map.scans.registration import exp, inverse
from gnss_sem_map.sensor_log import Points, Scan
from gnss_sem_map.voxels.hash_unique import distinct
from gnss_sem_map.voxels.kernels import pack_keys

Array = NDArray[np.float64]
WAY_STDDEV_M, TURN_STDDEV_RAD = 0.05, np.radians(0.15)
"""How well a match knows the way and the turn of a second."""
Keys = NDArray[np.int64]
Rates = tuple[Array, Array]
"""Angular rate (3,) rad/s and velocity (3,) m/s."""

STEPS = (1, 3, 6, 9)
"""Sweeps of a stretch, counted from its first."""
NEAREST_M, FARTHEST_M = 2.5, 50.0
EDGE_M = 0.6
"""One point per cube of this edge is matched."""
LEAST_POINTS = 150
FIRST_M, NEXT_M, AGAIN_M = (3.0, 2.0, 1.0, 0.5), (2.0, 1.0, 0.5, 0.3), (0.5, 0.3)
"""How far a point may lie from its surface, step by step: unknown speed, known speed, deskewed once more."""
LOST_M = 0.3
LEAST_HELD = 0.01
"""A motion is known along a direction that so much of the points' weight holds."""
LEAST_SHARE = 0.35
"""A match is believed when so many of its points lie on a surface of the other sweep (good ones: 0.5 to 0.9)."""
EVERY = 4
"""Of a sweep's points, this part tells how thick its surfaces are."""
CUBE_M, LEAST_IN_CUBE, LEAST_SWEEPS = 0.5, 10, 3
SMOOTH_M = 0.02
"""Least thickness of a surface: the noise of a LiDAR."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """Some points of a sweep as they were measured: (m) to match, and (d) more to see surfaces with."""

    stamp: float
    p_lidar: Array
    """(m, 3) m."""
    after_s: Array | None
    """(m,) s after the sweep's stamp, as given; None: said to be compensated."""
    dense: Array
    """(d, 3) m."""
    dense_after_s: Array | None
    """(d,) s."""

    @cached_property
    def normals(self) -> Array:
        """Of the planes at the points to match (m, 3), zero where there is none; few sweeps need them."""
        return normals_of(self.p_lidar)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The cubes (c) that several sweeps of a stretch saw."""

    cubes: Keys
    extents: Array
    """(c,) ½ ln det of the covariance: how far the points spread, edges and poles included."""
    thicknesses: Array
    """(c,) ln of the standard deviation across the surface."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Five sweeps, and where each lies in the first as measured: T_first_sweep (5, 4, 4)."""

    sweeps: tuple[Sweep, ...]
    T: Array
    is_held: bool
    """Whether the scene tells the motion in all directions."""

    @property
    def stamps(self) -> Array:
        """(5,) s."""
        return np.array([sweep.stamp for sweep in self.sweeps])

    @cached_property
    def rates(self) -> tuple[Rates, ...]:
        """How the LiDAR moved at each sweep, in its own axes, from the sweeps beside it."""
        last, stamps = len(self.T) - 1, self.stamps
        beside = [(max(k - 1, 0), min(k + 1, last)) for k in range(last + 1)]
        return tuple(_rates(inverse(self.T[a]) @ self.T[b], stamps[b] - stamps[a]) for a, b in beside)

    def deskewed(self, after_s: tuple[tuple[Array, Array] | None, ...]) -> tuple[Array, Surfaces]:
        """T_first_sweep (4, 4, 4) of all but the second, and the surfaces, with other times of (m) and (d) points."""
        matched, clouds, first = [np.eye(4)], [], None
        for k in (0, *range(2, len(self.sweeps))):
            sweep, times = self.sweeps[k], after_s[k]
            p, dense = sweep.p_lidar, sweep.dense
            if times is not None:
                p, dense = _moved(p, times[0], self.rates[k]), _moved(dense, times[1], self.rates[k])
            if first is None:
                first = Target(p, sweep.normals)
            else:
                found = first.match(p, self.T[k], AGAIN_M)
                matched.append(self.T[k] if found is None else found.T)
            clouds.append(dense @ matched[-1][:3, :3].T + matched[-1][:3, 3])
        return np.array(matched), _surfaces(clouds)


@dataclass(frozen=True, eq=False)
class Match:
    """Where one sweep lies in another, and the share of its points that lie on a surface there."""

    T: Array
    share: float
    off: float
    """Mean squared distance of all points from the surfaces, m², none counted farther than `LOST_M`."""
    held: float
    """Part of the points' weight that holds the least held direction: 0 in a street of smooth walls."""


class Target:
    """A sweep that others are matched with, point to plane."""

    def __init__(self, p_lidar: Array, normals: Array) -> None:
        self._planes = Planes(p_lidar, normals)

    def match(self, p: Array, guess: Array, steps_m: tuple[float, ...]) -> Match | None:
        """Register the points (m, 3) of another sweep to this one; None if too few have a correspondence."""
        T, share, off, held = guess, 0.0, 0.0, 0.0
        for within_m in steps_m:
            at, n, residuals = self._planes.near(p @ T[:3, :3].T + T[:3, 3], within_m)
            if len(at) < LEAST_POINTS / 2:
                return None
            share = len(at) / len(p)
            off = (1 - share) * LOST_M**2 + share * float(np.minimum(residuals**2, LOST_M**2).mean())
            J, weighted = jacobians(at, n, residuals)
            H = J.T @ weighted
            # a little weight on the guess: along an open street nothing holds, and nothing may run away
            step = np.linalg.solve(H + 0.1 * np.eye(6), weighted.T @ residuals)
            T = exp(-np.asarray(step, np.float64)) @ T
            along = H[3:, 3:] - H[3:, :3] @ np.linalg.lstsq(H[:3, :3], H[:3, 3:], rcond=None)[0]
            held = float(np.linalg.eigvalsh(along)[0] / len(at))
        return Match(T, share, off, held)


def stretch(scans: tuple[Scan, ...], first: int, starts: tuple[Array, ...] = ()) -> Stretch | None:
    """The sweeps from `first` on, matched; None where one has too few points or finds no place. Raises DataError.

    The second is tried from where the first was and from all `starts` (4, 4), and the best match counts: in a street
    of smooth walls a match stays near its start, wherever that is.
    """
    sweeps: list[Sweep] = []
    for place in (0, *STEPS):
        scan = scans[first + place]
        sweep = thinned(scan.read(), scan.stamp)
        if sweep is None:
            return None
        sweeps.append(sweep)
    holds: list[float] = []
    target, T, rates = Target(sweeps[0].p_lidar, sweeps[0].normals), [np.eye(4)], None
    for k in range(1, len(sweeps)):
        step_s = sweeps[k].stamp - sweeps[k - 1].stamp
        if rates is None:
            tried = [target.match(sweeps[k].p_lidar, guess, FIRST_M) for guess in (np.eye(4), *starts)]
            found = min((t for t in tried if t is not None), key=lambda t: t.off, default=None)
        else:
            found = target.match(sweeps[k].p_lidar, T[-1] @ exp(np.concatenate(rates) * step_s), NEXT_M)
        if found is None or found.share < LEAST_SHARE:
            return None
        rates = _rates(inverse(T[-1]) @ found.T, step_s)
        T.append(found.T)
        holds.append(found.held)
    return Stretch(tuple(sweeps), np.array(T), min(holds) > LEAST_HELD)


def thinned(points: Points, stamp: float) -> Sweep | None:
    """A sweep ready to be matched; None where too few of its points can be used."""
    squares = np.einsum("ij,ij->i", points.xyz, points.xyz)
    usable = np.flatnonzero((squares > NEAREST_M**2) & (squares < FARTHEST_M**2))[::2]
    cloud = points.xyz[usable].astype(np.float64)
    keys = np.empty(len(cloud), np.int64)
    pack_keys(cloud, EDGE_M, keys)
    cubes, cube = distinct(keys)
    if len(cubes) < LEAST_POINTS:
        return None
    one = np.empty(len(cubes), np.int64)
    one[cube] = np.arange(len(cloud))
    p, dense = cloud[one], slice(None, None, EVERY // 2)
    after = None if points.stamps is None else points.stamps[usable] - stamp
    return Sweep(
        stamp,
        p,
        None if after is None else after[one],
        cloud[dense],
        None if after is None else after[dense],
    )


def turns(p: NDArray[np.floating]) -> Array:
    """How far a clockwise scanner had turned at each point (n, 3): -0.5 and 0.5 at the rear, 0 in front."""
    return np.asarray(-np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi), np.float64)


def _surfaces(clouds: list[Array]) -> Surfaces:
    """Moments of the points in every cube of the first sweep's frame."""
    p, seen = np.concatenate(clouds), np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    keys = np.empty(len(p), np.int64)
    pack_keys(p, CUBE_M, keys)
    cubes, cube = distinct(keys)
    counts = np.bincount(cube, minlength=len(cubes))
    sweeps = sum(
        (np.bincount(cube[seen == k], minlength=len(cubes)) > 0).astype(int) for k in range(len(clouds))
    )
    enough = (counts >= LEAST_IN_CUBE) & (sweeps >= LEAST_SWEEPS) & (cubes != 0)
    p = p - (np.floor(p / CUBE_M) + 0.5) * CUBE_M
    means = [np.bincount(cube, p[:, i], len(cubes)) / counts for i in range(3)]
    covariances = np.empty((len(cubes), 3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        moment = np.bincount(cube, p[:, i] * p[:, j], len(cubes)) / counts
        covariances[:, i, j] = covariances[:, j, i] = moment - means[i] * means[j]
    variances = np.maximum(np.linalg.eigvalsh(covariances[enough]), 0.0) + SMOOTH_M**2
    return Surfaces(cubes[enough], 0.5 * np.log(variances).sum(axis=1), 0.5 * np.log(variances[:, 0]))


def _moved(p: Array, after_s: Array, rates: Rates) -> Array:
    """Points from where they were measured to the frame of the sweep's stamp."""
    return p + after_s[:, None] * (np.cross(rates[0], p) + rates[1])


def _rates(T: Array, seconds: float) -> Rates:
    return Rotation.from_matrix(T[:3, :3]).as_rotvec() / seconds, T[:3, 3] / seconds

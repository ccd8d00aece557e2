"""Check of several LiDARs against each other: what one sees lies on the surfaces that the first one sees.

At a few moments of the drive, sweeps of the first LiDAR from two seconds before to two seconds after, placed by the
trajectory, are the surfaces. A sweep of another LiDAR is matched with them, point to plane, at all moments at once: the
one motion in the imu frame that brings its points onto the surfaces is the error of its pose relative to the first.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.preflight.planes import SOFT_M, Planes, jacobians, normals_of
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.scans.deskew import EXTRAPOLATE_S, points_in_map
from gnss_sem_map.scans.downsampling import one_per_cube
from gnss_sem_map.scans.registration import exp, inverse
from gnss_sem_map.sensor_log import Scan, SensorLog

Array = NDArray[np.float64]

AROUND_S = (-2.0, -1.0, -0.4, 0.0, 0.4, 1.0, 2.0)
"""So long before and after a moment the first LiDAR is looked at: it has then seen what the other one sees."""
AT_MOST_S = 0.3
"""Farther from where it was wanted, no sweep is taken."""
NEAREST_M, FARTHEST_M = 2.5, 40.0
EDGE_M = 0.3
"""One point per cube of this edge counts, the mean."""
LEAST_POINTS = 150
STEPS_M = (3.0, 2.0, 1.0, 0.5, 0.3, 0.2)
"""How far a point may lie from its surface, step by step."""
REPEATS, STILL = 6, 2e-3
"""Each step is repeated at most so often, until the next motion is smaller than this, rad and m."""
NEAR_M = 1.0
"""Of points within this distance of a surface, the median distance is told."""
LEAST_SHARE = 0.35
"""A match is believed when so many of the points lie within the last step of a surface."""
POINTS_PER_SURFACE = 100
"""Points of one surface err together: so many count as one."""
SIGMAS = 4.0
SAME_RAD, SAME_M = np.radians(0.3), 0.06
"""Differences that are no reason to warn."""
WRONG_RAD, WRONG_M = np.radians(1.0), 0.15
"""Larger ones double every wall."""
TURNS, CELL_M = 4000, 0.5
"""Where nothing fits, so many rotations all around are tried, 10 degrees apart: by the points of a few moments that
then lie in a cell of this size with a surface, or beside one."""
TURNS_MATCHED, HEADINGS, MOMENTS_TRIED, POINTS_TRIED = 12, 24, 3, 400
"""The best of them are matched, by few points of these moments, and the best of these again with so many headings: the
ground alone holds it level."""


@dataclass(frozen=True, eq=False)
class _Moment:
    """Surfaces by the first LiDAR, and points of the other one, both in the imu frame of one moment."""

    surfaces: Planes
    p: Array
    """(m, 3) m"""
    up: Array
    """(3,) unit vector."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """Where points lie best: T (4, 4) in the imu frame, and how well."""

    T: Array
    stddevs: Array
    """(6,) rad and m."""
    share: float
    """Of the points that lie within the last step of a surface."""

    @property
    def turn(self) -> Array:
        """(3,) rad"""
        return np.asarray(Rotation.from_matrix(self.T[:3, :3]).as_rotvec())


def check(sample: Sample) -> Iterator[Finding]:
    """Every LiDAR but the first."""
    first, *others = sample.log.by_lidar
    for other in others:
        yield _check(sample, first, other)


def _check(sample: Sample, first: SensorLog, other: SensorLog) -> Finding:
    name, trajectory = f"{other.lidar} against {first.lidar}", sample.trajectory
    if trajectory is None:
        return green(name, "not observable: no trajectory of the sample")
    moments = _moments(sample, first, other, trajectory)
    if not moments:
        return green(name, "not observable: no moment at which both have points")
    best = _match(moments, np.eye(4))
    apart, fitted = _distance(moments, np.eye(4)), _distance(moments, best.T)
    if best.share < LEAST_SHARE or fitted > SOFT_M:
        far = max(_far_matches(moments, other.calibration.T_imu_lidar), key=lambda fit: fit.share)
        # sweeps that are deskewed by a pose that is far off are bent: once more by the pose that was found
        there = _placed(other, far.T @ other.calibration.T_imu_lidar)
        if straight := _moments(sample, first, there, trajectory):
            found = _match(straight, np.eye(4))
            if found.share > best.share:
                best, fitted = replace(found, T=found.T @ far.T), _distance(straight, found.T)
    return _finding(name, other.lidar, first.lidar, best, apart, fitted, len(moments))


def _moments(sample: Sample, first: SensorLog, other: SensorLog, trajectory: Trajectory) -> list[_Moment]:
    found = (_moment(first, other, scan.stamp, trajectory) for scan in sample.moving_scans[0][::2])
    return [one for one in found if one is not None]


def _placed(log: SensorLog, T_imu_lidar: Array) -> SensorLog:
    """The log with its LiDAR at another pose."""
    return replace(log, calibration=replace(log.calibration, T_imu_lidar=T_imu_lidar))


def _far_matches(moments: list[_Moment], T_imu_lidar: Array) -> Iterator[_Fit]:
    """Matches from where the LiDAR lies by the inverse of its pose, and from the best of all rotations.

    These are about the LiDAR, whose axes may be wrong, and about the imu, whose axes may be.
    """
    few = [_thinned(moment) for moment in moments[:: -(-len(moments) // MOMENTS_TRIED)]]
    turns = Rotation.random(TURNS, random_state=0)
    all_around = np.concatenate([_about(place, turns) for place in (T_imu_lidar[:3, 3], np.zeros(3))])
    hits = np.sum([_on_surfaces(moment, all_around) for moment in few], axis=0)
    level = _best(few, all_around[np.argsort(-hits, kind="stable")[:TURNS_MATCHED]])
    angles = np.arange(HEADINGS) * 2 * np.pi / HEADINGS
    headings = _about((level @ T_imu_lidar)[:3, 3], Rotation.from_rotvec(np.outer(angles, moments[0].up)))
    yield _match(moments, _best(few, headings @ level))
    inverted = inverse(T_imu_lidar)
    yield _match(moments, inverted @ inverted)


def _about(place: Array, turns: Rotation) -> Array:
    """Rotations about a place (3,) m, as (k, 4, 4)."""
    T = np.tile(np.eye(4), (len(turns), 1, 1))
    T[:, :3, :3] = turns.as_matrix()
    T[:, :3, 3] = place - T[:, :3, :3] @ place
    return T


def _best(moments: list[_Moment], starts: Array) -> Array:
    """The best match (4, 4) from some starts (k, 4, 4)."""
    return max((_match(moments, T) for T in starts), key=lambda fit: fit.share).T


def _thinned(moment: _Moment) -> _Moment:
    return replace(moment, p=moment.p[:: -(-len(moment.p) // POINTS_TRIED)])


def _on_surfaces(moment: _Moment, Ts: Array) -> NDArray[np.int64]:
    """For each motion (k, 4, 4), how many points it brings into a cell with a surface, or beside one: (k,)."""
    size = int(2 * FARTHEST_M / CELL_M) + 3  # an empty cell on every side
    occupied = np.zeros((size,) * 3, np.bool_)
    occupied[tuple((moment.surfaces.p / CELL_M).astype(np.int64).T + size // 2)] = True
    occupied = binary_dilation(occupied, np.ones((3, 3, 3), np.bool_))
    hits = np.empty(len(Ts), np.int64)
    for k, T in enumerate(Ts):
        cells = ((moment.p @ T[:3, :3].T + T[:3, 3]) / CELL_M).astype(np.int64) + size // 2
        hits[k] = occupied[tuple(np.clip(cells, 0, size - 1).T)].sum()
    return hits


def _finding(
    name: str, other: str, first: str, best: _Fit, apart: float, fitted: float, moments: int
) -> Finding:
    lies = f"surfaces of {other} lie {apart:.3f} m from those of {first} (median of {moments} moments)"
    if best.share < LEAST_SHARE:
        return amber(
            name,
            f"{lies}; {best.share:.0%} of the points find a surface, expected more than {LEAST_SHARE:.0%}",
            f"T_imu_lidar of {other} or of {first} is far off, or the two see different places",
            f"check T_imu_lidar of {other} and {first}",
        )
    turn, shift = best.turn, best.T[:3, 3]
    size = np.concatenate([np.abs(turn), np.abs(shift)])
    limits = np.repeat([SAME_RAD, SAME_M], 3)
    if not ((size > limits) & (size > SIGMAS * best.stddevs)).any():
        return green(name, lies)
    degrees = " ".join(f"{angle:.2f}" for angle in np.degrees(turn))
    metres = " ".join(f"{value:.2f}" for value in shift)
    is_wrong = ((size > np.repeat([WRONG_RAD, WRONG_M], 3)) & (size > SIGMAS * best.stddevs)).any()
    level = red if is_wrong and fitted < apart else amber
    return level(
        name,
        f"{lies}, and {fitted:.3f} m when turned by {degrees} deg about x, y, z of the imu and moved by {metres} m",
        f"the two LiDARs are calibrated onto each other wrongly: T_imu_lidar of {other} or of {first}",
        f"if {first} is right, put this rotation and shift before T_imu_lidar of {other}; else calibrate again",
    )


def _moment(first: SensorLog, other: SensorLog, stamp: float, trajectory: Trajectory) -> _Moment | None:
    try:
        T_imu_map = inverse(trajectory.at([stamp], EXTRAPOLATE_S)[0])
        p = _points(other, _nearest(other.scans, stamp), trajectory, T_imu_map)
        clouds = []
        for after in AROUND_S:
            if trajectory.start <= stamp + after <= trajectory.end:
                clouds.append(_points(first, _nearest(first.scans, stamp + after), trajectory, T_imu_map))
    except (DataError, MeasurementError):
        return None  # what cannot be read is told by other checks
    if not clouds or len(p) < LEAST_POINTS:
        return None
    surface = one_per_cube(np.concatenate(clouds), EDGE_M)
    if len(surface) < LEAST_POINTS:
        return None
    surfaces = Planes(surface, normals_of(surface))
    return _Moment(surfaces, one_per_cube(p, EDGE_M), np.asarray(T_imu_map[:3, 2]))


def _nearest(scans: tuple[Scan, ...], stamp: float) -> Scan | None:
    scan = min(scans, key=lambda scan: abs(scan.stamp - stamp), default=None)
    return scan if scan is not None and abs(scan.stamp - stamp) <= AT_MOST_S else None


def _points(log: SensorLog, scan: Scan | None, trajectory: Trajectory, T_imu_map: Array) -> Array:
    """The points of a sweep in the imu frame of the moment (n, 3); none without a sweep."""
    if scan is None:
        return np.empty((0, 3))
    p_map = points_in_map(scan.read(), scan.stamp, trajectory, log.calibration.T_imu_lidar)
    p = p_map @ T_imu_map[:3, :3].T + T_imu_map[:3, 3]
    squares = np.einsum("ij,ij->i", p, p)
    return np.asarray(p[(squares > NEAREST_M**2) & (squares < FARTHEST_M**2)])


def _residuals(moment: _Moment, T: Array, within_m: float) -> tuple[Array, Array, Array]:
    """Points (k, 3) within a distance of a surface, its normals there (k, 3), and their distances across it (k,)."""
    return moment.surfaces.near(moment.p @ T[:3, :3].T + T[:3, 3], within_m)


def _distance(moments: list[_Moment], T: Array) -> float:
    """Median distance of the points from their surfaces, m."""
    return float(np.median(np.abs(np.concatenate([_residuals(moment, T, NEAR_M)[2] for moment in moments]))))


def _match(moments: list[_Moment], T: Array) -> _Fit:
    fit = _Fit(T, np.full(6, np.inf), 0.0)
    for within_m in STEPS_M:
        for _ in range(REPEATS):
            before, fit = fit.T, _step(moments, fit.T, within_m)
            if np.abs(fit.T - before).max() < STILL:
                break
    return fit


def _step(moments: list[_Moment], T: Array, within_m: float) -> _Fit:
    """One step of Gauss and Newton."""
    found = [_residuals(moment, T, within_m) for moment in moments]
    at, n, r = (np.concatenate(parts) for parts in zip(*found, strict=True))
    share = len(r) / sum(len(moment.p) for moment in moments)
    J, weighted = jacobians(at, n, r)
    scatter = 1.48 * float(np.median(np.abs(r))) if len(r) else np.inf
    H = J.T @ weighted + np.eye(6)  # a little weight on where it is: what no surface holds stays
    T = exp(-np.linalg.solve(H, weighted.T @ r)) @ T
    return _Fit(T, np.sqrt(np.diag(POINTS_PER_SURFACE * scatter**2 * np.linalg.inv(H))), share)

"""Is the camera where, and when, the calibration says? Depth edges of the LiDAR against edges of the image.

Where a ring jumps from something near to something far, the image has an edge, too, if time and mounting are right.
The agreement is how much stronger the image's gradient is at such points than at all points that it shows; time offset
and rotation are those under which it is largest. Source: Levinson, Thrun, "Automatic online calibration of cameras and
lasers" (2013); the time offset beside the rotation is ours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.account import Progress, silent
from gnss_sem_map.config import Settings
from gnss_sem_map.deskew import EXTRAPOLATE_S
from gnss_sem_map.errors import DataError
from gnss_sem_map.labelling import NEAREST_DEPTH_M, exposure_stamp
from gnss_sem_map.seen_scans import map_points
from gnss_sem_map.sensor_log import Calibration, Scan, SensorLog

Array = NDArray[np.float64]
JUMP_M, LARGEST_JUMP_M, FARTHEST_M = 0.5, 5.0, 50.0
"""A point is at a depth edge when its neighbour in the ring is this much farther; more than 5 m counts as 5 m."""
NEIGHBOUR_DEG, SURFACE_M = 1.0, 0.15
"""Neighbours in a ring; and how smooth the near side must go on, for foliage is all jumps."""
MOST_EDGES = 600
"""Edges per scan: more tell nothing new."""
SURROUNDINGS_PX = 25.0
COARSE_PX, FINE_PX = 6.0, 1.5
"""Blur of the image's gradient, in the first search and in the last."""
STEP_S, STEP_DEG = 0.005, 0.1
SEARCH_S, SEARCH_DEG = 0.06, 1.0
GROUPS = 5
LEAST_IMAGES, LEAST_EDGES = 5, 300
SAME_S, SAME_DEG, SIGMAS = 0.005, (0.3, 0.15, 0.3), 3.0
"""Differences that are no reason to warn: a rotation about y is two pixels of KITTI's camera; upright edges tell it
best, and the others, which they only see where they lean, to about 0.2 deg (simulated and real drives)."""
LEAST_AGREEMENT = 1.25
"""Real and simulated drives reach 1.6 to 3; images of something else 1."""


@dataclass(frozen=True)
class CameraCheck:
    """What depth edges and image edges say about the camera of a drive."""

    time_offset_s: float
    """Moment of exposure minus image stamp, as the edges say."""
    time_offset_stddev_s: float
    given_time_offset_s: float
    rotation_deg: tuple[float, float, float]
    """What to turn the camera by, about its own x (right), y (down) and z (forward): rotation vector."""
    rotation_stddev_deg: tuple[float, float, float]
    agreement: float
    """Image gradient at depth edges over that at all points, as calibrated."""
    best_agreement: float
    images: int
    edges: int
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Edges:
    """Depth edges of all looked-at scans, with their images' gradients."""

    p_map: Array
    """(n, 3) m."""
    weights: Array
    """(n,)."""
    images: NDArray[np.int64]
    """(n,) which image each is to be found in."""
    stamps: Array
    """(k,) s, when the images were exposed, as calibrated."""
    gradients: dict[float, NDArray[np.float32]]
    """Blur, px -> (k, h, w), each divided by its mean over all points that the image shows."""

    def of(self, chosen: NDArray[np.bool_]) -> _Edges:
        """Only the edges in some images (k,)."""
        use = chosen[self.images]
        return _Edges(self.p_map[use], self.weights[use], self.images[use], self.stamps, self.gradients)


def check_camera(
    log: SensorLog,
    trajectory: Trajectory,
    settings: Settings | None = None,
    images: int = 40,
    progress: Progress = silent,
) -> CameraCheck:
    """Estimate the camera's time offset and residual rotation from up to `images` images, and compare with the file.

    Raises DataError without a camera, when no point lies in front of it, or when there is too little to compare.
    """
    settings = settings or Settings()
    check_projection(log)
    edges = _find_edges(log, trajectory, settings, images, progress)
    calibration = log.calibration
    given = exposure_stamp(log.images[0], calibration, settings.labelling) - log.images[0].stamp
    agreement = _agreement(edges, trajectory, calibration, FINE_PX)
    best = _search(edges, trajectory, calibration)
    spread = _spread(edges, trajectory, calibration, best)
    found = CameraCheck(
        time_offset_s=float(given + best[0]),
        time_offset_stddev_s=float(spread[0]),
        given_time_offset_s=float(given),
        rotation_deg=_three(best[1:]),
        rotation_stddev_deg=_three(spread[1:]),
        agreement=-agreement(np.zeros(4)),
        best_agreement=-agreement(best),
        images=len(edges.stamps),
        edges=len(edges.p_map),
        warnings=(),
    )
    return replace(found, warnings=tuple(_warnings(found)))


def check_projection(log: SensorLog, scans: int = 3) -> None:
    """Raise DataError when the calibration puts not one point of the first readable scans in front of the camera."""
    T_camera_lidar = log.calibration.T_camera_lidar
    if not log.calibration.has_camera or T_camera_lidar is None or not log.images:
        raise DataError(f"{log.name}: no camera with calibration and images; nothing to compare")
    looked, points = 0, 0
    for scan in log.scans:
        try:
            xyz = scan.read().xyz
        except DataError:
            continue
        depth = xyz @ T_camera_lidar[2, :3] + T_camera_lidar[2, 3]
        if (depth > NEAREST_DEPTH_M).any():
            return
        looked, points = looked + 1, points + len(xyz)
        if looked == scans:
            break
    if looked:
        raise DataError(
            f"{log.name}: all {points} points of {looked} scans lie behind the camera; expected some in front of it."
            " Is T_camera_lidar inverted, or of another camera?"
        )


def check_stamps(log: SensorLog, within_s: float) -> None:
    """Raise DataError when all images are earlier, or all later, than every scan by more than `within_s`."""
    if not log.scans or not log.images:
        return
    start, end = log.scans[0].stamp, log.scans[-1].stamp
    first, last = log.images[0].stamp, log.images[-1].stamp
    if first > end + within_s or last < start - within_s:
        raise DataError(
            f"{log.name}: images are of {first:.1f} to {last:.1f} s, scans of {start:.1f} to {end:.1f} s; expected the"
            " same time. Are their clocks the same? Without images: --segmenter none"
        )


@dataclass(frozen=True, eq=False)
class _View:
    """Depth edges of one scan, and the image that they are to be found in."""

    p_map: Array
    weights: Array
    stamp: float
    gradients: dict[float, NDArray[np.float32]]


def _find_edges(
    log: SensorLog, trajectory: Trajectory, settings: Settings, images: int, progress: Progress
) -> _Edges:
    """Depth edges in map coordinates, and gradient images, of scans spread over the drive."""
    chosen = np.unique(np.linspace(0, len(log.scans) - 1, min(images, len(log.scans))).astype(int))
    views: list[_View] = []
    refused = ""
    for done, place in enumerate(chosen):
        try:
            views.append(_look(log.scans[place], log, trajectory, settings))
        except (DataError, MeasurementError) as error:
            refused = refused or str(error)
        progress("check", done + 1, len(chosen))
    counts = [len(view.p_map) for view in views]
    if len(views) < LEAST_IMAGES or sum(counts) < LEAST_EDGES:
        why = f"; first reason: {refused}" if refused else ""
        raise DataError(
            f"{log.name}: found {len(views)} usable images and {sum(counts)} depth edges of {len(chosen)} scans,"
            f" expected at least {LEAST_IMAGES} and {LEAST_EDGES} (points ring by ring, as the scanner gives them){why}"
        )
    return _Edges(
        np.concatenate([view.p_map for view in views]),
        np.concatenate([view.weights for view in views]),
        np.repeat(np.arange(len(views)), counts),
        np.array([view.stamp for view in views]),
        {blur: np.stack([view.gradients[blur] for view in views]) for blur in (COARSE_PX, FINE_PX)},
    )


def _look(scan: Scan, log: SensorLog, trajectory: Trajectory, settings: Settings) -> _View:
    """One scan and its image; raises DataError or MeasurementError where they cannot be used."""
    image = log.image_at(scan.stamp, settings.labelling.image_within_s)
    if image is None:
        raise DataError(f"frame {scan.number}: no image near its stamp")
    stamp = exposure_stamp(image, log.calibration, settings.labelling)
    p_map, weights, everything = _depth_edges(scan, log, trajectory, settings)
    T_camera_map = _T_camera_map(np.array([stamp]), trajectory, log.calibration)
    u, v, inside = _project(everything, T_camera_map, log.calibration)
    rows, columns = v[inside].astype(int), u[inside].astype(int)
    grey = image.read().mean(axis=2, dtype=np.float32)
    gradients = {blur: _gradient(grey, blur) for blur in (COARSE_PX, FINE_PX)}
    for gradient in gradients.values():
        gradient /= (gradient[rows, columns].mean() if len(rows) else 0.0) or 1.0  # an image of one colour
    return _View(p_map, weights, stamp, gradients)


def _depth_edges(
    scan: Scan, log: SensorLog, trajectory: Trajectory, settings: Settings
) -> tuple[Array, Array, Array]:
    """Near side of every jump along a ring, in the map (n, 3); weights (n,); and all points (m, 3)."""
    points = scan.read()
    p_map, valid = map_points(points, scan, trajectory, log, settings.mapping)
    xyz = points.xyz[valid].astype(np.float64)
    ranges = np.linalg.norm(xyz, axis=1)
    directions = xyz / ranges[:, None]
    beside = (directions[1:] * directions[:-1]).sum(axis=1) > np.cos(np.radians(NEIGHBOUR_DEG))
    step = np.where(beside, np.diff(ranges), 0.0)
    jump = np.zeros(len(xyz))
    jump[:-1] = np.maximum(jump[:-1], step)
    jump[1:] = np.maximum(jump[1:], -step)
    smooth = np.zeros(len(xyz), np.bool_)
    smooth[1:-1] = beside[1:] & beside[:-1] & (np.minimum(np.abs(step[1:]), np.abs(step[:-1])) < SURFACE_M)
    use = np.flatnonzero((jump > JUMP_M) & (ranges < FARTHEST_M) & smooth)
    use = use[:: len(use) // MOST_EDGES + 1]
    return p_map[use], np.sqrt(np.minimum(jump[use], LARGEST_JUMP_M)), p_map


def _gradient(grey: NDArray[np.float32], blur: float) -> NDArray[np.float32]:
    """Strength of the image's upright edges (h, w), the ones that a ring crosses, against the surroundings.

    The root keeps one bright edge from outweighing all others, the division foliage from attracting everything.
    """
    import cv2

    strength = np.sqrt(np.abs(cv2.Sobel(cv2.GaussianBlur(grey, (0, 0), 1.0), cv2.CV_32F, 1, 0)))
    around = cv2.GaussianBlur(strength, (0, 0), SURROUNDINGS_PX)
    return np.asarray(cv2.GaussianBlur(strength / (around + 1.0), (0, 0), blur), np.float32)


def _T_camera_map(stamps: Array, trajectory: Trajectory, calibration: Calibration) -> Array:
    assert calibration.T_camera_lidar is not None
    T_map_lidar = trajectory.at(stamps, EXTRAPOLATE_S) @ calibration.T_imu_lidar
    return np.asarray(calibration.T_camera_lidar @ np.linalg.inv(T_map_lidar))


def _project(
    p_map: Array, T_camera_map: Array, calibration: Calibration
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Pixel coordinates of points (n, 3) under one pose or one each, and whether the image shows them."""
    assert calibration.K is not None
    assert calibration.image_size is not None
    x, y, depth = (np.einsum("nij,nj->ni", T_camera_map[:, :3, :3], p_map) + T_camera_map[:, :3, 3]).T
    width, height = calibration.image_size
    with np.errstate(divide="ignore", invalid="ignore"):
        u = calibration.K[0, 0] * x / depth + calibration.K[0, 1] * y / depth + calibration.K[0, 2]
        v = calibration.K[1, 1] * y / depth + calibration.K[1, 2]
    inside = (depth > NEAREST_DEPTH_M) & (u >= 0) & (u < width - 1) & (v >= 0) & (v < height - 1)
    return u, v, inside


def _agreement(
    edges: _Edges, trajectory: Trajectory, calibration: Calibration, blur: float
) -> Callable[[Array], float]:
    """Minus the agreement, of a change (4,) of time offset, s, and rotation, deg, against the calibration."""
    gradients = edges.gradients[blur]

    def of(change: Array) -> float:
        T = _T_camera_map(edges.stamps + change[0], trajectory, calibration)
        T[:, :3] = Rotation.from_rotvec(change[1:], degrees=True).as_matrix() @ T[:, :3]
        u, v, inside = _project(edges.p_map, T[edges.images], calibration)
        at = np.stack([edges.images[inside], v[inside], u[inside]])
        strength = map_coordinates(gradients, at, order=1, mode="nearest")
        weights = edges.weights[inside]
        return -float(weights @ strength / weights.sum()) if len(weights) else 0.0

    return of


def _search(edges: _Edges, trajectory: Trajectory, calibration: Calibration) -> Array:
    """The change (4,) with the best agreement: along each axis first, then all together, coarse to fine."""
    best = np.zeros(4)
    agreement = _agreement(edges, trajectory, calibration, COARSE_PX)
    steps = np.array([STEP_S, STEP_DEG, STEP_DEG, STEP_DEG])
    reaches = (SEARCH_S, SEARCH_DEG, SEARCH_DEG, SEARCH_DEG)
    for axis in (2, 1, 0, 3):  # a turn to the side moves the whole image, the others less
        candidates = [
            best + np.eye(4)[axis] * shift
            for shift in np.arange(-reaches[axis], reaches[axis] + 1e-9, 2 * steps[axis])
        ]
        best = min(candidates, key=agreement)
    for blur in (COARSE_PX, FINE_PX):
        best = _polish(_agreement(edges, trajectory, calibration, blur), best, steps)
        steps = steps / 2
    return best


def _polish(agreement: Callable[[Array], float], start: Array, steps: Array) -> Array:
    simplex = np.vstack([np.zeros(4), np.eye(4)])

    def from_start(x: Array) -> float:
        return agreement(start + steps * x)

    options: Any = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-5, "maxfev": 200}
    found = minimize(from_start, np.zeros(4), method="Nelder-Mead", options=options)
    return np.asarray(start + steps * found.x)


def _spread(edges: _Edges, trajectory: Trajectory, calibration: Calibration, best: Array) -> Array:
    """Standard deviation (4,) of the estimate, from estimates of interleaved fifths of the images."""
    groups = np.arange(len(edges.stamps)) % GROUPS
    steps = np.array([STEP_S, STEP_DEG, STEP_DEG, STEP_DEG])
    each = [
        _polish(_agreement(edges.of(groups == g), trajectory, calibration, FINE_PX), best, steps)
        for g in range(GROUPS)
    ]
    return np.asarray(np.std(each, axis=0, ddof=1) / np.sqrt(GROUPS))


def _warnings(found: CameraCheck) -> list[str]:
    if found.best_agreement < LEAST_AGREEMENT:
        return [
            f"depth edges and image edges have nothing in common (agreement {found.best_agreement:.2f}, expected more"
            f" than {LEAST_AGREEMENT}): are the images and the calibration of the same camera?"
        ]
    warnings = []
    late = found.time_offset_s - found.given_time_offset_s
    if abs(late) > max(SAME_S, SIGMAS * found.time_offset_stddev_s):
        warnings.append(
            f"the camera's time offset is {1e3 * found.given_time_offset_s:.1f} ms, the edges say"
            f" {1e3 * found.time_offset_s:.1f} +- {1e3 * found.time_offset_stddev_s:.1f} ms;"
            f" try --set labelling.camera_time_offset_s={found.time_offset_s:.4f}"
        )
    turns = zip("xyz", SAME_DEG, found.rotation_deg, found.rotation_stddev_deg, strict=True)
    for axis, same, turn, stddev in turns:
        if abs(turn) > max(same, SIGMAS * stddev):
            warnings.append(
                f"the camera is turned by {turn:.2f} +- {stddev:.2f} deg about its {axis} axis against the calibration;"
                " check T_camera_lidar"
            )
    return warnings


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z

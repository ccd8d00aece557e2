"""Depth edges of the LiDAR against edges of images or borders of labels: tests the pose and the clock of the camera.

Where a ring jumps from something near to something far, the image has an edge, too, if time and mounting are right.
The agreement is how strong the image's edges are at such points, against their strength all over the image. Source:
Levinson, Thrun, "Automatic online calibration of cameras and lasers" (2013).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.scans import kernels
from gnss_sem_map.scans.deskew import EXTRAPOLATE_S, LONGEST_SWEEP_S
from gnss_sem_map.scans.projection import NEAREST_DEPTH_M
from gnss_sem_map.sensor_log import Points
from gnss_sem_map.sensor_log.cameras import Camera

Array = NDArray[np.float64]
Strength = NDArray[np.float32]
JUMP_M, LARGEST_JUMP_M, FARTHEST_M = 0.5, 5.0, 50.0
"""A point is at a depth edge when its neighbour in the ring is this much farther; more than 5 m counts as 5 m."""
NEIGHBOUR_DEG, SURFACE_M = 1.0, 0.15
"""Neighbours in a ring; and how smooth the near side must go on, for foliage is all jumps."""
MOST_EDGES = 800
SURROUNDINGS_PX = 12.0
COARSE_PX, FINE_PX = 3.0, 1.0
"""Blur of the image's edges, in pixels of half its size: in the first search, and in the last."""
BEHIND_M = 15.0
"""No moment that is tried brings what is farther behind the camera before it: 0.3 s at 50 m/s."""
LEAST_SEEN = 15
"""Edges of one scan that an image must show to tell anything."""


@dataclass(frozen=True)
class Change:
    """What is changed about the camera, against what is said."""

    time_s: float = 0.0
    """The image was exposed so much later."""
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The camera turned about its x (right), y (down) and z (forward): rotation vector."""
    focal: float = 1.0
    """Focal length, times the given one."""
    size: float = 1.0
    """All of K, times the given one: an image of another size."""


UNCHANGED = Change()


@dataclass(frozen=True, eq=False)
class View:
    """Depth edges of one scan, and the edges of the image that shows them."""

    p_map: Array
    """(n, 3) m."""
    weights: Array
    """(n,)."""
    stamp: float
    """s, when the image was exposed, as said."""
    coarse: Strength
    """(h, w) of half the image's size: strength of its edges over their mean."""
    fine: Strength


@dataclass(frozen=True, eq=False)
class Edges:
    """Views of several scans (k), with what projects them."""

    views: tuple[View, ...]
    trajectory: Trajectory | None
    T_imu_lidar: Array
    camera: Camera

    def agreement(self, change: Change = UNCHANGED, fine: bool = False, shift: int = 0) -> Array:
        """Strength of the images' edges at the depth edges (k,), NaN where too few are seen.

        `shift` asks the image of another view, so many on, what it shows at this one's depth edges.
        """
        strengths, count = self._fine if fine else self._coarse, len(self.views)
        u, v, depth = self._pixels(change)
        height, width = strengths.shape[1:]
        inside = (depth > NEAREST_DEPTH_M) & (u >= 0) & (u < 2 * width) & (v >= 0) & (v < 2 * height)
        of, weights = self._of[inside], self._weights[inside]
        at = strengths[(of + shift) % count, (v[inside] / 2).astype(int), (u[inside] / 2).astype(int)]
        sums, totals = np.bincount(of, weights * at, count), np.bincount(of, weights, count)
        enough = np.bincount(of, minlength=count) >= LEAST_SEEN
        return np.where(enough, sums / np.maximum(totals, 1e-9), np.nan)

    def others(self, change: Change = UNCHANGED, fine: bool = False) -> Array:
        """The same with the images of all other views (k,): what depth edges and images have in common by chance."""
        count = len(self.views)
        found = np.array([self.agreement(change, fine, shift) for shift in range(1, count)])
        return np.asarray(found.mean(axis=0)) if count > 1 else np.full(count, np.nan)

    def with_camera(self, T_camera_lidar: Array) -> Edges:
        """The same, for a camera elsewhere."""
        return replace(self, camera=replace(self.camera, T_camera_lidar=T_camera_lidar))

    def _pixels(self, change: Change) -> tuple[Array, Array, Array]:
        camera = self.camera
        T_lidar_map = self._T_lidar_map if not change.time_s else self._at(change.time_s)
        T = camera.T_camera_lidar @ T_lidar_map
        if any(change.rotation_deg):
            T[:, :3] = Rotation.from_rotvec(change.rotation_deg, degrees=True).as_matrix() @ T[:, :3]
        T = T[self._of, :3]
        p_camera = np.einsum("nij,nj->ni", T[:, :, :3], self._p_map) + T[:, :, 3]
        if (change.focal, change.size) != (1.0, 1.0):
            K = camera.K.copy()
            K[:2, :2] *= change.focal * change.size
            K[:2, 2] *= change.size
            camera = replace(camera, K=K)
        found = np.empty_like(p_camera)
        kernels.pixels(p_camera, camera.projection(np.eye(4)), camera.lens, NEAREST_DEPTH_M, found)
        u, v, depth = found.T
        return u, v, depth

    def _at(self, time_s: float) -> Array:
        """T_lidar_map (k, 4, 4) when the images were exposed, so much later than said."""
        if self.trajectory is None:
            return np.tile(np.eye(4), (len(self.views), 1, 1))
        stamps = np.array([view.stamp for view in self.views]) + time_s
        start, end = self.trajectory.start - EXTRAPOLATE_S, self.trajectory.end + EXTRAPOLATE_S
        T_map_imu = self.trajectory.at(np.clip(stamps, start, end), EXTRAPOLATE_S)
        return np.asarray(np.linalg.inv(T_map_imu @ self.T_imu_lidar))

    @cached_property
    def _T_lidar_map(self) -> Array:
        return self._at(0.0)

    @cached_property
    def _near_view(self) -> tuple[NDArray[np.int64], Array, Array]:
        """View (n,), place (n, 3) m and weight (n,) of the edges that some change may bring into an image."""
        of = np.repeat(np.arange(len(self.views)), [len(view.p_map) for view in self.views])
        p_map = np.concatenate([view.p_map for view in self.views])
        weights = np.concatenate([view.weights for view in self.views])
        ahead = (self.camera.T_camera_lidar @ self._T_lidar_map)[of, 2]
        use = np.flatnonzero(np.einsum("nj,nj->n", ahead[:, :3], p_map) + ahead[:, 3] > -BEHIND_M)
        return of[use], p_map[use], weights[use]

    @property
    def _of(self) -> NDArray[np.int64]:
        return self._near_view[0]

    @property
    def _p_map(self) -> Array:
        return self._near_view[1]

    @property
    def _weights(self) -> Array:
        return self._near_view[2]

    @cached_property
    def _coarse(self) -> Strength:
        return np.stack([view.coarse for view in self.views])

    @cached_property
    def _fine(self) -> Strength:
        return np.stack([view.fine for view in self.views])


def depth_edges(
    points: Points, stamp: float, trajectory: Trajectory | None, T_imu_lidar: Array
) -> tuple[Array, Array]:
    """Near side of every jump along a ring, in the map (n, 3) m, and weights (n,)."""
    xyz = points.xyz
    ranges = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))
    usable = np.flatnonzero((ranges > 1.0) & (ranges < 120.0))
    xyz, ranges = xyz[usable], ranges[usable]
    if len(xyz) < 3:
        return np.empty((0, 3)), np.empty(0)
    cosines = np.einsum("ij,ij->i", xyz[1:], xyz[:-1]) / (ranges[1:] * ranges[:-1])
    beside = cosines > np.cos(np.radians(NEIGHBOUR_DEG))
    step = np.where(beside, np.diff(ranges), 0.0)
    jump = np.zeros(len(xyz))
    jump[:-1] = np.maximum(jump[:-1], step)
    jump[1:] = np.maximum(jump[1:], -step)
    smooth = np.zeros(len(xyz), np.bool_)
    smooth[1:-1] = beside[1:] & beside[:-1] & (np.minimum(np.abs(step[1:]), np.abs(step[:-1])) < SURFACE_M)
    use = np.flatnonzero((jump > JUMP_M) & (ranges < FARTHEST_M) & smooth)
    use = use[:: len(use) // MOST_EDGES + 1]
    weights = np.sqrt(np.minimum(jump[use], LARGEST_JUMP_M))
    p = xyz[use].astype(np.float64)
    if trajectory is None:
        return p, weights
    stamps = np.full(len(use), stamp) if points.stamps is None else points.stamps[usable[use]]
    if len(stamps) and not float(np.ptp(stamps)) < LONGEST_SWEEP_S:
        stamps = np.full(len(use), stamp)
    T = trajectory.at(stamps, EXTRAPOLATE_S) @ T_imu_lidar
    return np.einsum("nij,nj->ni", T[:, :3, :3], p) + T[:, :3, 3], weights


def edge_strength(image: NDArray[np.uint8]) -> tuple[Strength, Strength]:
    """Coarse and fine strength of an image's upright edges, the ones that a ring crosses, over their mean.

    The root keeps one bright edge from outweighing all others, the division foliage from attracting everything.
    """
    import cv2

    height, width = image.shape[0] // 2, image.shape[1] // 2
    grey = cv2.resize(image[:, :, 1], (width, height), interpolation=cv2.INTER_AREA)
    strength = np.sqrt(np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)))
    around = cv2.GaussianBlur(strength, (0, 0), SURROUNDINGS_PX)
    return _blurred(np.asarray(strength / (around + 1.0), np.float32))


def border_strength(classes: NDArray[np.int64], size: tuple[int, int]) -> tuple[Strength, Strength]:
    """Likewise of the upright borders between the classes (h, w) of a label image, of an image of (width, height)."""
    import cv2

    border = np.zeros(classes.shape, np.float32)
    border[:, 1:] = classes[:, 1:] != classes[:, :-1]
    half = cv2.resize(border, (size[0] // 2, size[1] // 2), interpolation=cv2.INTER_AREA)
    return _blurred(np.asarray(half, np.float32))


def _blurred(strength: Strength) -> tuple[Strength, Strength]:
    import cv2

    fine = cv2.GaussianBlur(strength, (0, 0), FINE_PX)
    coarse = cv2.GaussianBlur(strength, (0, 0), COARSE_PX)
    mean = float(strength.mean()) or 1.0
    return np.asarray(coarse / mean, np.float32), np.asarray(fine / mean, np.float32)

"""The whole chain from points to voxels in plain numpy, one readable line per idea: what the compiled one must equal.

Used by the tests as the oracle, bit for bit, and by the benchmark as the measure.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.scans.deskew import EXTRAPOLATE_S, KNOTS_PER_S
from gnss_sem_map.scans.projection import NEAREST_DEPTH_M, ClassImage, LabellingSettings, exposure_stamp
from gnss_sem_map.sensor_log import Calibration, Image, Points
from gnss_sem_map.voxels.voxel_map import VoxelMap, log_table, pack

Array = NDArray[np.float64]


def points_in_map(
    points: Points,
    stamp: float,
    trajectory: Trajectory,
    T_imu_lidar: Array,
    nearest_m: float,
    farthest_m: float,
) -> Array:
    """The usable points of one sweep in the map frame, each moved with the pose of its own stamp."""
    x, y, z = points.xyz.T.astype(np.float64)
    squares = x * x + y * y + z * z
    valid = (squares >= nearest_m**2) & (squares <= farthest_m**2)
    x, y, z = x[valid, None], y[valid, None], z[valid, None]
    stamps = np.full(len(x), stamp) if points.stamps is None else points.stamps[valid]
    numbers = np.arange(np.floor(stamps.min() * KNOTS_PER_S), np.floor(stamps.max() * KNOTS_PER_S) + 2)
    if points.stamps is None:
        knots = np.repeat(trajectory.at([stamp], EXTRAPOLATE_S) @ T_imu_lidar, len(numbers), axis=0)
    else:
        knots = trajectory.at(numbers / KNOTS_PER_S, EXTRAPOLATE_S + 1 / KNOTS_PER_S) @ T_imu_lidar
    place = stamps * KNOTS_PER_S - numbers[0]
    k = place.astype(np.int64)
    here, ahead = knots[:-1, :3][k], np.diff(knots[:, :3], axis=0)[k]
    p = here[:, :, 0] * x + here[:, :, 1] * y + here[:, :, 2] * z + here[:, :, 3]
    q = ahead[:, :, 0] * x + ahead[:, :, 1] * y + ahead[:, :, 2] * z + ahead[:, :, 3]
    return np.asarray(p + (place - k)[:, None] * q)


def keys_of(p_map: Array, voxel_size_m: float) -> NDArray[np.int64]:
    """Packed voxel keys (eq. of the map's docstring)."""
    return pack(np.floor(p_map / voxel_size_m).astype(np.int64))


def heights_of(p_map: Array, voxel_size_m: float) -> NDArray[np.int64]:
    """Heights of points over the bottom of their voxels, in 256 steps."""
    z = p_map[:, 2] / voxel_size_m
    return np.floor(256 * (z - np.floor(z))).astype(np.int64)


def pixels_seen(
    p_map: Array,
    image: Image,
    trajectory: Trajectory,
    calibration: Calibration,
    classes: ClassImage,
    settings: LabellingSettings,
) -> NDArray[np.int32]:
    """Row of the class image that each point sees, -1 for none: z-buffer, then the minimum over the window."""
    camera = calibration.camera()
    width, height = camera.image_size
    T_map_imu = trajectory.at(np.array([exposure_stamp(image, calibration, settings)]), EXTRAPOLATE_S)[0]
    T_camera_map = camera.T_camera_lidar @ np.linalg.inv(T_map_imu @ calibration.T_imu_lidar)
    P = camera.K @ T_camera_map[:3]
    x, y, z = p_map.T
    w = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    ahead = np.flatnonzero(w > NEAREST_DEPTH_M)
    x, y, z, w = x[ahead], y[ahead], z[ahead], w[ahead]
    u = np.floor((P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / w).astype(np.int64)
    v = np.floor((P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / w).astype(np.int64)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    ahead, u, v, depth = ahead[inside], u[inside], v[inside], w[inside].astype(np.float32)
    nearest = np.full((height, width), np.inf, np.float32)
    np.minimum.at(nearest, (v, u), depth)
    for axis, half in ((1, settings.occlusion_columns_px // 2), (0, settings.occlusion_rows_px // 2)):
        nearest = _window_minimum(nearest, axis, half)
    closest = nearest[v, u].astype(np.float64)
    seen = depth <= (1.0 + settings.occlusion_ratio) * closest + settings.occlusion_m
    h, w_ = classes.size
    pixels = np.full(len(p_map), -1, np.int32)
    rows, columns = (
        np.minimum(v[seen] // classes.shrink, h - 1),
        np.minimum(u[seen] // classes.shrink, w_ - 1),
    )
    pixels[ahead[seen]] = rows * w_ + columns
    return pixels


def _window_minimum(image: NDArray[np.float32], axis: int, half: int) -> NDArray[np.float32]:
    smallest = image.copy()
    a, b = np.moveaxis(image, axis, 0), np.moveaxis(smallest, axis, 0)
    for shift in range(1, half + 1):
        np.minimum(b[shift:], a[:-shift], out=b[shift:])
        np.minimum(b[:-shift], a[shift:], out=b[:-shift])
    return smallest


def log_likelihoods(
    seen: NDArray[np.uint8], logs: NDArray[np.int32], floor_percent: int
) -> NDArray[np.int32]:
    """Floored, renormalised log-probabilities (p, c) in 2^-10 nat of class pixels (p, c + 1)."""
    p = seen[:, :-1].astype(np.int64)
    total = p.sum(axis=1, keepdims=True)
    q = np.maximum(100 * p, floor_percent * total)
    return np.asarray(np.where(total > 0, logs[q] - logs[q.sum(axis=1, keepdims=True)], 0), np.int32)


@dataclass
class NumpyMap:
    """A map that grows scan by scan: sort, sum the groups, add to what is there, insert what is new."""

    voxel_size_m: float
    label_set: LabelSet
    floor_percent: int = 5
    answers: NDArray[np.float64] | None = None
    abstain: bool = False
    keys: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    def __post_init__(self) -> None:
        self.sums = np.empty((0, len(self.label_set.names) + 4), np.int64)
        share = 1.0 if self.answers is None else 0.5
        self._logs = log_table(len(self.label_set.names), self.floor_percent, share)

    def add(
        self,
        keys: NDArray[np.int64],
        pixels: NDArray[np.int32],
        classes: NDArray[np.uint8],
        heights: NDArray[np.integer],
    ) -> None:
        """Add one scan, as `VoxelTable.add`."""
        seen = pixels >= 0
        looks = np.zeros((len(keys), self.sums.shape[1]), np.int64)
        looks[:, -2], looks[:, -1] = 1, heights
        looks[seen, :-4] = self._looks(classes[pixels[seen]])
        looks[seen, -4] = classes[pixels[seen]].any(axis=1)
        looks[seen, -3] = classes[pixels[seen], -1]
        order = np.argsort(keys)
        starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
        new_keys, sums = keys[order][starts], np.add.reduceat(looks[order], starts)
        places = np.searchsorted(self.keys, new_keys)
        known = np.zeros(len(new_keys), np.bool_)
        known[places < len(self.keys)] = (
            self.keys[places[places < len(self.keys)]] == new_keys[places < len(self.keys)]
        )
        self.sums[places[known]] += sums[known]
        self.keys = np.insert(self.keys, places[~known], new_keys[~known])
        self.sums = np.insert(self.sums, places[~known], sums[~known], axis=0)

    def _looks(self, seen: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Evidence (p, c) of class pixels (p, c + 1): probabilities, and likelihood of the predicted class."""
        looks, answer = log_likelihoods(seen, self._logs, self.floor_percent), seen.argmax(axis=1)
        if self.answers is not None:
            looks += np.rint(512 * self.answers).astype(np.int32)[answer]
        silent = ~seen.any(axis=1) | (self.abstain & (answer == seen.shape[1] - 1))
        return np.where(silent[:, None], 0, looks)

    def to_map(self) -> VoxelMap:
        """The same value as `VoxelTable.to_map`."""
        return VoxelMap(
            self.voxel_size_m, self.label_set, self.keys,
            np.ascontiguousarray(self.sums[:, :-4], np.int32), self.sums[:, -2].astype(np.uint32),
            self.sums[:, -1].copy(), np.ascontiguousarray(self.sums[:, -4:-2], np.int32),
        )  # fmt: skip

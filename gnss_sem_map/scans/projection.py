"""Projection of map points into an image at its moment of exposure, with occlusion (eq. 3 to 5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.labels.probabilities import LabelImage, shrink_of
from gnss_sem_map.scans import kernels
from gnss_sem_map.scans.deskew import EXTRAPOLATE_S
from gnss_sem_map.sensor_log import Calibration, Image, SensorLog
from gnss_sem_map.sensor_log.cameras import Camera

NEAREST_DEPTH_M = 0.5


class LabellingSettings(BaseModel):
    """How points get the class probabilities of pixels."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    probability_floor: float = Field(
        0.05,
        ge=0.01,
        le=0.5,
        description="Least probability of a class in one observation (whole percent).",
    )
    occlusion_rows_px: int = Field(
        7,
        ge=1,
        le=101,
        description="Height of the window in which a nearer point occludes a farther one (odd).",
    )
    occlusion_columns_px: int = Field(5, ge=1, le=101, description="Width of that window (odd).")
    occlusion_ratio: float = Field(
        0.05,
        ge=0,
        description="A point is visible if its depth exceeds the least in the window by up to this share,",
    )
    occlusion_m: float = Field(0.3, ge=0, description="plus this distance.")
    abstain: bool = Field(
        False,
        description="Ignore pixels that are most probably `other`; by default the other classes share their vote.",
    )
    image_within_s: float = Field(
        0.06, gt=0, description="Largest time difference between a scan and the exposure of its image."
    )
    camera_time_offset_s: float | None = Field(
        None,
        description="Moment of exposure minus image stamp; default: the known offset of the drive's format.",
    )


@dataclass(frozen=True, eq=False)
class ClassImage:
    """Class probabilities of one image, in the map's classes."""

    seen: NDArray[np.uint8] | LabelImage
    """(h, w, c + 1), round(255 p); `other` last. Or a label image of the same classes."""
    shrink: int
    """Camera pixels per pixel of this image, along each axis."""

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)."""
        image = self.seen.ids if isinstance(self.seen, LabelImage) else self.seen
        return image.shape[0], image.shape[1]

    @property
    def probabilities(self) -> NDArray[np.uint8]:
        """(h, w, c + 1) of every pixel."""
        return self.seen.probabilities if isinstance(self.seen, LabelImage) else self.seen

    @property
    def rows(self) -> NDArray[np.uint8]:
        """Probabilities of the flattened pixels, (h w, c + 1)."""
        return self.probabilities.reshape(-1, self.probabilities.shape[2])

    def at(self, pixels: NDArray[np.int32]) -> NDArray[np.uint8]:
        """Probabilities (m, c + 1) of some flattened pixels; for any memory layout only these are copied."""
        if isinstance(self.seen, LabelImage):
            return np.take(self.seen.table, np.take(self.seen.ids, pixels), axis=0)
        classes = np.empty((len(pixels), self.seen.shape[2]), np.uint8)
        kernels.gather(self.seen, pixels, classes)
        return classes


@dataclass(frozen=True, eq=False)
class View:
    """Camera at the moment of exposure, with the buffers of the projection: see `kernels.project`."""

    P: NDArray[np.float64]
    """(3, 4): what takes points of the map to the camera, see `Camera.projection`."""
    lens: NDArray[np.float64]
    """What comes after it, see `Camera.lens`."""
    inside: tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]
    """Points, columns, lines, depths: (n,) each, partly filled."""
    nearest: NDArray[np.float32]
    """(h, w) m."""


def class_image(
    probabilities: NDArray[np.uint8] | NDArray[np.floating] | LabelImage,
    class_names: tuple[str, ...],
    label_set: LabelSet,
    image_size: tuple[int, int],
    where: str,
) -> ClassImage:
    """Sum the classes of a network, by name, into those of the map, and find the scale to the camera image.

    `probabilities` (h, w, s): uint8 as round(255 p), or floating in 0..1; (h, w) the camera image's size or that size
    divided and rounded down, see `shrink_of`. Raises DataError for another size, ConfigError for an unknown class name.
    """
    if isinstance(probabilities, LabelImage):
        return ClassImage(probabilities, shrink_of(probabilities.ids.shape, image_size, where))
    if probabilities.ndim != 3 or probabilities.shape[2] != len(class_names):
        raise DataError(
            f"{where}: found shape {probabilities.shape}, expected (h, w, {len(class_names)}) for {list(class_names)}"
        )
    shrink = shrink_of(probabilities.shape, image_size, where)
    wanted = (*label_set.names, "other")
    if probabilities.dtype == np.uint8 and tuple(class_names) == wanted:
        return ClassImage(np.asarray(probabilities, np.uint8), shrink)
    table = label_set.table_from(class_names)
    scale = 1.0 if probabilities.dtype == np.uint8 else 255.0
    summed = np.rint(np.asarray(probabilities, np.float32) * np.float32(scale) @ table)
    if not (np.isfinite(summed).all() and (summed >= 0).all()):
        raise DataError(f"{where}: found probabilities that are negative or not finite; expected 0..1")
    return ClassImage(np.minimum(summed, 255).astype(np.uint8), shrink)


def exposure_offset_s(camera: Camera, settings: LabellingSettings) -> float:
    """Moment of exposure minus image stamp, s."""
    given = settings.camera_time_offset_s
    return camera.time_offset_s if given is None else given


def exposure_stamp(image: Image, calibration: Calibration, settings: LabellingSettings) -> float:
    """Moment at which the image was exposed, s."""
    return image.stamp + exposure_offset_s(calibration.camera(image.camera), settings)


def image_exposed_at(
    stamp: float, log: SensorLog, camera: Camera, settings: LabellingSettings
) -> Image | None:
    """The image of a camera exposed nearest in time to `stamp`, or None when none was within `image_within_s`."""
    return log.image_at(stamp - exposure_offset_s(camera, settings), settings.image_within_s, camera.name)


def view_at(
    stamp: float,
    trajectory: Trajectory,
    T_imu_lidar: NDArray[np.float64],
    camera: Camera,
    n: int,
    over: View | None,
) -> View:
    """A camera at the moment `stamp`, with buffers for the `n` points of a scan.

    Those of the earlier view `over` are reused if large enough: allocating memory costs more than the projection.
    """
    T_map_imu = trajectory.at(np.array([stamp]), EXTRAPOLATE_S)[0]
    P = camera.projection(camera.T_camera_lidar @ np.linalg.inv(T_map_imu @ T_imu_lidar))
    shape = camera.image_size[::-1]
    if over is not None and over.nearest.shape == shape and len(over.inside[0]) >= n:
        over.nearest.fill(np.inf)
        return View(P, camera.lens, over.inside, over.nearest)
    points, columns, lines = (np.empty(n, np.int32) for _ in range(3))
    nearest = np.full(shape, np.inf, np.float32)
    return View(P, camera.lens, (points, columns, lines, np.empty(n, np.float32)), nearest)


def visible(
    p_map: NDArray[np.float64], view: View, classes: ClassImage, settings: LabellingSettings
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The points (p,) of the m in the map (m, 3) that the image shows, and the pixel of `classes` of each.

    A point is occluded when another point of the same scan, in a window around its pixel, is nearer by more than the
    tolerance. The window fits the spacing of the LiDAR, which is sparser than the image (7 x 5 px, 5 % + 0.3 m on real
    data). Eq. 5 keeps the nearest point of each pixel instead.
    """
    (height, width), (class_height, class_width) = view.nearest.shape, classes.size
    inside = kernels.project(
        p_map.reshape(-1), view.P, view.lens, NEAREST_DEPTH_M, settings.occlusion_columns_px // 2,
        *view.inside, view.nearest,
    )  # fmt: skip
    points, columns, lines, depths = view.inside
    pixels = np.empty(inside, np.int32)
    kept = kernels.visible(
        points[:inside], columns, lines, depths, view.nearest,
        settings.occlusion_rows_px // 2, settings.occlusion_ratio, settings.occlusion_m,
        np.minimum(np.arange(height) // classes.shrink, class_height - 1),
        np.minimum(np.arange(width) // classes.shrink, class_width - 1), class_width, pixels,
    )  # fmt: skip
    return points[:kept], pixels[:kept]


def pixels_seen(
    p_map: NDArray[np.float64],
    stamp: float,
    trajectory: Trajectory,
    calibration: Calibration,
    classes: ClassImage,
    settings: LabellingSettings,
    camera: str = "",
) -> NDArray[np.int32]:
    """For every map point (n, 3) m its flattened pixel in `classes` at `stamp`, or -1 if not visible: see `visible`."""
    view = view_at(stamp, trajectory, calibration.T_imu_lidar, calibration.camera(camera), len(p_map), None)
    points, seen = visible(np.ascontiguousarray(p_map), view, classes, settings)
    pixels = np.full(len(p_map), -1, np.int32)
    pixels[points] = seen
    return pixels

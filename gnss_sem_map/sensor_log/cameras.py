"""Cameras: how each maps what lies around it to pixels. Models are those of OpenCV, and that of Mei for KITTI-360.

    none      x / z, y / z
    brown     the same, bent by k1 k2 p1 p2 [k3 [k4 k5 k6]]: OpenCV's `projectPoints`, `plumb_bob` and
              `rational_polynomial` of ROS
    fisheye   the angle to the axis, bent by k1 k2 k3 k4: OpenCV's `fisheye`, `equidistant` of ROS
    mei       the unit sphere, seen from `xi` behind its centre, bent by k1 k2 p1 p2: Mei, Rives, "Single view point
              omnidirectional camera calibration from planar grids" (2007)

A polynomial fits the lens as far as the image reaches; beyond, it turns back, and what lies far aside would appear in
the image again. Points beyond the angle where that begins are in no image.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from gnss_sem_map.errors import DataError

Array = NDArray[np.float64]

NAME = r"[A-Za-z0-9_-]{0,64}"
COEFFICIENTS = {"brown": (4, 5, 8), "fisheye": (4,), "mei": (4,)}
"""How many coefficients each model may have."""
PINHOLE, SPHERE, ANGLE = 0, 1, 2
"""Kinds of lenses for the compiled loops: x / z; Brown and Mei, who differ by xi; fisheye."""
LENS = 16
"""Numbers of a lens: kind, least cosine, xi, fx, skew, cx, fy, cy, and eight coefficients."""
STEP_DEG, DIRECTIONS = 0.1, 72
"""Grid on which the turning back of a lens is looked for."""
NEWTON_STEPS, NEWTON_STEP_RAD = 6, 1e-6
"""Of `Distortion.straightened`: so many steps, each with differences over so small an angle."""
LENS_EDGE = 1.05
"""How much farther out than along x a lens may show its last angle: it is bent sidewards, too."""
WIDEST_DEG = {"brown": 89.5, "fisheye": 179.5, "mei": 179.5}


def _checked_name(name: str) -> str:
    if not re.fullmatch(NAME, name):
        raise ValueError("expected a name of letters, digits, _ and -; a folder of the drive has it")
    return name


SensorName = Annotated[str, AfterValidator(_checked_name)]
"""Name of a LiDAR or camera in a settings file: no path, so nothing outside of the drive is read."""


class Distortion(BaseModel):
    """How a lens bends what a pinhole would show."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    model: Literal["brown", "fisheye", "mei"] = Field(description="The model of the coefficients.")
    coefficients: tuple[float, ...] = Field(
        description="brown: k1 k2 p1 p2 [k3 [k4 k5 k6]]; fisheye: k1 k2 k3 k4; mei: k1 k2 p1 p2."
    )
    xi: float = Field(0.0, ge=0, description="mei only: how far behind its centre the sphere is seen from.")

    @model_validator(mode="after")
    def _is_of_its_model(self) -> Distortion:
        counts = COEFFICIENTS[self.model]
        if len(self.coefficients) not in counts:
            expected = " or ".join(map(str, counts))
            raise ValueError(f"found {len(self.coefficients)} coefficients, not {expected}: {self.model}")
        if self.xi and self.model != "mei":
            raise ValueError(f"found xi {self.xi} for {self.model}; only mei has it")
        return self

    @cached_property
    def least_cosine(self) -> float:
        """Cosine of the angle to the axis up to which the lens maps one to one."""
        angles = np.radians(np.arange(STEP_DEG, WIDEST_DEG[self.model], STEP_DEG))
        if self.model == "mei":  # from behind the sphere one sees it up to its horizon
            angles = angles[np.cos(angles) > -min(self.xi, 1 / max(self.xi, 1e-9)) + 1e-6]
        around = np.linspace(0.0, 2 * np.pi, DIRECTIONS + 1)
        rays = np.stack(
            [np.outer(np.sin(angles), np.cos(around)), np.outer(np.sin(angles), np.sin(around)),
             np.tile(np.cos(angles)[:, None], len(around))]
        )  # fmt: skip
        with np.errstate(all="ignore"):  # of a pole: it turns back there, too
            x, y = self.bent(rays)
            (x_out, x_round), (y_out, y_round) = np.gradient(x), np.gradient(y)
            turned = ~np.all(x_out * y_round - x_round * y_out > 0, axis=1)
        last = int(turned.argmax()) - 1 if turned.any() else len(angles) - 1
        return float(np.cos(angles[last])) if last >= 0 else 1.0

    def straightened(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Rays of length 1 that meet the image plane at focal length 1 in x and y: `bent` turned back, by Newton.

        Beyond the last angle that the lens maps one to one, rays of that angle.
        """
        most = float(np.arccos(self.least_cosine))
        angles, zero = np.linspace(0.0, most, 1000), np.zeros(1000)
        out = self.bent(np.stack([np.sin(angles), zero, np.cos(angles)]))[0]
        r = np.hypot(x, y)
        first = np.interp(r, out, angles) / np.where(r > 0, r, 1.0)
        a, b = x * first, y * first  # the angle to the axis, along x and y
        h = NEWTON_STEP_RAD
        for _ in range(NEWTON_STEPS):
            here, beside_a, beside_b = (
                self.bent(_rays(a + da, b + db)) for da, db in ((0, 0), (h, 0), (0, h))
            )
            (xa, ya), (xb, yb) = (
                ((beside[0] - here[0]) / h, (beside[1] - here[1]) / h) for beside in (beside_a, beside_b)
            )
            dx, dy, area = here[0] - x, here[1] - y, xa * yb - xb * ya
            # beyond the edge there is nothing to be found
            area = np.where((r < LENS_EDGE * out[-1]) & (area > 0), area, np.inf)
            a, b = a - (yb * dx - xb * dy) / area, b - (xa * dy - ya * dx) / area
            shrink = np.minimum(1.0, most / np.maximum(np.hypot(a, b), 1e-12))
            a, b = a * shrink, b * shrink
        X, Y, Z = _rays(a, b)
        return X, Y, Z

    def bent(self, rays: Array) -> tuple[Array, Array]:
        """Where rays (3, ...) of length 1 meet the image plane at focal length 1."""
        X, Y, Z = rays
        k = np.zeros(8)
        k[: len(self.coefficients)] = self.coefficients
        if self.model == "fisheye":
            r = np.hypot(X, Y)
            angle = np.arctan2(r, Z)
            square = angle * angle
            out = angle * (1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3]))))
            out = out / np.maximum(r, 1e-300)  # nothing is bent on the axis
            return X * out, Y * out
        x, y = X / (Z + self.xi), Y / (Z + self.xi)
        r2 = x * x + y * y
        out = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        return (
            x * out + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
            y * out + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y,
        )


def _rays(a: Array, b: Array) -> Array:
    """Rays (3, ...) of length 1 whose angle to the axis is a along x and b along y."""
    angle = np.hypot(a, b)
    side = np.sinc(angle / np.pi)
    return np.stack([a * side, b * side, np.cos(angle)])


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera: where it is, and how it maps points to pixels."""

    T_camera_lidar: Array
    """(4, 4); it looks along z, x right, y down."""
    K: Array
    """(3, 3) intrinsics, px."""
    image_size: tuple[int, int]
    """(width, height), px."""
    time_offset_s: float = 0.0
    """Moment of exposure minus image stamp."""
    distortion: Distortion | None = None
    """None: the images are rectified."""
    name: str = ""
    """Empty where the log has but one."""

    def __post_init__(self) -> None:
        of = f" of camera {self.name}" if self.name else ""
        if not re.fullmatch(NAME, self.name):
            raise DataError(f"calibration: found a camera {self.name!r}, expected letters, digits, _ and -")
        check_rigid(self.T_camera_lidar, f"{of}: T_camera_lidar")
        if self.K.shape != (3, 3) or self.K[0, 0] <= 0 or self.K[1, 1] <= 0:
            raise DataError(f"calibration{of}: found K {self.K.tolist()}, expected focal lengths above 0")

    def projection(self, T_camera_source: Array) -> Array:
        """What takes points to this camera (3, 4): to its pixels where it has no distortion, else into its frame."""
        T = T_camera_source[:3]
        return np.ascontiguousarray(self.K @ T if self.distortion is None else T)

    @cached_property
    def lens(self) -> Array:
        """(LENS,): what is done with points behind `projection`, see `scans.kernels.pixel_of`."""
        lens, K = np.zeros(LENS), self.K
        lens[3:8] = K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]
        if self.distortion is not None:
            given = self.distortion
            lens[0] = ANGLE if given.model == "fisheye" else SPHERE
            lens[1], lens[2] = given.least_cosine, given.xi
            lens[8 : 8 + len(given.coefficients)] = given.coefficients
        return lens


def lidar_to_camera(T_imu_camera: Array, T_imu_lidar: Array) -> Array:
    """T_camera_lidar (4, 4) of a camera whose pose in the imu frame is known."""
    check_rigid(T_imu_camera, ": T_imu_camera")
    return np.asarray(np.linalg.inv(T_imu_camera) @ T_imu_lidar, np.float64)


def is_rigid(T: Array, tolerance: float = 1e-3) -> bool:
    """Whether a matrix is a 4 x 4 rigid transform: finite, orthonormal rotation of determinant +1."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], (0, 0, 0, 1)):
        return False
    R = T[:3, :3]
    with np.errstate(all="ignore"):  # of numbers that are no rotation's
        return bool(np.allclose(R @ R.T, np.eye(3), atol=tolerance) and np.linalg.det(R) > 0)


def check_rigid(T: Array, what: str) -> None:
    """Raise DataError unless a transform of the calibration is rigid; `what` says which."""
    if not is_rigid(T):
        found = f"found shape {np.shape(T)}, expected 4 x 4, rotation orthonormal to 1e-3"
        raise DataError(f"calibration{what} is no rigid transform ({found}); check the calibration file")

"""`log.yaml` of a CSV log: where its sensors are, and what their numbers mean."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from scipy.spatial.transform import Rotation

from factor_graphs.alignment import AttitudePrior
from factor_graphs.measurements import ImuNoise
from factor_graphs.settings import SampleInstant
from gnss_sem_map.datasets.gnss_files import GnssFile
from gnss_sem_map.files.structured import fault_of, read_yaml
from gnss_sem_map.files.untrusted import is_file, refused
from gnss_sem_map.sensor_log import Calibration
from gnss_sem_map.sensor_log.cameras import Camera, Distortion, SensorName, lidar_to_camera
from gnss_sem_map.sensor_log.conventions import SensorConventions

Array = NDArray[np.float64]
Matrix4 = tuple[
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
]
Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
IDENTITY: Matrix4 = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))


class InitialAttitude(BaseModel):
    """Attitude of the IMU at its first stamp, as an inertial unit knows it."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    quaternion_xyzw: tuple[float, float, float, float] = Field(description="imu to east, north, up.")
    stddevs_rad: tuple[float, float, float] = Field(description="About the imu's x, y, z.")

    @model_validator(mode="after")
    def _is_attitude(self) -> InitialAttitude:
        if abs(float(np.linalg.norm(self.quaternion_xyzw)) - 1) > 1e-3 or min(self.stddevs_rad) <= 0:
            raise ValueError("expected a unit quaternion, and standard deviations above 0")
        return self

    @property
    def prior(self) -> AttitudePrior:
        """The same for the smoother."""
        R = Rotation.from_quat(self.quaternion_xyzw).as_matrix()
        return AttitudePrior(np.asarray(R), np.array(self.stddevs_rad))


class CameraFile(BaseModel):
    """One of several cameras in `log.yaml`; its images are in `images/NAME/`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    K: Matrix3 = Field(description="Intrinsics, px.")
    image_size: tuple[int, int] = Field(description="Width and height of the images, px.")
    T_camera_lidar: Matrix4 | None = Field(None, description="LiDAR to camera; this or T_imu_camera.")
    T_imu_camera: Matrix4 | None = Field(None, description="Camera to IMU.")
    distortion: Distortion | None = Field(None, description="Of the lens; default: the images are rectified.")
    time_offset_s: float = Field(0.0, description="Moment of exposure minus image stamp.")

    @model_validator(mode="after")
    def _has_one_pose(self) -> CameraFile:
        if (self.T_camera_lidar is None) == (self.T_imu_camera is None):
            raise ValueError("expected one of T_camera_lidar and T_imu_camera")
        return self

    def camera(self, T_imu_lidar: Array, name: str) -> Camera:
        """The same for the log."""
        if self.T_camera_lidar is not None:
            T_camera_lidar = np.array(self.T_camera_lidar, np.float64)
        else:
            T_camera_lidar = lidar_to_camera(np.array(self.T_imu_camera, np.float64), T_imu_lidar)
        K = np.array(self.K, np.float64)
        return Camera(T_camera_lidar, K, self.image_size, self.time_offset_s, self.distortion, name)


class LidarFile(BaseModel):
    """One of several LiDARs in `log.yaml`; its scans are in `lidar/NAME/`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    T_imu_lidar: Matrix4 = Field(description="LiDAR to IMU.")
    is_compensated: bool = Field(False, description="As `lidar_is_compensated`.")
    intensity_max: float = Field(1.0, gt=0, description="Number for an intensity of 1 in its scans.")


class LogFile(SensorConventions):
    """Content of `log.yaml`; axes, units and clocks are those of `SensorConventions`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    epoch_ns: int = Field(0, ge=-(1 << 63), lt=1 << 63, description="Unix time, ns, of stamp zero.")
    p_imu_antenna: tuple[float, float, float] = Field(
        (0, 0, 0), description="GNSS antenna in the imu frame, m."
    )
    p_imu_antenna2: tuple[float, float, float] | None = Field(
        None,
        description="Second antenna of a receiver that tells heading, m; default: the heading is that of the IMU.",
    )
    T_imu_lidar: Matrix4 | None = Field(
        None, description="LiDAR to IMU; default: that of the IMU, and the pre-flight check is amber."
    )
    lidars: dict[SensorName, LidarFile] = Field(
        {}, description="Several LiDARs by name, in place of T_imu_lidar; T_camera_lidar is of the first."
    )
    T_camera_lidar: Matrix4 | None = Field(None, description="LiDAR to the only camera.")
    K: Matrix3 | None = Field(None, description="Its intrinsics, px.")
    image_size: tuple[int, int] | None = Field(None, description="Width and height of its images, px.")
    distortion: Distortion | None = Field(None, description="Of its lens; default: its images are rectified.")
    camera_time_offset_s: float = Field(0.0, description="Moment of its exposure minus image stamp.")
    cameras: dict[SensorName, CameraFile] = Field(
        {}, description="Several cameras by name, in place of the keys above."
    )
    imu_noise: ImuNoise | None = Field(None, description="Noise of the IMU; default: a good consumer unit.")
    imu_sample_instant: SampleInstant | None = Field(
        None,
        description="What stamp_s of imu.csv names of a sample's interval; default: found, else its middle.",
    )
    initial_attitude: InitialAttitude | None = Field(
        None, description="Attitude at the first row of imu.csv; default: by the motion."
    )
    gnss_file: GnssFile | None = Field(None, description="A file of positions in place of gnss.csv.")
    lidar_is_compensated: bool = Field(
        False, description="Scans of four columns are already motion-compensated to their stamp."
    )
    intensity_max: float = Field(
        1.0, gt=0, description="Number for an intensity of 1 in the scans of the only LiDAR."
    )

    @property
    def baseline(self) -> Array | None:
        """From the antenna to the second one, (3,) m, in the imu frame."""
        return None if self.p_imu_antenna2 is None else np.subtract(self.p_imu_antenna2, self.p_imu_antenna)

    @property
    def all_lidars(self) -> list[tuple[str, LidarFile]]:
        """The LiDARs with the names of their folders; the first is the one that all else is relative to."""
        alone = LidarFile(
            T_imu_lidar=self.T_imu_lidar or IDENTITY,
            is_compensated=self.lidar_is_compensated,
            intensity_max=self.intensity_max,
        )
        return list(self.lidars.items()) or [("", alone)]


def read_log_yaml(path: Path) -> LogFile:
    """What the file says, or the defaults where there is none; raises DataError."""
    if not is_file(path):
        return LogFile()
    try:
        return LogFile.model_validate(read_yaml(path) or {})
    except ValidationError as error:
        raise refused(path, f"{fault_of(error)}; known keys are {sorted(LogFile.model_fields)}") from None


def calibration_of(about: LogFile, path: Path) -> Calibration:
    """Where the sensors are, as the file at `path` says; raises DataError for a camera that is described in part."""
    T_imu_lidar = np.array(about.all_lidars[0][1].T_imu_lidar, np.float64)
    given = about.cameras or _only_camera(about, path)
    cameras = [one.camera(T_imu_lidar, name if len(given) > 1 else "") for name, one in given.items()]
    return Calibration(T_imu_lidar, tuple(cameras), np.array(about.p_imu_antenna, np.float64))


def _only_camera(about: LogFile, path: Path) -> dict[str, CameraFile]:
    """The camera that is described by keys of its own; none if there is none."""
    if about.T_camera_lidar is None and about.K is None and about.image_size is None:
        return {}
    if about.T_camera_lidar is None or about.K is None or about.image_size is None:
        raise refused(path, "a camera needs all of T_camera_lidar, K and image_size; found only some of them")
    only = CameraFile(
        K=about.K, image_size=about.image_size, T_camera_lidar=about.T_camera_lidar,
        distortion=about.distortion, time_offset_s=about.camera_time_offset_s,
    )  # fmt: skip
    return {"": only}

"""rig.yaml: which topic of a bag is which sensor, and what the bag does not say of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from factor_graphs.measurements import ImuNoise
from factor_graphs.settings import SampleInstant
from gnss_sem_map.datasets.gnss_files import GnssFile
from gnss_sem_map.datasets.ros.clouds import Unit
from gnss_sem_map.datasets.ros.stamps import Clock
from gnss_sem_map.files.structured import fault_of, read_yaml
from gnss_sem_map.files.untrusted import is_file, refused
from gnss_sem_map.sensor_log.cameras import Distortion, is_rigid
from gnss_sem_map.sensor_log.conventions import SensorConventions

NAME = "rig.yaml"

Row = Annotated[list[float], Field(min_length=4, max_length=4)]


def _rigid(pose: list[Row]) -> list[Row]:
    if not is_rigid(np.array(pose, np.float64)):
        raise ValueError("found no rigid transform, expected 4 x 4, rotation orthonormal to 1e-3")
    return pose


Pose = Annotated[list[Row], Field(min_length=4, max_length=4), AfterValidator(_rigid)]
Row3 = Annotated[list[float], Field(min_length=3, max_length=3)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class _Stamped(_Section):
    topic: str = Field(description="Name of the topic.")
    stamps: Clock = Field("header", description="When a message was measured: its header, or its arrival.")


class _Topic(_Stamped):
    frame: str | None = Field(None, description="Frame of the sensor; default: the frame_id in its messages.")


class ImuTopic(_Topic):
    """The IMU; its frame is the body frame."""

    force_topic: str | None = Field(
        None, description="Topic of the accelerometer, where `topic` is that of the gyroscope alone."
    )
    noise: ImuNoise | None = Field(None, description="Noise of the IMU; default: a good consumer unit.")
    sample_instant: SampleInstant | None = Field(
        None, description="What a stamp names of a sample's interval; default: found, else its middle."
    )
    attitude: bool = Field(
        False,
        description="The orientation in the first message, with its covariance, is the attitude in east, north, up.",
    )


class VelocityTopic(_Stamped):
    """Velocity of the antenna: a topic of TwistStamped or TwistWithCovarianceStamped."""

    axes: Literal["enu", "ned"] = Field("enu", description="East, north, up, or north, east, down.")


class HeadingTopic(_Stamped):
    """Heading between two antennas: a topic of Imu (its orientation), QuaternionStamped or Float64 (degrees)."""

    axes: Literal["enu", "ned"] | None = Field(
        None,
        description="enu: counter-clockwise from east, ned: clockwise from north; default: enu of Imu, else ned.",
    )


class WheelTopic(_Stamped):
    """Speed of the vehicle along x: a topic of Odometry, a twist, an Autoware report or a float; `speed_unit`."""


class GnssTopic(_Section):
    """The receiver: a topic of NavSatFix, GPSFix or NMEA sentences, or a file."""

    topic: str | None = Field(None, description="Name of the topic.")
    file: GnssFile | None = Field(None, description="A file in place of a topic.")
    frame: str | None = Field(
        None, description="Frame of the antenna; default: the frame_id in its messages."
    )
    stamps: Clock = Field("header", description="When a fix was measured: its header, or its arrival.")
    stddevs_m: tuple[float, float, float] | None = Field(
        None,
        description="East, north, up, m, of fixes whose covariance is unknown or zero; default: these are left out.",
    )
    p_imu_antenna: tuple[float, float, float] | None = Field(
        None, description="Antenna in the imu frame, m; default: by the static transforms."
    )
    p_imu_antenna2: tuple[float, float, float] | None = Field(
        None,
        description="Second antenna, m, where headings are told; default: the heading is that of the IMU.",
    )
    velocity: VelocityTopic | None = Field(None, description="Its velocity, in place of that of a file.")
    heading: HeadingTopic | None = Field(None, description="Its heading, in place of that of a file.")


class LidarTopic(_Topic):
    """A LiDAR."""

    T_imu_lidar: Pose | None = Field(None, description="LiDAR to IMU; default: by the static transforms.")
    point_times: str | None = Field(
        None,
        description="Field of the points' times, or `compensated`; default: time, t, offset_time or timestamp.",
    )
    point_times_unit: Unit | None = Field(
        None, description="Unit of the points' times; default: by their size, and the time between sweeps."
    )
    intensity_max: float | None = Field(
        None,
        gt=0,
        description="Number for an intensity of 1; default: 1, and of an unsigned field its largest number.",
    )


class CameraTopic(_Topic):
    """A camera."""

    info: str | None = Field(None, description="Topic of its CameraInfo.")
    K: Annotated[list[Row3], Field(min_length=3, max_length=3)] | None = Field(
        None, description="Intrinsics, px; default: by the CameraInfo."
    )
    distortion: Distortion | None = Field(
        None, description="Of the lens, with K; default: by the CameraInfo, none for rectified images."
    )
    image_size: tuple[int, int] | None = Field(None, description="Width and height, px; default: CameraInfo.")
    rectified: bool | None = Field(
        None, description="Whether the images are rectified; default: if their topic's name has `rect` in it."
    )
    T_camera_lidar: Pose | None = Field(
        None, description="LiDAR to camera; default: by the static transforms."
    )
    T_imu_camera: Pose | None = Field(None, description="Camera to IMU, in place of T_camera_lidar.")
    time_offset_s: float = Field(0.0, description="Moment of exposure minus image stamp.")


class Rig(SensorConventions):
    """Content of rig.yaml; axes, units and clocks are those of `SensorConventions`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    imu: ImuTopic | None = Field(None, description="The IMU.")
    gnss: GnssTopic | None = Field(None, description="The receiver.")
    wheels: WheelTopic | None = Field(None, description="The speed of the wheels.")
    lidars: dict[str, LidarTopic] = Field({}, description="LiDARs by name.")
    cameras: dict[str, CameraTopic] = Field({}, description="Cameras by name.")


def rig_file(bag: Path) -> Path | None:
    """The rig.yaml of a bag: in its folder, else beside it, or beside the target of a link; None if there is none."""
    places = [bag / NAME] if bag.is_dir() else []
    places += [bag.absolute().parent / NAME, bag.resolve().parent / NAME]
    others = [place.with_suffix(".yml") for place in places if is_file(place.with_suffix(".yml"))]
    if others and not any(map(is_file, places)):
        raise refused(others[0], f"is not read; rename it to {NAME}")
    return next((place for place in places if is_file(place)), None)


def read_rig(path: Path) -> Rig:
    """Read a rig.yaml; raises DataError for unknown keys and values out of range."""
    try:
        return Rig.model_validate(read_yaml(path) or {})
    except ValidationError as error:
        raise refused(path, f"{fault_of(error)}; see docs/your_own_log.md") from None


def matrix(pose: Pose | None) -> NDArray[np.float64] | None:
    """A pose of rig.yaml (4, 4)."""
    return None if pose is None else np.array(pose, np.float64)

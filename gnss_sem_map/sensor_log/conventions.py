"""Axes, units and clocks of the sensors of a log, and their conversion to ours.

Ours: x forward, y left, z up; specific force in m/s² (at rest it points up), angular rate in rad/s; one clock.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from factor_graphs.alignment import AttitudePrior
from factor_graphs.measurements import AntennaHeadings, GnssFixes, GnssVelocities, ImuSamples, WheelSpeeds
from factor_graphs.surveyed_points import SurveyedPoints

Array = NDArray[np.float64]
OfReceiver = TypeVar("OfReceiver", GnssFixes, GnssVelocities, AntennaHeadings, SurveyedPoints)

NAMED_AXES = {"flu": "x y z", "frd": "x -y -z", "rfu": "y -x z"}
"""Forward left up, forward right down, right forward up: each says where our x, y, z are among the sensor's axes."""
STANDARD_GRAVITY = 9.80665
FORCE_UNITS = {"m/s2": 1.0, "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000}
RATE_UNITS = {"rad/s": 1.0, "deg/s": float(np.pi / 180)}
SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}


def matrix_of(axes: str) -> Array:
    """The (3, 3) matrix that takes a vector in the sensor's axes to ours; raises ValueError for what names no axes."""
    words = NAMED_AXES.get(axes, axes).replace(",", " ").split()
    if sorted(word.lstrip("+-") for word in words) != ["x", "y", "z"] or any(len(w) > 2 for w in words):
        raise ValueError(
            f"found {axes!r}, expected one of {', '.join(NAMED_AXES)}, or x, y, z once each in any order with signs:"
            ' "x -y -z" where our y and z point against the sensor\'s'
        )
    matrix = np.zeros((3, 3))
    for row, word in enumerate(words):
        matrix[row, "xyz".index(word[-1])] = -1.0 if word[0] == "-" else 1.0
    return matrix


def _known(axes: str) -> str:
    matrix_of(axes)
    return axes


Axes = Annotated[str, AfterValidator(_known)]


class SensorConventions(BaseModel):
    """Conventions of the sensors of a drive. Empty ones are as in the drive's `log.yaml`, and else ours."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    imu_axes: Axes | None = Field(
        None,
        description='Axes of the IMU: flu, frd, rfu, or our x, y, z in its own axes, for example "y -x z".',
    )
    force_axes: Axes | None = Field(
        None,
        description='Those of the accelerometer, where they differ: "-x -y -z" when it points down at rest.',
    )
    rate_axes: Axes | None = Field(None, description="Those of the gyroscope, where they differ.")
    imu_rotation_deg: tuple[float, float, float] | None = Field(
        None,
        description="Roll, pitch, yaw of a unit that is mounted askew, after `imu_axes`: its attitude in ours.",
    )
    force_unit: Literal["m/s2", "g", "mg"] | None = Field(None, description="Unit of the specific force.")
    rate_unit: Literal["rad/s", "deg/s"] | None = Field(None, description="Unit of the angular rate.")
    speed_unit: Literal["m/s", "km/h", "mph"] | None = Field(None, description="Unit of the wheel speed.")
    gnss_time_offset_s: float | None = Field(
        None, ge=-3600, le=3600, description="Moment of a fix minus its stamp: -1 when stamps are 1 s late."
    )
    lidar_time_offset_s: float | None = Field(
        None, ge=-3600, le=3600, description="Moment of a point minus its stamp."
    )

    @property
    def conventions(self) -> SensorConventions:
        """These alone, of a file that says more."""
        return SensorConventions(**self.model_dump(include=set(SensorConventions.model_fields)))

    def over(self, drive: SensorConventions) -> SensorConventions:
        """These conventions, completed with those of the drive."""
        return drive.model_copy(update=self.model_dump(exclude_none=True))

    def imu_in_ours(self, imu: ImuSamples) -> ImuSamples:
        """The same samples in our axes and units; the very same object where nothing is to be done."""
        force = self._to_ours(self.force_axes) * FORCE_UNITS[self.force_unit or "m/s2"]
        rate = self._to_ours(self.rate_axes) * RATE_UNITS[self.rate_unit or "rad/s"]
        if np.array_equal(force, np.eye(3)) and np.array_equal(rate, np.eye(3)):
            return imu
        return ImuSamples(imu.stamps, imu.specific_force @ force.T, imu.angular_rate @ rate.T)

    def attitude_in_ours(self, unit: AttitudePrior) -> AttitudePrior:
        """The attitude of our axes by that of the unit's own; the very same object where they are the same."""
        turn = self._to_ours(None)
        if np.array_equal(turn, np.eye(3)):
            return unit
        variances = np.diag((turn * unit.stddevs**2) @ turn.T)
        return AttitudePrior(unit.R_map_imu @ turn.T, np.sqrt(variances))

    def on_our_clock(self, of_receiver: OfReceiver) -> OfReceiver:
        """The same measurements of the receiver on our clock."""
        late = self.gnss_time_offset_s
        return replace(of_receiver, stamps=of_receiver.stamps + late) if late else of_receiver

    def wheels_in_ours(self, wheels: WheelSpeeds) -> WheelSpeeds:
        """The same wheel speeds in our unit."""
        if self.speed_unit in (None, "m/s"):
            return wheels
        return WheelSpeeds(wheels.stamps, wheels.speeds * SPEED_UNITS[self.speed_unit])

    def _to_ours(self, axes: str | None) -> Array:
        matrix = matrix_of(axes or self.imu_axes or "flu")
        if self.imu_rotation_deg is None or not any(self.imu_rotation_deg):
            return matrix
        roll, pitch, yaw = self.imu_rotation_deg
        turn = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
        return np.asarray(turn @ matrix)

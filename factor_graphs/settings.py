"""How the trajectory is estimated: every choice that a user may make, with its default and its reason."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from factor_graphs.measurements import ImuNoise

SampleInstant = Literal["end", "middle"]


class SmootherSettings(BaseModel):
    """How the trajectory is estimated; the defaults need no tuning for a road vehicle."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    imu_noise: ImuNoise | None = Field(
        None,
        description="What the IMU's data sheet promises; default: what the log says, or a consumer unit's.",
    )
    imu_sample_instant: SampleInstant | None = Field(
        None,
        description="What the stamp of an IMU sample names: the end or the middle of the interval whose mean it is."
        " Empty: the end where precise fixes show it, else the middle.",
    )
    inflate_imu_noise: bool = Field(
        True, description="Multiply the IMU noise until the residuals fit their standard deviations."
    )
    robust: bool = Field(True, description="Give fixes that do not fit less weight, or none.")
    keyframe_interval_s: float = Field(1.0, gt=0, description="Longest time between two keyframes.")
    fix_correlation_time_s: float = Field(
        1.0, ge=0, description="Fixes closer than this are not independent: together they weigh as one."
    )
    drift_correlation_time_s: float = Field(
        10.0,
        ge=0,
        description="Likewise for an inertial unit's positions, where relative poses hold the track's shape.",
    )
    min_fix_stddev_m: float = Field(
        0.02,
        gt=0,
        description="No fix is trusted more than this, unless many a second scatter as they claim.",
    )
    max_speed_mps: float = Field(70.0, gt=0, description="A fix that would need more speed is dropped.")
    estimate_time_offset: bool | None = Field(
        None,
        description="Find how much later than its stamp a fix is. Empty: only in a long drive that leaves no doubt.",
    )
    estimate_lever_arm: bool = Field(
        False, description="Find where the antenna is, starting from where it is said."
    )
    standing_stddev_mps: float | None = Field(
        0.03, gt=0, description="Velocity of a vehicle seen to stand (zero-velocity update). Empty: not used."
    )
    standing_stddev_radps: float = Field(
        1e-4, gt=0, description="Angular rate of a vehicle seen to stand (zero-angular-rate update)."
    )
    vehicle_constraint: Literal["auto", "on", "off"] = Field(
        "auto",
        description="The axle of a vehicle does not slide. auto: where the drive shows that, without LiDAR odometry.",
    )
    wheel_speed: Literal["auto", "on", "off"] = Field(
        "auto", description="Speed of the wheels, where a log has it. auto: where it fits the drive."
    )
    start_tilt_stddev_rad: float = Field(0.2, gt=0, description="Unknown roll and pitch of the first guess.")
    start_heading_stddev_rad: float = Field(
        1.8, gt=0, description="Unknown heading of the first guess; by default any heading is as likely."
    )
    forward_backward: bool = Field(
        False,
        description="Also solve by what was before and by what comes after each keyframe, and plot how far these lie"
        " apart: up to a third more time.",
    )
    max_iterations: int = Field(50, gt=0, description="The optimiser fails when it needs more.")

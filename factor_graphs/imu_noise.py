"""How good an IMU is: noise densities and biases, in SI units or in those of data sheets, or by a preset."""

from collections.abc import Mapping
from math import pi
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

STANDARD_GRAVITY = 9.80665
DATA_SHEET = {
    "angular_random_walk_deg_per_sqrt_h": ("gyroscope_noise_density", pi / 180 / 60),
    "gyroscope_noise_deg_per_s_per_sqrt_hz": ("gyroscope_noise_density", pi / 180),
    "velocity_random_walk_mps_per_sqrt_h": ("accelerometer_noise_density", 1 / 60),
    "accelerometer_noise_ug_per_sqrt_hz": ("accelerometer_noise_density", 1e-6 * STANDARD_GRAVITY),
    "gyroscope_bias_deg_per_h": ("gyroscope_bias_stddev", pi / 180 / 3600),
    "accelerometer_bias_mg": ("accelerometer_bias_stddev", 1e-3 * STANDARD_GRAVITY),
}
"""Numbers of a data sheet: the field that each is, and how much one of its units is there."""
CORRELATION = "bias_correlation_time_h"
"""How long biases last, hours: it gives the walk of both."""
PRESETS: dict[str, dict[str, float]] = {
    "consumer": {},
    # ADIS16465, as OB_GINS (Tang et al. 2022) sets it; 200 mGal are 0.2 mg
    "industrial": {
        "angular_random_walk_deg_per_sqrt_h": 0.1,
        "velocity_random_walk_mps_per_sqrt_h": 0.1,
        "gyroscope_bias_deg_per_h": 25.0,
        "accelerometer_bias_mg": 0.204,
        CORRELATION: 1.0,
    },
    # a ring laser or fibre unit, as the sample of KF-GINS (i2Nav) sets it; 15 mGal
    "tactical": {
        "angular_random_walk_deg_per_sqrt_h": 0.003,
        "velocity_random_walk_mps_per_sqrt_h": 0.03,
        "gyroscope_bias_deg_per_h": 0.027,
        "accelerometer_bias_mg": 0.0153,
        CORRELATION: 4.0,
    },
}


class ImuNoise(BaseModel):
    """How good an IMU is, in continuous time; the defaults are a good consumer MEMS unit.

    Numbers of a data sheet are taken as well, in its units (`DATA_SHEET`), or the name of a preset (`PRESETS`). Raises
    ValidationError for what is unknown, and for a number that is given twice.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    accelerometer_noise_density: float = Field(2e-3, gt=0, description="White noise, m/s²/√Hz.")
    gyroscope_noise_density: float = Field(1.7e-4, gt=0, description="White noise, rad/s/√Hz.")
    accelerometer_bias_walk: float = Field(2e-4, gt=0, description="Random walk of the bias, m/s³/√Hz.")
    gyroscope_bias_walk: float = Field(5e-6, gt=0, description="Random walk of the bias, rad/s²/√Hz.")
    accelerometer_bias_stddev: float = Field(0.1, gt=0, description="Unknown bias at the start, m/s².")
    gyroscope_bias_stddev: float = Field(5e-3, gt=0, description="Unknown bias at the start, rad/s.")

    def scaled(self, factor: float, of_walk: float | None = None) -> "ImuNoise":
        """The same unit with `factor` times the white noise, and `of_walk` times the bias walk, if not as much."""
        of_walk = factor if of_walk is None else of_walk
        return self.model_copy(
            update={
                "accelerometer_noise_density": self.accelerometer_noise_density * factor,
                "gyroscope_noise_density": self.gyroscope_noise_density * factor,
                "accelerometer_bias_walk": self.accelerometer_bias_walk * of_walk,
                "gyroscope_bias_walk": self.gyroscope_bias_walk * of_walk,
            }
        )

    @model_validator(mode="before")
    @classmethod
    def _in_si(cls, given: Any) -> Any:
        """What is given in units of a data sheet, or by the name of a preset, in those of the fields."""
        if isinstance(given, str):
            if given not in PRESETS:
                raise ValueError(f"{given!r} is no preset; known are {', '.join(PRESETS)}")
            given = PRESETS[given]
        if not isinstance(given, Mapping):
            return given
        values = {
            name: value for name, value in given.items() if name not in DATA_SHEET and name != CORRELATION
        }
        for name, value in given.items():
            if name in DATA_SHEET:
                field, unit = DATA_SHEET[name]
                if field in values:
                    raise ValueError(f"{name} is {field} in other units; give one of them")
                values[field] = unit * float(value)
        if CORRELATION in given:
            steady_s = 3600 * float(given[CORRELATION])
            for sensor in ("accelerometer", "gyroscope"):
                stddev = values.get(f"{sensor}_bias_stddev")
                if stddev is None or not steady_s > 0 or f"{sensor}_bias_walk" in values:
                    raise ValueError(
                        f"{CORRELATION} above zero needs the bias of the {sensor}, and not its walk"
                    )
                # a Gauss-Markov bias walks so fast over times much shorter than its correlation time
                values[f"{sensor}_bias_walk"] = stddev * (2 / steady_s) ** 0.5
        return values

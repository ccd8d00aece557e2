"""Noise of an IMU in the units of data sheets, and presets."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from factor_graphs.imu_noise import PRESETS, ImuNoise
from factor_graphs.settings import SmootherSettings


def test_numbers_of_a_data_sheet_are_those_in_si_units() -> None:
    """A gyroscope of 0.15 deg/sqrt(h) turns by 0.15 deg in an hour, one of 1 mg weighs 9.80665 mm/s2 more."""
    noise = ImuNoise(
        angular_random_walk_deg_per_sqrt_h=0.15,
        accelerometer_noise_ug_per_sqrt_hz=100,
        gyroscope_bias_deg_per_h=36,
        accelerometer_bias_mg=1,
    )
    assert np.degrees(noise.gyroscope_noise_density * np.sqrt(3600)) == pytest.approx(0.15)
    assert noise.accelerometer_noise_density == pytest.approx(9.80665e-4)
    assert np.degrees(noise.gyroscope_bias_stddev) * 3600 == pytest.approx(36)
    assert noise.accelerometer_bias_stddev == pytest.approx(9.80665e-3)
    assert noise.gyroscope_bias_walk == ImuNoise().gyroscope_bias_walk
    walk = ImuNoise(velocity_random_walk_mps_per_sqrt_h=0.06).accelerometer_noise_density
    assert walk * np.sqrt(3600) == pytest.approx(0.06)
    rate = ImuNoise(gyroscope_noise_deg_per_s_per_sqrt_hz=0.01).gyroscope_noise_density
    assert rate == pytest.approx(np.radians(0.01))


def test_the_walk_is_that_of_a_bias_which_lasts_so_long() -> None:
    """Simulated, a Gauss-Markov bias of 1 rad/s that lasts for an hour walks as far in a minute."""
    noise = ImuNoise(gyroscope_bias_stddev=1, accelerometer_bias_stddev=2, bias_correlation_time_h=1)
    keep, rng = np.exp(-1 / 3600), np.random.default_rng(0)
    bias = rng.standard_normal(20_000)
    start = bias
    for _ in range(60):
        bias = keep * bias + np.sqrt(1 - keep**2) * rng.standard_normal(len(bias))
    assert np.std(bias - start) == pytest.approx(noise.gyroscope_bias_walk * np.sqrt(60), rel=0.03)
    assert noise.accelerometer_bias_walk == pytest.approx(2 * noise.gyroscope_bias_walk)


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_set_by_its_name(name: str) -> None:
    found = SmootherSettings.model_validate({"imu_noise": name}).imu_noise
    assert found == ImuNoise.model_validate(PRESETS[name])
    assert (
        SmootherSettings.model_validate_json(SmootherSettings(imu_noise=found).model_dump_json()).imu_noise
        == found
    )


def test_a_better_unit_is_better_in_all_numbers() -> None:
    consumer, industrial, tactical = (ImuNoise.model_validate(name) for name in PRESETS)
    for field in ("gyroscope_noise_density", "gyroscope_bias_stddev", "accelerometer_noise_density"):
        assert getattr(consumer, field) > getattr(industrial, field) > getattr(tactical, field)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("navigation", "'navigation' is no preset; known are consumer, industrial, tactical"),
        ({"gyroscope_noise_density": 1e-4, "angular_random_walk_deg_per_sqrt_h": 0.1}, "in other units"),
        ({"bias_correlation_time_h": 1.0}, "needs the bias of the accelerometer"),
        (
            {"bias_correlation_time_h": 0.0, "gyroscope_bias_stddev": 1, "accelerometer_bias_stddev": 1},
            "above zero",
        ),
        ({"angular_random_walk": 0.1}, "Extra inputs are not permitted"),
        ({"gyroscope_bias_deg_per_h": -1.0}, "greater than 0"),
        ({"gyroscope_bias_deg_per_h": float("nan")}, "greater than 0"),
    ],
)
def test_what_is_unclear_is_refused(given: object, said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        ImuNoise.model_validate(given)

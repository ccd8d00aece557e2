import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factor_graphs.errors import MeasurementError
from factor_graphs.measurements import (
    GnssFixes,
    ImuNoise,
    ImuSamples,
    WheelSpeeds,
    clean_gnss,
    clean_imu,
    clean_wheels,
)

ZEROS = np.zeros((4, 3))


@given(
    st.permutations(range(12)),
    st.lists(st.integers(0, 11), max_size=6),
    st.sets(st.integers(0, 11), max_size=4),
)
def test_cleaning_gives_the_same_samples_whatever_was_shuffled_repeated_or_spoilt(order, repeats, spoilt):
    stamps = np.arange(12) * 0.01
    values = np.random.default_rng(0).standard_normal((12, 6))
    rows = np.array([*order, *repeats])
    bad = np.isin(rows, list(spoilt))
    noisy = np.where(bad[:, None], np.nan, values[rows])
    imu, repairs = clean_imu(stamps[rows], noisy[:, :3], noisy[:, 3:])
    left = np.setdiff1d(np.arange(12), list(spoilt))
    np.testing.assert_array_equal(imu.stamps, stamps[left])
    np.testing.assert_array_equal(np.hstack([imu.specific_force, imu.angular_rate]), values[left])
    assert repairs.not_finite == bad.sum()
    assert repairs.dropped + len(imu) == repairs.rows == len(rows)


def test_repairs_are_told_in_words():
    _, repairs = clean_imu([0.0, 0.01, 0.01, 0.03, 0.02, 0.04, 1.0, 1.01], *2 * [np.zeros((8, 3))])
    assert str(repairs) == "IMU: 8 rows; 1 repeated, dropped; 1 out of order, sorted; 1 gaps, longest 0.96 s"


def test_a_single_lost_row_is_no_gap():
    rng = np.random.default_rng(0)
    stamps = np.delete(np.arange(200) * 0.01 + rng.uniform(-5e-4, 5e-4, 200), [*range(10, 150, 7), 160, 161])
    _, repairs = clean_imu(stamps, *2 * [rng.standard_normal((len(stamps), 3))])
    assert str(repairs) == f"IMU: {len(stamps)} rows; 1 gaps, longest 0.03 s"


@pytest.mark.parametrize("unit", [1.0, 3.6, 100.0, 1000.0])
def test_codes_for_no_speed_are_dropped_whatever_the_unit(unit):
    stamps, speeds = np.arange(12) * 0.1, unit * np.array([0, 3, 5, 8, 9, 9, -9, 8, 7, 5, 3, 0.0])
    spoilt = speeds.copy()
    spoilt[[2, 9]] = np.nan, 655.35 * unit
    wheels, repairs = clean_wheels([*stamps, 0.4, 1e9], [*spoilt, 1.0, 1.0])
    left = np.delete(np.arange(12), [2, 9])
    np.testing.assert_array_equal(wheels.stamps, stamps[left])
    np.testing.assert_array_equal(wheels.speeds, speeds[left])
    assert (repairs.not_finite, repairs.absurd, repairs.repeated, repairs.far_off) == (1, 1, 1, 1)
    assert repairs.dropped + len(wheels) == repairs.rows == 14


def test_wheels_that_say_only_codes_say_nothing():
    wheels, repairs = clean_wheels(np.arange(5.0), [1e300, -1e300, np.inf, 0.0, 1e7])
    np.testing.assert_array_equal(wheels.speeds, [0.0])
    assert (repairs.not_finite, repairs.absurd) == (1, 3)


def test_wheel_speeds_are_of_one_column_in_order_and_may_be_none():
    assert len(clean_wheels([], [])[0]) == 0
    for stamps, speeds in (
        ([0.0, 1.0], [[1.0], [2.0]]),
        ([1.0, 1.0], [0.0, 0.0]),
        ([0.0, 1.0], [0.0, np.nan]),
    ):
        with pytest.raises(MeasurementError, match=r"WheelSpeeds\.(speeds|stamps)"):
            WheelSpeeds(np.array(stamps), np.array(speeds))


@pytest.mark.parametrize(
    ("stamps", "force", "says"),
    [
        ([0.0, 1.0, 1.0, 2.0], ZEROS, "strictly increasing"),
        ([0.0, 1.0, 0.5, 2.0], ZEROS, "strictly increasing"),
        ([0.0, 1.0, np.nan, 2.0], ZEROS, r"stamps\[2\] is not finite"),
        ([0.0, 1.0, 2.0, 3.0], np.full((4, 3), np.inf), r"specific_force\[0\] is not finite"),
        ([0.0, 1.0, 2.0], ZEROS, r"expected \(3, 3\)"),
    ],
)
def test_imu_samples_refuse_what_gtsam_would_swallow(stamps, force, says):
    with pytest.raises(MeasurementError, match=says):
        ImuSamples(np.array(stamps), force, ZEROS)


def test_a_fix_without_uncertainty_is_refused():
    with pytest.raises(MeasurementError, match=r"stddevs\[1\]"):
        GnssFixes(np.arange(4.0), ZEROS, np.array([[1.0] * 3, [1.0, 0.0, 1.0], [1.0] * 3, [1.0] * 3]))


def test_no_fix_at_all_is_a_value_and_measurements_cannot_be_changed():
    fixes, _ = clean_gnss([], np.empty((0, 3)), np.empty((0, 3)))
    assert len(fixes) == 0
    imu = ImuSamples(np.arange(4.0), ZEROS, ZEROS)
    with pytest.raises(ValueError, match="read-only"):
        imu.specific_force[0] = 1.0


def test_too_few_rows_and_wrong_shapes_are_refused():
    with pytest.raises(MeasurementError, match="1 left, expected at least 2"):
        clean_imu([0.0, np.nan], np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(MeasurementError, match="have shapes"):
        clean_imu([0.0, 1.0], np.zeros((2, 2)), np.zeros((2, 3)))


def test_scaled_noise_leaves_the_initial_bias_alone():
    noise = ImuNoise()
    twice = noise.scaled(2.0)
    assert twice.gyroscope_noise_density == 2 * noise.gyroscope_noise_density
    assert twice.accelerometer_bias_walk == 2 * noise.accelerometer_bias_walk
    assert twice.accelerometer_bias_stddev == noise.accelerometer_bias_stddev

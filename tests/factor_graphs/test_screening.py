import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factor_graphs.measurements import GnssFixes, ImuSamples
from factor_graphs.screening import (
    are_drifting,
    correlation_times,
    decorrelate,
    inside,
    plausible,
    white_share,
)
from factor_graphs.settings import SmootherSettings


def fixes_along(x: np.ndarray, stamps: np.ndarray | None = None) -> GnssFixes:
    stamps = np.arange(len(x), dtype=float) if stamps is None else stamps
    return GnssFixes(stamps, np.column_stack([x, 0 * x, 0 * x]), np.ones((len(x), 3)))


@given(st.sets(st.integers(0, 29), max_size=10), st.floats(1e3, 1e6))
def test_fixes_kilometres_away_are_not_plausible_and_all_others_are(wild, distance):
    x = 10.0 * np.arange(30)
    x[list(wild)] += distance
    expected = ~np.isin(np.arange(30), list(wild))
    np.testing.assert_array_equal(plausible(fixes_along(x), 70.0), expected)


def test_a_jump_that_lasts_is_dropped_as_a_whole():
    x = 10.0 * np.arange(60)
    x[20:35] += 5000.0
    keep = plausible(fixes_along(x), 70.0)
    np.testing.assert_array_equal(np.flatnonzero(~keep), np.arange(20, 35))


def test_a_long_outage_may_be_driven_through():
    stamps = np.concatenate([np.arange(20.0), np.arange(300.0, 330.0)])
    assert plausible(fixes_along(15 * stamps, stamps), 70.0).all()


def test_no_fix_is_plausible_where_there_is_none():
    assert plausible(fixes_along(np.empty(0)), 70.0).shape == (0,)


def test_ten_fixes_a_second_weigh_as_one_and_one_a_second_keeps_its_weight():
    slow = decorrelate(fixes_along(np.arange(50.0)), 1.0, 0.02)
    np.testing.assert_array_equal(slow.stddevs, 1.0)
    fast = decorrelate(fixes_along(np.arange(500.0), np.arange(500) * 0.1), 1.0, 0.02)
    weight_per_second = np.sum(1 / fast.stddevs[100:400, 0] ** 2) / 30
    assert np.isclose(weight_per_second, 1.0, rtol=1e-6)


@given(st.integers(1, 40), st.floats(0.05, 5.0), st.floats(0, 1e-3))
def test_so_many_fixes_as_a_correlation_time_holds_weigh_as_one(n: int, step_s: float, jitter: float) -> None:
    stamps = step_s * np.arange(200) * (1 + jitter)
    weighed = decorrelate(fixes_along(stamps, stamps), n * step_s, 0.02)
    np.testing.assert_allclose(weighed.stddevs[50:-50] ** 2, max(n / (1 + jitter), 1.0), rtol=2e-3 + n * 1e-6)


def test_stamps_that_shake_by_a_millisecond_change_no_weight() -> None:
    stamps = np.arange(100.0) + 1e-3 * np.random.default_rng(0).uniform(-1, 1, 100)
    for time_s in (1.0, 2.0, 4.0):
        weighed = decorrelate(fixes_along(stamps, stamps), time_s, 0.02)
        np.testing.assert_allclose(weighed.stddevs[10:-10] ** 2, time_s, rtol=5e-3)


def test_fixes_drift_together_only_where_an_inertial_unit_reports_them_and_relative_poses_hold_the_shape():
    settings = SmootherSettings(fix_correlation_time_s=1.0, drift_correlation_time_s=10.0)
    stamps = np.arange(0.0, 20.0, 0.1)
    unit = fixes_along(5 * stamps, stamps)
    pairs = np.array([[3.95, 4.05], [3.95, 5.05], [11.95, 12.05], [4.05, 4.15]])
    times = correlation_times(unit, settings, pairs)
    held = ((stamps > 3.95) & (stamps < 5.05)) | ((stamps > 11.95) & (stamps < 12.05))
    np.testing.assert_array_equal(times, np.where(held, 10.0, 1.0))
    np.testing.assert_array_equal(correlation_times(unit, settings, np.empty((0, 2))), 1.0)
    receiver = fixes_along(5 * np.arange(20.0))
    np.testing.assert_array_equal(correlation_times(receiver, settings, pairs), 1.0)


@pytest.mark.parametrize("hertz", [2.0, 4.0, 10.0])
def test_a_fast_receiver_is_no_inertial_unit(simulate, hertz: float) -> None:
    drive = simulate(5, 100.0)
    stamps = np.arange(0.5, 99.0, 1 / hertz)
    way, rng = drive.motion.poses(stamps)[:, :3, 3], np.random.default_rng(0)
    stddevs = np.full((len(stamps), 3), 1.0)
    receiver = GnssFixes(stamps, way + rng.standard_normal(way.shape), stddevs)
    assert 0.85 < white_share(receiver) <= 1
    assert not are_drifting(receiver)
    np.testing.assert_allclose(decorrelate(receiver, 1.0, 0.02).stddevs, 1.0, atol=0.4)
    drift = np.cumsum(0.02 * rng.standard_normal(way.shape), axis=0)
    unit = GnssFixes(stamps, way + drift, stddevs)
    assert white_share(unit) < 0.15
    assert are_drifting(unit) == (hertz > 2)


def test_fixes_of_different_correlation_times_lose_weight_each_by_its_own():
    stamps = np.arange(500) * 0.1
    both = decorrelate(fixes_along(stamps, stamps), np.where(stamps < 25.0, 1.0, 10.0), 0.02)
    for time, rows in ((1.0, slice(50, 150)), (10.0, slice(350, 400))):
        alone = decorrelate(fixes_along(stamps, stamps), time, 0.02)
        np.testing.assert_array_equal(both.stddevs[rows], alone.stddevs[rows])


def test_no_fix_is_trusted_beyond_the_least_stddev():
    fixes = GnssFixes(np.arange(3.0), np.zeros((3, 3)), np.full((3, 3), 1e-9))
    np.testing.assert_array_equal(decorrelate(fixes, 1.0, 0.02).stddevs, 0.02)


def test_only_fixes_within_the_imu_can_be_used():
    imu = ImuSamples(np.array([1.0, 2.0, 3.0]), np.zeros((3, 3)), np.zeros((3, 3)))
    np.testing.assert_array_equal(inside(fixes_along(np.zeros(5)), imu), [False, True, True, True, False])

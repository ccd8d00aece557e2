import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from factor_graphs import intervals
from factor_graphs.intervals import noise_as_sampled, split
from factor_graphs.measurements import ImuNoise, ImuSamples


def imu_at(stamps: np.ndarray) -> ImuSamples:
    slope = np.column_stack([stamps, -stamps, np.ones_like(stamps)])
    return ImuSamples(stamps, slope, np.zeros((len(stamps), 3)))


@given(st.integers(0, 10**6), st.integers(0, 8))
def test_the_intervals_cover_the_imu_without_a_hole_and_have_a_keyframe_at_every_fix(seed, m):
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(rng.uniform(0.005, 0.015, 500))
    fixes = np.sort(rng.uniform(stamps[0], stamps[-1], m))
    cut = split(imu_at(stamps), fixes)
    assert (cut.keyframes[0], cut.keyframes[-1]) == (stamps[0], stamps[-1])
    assert np.all(np.diff(cut.keyframes) > 0)
    assert np.all(np.diff(cut.keyframes) < 1.06)
    assert np.all(np.diff(cut.nodes) > 0)
    np.testing.assert_array_equal(cut.nodes[cut.bounds], cut.keyframes)
    assert np.all(np.abs(cut.keyframes[cut.keyframe_of(fixes)] - fixes) < 1e-3)
    # a force that grows linearly is integrated exactly
    whole = (cut.specific_force[:, 0] * cut.durations).sum()
    np.testing.assert_allclose(whole, (stamps[-1] ** 2 - stamps[0] ** 2) / 2, rtol=1e-9)


def test_measurements_that_end_together_with_the_imu_leave_no_empty_interval():
    """A fix and the later ends of several relative poses may all bear the stamp of the last sample."""
    stamps = np.arange(0.0, 2.0, 0.01)
    for beside in (0.0, 2e-4):
        cut = split(imu_at(stamps), np.array([0.0, 0.0, 1.0, 1.0, *[stamps[-1] - beside] * 3]))
        assert (cut.keyframes[0], cut.keyframes[-1]) == (stamps[0], stamps[-1])
        assert np.diff(cut.keyframes).min() > 0.5
        assert np.diff(cut.nodes).min() > 5e-3


def test_steps_made_in_blocks_are_those_made_in_one_piece(monkeypatch):
    """Wherever a block ends: at a fix, in a gap, and at the last sample alone."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        stamps = np.cumsum(rng.uniform(0.005, 0.035, 501) + 2.0 * (rng.random(501) < 0.01))
        imu = ImuSamples(stamps, rng.standard_normal((501, 3)), rng.standard_normal((501, 3)))
        fixes = np.sort([*rng.uniform(stamps[0], stamps[-1], 20), *rng.choice(stamps, 5)])
        whole = split(imu, fixes)
        for block in (1, 7, 100, 500):
            monkeypatch.setattr(intervals, "BLOCK", block)
            cut = split(imu, fixes)
            for name in ("keyframes", "bounds", "nodes", "blind"):
                np.testing.assert_array_equal(getattr(cut, name), getattr(whole, name))
            np.testing.assert_allclose(cut.specific_force, whole.specific_force, atol=1e-9)
            np.testing.assert_allclose(cut.angular_rate, whole.angular_rate, atol=1e-9)
        monkeypatch.undo()


def test_a_silent_imu_is_an_interval_of_its_own_with_the_noise_of_an_unseen_vehicle():
    stamps = np.concatenate([np.arange(0.0, 2.0, 0.01), np.arange(3.5, 5.0, 0.01)])
    cut = split(imu_at(stamps), np.array([0.5, 2.7]))
    spans = cut.keyframes[np.flatnonzero(cut.blind)]
    assert spans[0] == stamps[199]
    assert np.isclose(np.diff(cut.keyframes)[cut.blind].sum(), 3.5 - stamps[199])
    noise = cut.noise(ImuNoise())
    for its, blind in zip(noise, cut.blind, strict=True):
        assert (its.accelerometer_noise_density > 0.1) == blind


def test_force_is_seen_from_the_start_of_the_step():
    """A constant force in the map, felt by a turning imu, must come out as that constant force."""
    stamps, rate = np.arange(0.0, 1.0, 0.01), 2.0
    angle = rate * stamps
    force = np.column_stack([np.cos(angle), -np.sin(angle), np.zeros_like(angle)])
    cut = split(ImuSamples(stamps, force, np.tile([0.0, 0.0, rate], (100, 1))), np.empty(0))
    start = rate * cut.nodes[:-1]
    east = np.cos(start) * cut.specific_force[:, 0] - np.sin(start) * cut.specific_force[:, 1]
    north = np.sin(start) * cut.specific_force[:, 0] + np.cos(start) * cut.specific_force[:, 1]
    np.testing.assert_allclose(east, 1.0, atol=1e-3)
    np.testing.assert_allclose(north, 0.0, atol=1e-9)


def test_a_slow_log_shows_its_own_noise_and_a_fast_one_keeps_the_data_sheet():
    rng = np.random.default_rng(0)
    noise = ImuNoise()
    for step, expected in ((0.01, noise.accelerometer_noise_density), (0.1, 0.3 * np.sqrt(0.1))):
        stamps = np.arange(4000) * step
        imu = ImuSamples(stamps, 0.3 * rng.standard_normal((4000, 3)), np.zeros((4000, 3)))
        shown = noise_as_sampled(imu, noise)
        assert np.isclose(shown.accelerometer_noise_density, expected, rtol=0.03)
        assert shown.gyroscope_noise_density == noise.gyroscope_noise_density

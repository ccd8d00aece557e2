import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factor_graphs.accuracy import errors
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise, ImuSamples, clean_imu
from factor_graphs.simulation import random_drive, simulate_gnss, simulate_imu
from factor_graphs.smoothing import smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
UNSEEN = (85.0, 155.0)


@given(st.integers(0, 1000), st.integers(6, 200), st.booleans(), st.sampled_from([np.float64, np.float32]))
def test_what_fills_a_gap_with_straight_lines_is_dropped_and_nothing_else(seed, missing, by_row, kind):
    """As tools fill gaps, in time or from row to row; the samples at both ends were measured."""
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(0.01 + 4e-4 * rng.standard_normal(600))
    values = 9.8 + np.cumsum(rng.standard_normal((600, 6)), axis=0)
    first = int(rng.integers(1, 600 - missing - 2))
    ends, within = [first, first + missing + 1], np.arange(first + 1, first + missing + 1)
    axis = np.arange(600.0) if by_row else stamps
    filled = values.copy()
    filled[within] = np.column_stack(
        [np.interp(axis[within], axis[ends], column[ends]) for column in values.T]
    )
    imu, repairs = clean_imu(stamps, filled[:, :3].astype(kind), filled[:, 3:].astype(kind))
    np.testing.assert_array_equal(imu.stamps, np.delete(stamps, within))
    assert repairs.filled_in == repairs.dropped == missing
    np.testing.assert_array_equal(repairs.gaps[np.ptp(repairs.gaps, axis=1) > 0.03], [stamps[ends]])


@pytest.mark.parametrize(
    "spoil",
    [
        lambda stamps, values: (stamps, values),
        lambda stamps, values: (stamps, values.round(1)),
        lambda stamps, values: (stamps, np.where(stamps[:, None] < 3, values, 0.0)),
        lambda stamps, values: (stamps, np.where(np.arange(6) < 5, values, 0.0)),
        lambda stamps, values: _resampled(stamps, values, 0.005),
        lambda stamps, values: _resampled(stamps, values, 0.0025),
    ],
    ids=["noise", "coarse", "at rest", "a dead channel", "twice the rate", "four times the rate"],
)
def test_what_a_sensor_says_is_not_taken_for_what_fills_a_gap(spoil):
    values = 0.1 * np.random.default_rng(0).standard_normal((1000, 6))
    stamps, said = spoil(np.arange(1000) * 0.01, values)
    _, repairs = clean_imu(stamps, said[:, :3], said[:, 3:])
    assert repairs.dropped == 0


def _resampled(stamps, values, step_s):
    finer = np.arange(stamps[0], stamps[-1], step_s)
    return finer, np.column_stack([np.interp(finer, stamps, column) for column in values.T])


@pytest.mark.integration
def test_a_turn_in_a_gap_that_was_filled_in_bends_nothing():
    """The fixes tell no heading for a minute, and the middle of a turn within it was not measured."""
    drive, rng = random_drive(240.0, np.random.default_rng(3)), np.random.default_rng(3)
    imu = simulate_imu(drive, np.arange(0.0, 240.0, 0.01), FRAME, ImuNoise(), rng)
    fixes = simulate_gnss(drive, np.arange(0.5, 239.0), (0.3,) * 3, LEVER, rng, outages=(UNSEEN,))
    middle = 9000 + int(np.abs(imu.angular_rate[9000:15000, 2]).argmax())
    ends, within = [middle - 80, middle + 80], np.arange(middle - 79, middle + 80)
    said = np.hstack([imu.specific_force, imu.angular_rate])
    said[within] = np.column_stack([np.interp(within, ends, column[ends]) for column in said.T])

    alike = said + 0.0
    alike[within] += 0.01 * rng.standard_normal((len(within), 6))  # no line any more: believed

    def heading_deg(values: np.ndarray) -> float:
        found = smooth(ImuSamples(imu.stamps, values[:, :3], values[:, 3:]), fixes, FRAME, None, LEVER)
        told = f"{len(within)} of {len(imu)} samples of the IMU fill gaps with straight lines: not believed"
        assert (told in found.notes) == (values is said)
        track = found.trajectory
        return errors(track, drive.trajectory(track.stamps)).within([UNSEEN]).heading_rms_deg

    assert heading_deg(said) < 0.5  # 0.05 had it been measured
    assert heading_deg(alike) > 1.5

import numpy as np
import pytest

from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import simulate_gnss
from factor_graphs.smoothing import smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


def precise(drive, offset: float) -> GnssFixes:
    """Fixes of 5 cm, of `offset` s after their stamps."""
    return simulate_gnss(
        drive.motion, drive.fixes.stamps, 0.05, LEVER, np.random.default_rng(0), time_offset_s=offset
    )


@pytest.mark.parametrize("offset", [0.1, -0.04])
def test_a_time_offset_is_found_unasked_where_the_data_leave_no_doubt(simulate, offset):
    drive = simulate(60, seconds=180.0, noise=ImuNoise())
    s = smooth(drive.imu, precise(drive, offset), FRAME, None, LEVER)
    found = s.calibration
    assert found.time_offset_s == pytest.approx(offset, abs=4 * found.time_offset_stddev_s)
    assert found.time_offset_stddev_s < 0.005
    assert any("after its stamp" in note for note in s.notes)
    assert 0.8 < s.chi2_per_dof < 1.3


def test_where_there_is_no_offset_none_is_applied(simulate):
    for seed in range(3):
        drive = simulate(61 + seed, seconds=180.0, noise=ImuNoise())
        s = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
        assert s.calibration.time_offset_s == 0.0


def test_a_time_offset_is_left_alone_when_it_shall_be(simulate):
    drive = simulate(60, seconds=180.0, noise=ImuNoise())
    s = smooth(drive.imu, precise(drive, 0.1), FRAME, SmootherSettings(estimate_time_offset=False), LEVER)
    assert s.calibration.time_offset_s == 0.0
    assert s.calibration.time_offset_stddev_s is None


def test_lever_arm_and_offset_are_found_together_when_asked(simulate):
    drive = simulate(65, seconds=180.0, noise=ImuNoise())
    settings = SmootherSettings(estimate_lever_arm=True, estimate_time_offset=True)
    s = smooth(drive.imu, precise(drive, 0.05), FRAME, settings, LEVER + np.array([0.4, -0.3, 0.0]))
    found = s.calibration
    off = np.abs(found.p_imu_antenna - LEVER) / found.p_imu_antenna_stddevs
    assert np.all(off < 4)
    assert np.all(found.p_imu_antenna_stddevs[:2] < 0.1)
    assert (
        found.p_imu_antenna_stddevs[2] > 0.3
    )  # a vehicle that hardly tilts does not show the height of its antenna
    assert found.time_offset_s == pytest.approx(0.05, abs=4 * found.time_offset_stddev_s)


def test_covariances_hold_what_is_not_known_of_clock_and_lever_arm(simulate):
    """They are those of the same data with both given, and what an error of either does to the place."""
    drive = simulate(65, seconds=130.0, noise=ImuNoise())
    both = SmootherSettings(estimate_lever_arm=True, estimate_time_offset=True)
    found = smooth(drive.imu, drive.fixes, FRAME, both, LEVER)
    clock, fixes = found.calibration, drive.fixes
    given = GnssFixes(fixes.stamps + clock.time_offset_s, fixes.positions, fixes.stddevs)
    none = SmootherSettings(estimate_time_offset=False)
    known = smooth(drive.imu, given, FRAME, none, clock.p_imu_antenna).keyframes
    R, moving = known.T_map_imu[:, :3, :3], known.velocities
    of_clock = clock.time_offset_stddev_s**2 * moving[:, :, None] * moving[:, None]
    of_lever = R @ np.diag(clock.p_imu_antenna_stddevs**2) @ np.swapaxes(R, 1, 2)
    expected = known.position_covariances + of_clock + of_lever
    np.testing.assert_allclose(found.keyframes.position_covariances, expected, atol=1e-6)

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factor_graphs.accuracy import anees_band, errors, nees, state_error
from factor_graphs.alignment import AttitudePrior
from factor_graphs.errors import EstimationError, MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import simulate_gnss, simulate_imu
from factor_graphs.smoothing import heading_stddevs, smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])


def error_of(solution, drive):
    return errors(solution.trajectory, drive.motion.trajectory(solution.trajectory.stamps))


def test_without_noise_the_truth_is_the_solution(simulate):
    drive = simulate(0)
    # the suspension is slip to a vehicle constraint: that is noise
    solution = smooth(drive.imu, drive.fixes, FRAME, SmootherSettings(vehicle_constraint="off"), LEVER)
    e = error_of(solution, drive)
    assert e.ate_m < 2e-3
    assert e.heading_rms_deg < 0.01
    np.testing.assert_allclose(solution.fix_residuals, 0.0, atol=0.01)


def test_the_estimate_is_several_times_better_than_the_fixes(mems, mems_solution):
    e = error_of(mems_solution, mems)
    assert e.horizontal_rms_m < 0.5
    assert e.vertical_rms_m < 0.6
    assert e.heading_rms_deg < 1.0
    assert not mems_solution.rejected.any()
    assert mems_solution.inflation == 1.0
    assert 0.8 < mems_solution.chi2_per_dof < 1.3


def test_the_trajectory_has_a_state_at_every_imu_stamp_and_no_step_at_a_keyframe(mems, mems_solution):
    t = mems_solution.trajectory
    nearest = np.min(
        np.abs(
            mems.imu.stamps[:, None] - t.stamps[np.searchsorted(t.stamps, mems.imu.stamps)[:, None] + [-1, 0]]
        ),
        axis=1,
    )
    assert nearest.max() < 1e-3
    at_keyframes = t.at(mems_solution.keyframes.stamps)
    np.testing.assert_allclose(at_keyframes, mems_solution.keyframes.T_map_imu, atol=1e-9)
    steps = (
        np.diff(t.positions, axis=0) - (t.velocities[1:] + t.velocities[:-1]) / 2 * np.diff(t.stamps)[:, None]
    )
    assert np.abs(steps).max() < 1e-3
    assert np.isfinite(t.covariances).all()


def test_the_errors_are_as_large_as_the_covariances_say(simulate):
    """One epoch per run: epochs of one run are not independent."""
    runs, values = 12, []
    for seed in range(runs):
        drive = simulate(100 + seed, seconds=60.0, noise=ImuNoise())
        s = smooth(
            drive.imu, drive.fixes, FRAME, SmootherSettings(robust=False, standing_stddev_mps=None), LEVER
        )
        k = 30
        stamp = s.keyframes.stamps[k : k + 1]
        truth = drive.motion.trajectory(stamp)
        bias = np.array([np.interp(stamp[0], drive.imu.stamps, b) for b in drive.biases.T])
        e = state_error(
            s.keyframes.T_map_imu[k], s.keyframes.velocities[k], s.biases[k],
            truth.T_map_imu[0], truth.velocities[0], bias,
        )  # fmt: skip
        values.append(nees(e, s.state_covariances[k]))
    low, high = anees_band(15, runs)
    assert low < np.mean(values) < high


@pytest.mark.slow
def test_positions_of_an_inertial_unit_that_drift_together_place_the_track_no_better_than_one_of_them(
    simulate,
):
    """One error per drive; a graph that takes a fix each second for new is far too sure of the place."""
    runs, honest, by_graph = 8, [], []
    for seed in range(runs):
        drive = simulate(300 + seed, seconds=20.0, noise=ImuNoise())
        stamps, rng = np.arange(0.05, 19.9, 0.1), np.random.default_rng(seed)
        positions = simulate_gnss(
            drive.motion,
            stamps,
            [0.002] * 3,
            LEVER,
            rng,
            correlated_stddevs=[0.4] * 3,
            correlation_time_s=120.0,
        ).positions
        s = smooth(
            drive.imu, GnssFixes(stamps, positions, np.full((len(stamps), 3), 0.4)), FRAME, None, LEVER
        )
        k = len(s.keyframes) // 2
        off = s.keyframes.positions[k] - drive.motion.trajectory(s.keyframes.stamps[k : k + 1]).positions[0]
        error = s.keyframes.T_map_imu[k, :3, :3].T @ off
        honest.append(nees(error, s.keyframes.covariances[k, 3:, 3:]))
        by_graph.append(nees(error, s.state_covariances[k, 3:6, 3:6]))
    low, high = anees_band(3, runs)
    assert low < np.mean(honest) < high
    assert np.mean(by_graph) > high


def test_a_frame_elsewhere_on_the_earth_sees_the_same_trajectory(mems):
    here, far = LocalFrame(89.99, 0.0, 115.0), LocalFrame(89.7, 115.0, 300.0)
    T = far.pose_of(here)  # turned by 115° and 34 km away, where the ground is tilted by 0.3°
    moved = mems.fixes.positions @ T[:3, :3].T + T[:3, 3]
    fixes = GnssFixes(mems.fixes.stamps, moved, mems.fixes.stddevs)
    before = smooth(mems.imu, mems.fixes, here, None, LEVER).trajectory.moved(T)
    after = smooth(mems.imu, fixes, far, None, LEVER).trajectory
    np.testing.assert_allclose(after.positions, before.positions, atol=5e-3)
    np.testing.assert_allclose(after.T_map_imu[:, :3, :3], before.T_map_imu[:, :3, :3], atol=1e-3)


@pytest.mark.parametrize("euler_deg", [[0, 0, 90], [0, -90, 0], [123, -40, 77]])
def test_an_imu_that_is_mounted_otherwise_sees_the_same_trajectory(mems, euler_deg):
    """Which way it looks is unknown about the vertical, not about an axis of the IMU."""
    turn = Rotation.from_euler("ZYX", euler_deg, degrees=True).as_matrix()  # to the level imu
    force, rate = mems.imu.specific_force @ turn, mems.imu.angular_rate @ turn
    settings = SmootherSettings(vehicle_constraint="off")
    level = smooth(mems.imu, mems.fixes, FRAME, settings, LEVER)
    turned = smooth(ImuSamples(mems.imu.stamps, force, rate), mems.fixes, FRAME, settings, LEVER @ turn)
    assert turned.chi2_per_dof == pytest.approx(level.chi2_per_dof, rel=0.02)
    np.testing.assert_allclose(turned.trajectory.positions, level.trajectory.positions, atol=0.02)
    R = turned.trajectory.T_map_imu[:, :3, :3] @ turn.T
    np.testing.assert_allclose(R, level.trajectory.T_map_imu[:, :3, :3], atol=5e-3)


@pytest.mark.parametrize("claimed", [0.05, 1e-6])
def test_fixes_that_claim_centimetres_and_scatter_by_a_metre_are_not_taken_for_a_bad_imu(mems, claimed):
    fixes = GnssFixes(mems.fixes.stamps, mems.fixes.positions, claimed * mems.fixes.stddevs)
    s = smooth(mems.imu, fixes, FRAME, None, LEVER)
    believed = np.maximum(fixes.stddevs[0], SmootherSettings().min_fix_stddev_m)
    assert s.fix_inflation == pytest.approx(
        np.sqrt(np.mean((mems.fixes.stddevs[0] / believed) ** 2)), rel=0.2
    )
    assert s.inflation < 1.2
    assert s.rejected.sum() < 0.05 * len(fixes)
    assert error_of(s, mems).horizontal_rms_m < 0.5


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_outliers_are_rejected_and_hardly_hurt(simulate, share):
    drive = simulate(5, noise=ImuNoise(), outlier_share=share)
    s = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
    clean = simulate_gnss(drive.motion, drive.fixes.stamps, 1.0, LEVER).positions
    wild = np.linalg.norm((drive.fixes.positions - clean)[:, :2], axis=1) > 6.5
    assert s.rejected[wild].all()
    assert s.rejected.sum() < 1.3 * share * len(drive.fixes) + 3
    assert np.all(s.fix_weights[s.rejected] == 0)
    assert error_of(s, drive).horizontal_rms_m < 0.75


def test_the_noise_of_a_bad_imu_is_found_even_among_outliers(simulate):
    bad = ImuNoise().scaled(8.0)
    for share in (0.0, 0.1):
        drive = simulate(6, noise=bad, outlier_share=share)
        stiff = smooth(drive.imu, drive.fixes, FRAME, SmootherSettings(inflate_imu_noise=False), LEVER)
        fitted = smooth(drive.imu, drive.fixes, FRAME, None, LEVER)
        assert 2.0 < fitted.inflation < 16.0
        assert 0.8 < fitted.chi2_per_dof < 1.3 < stiff.chi2_per_dof
        assert error_of(fitted, drive).horizontal_rms_m < error_of(stiff, drive).horizontal_rms_m
        assert any("times the noise" in note for note in fitted.notes)


def test_an_outage_costs_more_the_longer_it_is_and_its_stddev_says_so(simulate):
    worst, stddevs = [], []
    for length in (0.0, 20.0, 50.0):
        drive = simulate(7, noise=ImuNoise(), outages=[(40.0, 40.0 + length)] if length else [])
        s = smooth(drive.imu, drive.fixes, FRAME, SmootherSettings(standing_stddev_mps=None), LEVER)
        stddevs.append(s.trajectory.position_stddevs[:, :2].max())
        worst.append(np.linalg.norm(error_of(s, drive).position[:, :2], axis=1).max())
    assert stddevs[0] < stddevs[1] < stddevs[2]
    assert worst[2] < 4 * stddevs[2]


def test_a_silent_imu_is_bridged_and_reported(simulate):
    drive = simulate(8, noise=ImuNoise())
    keep = (drive.imu.stamps < 50.0) | (drive.imu.stamps > 52.0)
    imu = ImuSamples(drive.imu.stamps[keep], drive.imu.specific_force[keep], drive.imu.angular_rate[keep])
    s = smooth(imu, drive.fixes, FRAME, None, LEVER)
    assert any("silent for 2.0" in note for note in s.notes)
    e = error_of(s, drive)
    assert e.horizontal_rms_m < 0.6
    assert e.within([(50.0, 52.0)]).ate_m < 4 * s.trajectory.position_stddevs[:, :2].max()


def test_fixes_kilometres_away_or_outside_the_imu_are_left_out_and_reported(simulate):
    drive = simulate(9, noise=ImuNoise())
    positions = drive.fixes.positions.copy()
    positions[[20, 21, 70]] += 20_000.0
    stamps = drive.fixes.stamps.copy()
    stamps[-1] = 500.0
    s = smooth(drive.imu, GnssFixes(stamps, positions, drive.fixes.stddevs), FRAME, None, LEVER)
    assert set(np.flatnonzero(s.rejected)) >= {20, 21, 70, len(stamps) - 1}
    assert np.isnan(s.fix_residuals[-1]).all()
    assert any(f"3 of {len(stamps)} fixes need more than 70 m/s" in note for note in s.notes)
    assert any(f"1 of {len(stamps)} fixes outside the IMU's span" in note for note in s.notes)
    assert np.flatnonzero(s.outside_imu).tolist() == [len(stamps) - 1]
    unfit = s.rejected.sum() - 4
    told = [note for note in s.notes if note.endswith("fixes rejected")]
    assert told == ([f"{unfit} of {len(stamps)} fixes rejected"] if unfit else []), "each fix is told of once"
    assert error_of(s, drive).horizontal_rms_m < 0.6


def test_fixes_of_two_antennas_are_doubted_and_those_of_one_are_not(simulate):
    drive, rng = simulate(11, noise=ImuNoise()), np.random.default_rng(11)
    one, other = (
        simulate_gnss(drive.motion, drive.fixes.stamps, (0.02, 0.02, 0.04), LEVER + left, rng)
        for left in (0.0, np.array([0.0, -1.0, 0.0]))
    )
    is_other = np.arange(len(one)) % 2 == 1
    both = GnssFixes(one.stamps, np.where(is_other[:, None], other.positions, one.positions), one.stddevs)
    told = [
        any("one antenna" in note for note in smooth(drive.imu, fixes, FRAME, None, LEVER).notes)
        for fixes in (both, one)
    ]
    assert told == [True, False]


@pytest.mark.parametrize("m", [0, 1, 2])
def test_fewer_than_three_fixes_are_refused(simulate, m):
    drive = simulate(10, seconds=20.0)
    with pytest.raises(MeasurementError, match=f"{m} usable GNSS fixes of {m}.*expected at least 3"):
        smooth(drive.imu, drive.fixes[:m], FRAME)


def test_a_vehicle_that_never_moves_has_no_heading_and_the_solution_says_so():
    rng = np.random.default_rng(0)
    stamps = np.arange(0.0, 60.0, 0.01)
    noise = ImuNoise()
    force = np.tile([0.0, 0.0, FRAME.gravity], (len(stamps), 1)) + 0.02 * rng.standard_normal(
        (len(stamps), 3)
    )
    rate = 1.7e-3 * rng.standard_normal((len(stamps), 3))
    fixes = GnssFixes(np.arange(0.5, 59.0), rng.standard_normal((59, 3)), np.ones((59, 3)))
    s = smooth(ImuSamples(stamps, force, rate), fixes, FRAME, SmootherSettings(imu_noise=noise))
    assert any("heading is unobservable" in note for note in s.notes)
    assert np.degrees(heading_stddevs(s.trajectory)).min() > 25
    assert np.linalg.norm(s.trajectory.positions, axis=1).max() < 0.6
    known = AttitudePrior(np.eye(3), np.array([0.01, 0.01, 0.02]))
    told = smooth(ImuSamples(stamps, force, rate), fixes, FRAME, None, initial_attitude=known)
    assert not any("unobservable" in note for note in told.notes)
    assert np.degrees(heading_stddevs(told.trajectory)[0]) < 1.2


def test_an_optimiser_stopped_at_its_limit_is_an_error(mems):
    with pytest.raises(EstimationError, match="stopped at its limit of 1 iterations"):
        smooth(mems.imu, mems.fixes, FRAME, SmootherSettings(max_iterations=1), LEVER)


@pytest.mark.parametrize(
    "seconds", [2.0, pytest.param(6.0, marks=pytest.mark.slow), pytest.param(15.0, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(("step", "stddev"), [(0.2, 0.02), (0.1, 1.0), (0.5, 0.3)])
@pytest.mark.parametrize("imu_step", [0.01, 0.1])
def test_short_drives_of_any_rate_are_solved(simulate, seconds, step, stddev, imu_step):
    drive = simulate(11, seconds=60.0)
    stamps = np.arange(20.0, 20.0 + seconds, imu_step)
    imu = simulate_imu(drive.motion, stamps, FRAME)
    fixes = simulate_gnss(drive.motion, np.arange(20.03, stamps[-1], step), stddev, LEVER)
    s = smooth(imu, fixes, FRAME, None, LEVER)
    e = error_of(s, drive)
    assert np.all(
        np.linalg.norm(e.position, axis=1) < 3 * np.linalg.norm(s.trajectory.position_stddevs, axis=1)
    )


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
@pytest.mark.parametrize("wrong", [lambda force: force / 9.81, lambda force: force - [0.0, 0.0, 9.81]])
def test_a_specific_force_in_g_or_without_gravity_is_told(simulate, wrong, seed):
    drive = simulate(seed, noise=ImuNoise(), seconds=60.0)
    imu = ImuSamples(drive.imu.stamps, wrong(drive.imu.specific_force), drive.imu.angular_rate)
    try:
        told = smooth(imu, drive.fixes, FRAME, None, LEVER).notes[0]
    except EstimationError as error:
        told = str(error)
    assert "is it in g, or without gravity?" in told or "check units" in told


def test_wrong_lever_arms_and_unknown_settings_are_refused(mems):
    with pytest.raises(MeasurementError, match="p_imu_antenna is"):
        smooth(mems.imu, mems.fixes, FRAME, None, (0.0, 1.0))
    with pytest.raises(ValueError, match="Extra inputs are not permitted"):
        SmootherSettings(keyframe_intervall_s=1.0)
    with pytest.raises(MeasurementError, match="no rotation"):
        AttitudePrior(np.eye(3) * 2, np.ones(3))


def test_the_smoother_changes_none_of_its_input(mems):
    before = [a.copy() for a in (mems.imu.stamps, mems.imu.specific_force, mems.fixes.positions)]
    smooth(mems.imu, mems.fixes, FRAME, None, LEVER)
    for kept, now in zip(
        before, (mems.imu.stamps, mems.imu.specific_force, mems.fixes.positions), strict=True
    ):
        np.testing.assert_array_equal(kept, now)


@pytest.mark.slow
def test_white_fixes_ten_times_a_second_are_ten_times_as_many(simulate):
    drive = simulate(6, 240.0, ImuNoise())
    stamps = np.arange(0.4, 239.5, 0.1)
    fixes = simulate_gnss(drive.motion, stamps, (1.0, 1.0, 2.0), LEVER, np.random.default_rng(6))
    once, often = (smooth(drive.imu, of, FRAME, None, LEVER) for of in (drive.fixes, fixes))
    assert error_of(often, drive).horizontal_rms_m < min(0.15, 0.8 * error_of(once, drive).horizontal_rms_m)
    stddevs = np.sqrt(np.einsum("kii->k", often.keyframes.covariances[:, 3:, 3:]))
    assert np.median(stddevs) < 0.25

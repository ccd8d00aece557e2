"""Fixes that jump together: the displaced block goes, whatever else a drive has, and nothing goes without a jump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from factor_graphs.consistent_fixes import with_consistent_fixes
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise
from factor_graphs.problem import Problem, pose_problem
from factor_graphs.relative_poses import NO_RELATIVE_POSES, RelativePoses
from factor_graphs.settings import SmootherSettings
from factor_graphs.simulation import simulate_gnss
from factor_graphs.smoothing import smooth

FRAME = LocalFrame(49.0, 8.4, 115.0)
LEVER = np.array([0.5, 0.3, 1.0])
RTK, METRE = np.array([0.02, 0.02, 0.03]), np.array([1.0, 1.0, 2.0])
AWAY = np.array([0.6, -0.75, 0.3])
Mask = NDArray[np.bool_]


@pytest.fixture(scope="module")
def driven(simulate):
    return simulate(11, 160.0, ImuNoise())


def fixes_of(one, stddevs: NDArray[np.float64], hertz: float = 1.0, **gnss: object) -> GnssFixes:
    stamps = np.arange(0.37, 159.0, 1 / hertz)
    return simulate_gnss(one.motion, stamps, stddevs, LEVER, np.random.default_rng(5), **gnss)


def displaced(fixes: GnssFixes, first: float, last: float, by_m: float) -> tuple[GnssFixes, Mask]:
    block = (fixes.stamps >= first) & (fixes.stamps < last)
    positions = fixes.positions + by_m * AWAY / np.linalg.norm(AWAY) * block[:, None]
    return GnssFixes(fixes.stamps, positions, fixes.stddevs), block


def chosen(one, fixes: GnssFixes, relative: RelativePoses = NO_RELATIVE_POSES) -> tuple[Problem, Problem]:
    def pose(some: GnssFixes) -> Problem:
        return pose_problem(one.imu, some, FRAME, SmootherSettings(), LEVER, None, relative)

    posed = pose(fixes)
    return posed, with_consistent_fixes(posed, fixes, pose)


@pytest.mark.parametrize(
    ("stddevs", "by_m", "seconds", "hertz"),
    [(RTK, 5.0, 60.0, 1.0), (RTK, 20.0, 30.0, 1.0), (RTK, 1.0, 30.0, 5.0), (METRE, 20.0, 30.0, 1.0)],
)
def test_a_block_that_jumps_away_and_back_is_rejected_as_a_whole_and_alone(
    driven, stddevs: NDArray[np.float64], by_m: float, seconds: float, hertz: float
) -> None:
    fixes, block = displaced(fixes_of(driven, stddevs, hertz), 50.0, 50.0 + seconds, by_m)
    _, without = chosen(driven, fixes)
    assert not without.used[block].any()
    assert np.count_nonzero(~without.used[~block]) < 2 * hertz  # one fix in a second is looked at
    (note,) = without.notes
    assert " fixes jump together by " in note
    assert "before and after" in note


def test_the_trajectory_is_that_of_the_gap_and_says_so(driven) -> None:
    right = fixes_of(driven, RTK)
    fixes, block = displaced(right, 60.0, 90.0, 5.0)
    found, gap = (smooth(driven.imu, some, FRAME, None, LEVER) for some in (fixes, right[~block]))
    stamps = np.arange(60.0, 90.0)
    off, of_gap = (
        np.linalg.norm((s.trajectory.at(stamps) - driven.motion.poses(stamps))[:, :3, 3], axis=1)
        for s in (found, gap)
    )
    assert off.max() <= 1.5 * of_gap.max()
    assert found.rejected[block].all()
    assert found.inflation == gap.inflation
    assert any("30 of 159 fixes jump together by 5." in note for note in found.notes)


def test_beside_odometry_the_same_block_is_rejected(driven) -> None:
    fixes, block = displaced(fixes_of(driven, RTK), 60.0, 90.0, 5.0)
    stamps = np.arange(0.5, 158.0, 0.5)
    T, covariance = driven.motion.poses(stamps), np.diag(np.repeat([1e-3, 0.01], 3) ** 2)
    pairs, covariances = (
        np.column_stack([stamps[:-1], stamps[1:]]),
        np.tile(covariance, (len(stamps) - 1, 1, 1)),
    )
    _, without = chosen(driven, fixes, RelativePoses(pairs, np.linalg.inv(T[:-1]) @ T[1:], covariances))
    np.testing.assert_array_equal(without.used, ~block)


@pytest.mark.parametrize(
    ("stddevs", "gnss"),
    [
        (RTK, {}),
        (METRE, {}),
        (METRE, {"outages": [(40.0, 90.0)]}),
        (METRE, {"correlated_stddevs": (3.0, 3.0, 6.0), "correlation_time_s": 30.0}),
        (RTK, {"correlated_stddevs": (1.0, 1.0, 2.0)}),
        (METRE, {"outlier_share": 0.1}),
        (METRE, {"outlier_share": 0.3}),
        (RTK, {"outlier_share": 0.1}),
    ],
)
def test_without_a_jump_nothing_changes(
    driven, stddevs: NDArray[np.float64], gnss: dict[str, object]
) -> None:
    posed, same = chosen(driven, fixes_of(driven, stddevs, **gnss))
    assert same is posed


def test_a_solution_that_converges_after_it_came_back_is_kept(driven) -> None:
    fixes, block = displaced(fixes_of(driven, RTK), 50.0, 80.0, 5.0)
    later = np.clip(fixes.stamps - 80.0, 0.0, None)
    floating = (0.4 * np.exp(-later / 20.0) * (later > 0))[:, None] * [1.0, 0.0, 0.0]
    _, without = chosen(driven, replace(fixes, positions=fixes.positions + floating))
    np.testing.assert_array_equal(without.used, ~block)


def test_of_two_blocks_the_one_that_is_clearly_longer_wins(driven) -> None:
    fixes, block = displaced(fixes_of(driven, RTK), 0.0, 30.0, 5.0)
    _, without = chosen(driven, fixes)
    np.testing.assert_array_equal(without.used, ~block)


def test_of_two_blocks_about_as_long_neither_is_believed_and_the_doubt_is_in_the_covariance(
    driven,
) -> None:
    fixes, _ = displaced(fixes_of(driven, RTK), 0.0, 75.0, 5.0)
    found = smooth(driven.imu, fixes, FRAME, None, LEVER)
    poses = found.trajectory.T_map_imu
    error = np.linalg.norm((poses - driven.motion.poses(found.trajectory.stamps))[:, :3, 3], axis=1)
    assert not found.rejected.any()
    assert np.all(error < 3 * np.linalg.norm(found.trajectory.position_stddevs, axis=1))
    assert any("nothing tells which are right" in note for note in found.notes)


def test_over_a_gap_the_imu_tells_which_block_is_displaced(driven) -> None:
    good = fixes_of(driven, RTK, outages=[(60.0, 70.0)])
    fixes, block = displaced(good, 70.0, 115.0, 20.0)
    _, without = chosen(driven, fixes)
    np.testing.assert_array_equal(without.used, ~block)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
def test_a_block_is_found_beside_outliers(simulate, seed: int) -> None:
    one, rng = simulate(20 + seed, 160.0, ImuNoise()), np.random.default_rng(seed)
    stamps = np.arange(0.37, 159.0, 1.0)
    good = simulate_gnss(one.motion, stamps, RTK, LEVER, rng, outlier_share=0.1)
    fixes, block = displaced(good, 50.0, 110.0, 5.0)
    found = smooth(one.imu, fixes, FRAME, None, LEVER)
    gap = smooth(one.imu, good[~block], FRAME, None, LEVER)
    truth = one.motion.poses(stamps)[:, :3, 3]
    off, of_gap = (
        np.linalg.norm(s.keyframes.at(stamps)[:, :3, 3] - truth, axis=1).max() for s in (found, gap)
    )
    assert found.rejected[block].all()
    assert off <= max(1.5 * of_gap, 0.3)

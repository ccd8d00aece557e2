"""Fixes that jump together: the blocks of fixes between jumps, and which of them to believe.

A receiver that fixes wrong ambiguities, or sees reflections only, is wrong by the same vector for a minute. Each of its
fixes agrees with the next, so no robust loss finds the error. But where such a block begins and where it ends, the
fixes jump and the IMU does not. The jumps say by which vector every block is displaced. Blocks with the same vector
agree, and the largest group that agrees is believed, before any noise is changed.

A jump is a step in what is left of the fixes without the way that the IMU has gone.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import median_filter

from factor_graphs.arrays import Array, Mask, Rows
from factor_graphs.chi_square import BEYOND_DOUBT, NEVER_ZERO, ROUNDS, quantile, robust_stddev
from factor_graphs.measurements import GnssFixes
from factor_graphs.problem import REJECTION, RELATIVE_REJECTION, Fit, Problem, fit_as_expected
from factor_graphs.stamps import LONGEST_STEP

# So many fixes, a second apart, on each side of a jump: in 10 s the error of the IMU's way is a cubic (position,
# velocity, tilt, bias of the gyroscope).
SIDE, DEGREE = 5, 3
# A jump is beyond doubt, and so many m: solutions that converge from float to fixed move by decimetres. Where there is
# one, the jump back is likely, too; what is none does no harm, for the blocks beside it agree.
LIKELY, LEAST_JUMP_M = 3.5, 0.5
# Residuals so many times the usual are of an outlier, not of the road.
MISFIT = 3.0


def is_jump(steps: Array, variances: Array, least: float = BEYOND_DOUBT) -> Mask:
    """Whether steps (n, 3) m with variances (n, 3) m² are jumps."""
    surely = np.sum(steps**2 / np.maximum(variances, NEVER_ZERO), axis=-1) > least**2
    return np.asarray(surely & (np.linalg.norm(steps, axis=-1) > LEAST_JUMP_M))


def find_jumps(stamps: Array, stddevs: Array, off: Array, chain: Rows) -> tuple[Rows, Array, Array, Rows]:
    """Where fixes jump, by `off` (m, 3) m, what is left of them without the way of the IMU.

    `stddevs` (m, 3) m, one fix about every second; across a change of `chain` (m,), a gap, no jump is found. Returns
    the row (j,) after each jump, the jumps (j, 3) m with their variances (j, 3) m², and the rows (l,) without outliers.
    An outlier counts only where all else in its window fits, a jump only if it lasts.
    """
    rows = np.flatnonzero(~_spikes(stamps, stddevs, off, chain))
    for _ in range(ROUNDS):
        if len(rows) <= 2 * SIDE:
            break
        of = stamps[rows], stddevs[rows], off[rows]
        steps, variances, misfit = _found_in_windows(*of, np.arange(2 * SIDE) >= SIDE)
        outliers = np.empty(0, np.intp)
        if misfit.any():
            peaks, of_peaks, others_misfit = _found_in_windows(*of, np.arange(2 * SIDE + 1) == SIDE)
            sureness = np.sum(steps**2 / variances, axis=1)
            surer = np.sum(peaks**2 / of_peaks, axis=1) > np.maximum(sureness[:-1], sureness[1:])
            outliers = SIDE + np.flatnonzero(is_jump(peaks, of_peaks) & ~others_misfit & surer)
        if not len(outliers):
            whole = chain[rows[2 * SIDE - 1 :]] == chain[rows[: 1 - 2 * SIDE]]
            at = _apart(is_jump(steps, variances, LIKELY) & whole, np.sum(steps**2 / variances, axis=1))
            at = at[np.array([_lasts(i + SIDE, *of, steps[i], variances[i]) for i in at.tolist()], np.bool_)]
            if not is_jump(steps[at], variances[at]).any():
                at = at[:0]
            return rows[at + SIDE], steps[at], variances[at], np.asarray(rows)
        rows = np.delete(rows, outliers)
    return np.empty(0, np.intp), np.empty((0, 3)), np.empty((0, 3)), np.asarray(rows)


def _spikes(stamps: Array, stddevs: Array, off: Array, chain: Rows) -> Mask:
    """Which fixes (m,) stand out of a running median: several outliers in one window, which least squares mix up.

    A median keeps the edges of what lasts, and beside one a fix has neighbours at its level. The slope, an error of
    velocity, is the median of the steps.
    """
    found = np.zeros(len(stamps), np.bool_)
    for rows in np.split(np.arange(len(stamps)), np.flatnonzero(np.diff(chain)) + 1):
        if len(rows) <= 2 * SIDE:
            continue
        dt = np.diff(stamps[rows])[:, None]
        speeds = median_filter(np.diff(off[rows], axis=0) / dt, (2 * SIDE + 1, 1), mode="nearest")
        level = off[rows] - np.concatenate([np.zeros((1, 3)), np.cumsum(speeds * dt, axis=0)])
        beyond = np.abs(level - median_filter(level, (SIDE + 2, 1), mode="nearest"))
        usual = np.maximum(robust_stddev(beyond, axis=0), stddevs[rows])
        least = np.maximum(BEYOND_DOUBT * usual, LEAST_JUMP_M)
        neighbours = np.pad(level, ((2, 2), (0, 0)), constant_values=np.inf)
        alone = [np.any(np.abs(neighbours[i : i + len(rows)] - level) > least, axis=1) for i in (0, 1, 3, 4)]
        found[rows] = np.any(beyond > least, axis=1) & np.all(alone, axis=0)
    return found


def _lasts(i: int, stamps: Array, stddevs: Array, off: Array, step: Array, variance: Array) -> bool:
    """Whether a step before row i is there without the rows beside it: two outliers look like one, too."""
    around = np.arange(max(i - SIDE - 1, 0), min(i + SIDE + 1, len(stamps)))
    around = around[(around != i) & (around != i - 1)]
    found, _, _ = _found_in_windows(stamps[around], stddevs[around], off[around], around > i)
    return bool(np.sum((found[0] - step) ** 2 / variance) < np.sum(step**2 / variance) / 2)


def _apart(wanted: Mask, sureness: Array) -> Rows:
    """Of what is wanted, in order, the surest, SIDE or more apart."""
    at: list[int] = []
    for i in sorted(np.flatnonzero(wanted).tolist(), key=lambda i: -sureness[i]):
        if all(abs(i - other) >= SIDE for other in at):
            at.append(i)
    return np.array(sorted(at), np.intp)


def _found_in_windows(stamps: Array, stddevs: Array, off: Array, shape: Mask) -> tuple[Array, Array, Mask]:
    """What is found of a `shape` (w,) in each window of w fixes, beside a cubic, by least squares.

    Its size (n, 3) m and variances (n, 3) m², and whether the residuals of the window are far too large. Fixes that
    scatter more than they say, in the window or usually, have so much more variance.
    """
    w = len(shape)
    windows = sliding_window_view(np.arange(len(stamps)), w)
    t, stddevs, off = stamps[windows], stddevs[windows], off[windows]
    since = t - t.mean(axis=1, keepdims=True)
    A = np.stack(
        [*(since**power for power in range(DEGREE + 1)), np.broadcast_to(shape, since.shape)], axis=2
    )
    of_fixes, off = stddevs.mean(axis=2), off - off.mean(axis=1, keepdims=True)
    weighted = np.swapaxes(A / of_fixes[:, :, None] ** 2, 1, 2)
    P = np.linalg.inv(weighted @ A)
    found = P @ (weighted @ off)
    squares = np.mean(((off - A @ found) / stddevs) ** 2, axis=2) * w / (w - DEGREE - 2)
    usual = max(1.0, float(np.median(squares)) / quantile(0.5, 3) * 3)
    scatter = np.maximum(squares.mean(axis=1), usual)
    of_axes = stddevs.mean(axis=1) / of_fixes.mean(axis=1)[:, None]
    return found[:, -1], P[:, -1, -1, None] * of_axes**2 * scatter[:, None], scatter > MISFIT**2 * usual


def beyond_imu(problem: Problem) -> Array:
    """Fixes less the way that the IMU has gone by the attitudes of the first guess, (m, 3) m: smooth."""
    intervals, (T, velocities) = problem.intervals, problem.guess
    R, dt = T[:, :3, :3], intervals.durations[:, None]
    heading = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    cos, sin = np.cos(heading[0]), np.sin(heading[0])
    level = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ R[0]
    turned = np.append(0.0, np.cumsum(intervals.angular_rate @ level[2] * dt[:, 0]))
    missing = np.unwrap(heading - turned[intervals.bounds])
    turned = turned[:-1] + np.interp(intervals.nodes[:-1], intervals.keyframes, missing)
    force, cos, sin = intervals.specific_force @ level.T, np.cos(turned), np.sin(turned)
    east, north = cos * force[:, 0] - sin * force[:, 1], sin * force[:, 0] + cos * force[:, 1]
    steps = np.column_stack([east, north, force[:, 2] - problem.frame.gravity]) * dt
    speeds = np.cumsum(steps, axis=0)
    way = np.cumsum((speeds - steps / 2) * dt, axis=0)
    way = np.concatenate([np.zeros((1, 3)), way])[intervals.bounds[problem.at]]
    antennas: Array = problem.antennas_found(T, velocities) - R[problem.at] @ problem.p_imu_antenna
    return antennas - way


# Of the fixes, one in so many s is looked at for jumps.
STEP_S = 1.0
# What is wrong drifts: blocks that differ by such a share of the jumps may be of the same group.
DRIFTED = 0.2
# A group of fixes is believed without the IMU's word when it is so many times as large as any other.
CLEARLY = 2.0


@dataclass(frozen=True, eq=False)
class _Group:
    """Blocks of fixes of a problem, first and last of each, all displaced by `offset` (3,) m, `variance` (3,) m².

    Displaced against where the fixes were after the last gap: over a gap no displacement is known. The variance is
    summed over the jumps since then; of two blocks, the difference counts.
    """

    blocks: tuple[tuple[int, int], ...]
    offset: Array
    variance: Array

    @property
    def size(self) -> int:
        return sum(last - first + 1 for first, last in self.blocks)


def with_consistent_fixes(
    problem: Problem, fixes: GnssFixes, pose: Callable[[GnssFixes], Problem]
) -> Problem:
    """The problem without the blocks of fixes that are displaced; the same where no fixes jump.

    `pose` makes the problem of some of the `fixes` (m,) given. Where no group of blocks is clearly the largest, the IMU
    tells, over the gap to other fixes. Where there are no others, both are moved to the middle between them, and
    `common_stddevs` of the problem says by how much all poses may be wrong together.
    """
    stretches = list(_stretches(problem)) if problem.settings.robust else []
    if all(len(groups) == 1 for groups in stretches):
        return problem
    believed = [groups[:1] for groups in stretches]
    for i, groups in enumerate(stretches):
        if _is_clear(groups):
            continue
        costs = []
        for group in groups[:2] if len(stretches) > 1 else ():
            believed[i] = [group]
            posed = _posed(problem, fixes, pose, believed)
            costs.append(_cost(fit_as_expected(posed)) - 3 * group.size)
        is_told = costs and abs(costs[0] - costs[1]) > REJECTION
        believed[i] = [groups[int(costs[1] < costs[0])]] if is_told else groups[:2]
    chosen = _posed(problem, fixes, pose, believed)
    if not _fits_better(fit_as_expected(chosen), fit_as_expected(problem)):
        return problem
    return replace(chosen, displaced=True, notes=(*problem.notes, *_told(problem, stretches, believed)))


def _is_clear(groups: list[_Group]) -> bool:
    """Whether the first group is right without a doubt: the largest by far, or the only one that came back."""
    if len(groups) == 1 or groups[0].size >= CLEARLY * groups[1].size:
        return True
    return len(groups[0].blocks) > 1 and all(len(group.blocks) == 1 for group in groups[1:])


def _fits_better(chosen: Fit, fit: Fit) -> bool:
    """Whether some fixes fit the IMU so well that all of them would cost far less, did the others fit as well.

    And whether none in a row do not fit: beside outliers, one end of a block may not be seen.
    """
    n, lost = len(chosen.squares), len(fit.squares) - len(chosen.squares)
    chance = BEYOND_DOUBT * float(np.minimum(chosen.squares, REJECTION).std()) * lost**0.5
    usual = max(1.0, float(np.median(chosen.squares)) / quantile(0.5, 3))
    unfit = sliding_window_view(chosen.squares > REJECTION * usual, min(SIDE, n)).all(axis=1).any()
    return bool(not unfit and _cost(chosen) * (1 + lost / n) + chance < _cost(fit))


def _cost(fit: Fit) -> float:
    """The squared whitened residuals, none counted for more than rejection allows."""
    bounded = (
        np.minimum(fit.squares, REJECTION).sum() + np.minimum(fit.relative_squares, RELATIVE_REJECTION).sum()
    )
    return float(2 * fit.motion.error(fit.values) + bounded)


def _posed(
    problem: Problem, fixes: GnssFixes, pose: Callable[[GnssFixes], Problem], believed: list[list[_Group]]
) -> Problem:
    """The problem of these groups only, of each stretch; more than one are moved to the middle between them."""
    shifts, common = np.zeros((len(problem.fixes), 3)), np.zeros(3)
    kept = np.zeros(len(shifts), np.bool_)
    for groups in believed:
        middle = np.mean([group.offset for group in groups], axis=0)
        common = np.maximum(common, np.abs(groups[0].offset - middle))
        for group in groups:
            for first, last in group.blocks:
                kept[first : last + 1], shifts[first : last + 1] = True, middle - group.offset
    rows = np.flatnonzero(problem.used)[kept]
    some = replace(fixes[rows], positions=fixes.positions[rows] + shifts[kept])
    posed, used = pose(some), np.zeros(len(fixes), np.bool_)
    used[rows] = posed.used
    return replace(posed, used=used, common_stddevs=(common[0], common[1], common[2]))


def _told(problem: Problem, stretches: list[list[_Group]], believed: list[list[_Group]]) -> Iterator[str]:
    """What was rejected and why, in words."""
    t, n = problem.fixes.stamps, len(problem.fixes)
    for groups, right in zip(stretches, believed, strict=True):
        if len(right) > 1:
            off = np.linalg.norm(right[0].offset - right[1].offset)
            later = max(group.blocks[0][0] for group in right)
            yield (
                f"the fixes jump by {off:.1f} m at {t[later]:.1f} s, and nothing tells"
                f" which are right: moved to the middle, all poses may be {off / 2:.1f} m off together"
            )
        where = ", before and after" if len(right[0].blocks) > 1 else ""
        for group in (group for group in groups if group not in right):
            off = np.linalg.norm(group.offset - right[0].offset)
            for first, last in group.blocks:
                yield (
                    f"{last - first + 1} of {n} fixes jump together by {off:.1f} m, {t[first]:.1f} to {t[last]:.1f} s:"
                    f" rejected, for {right[0].size} others agree with the IMU{where}"
                )


def _stretches(problem: Problem) -> Iterator[list[_Group]]:
    """The groups of blocks of every stretch of fixes without a gap, the one that is most likely right first."""
    t = problem.fixes.stamps
    rows = np.unique(np.round((t - t[0]) / STEP_S), return_index=True)[1]
    steps = np.diff(t[rows], prepend=t[0])
    unseen = np.concatenate([[0.0], np.cumsum(problem.intervals.blind)])[problem.at[rows]]
    gaps = (steps > LONGEST_STEP * max(float(np.median(steps)), STEP_S)) | (np.diff(unseen, prepend=0) > 0)
    chain, off = np.cumsum(gaps, dtype=np.intp), beyond_imu(problem)[rows]
    at, jumps, variances, good = find_jumps(t[rows], problem.fixes.stddevs[rows], off, chain)
    for stretch in np.split(np.arange(len(rows)), np.flatnonzero(gaps[1:]) + 1):
        own = np.isin(at, stretch)
        begins = [int(stretch[0]), *at[own].tolist()]
        ends = [rows[good[good < i][-1]] for i in begins[1:]]
        ends.append(rows[stretch[-1] + 1] - 1 if stretch[-1] + 1 < len(rows) else len(t) - 1)
        offsets, summed = (np.cumsum([np.zeros(3), *each[own]], axis=0) for each in (jumps, variances))
        blocks = [(int(rows[i]), int(end)) for i, end in zip(begins, ends, strict=True)]
        yield _grouped([_Group((block,), *of) for block, *of in zip(blocks, offsets, summed, strict=True)])


def _grouped(blocks: list[_Group]) -> list[_Group]:
    """Blocks that are displaced by the same vector, together; those in front that are believed first."""
    drifted = DRIFTED * np.linalg.norm(np.ptp([block.offset for block in blocks], axis=0))
    groups: list[_Group] = []
    for block in sorted(blocks, key=lambda block: -block.size):
        for i, group in enumerate(groups):
            off, variance = block.offset - group.offset, np.abs(block.variance - group.variance)
            if np.linalg.norm(off) <= drifted or not is_jump(off, variance):
                groups[i] = replace(group, blocks=(*group.blocks, *block.blocks))
                break
        else:
            groups.append(block)
    groups.sort(key=lambda group: -group.size)
    returned = [group for group in groups if len(group.blocks) > 1 and CLEARLY * group.size > groups[0].size]
    if len(returned) == 1 and not groups[0].size >= CLEARLY * groups[min(1, len(groups) - 1)].size:
        groups.sort(key=lambda group: group is not returned[0])
    return groups

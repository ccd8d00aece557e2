"""Fixes that jump together: the blocks of fixes between jumps, and which of them to believe.

A receiver that fixes wrong ambiguities, or sees reflections only, is wrong by the same vector for a minute. Each of its
fixes agrees with the next, so no robust loss finds the error. But where such a block begins and where it ends, the
fixes jump and the IMU does not. The jumps say by which vector every block is displaced. Blocks with the same vector
agree, and the largest group that agrees is believed, before any noise is changed.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from factor_graphs.chi_square import quantile
from factor_graphs.jumps import SIDE, SURELY, beyond_imu, find_jumps, is_jump
from factor_graphs.measurements import GnssFixes
from factor_graphs.problem import REJECTION, RELATIVE_REJECTION, Fit, Problem, fit_as_expected
from factor_graphs.stamps import LONGEST_STEP

Array = NDArray[np.float64]

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
    chance = SURELY * float(np.minimum(chosen.squares, REJECTION).std()) * lost**0.5
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

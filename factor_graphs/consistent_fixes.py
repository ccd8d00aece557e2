"""Fixes that jump together: the blocks of fixes between jumps, and which of them to believe.

A receiver that fixes wrong ambiguities, or sees reflections only, is wrong by the same vector for a minute. Each of its
fixes agrees with the next, so no robust loss finds the error. But where such a block begins and where it ends, the
fixes jump and the IMU does not. The jumps say by which vector every block is displaced. Blocks with the same vector
agree, and the largest group that agrees is believed, before any noise is changed.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from factor_graphs.measurements import LONGEST_STEP, GnssFixes
from factor_graphs.problem import REJECTION, RELATIVE_REJECTION, Problem, fit_as_expected

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

# One fix in so many s is looked at, so many on each side of a jump: in 10 s the error of the IMU's way is a cubic
# (position, velocity, tilt, bias of the gyroscope).
STEP_S, SIDE, DEGREE = 1.0, 5, 3
# A jump has so many standard deviations (one false alarm in ten million) and so many m. Smaller ones, of solutions that
# converge, are of the same block. So are blocks that differ by such a share of the jumps: what is wrong drifts.
SURELY, LEAST_JUMP_M, DRIFTED = 6.0, 0.5, 0.2
# A group of fixes is believed without the IMU's word when it is so many times as large as any other.
CLEARLY = 2.0


@dataclass(frozen=True, eq=False)
class _Group:
    """Blocks of fixes of a problem, first and last of each, all displaced by `offset` (3,) m, `variance` (3,) m².

    Displaced against where the fixes were after the last gap: over a gap no displacement is known.
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
            costs.append(_cost(_posed(problem, fixes, pose, believed)) - 3 * group.size)
        is_told = costs and abs(costs[0] - costs[1]) > REJECTION
        believed[i] = [groups[int(costs[1] < costs[0])]] if is_told else groups[:2]
    chosen = _posed(problem, fixes, pose, believed)
    lost = len(problem.fixes) - len(chosen.fixes)
    if _cost(chosen) + REJECTION * lost >= _cost(problem):
        return problem
    told = _told(problem, stretches, believed)
    return replace(chosen, notes=(*problem.notes, *told))


def _is_clear(groups: list[_Group]) -> bool:
    """Whether the first group is right without a doubt: the largest by far, or the only one that came back."""
    if len(groups) == 1 or groups[0].size >= CLEARLY * groups[1].size:
        return True
    return len(groups[0].blocks) > 1 and all(len(group.blocks) == 1 for group in groups[1:])


def _cost(problem: Problem) -> float:
    """The squared whitened residuals of the best fit, none counted for more than rejection allows."""
    fit = fit_as_expected(problem)
    bounded = (
        np.minimum(fit.squares, REJECTION).sum() + np.minimum(fit.relative_squares, RELATIVE_REJECTION).sum()
    )
    return float(2 * fit.motion.error(fit.values) + bounded)


def _posed(
    problem: Problem, fixes: GnssFixes, pose: Callable[[GnssFixes], Problem], believed: list[list[_Group]]
) -> Problem:
    """The problem of these groups only, one of each stretch, or two, moved to the middle between them."""
    shifts, kept, common = (
        np.zeros((len(problem.fixes), 3)),
        np.zeros(len(problem.fixes), np.bool_),
        np.zeros(3),
    )
    for groups in believed:
        middle = np.mean([group.offset for group in groups], axis=0)
        common = np.maximum(common, np.abs(groups[0].offset - middle))
        for group in groups:
            for first, last in group.blocks:
                kept[first : last + 1], shifts[first : last + 1] = True, middle - group.offset
    rows = np.flatnonzero(problem.used)[kept]
    some = GnssFixes(fixes.stamps[rows], fixes.positions[rows] + shifts[kept], fixes.stddevs[rows])
    posed, used = pose(some), np.zeros(len(fixes), np.bool_)
    used[rows] = posed.used
    return replace(posed, used=used, common_stddevs=(*common.tolist(),))


def _told(problem: Problem, stretches: list[list[_Group]], believed: list[list[_Group]]) -> Iterator[str]:
    """What was rejected and why, in words."""
    t, n = problem.fixes.stamps, len(problem.fixes)
    for groups, right in zip(stretches, believed, strict=True):
        if len(right) > 1:
            off = np.linalg.norm(right[0].offset - right[1].offset)
            yield (
                f"the fixes jump by {off:.1f} m at {t[max(right, key=_begin).blocks[0][0]]:.1f} s, and nothing tells"
                f" which are right: moved to the middle, all poses may be {off / 2:.1f} m off together"
            )
        reason = f"{right[0].size} others agree with the IMU" + (
            ", before and after" if len(right[0].blocks) > 1 else ""
        )
        for group in (group for group in groups if group not in right):
            off = np.linalg.norm(group.offset - right[0].offset)
            for first, last in group.blocks:
                yield (
                    f"{last - first + 1} of {n} fixes jump together by {off:.1f} m, {t[first]:.1f} to {t[last]:.1f} s:"
                    f" rejected, for {reason}"
                )


def _begin(group: _Group) -> int:
    return group.blocks[0][0]


def _stretches(problem: Problem) -> Iterator[list[_Group]]:
    """The groups of blocks of every stretch of fixes without a gap, the one that is most likely right first."""
    t = problem.fixes.stamps
    rows = np.unique(np.round((t - t[0]) / STEP_S), return_index=True)[1]
    steps = np.diff(t[rows])
    unseen = np.concatenate([[0.0], np.cumsum(problem.intervals.blind)])[problem.at[rows]]
    gaps = (steps > LONGEST_STEP * max(float(np.median(steps)), STEP_S)) | (np.diff(unseen) > 0)
    at, jumps, variances = _jumps(problem, rows, gaps)
    for stretch in np.split(np.arange(len(rows)), np.flatnonzero(gaps) + 1):
        own = np.isin(at, stretch)
        begins = [int(stretch[0]), *at[own].tolist(), int(stretch[-1]) + 1]
        offsets, summed = (np.cumsum([np.zeros(3), *each[own]], axis=0) for each in (jumps, variances))
        ends = [rows[i - 1] for i in begins[1:-1]]
        ends.append(rows[begins[-1]] - 1 if begins[-1] < len(rows) else len(t) - 1)
        blocks = [(int(rows[i]), int(end)) for i, end in zip(begins, ends, strict=False)]
        yield _grouped([_Group((block,), *of) for block, *of in zip(blocks, offsets, summed, strict=True)])


def _grouped(blocks: list[_Group]) -> list[_Group]:
    """Blocks that are displaced by the same vector, together; those in front that are believed first."""
    drifted = DRIFTED * np.linalg.norm(np.ptp([block.offset for block in blocks], axis=0))
    groups: list[_Group] = []
    for block in sorted(blocks, key=lambda block: -block.size):
        for i, group in enumerate(groups):
            off, variance = block.offset - group.offset, block.variance + group.variance
            if np.linalg.norm(off) <= drifted or not _is_jump(off, variance):
                groups[i] = replace(group, blocks=(*group.blocks, *block.blocks))
                break
        else:
            groups.append(block)
    groups.sort(key=lambda group: -group.size)
    returned = [group for group in groups if len(group.blocks) > 1]
    if len(returned) == 1 and not groups[0].size >= CLEARLY * groups[min(1, len(groups) - 1)].size:
        groups.sort(key=lambda group: group is not returned[0])
    return groups


def _is_jump(steps: Array, variances: Array) -> NDArray[np.bool_]:
    """Whether steps (n, 3) m with variances (n, 3) m² are jumps."""
    surely = np.sum(steps**2 / np.maximum(variances, 1e-12), axis=-1) > SURELY**2
    return np.asarray(surely & (np.linalg.norm(steps, axis=-1) > LEAST_JUMP_M))


def _jumps(problem: Problem, rows: Rows, gaps: NDArray[np.bool_]) -> tuple[Rows, Array, Array]:
    """Before which of some `rows` of the fixes these jump, by how much (n, 3) m, and its variances (n, 3) m².

    By least squares of a step beside a cubic, in windows of SIDE fixes before and after. Fixes that scatter more than
    they say, in the window or usually, have so much more variance.
    """
    nothing = np.empty(0, np.intp), np.empty((0, 3)), np.empty((0, 3))
    if len(rows) < 2 * SIDE:
        return nothing
    windows = np.lib.stride_tricks.sliding_window_view(np.arange(len(rows)), 2 * SIDE)
    t, stddevs = problem.fixes.stamps[rows][windows], problem.fixes.stddevs[rows][windows]
    off = _beyond_imu(problem)[rows][windows]
    since = (t - t.mean(axis=1, keepdims=True)) / STEP_S
    step = np.broadcast_to(np.arange(2 * SIDE) >= SIDE, since.shape)
    A = np.stack([*(since**power for power in range(DEGREE + 1)), step], axis=2)
    of_axes = stddevs.mean(axis=1) / stddevs.mean(axis=(1, 2))[:, None]
    weights = 1 / stddevs.mean(axis=2)
    A, y = A * weights[:, :, None], (off - off.mean(axis=1, keepdims=True)) * weights[:, :, None]
    P = np.linalg.inv(np.swapaxes(A, 1, 2) @ A)
    found = P @ (np.swapaxes(A, 1, 2) @ y)
    squares = (
        np.mean(((y - A @ found) / of_axes[:, None]) ** 2, axis=(1, 2)) * 2 * SIDE / (2 * SIDE - DEGREE - 2)
    )
    scatter = np.maximum(squares, max(1.0, float(np.median(squares))))
    steps, variances = found[:, -1], P[:, -1, -1, None] * of_axes**2 * scatter[:, None]
    crossed = np.lib.stride_tricks.sliding_window_view(gaps, 2 * SIDE - 1).any(axis=1)
    are_jumps = _is_jump(steps, variances) & ~crossed
    sureness, at = np.sum(steps**2 / variances, axis=1), list[int]()
    for i in sorted(np.flatnonzero(are_jumps).tolist(), key=lambda i: -sureness[i]):
        if all(abs(i - other) >= SIDE for other in at):
            at.append(i)
    chosen = np.array(sorted(at), np.intp)
    return chosen + SIDE, steps[chosen], variances[chosen]


def _beyond_imu(problem: Problem) -> Array:
    """Fixes less the way that the IMU has gone by the attitudes of the first guess, (m, 3) m: smooth over some seconds."""
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

"""Where fixes jump and the IMU does not: a step in what is left of the fixes without the way that the IMU has gone."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from factor_graphs.chi_square import quantile
from factor_graphs.problem import Problem

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]

# So many fixes, a second apart, on each side of a jump: in 10 s the error of the IMU's way is a cubic (position,
# velocity, tilt, bias of the gyroscope).
SIDE, DEGREE = 5, 3
# A jump has so many standard deviations (one false alarm in a thousand drives of ten minutes), and so many m: solutions
# that converge from float to fixed move by decimetres. Where there is one, the jump back is likely, too; what is none
# does no harm, for the blocks beside it agree.
SURELY, LIKELY, LEAST_JUMP_M = 5.5, 3.5, 0.5
# Residuals so many times the usual are of an outlier, not of the road. Where outliers are left out, others show.
MISFIT, OUTLIER_ROUNDS = 3.0, 6
# Median of a square of 3 degrees of freedom over its mean.
MEDIAN_SQUARE = quantile(0.5, 3) / 3


def is_jump(steps: Array, variances: Array, least: float = SURELY) -> Mask:
    """Whether steps (n, 3) m with variances (n, 3) m² are jumps."""
    surely = np.sum(steps**2 / np.maximum(variances, 1e-12), axis=-1) > least**2
    return np.asarray(surely & (np.linalg.norm(steps, axis=-1) > LEAST_JUMP_M))


def find_jumps(stamps: Array, stddevs: Array, off: Array, chain: Rows) -> tuple[Rows, Array, Array, Rows]:
    """Where fixes jump, by `off` (m, 3) m, what is left of them without the way of the IMU.

    `stddevs` (m, 3) m, one fix about every second; across a change of `chain` (m,), a gap, no jump is found. Returns
    the row (j,) after each jump, the jumps (j, 3) m with their variances (j, 3) m², and the rows (l,) without outliers.
    An outlier counts only where all else in its window fits, a jump only if it lasts.
    """
    rows = np.flatnonzero(~_spikes(stamps, stddevs, off, chain))
    for _ in range(OUTLIER_ROUNDS):
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
        usual = np.maximum(1.4826 * np.median(beyond, axis=0), stddevs[rows])
        least = np.maximum(SURELY * usual, LEAST_JUMP_M)
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
    usual = max(1.0, float(np.median(squares)) / MEDIAN_SQUARE)
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

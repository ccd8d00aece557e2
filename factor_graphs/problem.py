"""The estimation problem: what stays the same from one optimisation to the next, and one optimisation."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from factor_graphs.alignment import (
    START_POSITION_STDDEV,
    START_SPEED_STDDEV,
    AttitudePrior,
    first_guess,
)
from factor_graphs.chi_square import probability_below, quantile
from factor_graphs.errors import EstimationError, MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.intervals import ImuIntervals, nearest, noise_as_sampled, split
from factor_graphs.least_squares import minimise
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.model import (
    gnss_factors,
    imu_factors,
    motion_from,
    prior_factors,
    relative_pose_factors,
    to_values,
)
from factor_graphs.relative_poses import NO_RELATIVE_POSES, RelativePoses
from factor_graphs.screening import FEWEST, are_new, correlation_times, decorrelate, inside, plausible
from factor_graphs.settings import SmootherSettings

Array = NDArray[np.float64]

# 99 % of good measurements have a squared whitened residual below the first, 99.9 % below the second: fixes ...
GATE, REJECTION = quantile(0.99, 3), quantile(0.999, 3)
GOOD_MEAN = 3 * probability_below(GATE, 5) / probability_below(GATE, 3)
# ... and relative poses.
RELATIVE_GATE, RELATIVE_REJECTION = quantile(0.99, 6), quantile(0.999, 6)
RELATIVE_GOOD_MEAN = 6 * probability_below(RELATIVE_GATE, 8) / probability_below(RELATIVE_GATE, 6)
# A fix so near to a relative pose needs no keyframe of its own, s: it is carried there by velocity. Braking at 3 m/s²
# moves it by 1 mm; a KITTI unit reports 10 to 23 ms after a scan, so the graph has half of the keyframes.
CARRIED_S = 0.025
# The cost stands still when it changes by less than this share; by the second where another solution begins there.
RELATIVE_TOLERANCE, ROUGH = 1e-5, 1e-3
NOWHERE = np.empty(0)

LOSSES: dict[str, gtsam.noiseModel.mEstimator.Base | None] = {
    "quadratic": None,
    "huber": gtsam.noiseModel.mEstimator.Huber.Create(1.345),
    "truncated": gtsam.noiseModel.mEstimator.TruncatedLeastSquares.Create(REJECTION**0.5),
}
# A norm of six residuals is larger than one of three: Huber's loss begins where it leaves the usual.
RELATIVE_LOSSES: dict[str, gtsam.noiseModel.mEstimator.Base | None] = {
    "quadratic": None,
    "huber": gtsam.noiseModel.mEstimator.Huber.Create(quantile(0.8, 6) ** 0.5),
    "truncated": gtsam.noiseModel.mEstimator.TruncatedLeastSquares.Create(RELATIVE_REJECTION**0.5),
}


@dataclass(frozen=True, eq=False)
class Problem:
    """Measurements ready for the graph, keyframes, first guess.

    `used` (m,) and `relative_used` (r,) say which of the fixes and relative poses given take part; `at` and
    `relative_at` (k, 2) are the keyframes of those that do. `late` (m,) s: a fix after its keyframe. Fixes have
    `of_fixes` times the standard deviations that they say. `heading_in_doubt`: another heading fits as well. By
    `common_stddevs`, m, all fixes may be wrong together. `displaced`: fixes that jump together are left out or moved.
    """

    settings: SmootherSettings
    frame: LocalFrame
    p_imu_antenna: Array
    intervals: ImuIntervals
    noise: ImuNoise
    used: NDArray[np.bool_]
    fixes: GnssFixes
    at: NDArray[np.intp]
    late: Array
    relative_used: NDArray[np.bool_]
    relative: RelativePoses
    relative_at: NDArray[np.intp]
    attitude: AttitudePrior
    guess: tuple[Array, Array]
    notes: tuple[str, ...]
    of_fixes: float = 1.0
    heading_in_doubt: bool = False
    common_stddevs: tuple[float, float, float] = (0.0, 0.0, 0.0)
    displaced: bool = False

    @property
    def first_loss(self) -> str:
        """Loss of the fixes, until outliers are rejected."""
        return "huber" if self.settings.robust else "quadratic"

    def with_fix_noise(self, of_fixes: float) -> "Problem":
        """The same with fixes of so many times the standard deviations that they say."""
        fixes = replace(self.fixes, stddevs=self.fixes.stddevs * (of_fixes / self.of_fixes))
        return replace(self, fixes=fixes, of_fixes=of_fixes)

    def antennas_found(self, T: Array, velocities: Array) -> Array:
        """Where the fixes say that the antenna is at their keyframes, (m, 3) m, by keyframes (k, 4, 4) and (k, 3)."""
        rates = self.intervals.angular_rate[self.intervals.bounds[np.minimum(self.at, len(T) - 2)]]
        about = np.cross(rates, self.p_imu_antenna)
        moving = velocities[self.at] + np.einsum("nij,nj->ni", T[self.at, :3, :3], about)
        found: Array = self.fixes.positions - moving * self.late[:, None]
        return found

    @cached_property
    def is_bound(self) -> bool:
        """Whether relative poses span most of the time."""
        stamps = self.intervals.keyframes
        first, last = self.relative_at.T
        edges = np.bincount(first, minlength=len(stamps)) - np.bincount(last, minlength=len(stamps))
        spanned = np.diff(stamps)[np.cumsum(edges)[:-1] > 0].sum()
        return bool(spanned > (stamps[-1] - stamps[0]) / 2)


@dataclass(frozen=True, eq=False)
class Fit:
    """One optimised graph.

    The IMU has `inflation` times the white noise that is expected of it, and `of_walk` times the bias walk.
    `squares` (m,) are the squared whitened residuals of the fixes, chi2 of 3 dof, `relative_squares` those of the
    relative poses, 6 dof.
    """

    inflation: float
    of_walk: float
    loss: str
    motion: gtsam.NonlinearFactorGraph
    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    iterations: int
    squares: Array
    weights: Array
    relative_squares: Array
    relative_weights: Array
    chi2_per_dof: float


def pose_problem(
    imu: ImuSamples,
    fixes: GnssFixes,
    frame: LocalFrame,
    settings: SmootherSettings,
    p_imu_antenna: Array,
    attitude: AttitudePrior | None,
    relative: RelativePoses = NO_RELATIVE_POSES,
    also_at: Array = NOWHERE,
) -> Problem:
    """Choose the fixes and keyframes, and make the first guess; raises MeasurementError below three fixes.

    `also_at` (n,) s: where other measurements want keyframes.
    """
    used, notes = usable_fixes(fixes, imu, settings.max_speed_mps)
    relative_used = np.all((relative.stamps >= imu.stamps[0]) & (relative.stamps <= imu.stamps[-1]), axis=1)
    relative = relative[relative_used]
    correlation_times_s = correlation_times(fixes[used], settings, relative.stamps)
    kept = decorrelate(fixes[used], correlation_times_s, settings.min_fix_stddev_m)
    own = np.concatenate([kept.stamps, also_at[(also_at >= imu.stamps[0]) & (also_at <= imu.stamps[-1])]])
    own = own[~_near(own, relative.stamps.ravel())]
    intervals = split(imu, np.concatenate([own, relative.stamps.ravel()]), settings.keyframe_interval_s)
    if intervals.blind.any():
        silent = np.diff(intervals.keyframes)[intervals.blind].sum()
        notes.append(f"the IMU is silent for {silent:.2f} s: bridged as an unseen vehicle")
    noise = noise_as_sampled(imu, settings.imu_noise or ImuNoise())
    at, guess = intervals.keyframe_of(kept.stamps), first_guess(intervals, kept, p_imu_antenna, attitude)
    unknown = np.array([*[settings.start_tilt_stddev_rad] * 2, settings.start_heading_stddev_rad])
    attitude = attitude or AttitudePrior(guess[0][0, :3, :3], unknown, in_map=True)
    return Problem(
        settings=settings,
        frame=frame,
        p_imu_antenna=p_imu_antenna,
        intervals=intervals,
        noise=noise,
        used=used,
        fixes=kept,
        at=at,
        late=kept.stamps - intervals.keyframes[at],
        relative_used=relative_used,
        relative=relative,
        relative_at=intervals.keyframe_of(relative.stamps),
        attitude=attitude,
        guess=guess,
        notes=tuple(notes),
    )


def _near(stamps: Array, others: Array) -> NDArray[np.bool_]:
    """Which of the stamps (m,) have another so near that a fix can be carried there."""
    if not len(others):
        return np.zeros(len(stamps), np.bool_)
    others = np.sort(others)
    return np.asarray(np.abs(others[nearest(others, stamps)] - stamps) <= CARRIED_S)


def usable_fixes(
    fixes: GnssFixes, imu: ImuSamples, max_speed_mps: float
) -> tuple[NDArray[np.bool_], list[str]]:
    """Which fixes (n,) are new, within the IMU's span, and need no impossible speed; and what to say of the others.

    Raises MeasurementError below three.
    """
    within, new = inside(fixes, imu), are_new(fixes)
    used = within & new
    used[used] = plausible(fixes[used], max_speed_mps)
    notes = []
    for unused, why in (
        (~within, "outside the IMU's span: not used"),
        (within & ~new, "repeat the position before them: each position used once, at its first stamp"),
        (within & new & ~used, f"need more than {max_speed_mps:g} m/s: not used"),
    ):
        if unused.any():
            notes.append(f"{unused.sum()} of {len(fixes)} fixes {why}")
    if used.sum() < FEWEST:
        raise MeasurementError(
            f"{used.sum()} usable GNSS fixes of {len(fixes)} in the IMU's span {imu.stamps[0]:.3f}.."
            f"{imu.stamps[-1]:.3f} s, expected at least {FEWEST}" + "".join(f"; {note}" for note in notes)
        )
    return used, notes


def fit_as_expected(problem: Problem, tolerance: float = RELATIVE_TOLERANCE) -> Fit:
    """The solution from the first guess, with the noise that is expected; `tolerance` and errors as in `optimise`."""
    motion = motion_graph(problem, 1.0, 1.0)
    return optimise(
        problem, motion, first_values(problem), (1.0, 1.0), problem.first_loss, tolerance=tolerance
    )


def motion_graph(problem: Problem, inflation: float, of_walk: float) -> gtsam.NonlinearFactorGraph:
    """Every factor but the fixes: the IMU with `inflation` times its noise, `of_walk` times its walk, and the prior."""
    graph = gtsam.NonlinearFactorGraph()
    noise = problem.intervals.noise(problem.noise.scaled(inflation, of_walk))
    T, velocities = problem.guess
    for factor in imu_factors(problem.intervals, noise, problem.frame, T[:-1, :3, 3]):
        graph.add(factor)
    priors = prior_factors(
        T[0], velocities[0], problem.attitude, START_POSITION_STDDEV, START_SPEED_STDDEV, problem.noise
    )
    for prior in priors:
        graph.add(prior)
    return graph


def optimise(
    problem: Problem,
    motion: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    noise: tuple[float, float],
    loss: str,
    constraints: Iterable[gtsam.NonlinearFactor] = (),
    tolerance: float = RELATIVE_TOLERANCE,
) -> Fit:
    """The most probable states, given a loss for the fixes: all but `tolerance` of the cost is gained.

    `noise`: `inflation` and `of_walk` of the motion.
    Raises EstimationError when they are not found.
    """
    graph, kernel = gtsam.NonlinearFactorGraph(motion), LOSSES[loss]
    T, velocities = motion_from(start)
    fixes = replace(problem.fixes, positions=problem.antennas_found(T, velocities))
    for factor in gnss_factors(fixes, problem.at, problem.p_imu_antenna, kernel):
        graph.add(factor)
    relative_kernel = RELATIVE_LOSSES[loss]
    for between in relative_pose_factors(problem.relative, problem.relative_at, relative_kernel):
        graph.add(between)
    still = []
    for constraint in constraints:
        graph.add(constraint)
        if isinstance(constraint, gtsam.BetweenFactorPose3):
            still.append(constraint)
    values, iterations = _minimise(problem, graph, start, tolerance)
    squares = _squares(problem, values)
    relative_squares = _relative_squares(problem, values)
    return Fit(
        inflation=noise[0],
        of_walk=noise[1],
        loss=loss,
        motion=motion,
        graph=graph,
        values=values,
        iterations=iterations,
        squares=squares,
        weights=_weights(kernel, squares),
        relative_squares=relative_squares,
        relative_weights=_weights(relative_kernel, relative_squares),
        chi2_per_dof=_chi2_per_dof(
            2 * motion.error(values) + sum(2 * one.error(values) for one in still),
            squares,
            relative_squares,
            3 * len(still),
        ),
    )


def _weights(kernel: gtsam.noiseModel.mEstimator.Base | None, squares: Array) -> Array:
    return np.array([1.0 if kernel is None else kernel.weight(r) for r in np.sqrt(squares)])  # type: ignore[attr-defined]


def _chi2_per_dof(motion: float, squares: Array, relative_squares: Array, known: int) -> float:
    """About 1 when all standard deviations are honest; measurements that do not fit are left out.

    `motion` is of the IMU and of what holds at rest, where so many angular rates are `known`: the gyroscope's noise is
    seen there.
    """
    good, relative_good = squares < GATE, relative_squares < RELATIVE_GATE
    total = motion + squares[good].sum() + relative_squares[relative_good].sum()
    return float(
        total / max(GOOD_MEAN * good.sum() + RELATIVE_GOOD_MEAN * relative_good.sum() + known, GOOD_MEAN)
    )


def _minimise(
    problem: Problem, graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, tolerance: float
) -> tuple[gtsam.Values, int]:
    limit = problem.settings.max_iterations
    try:
        values, iterations = minimise(graph, start, problem.is_bound, limit, tolerance)
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        raise EstimationError(f"the equations of the graph have no solution: {reason}") from error
    if iterations < limit:
        return values, iterations
    raise EstimationError(
        f"the optimiser stopped at its limit of {limit} iterations, cost {graph.error(values):.4g}; "
        "check units, axes and lever arm of the log, or raise max_iterations"
    )


def _squares(problem: Problem, values: gtsam.Values) -> Array:
    T, velocities = motion_from(values)
    R, p = T[problem.at, :3, :3], T[problem.at, :3, 3]
    off = problem.antennas_found(T, velocities) - p - R @ problem.p_imu_antenna
    squares: Array = np.sum(np.einsum("mij,mj->mi", problem.fixes.whitening, off) ** 2, axis=1)
    return squares


def _relative_squares(problem: Problem, values: gtsam.Values) -> Array:
    factors = relative_pose_factors(problem.relative, problem.relative_at, None)
    return np.array([2 * factor.error(values) for factor in factors])


def first_values(problem: Problem) -> gtsam.Values:
    """The first guess, biases zero, as the optimiser wants it."""
    T, velocities = problem.guess
    return to_values(T, velocities, np.zeros((len(T), 6)))

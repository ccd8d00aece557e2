"""Errors that last: of the receiver's clock, of the antenna's place, of the gyroscope's scale, found from the drive.

At the optimum, a fix that is `d` seconds later than its stamp and an antenna that is `dl` metres away from its place
move the residual by v d + R dl; a gyroscope that turns `s` times too much looks like a bias of s w. One elimination of
the graph with these unknowns leaves what the drive says of them beside the whole trajectory. Then each assumption, as a
clock that steps once, is a small problem of least squares.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C
from numpy.typing import NDArray

from factor_graphs.chi_square import BEYOND_DOUBT, probability_below, quantile
from factor_graphs.elimination import by_sections, eliminate, shared_keys, split
from factor_graphs.model import motion_from
from factor_graphs.problem import Fit, Problem

Array = NDArray[np.float64]

# What may be wrong before anything is estimated: clock s, antenna m, scale of the gyroscope.
CLOCK_STDDEV, ANTENNA_STDDEV, SCALE_STDDEV = 0.5, 2.0, 0.03
DOUBT = 1 - probability_below(BEYOND_DOUBT**2, 1)
# A scale is in question where fixes and IMU alone show more than those of half of all good gyroscopes.
QUESTIONABLE = 0.5
# The clock is looked at in so many stretches, none shorter than so many s; where a step is found, to so many s.
STRETCHES, SHORTEST_S, PLACED_S = 8, 20.0, 1.0
# Columns of an IMU factor: pose, velocity, pose, velocity, biases, biases.
OF_IMU = np.cumsum([0, 6, 3, 6, 3, 6, 6])


@dataclass(frozen=True, eq=False)
class Calibration:
    """How much later than its stamp a fix is, s, and where the antenna is, (3,) m, with standard deviations.

    A stddev is None for what was taken as given. `clock_steps`: from the first of each three numbers, s, fixes are so
    much later still, by a standard deviation. `gyroscope_scale`: what the gyroscope's `upright_axis` reads, less 1,
    where the vehicle turns by 1, and `scale_in_question` whether fixes and IMU speak for another. `refused`: why an
    offset that was found is not applied, or nothing.
    """

    time_offset_s: float
    p_imu_antenna: Array
    time_offset_stddev_s: float | None = None
    p_imu_antenna_stddevs: Array | None = None
    clock_steps: tuple[tuple[float, float, float], ...] = ()
    gyroscope_scale: float = 0.0
    scale_in_question: bool = True
    refused: str = ""

    @property
    def begins(self) -> list[float]:
        """Where the clock steps, s."""
        return [begin for begin, _, _ in self.clock_steps]

    def on_imu_clock(self, stamps: Array) -> Array:
        """The moments (n,) s of what the receiver stamps."""
        late: Array = np.full(len(stamps), self.time_offset_s)
        for begin, step, _ in self.clock_steps:
            late[stamps >= begin] += step
        return stamps + late


def upright_axis(specific_force: Array) -> int:
    """The number of the imu's axis that is nearest to the vertical: about that one a vehicle turns."""
    return int(np.abs(specific_force.mean(axis=0)).argmax())


def in_order(stamps: Array) -> Array:
    """The stamps (n,) s, those that a step of the clock brings before earlier ones just after these."""
    little = 1e-6 * np.arange(len(stamps))
    ordered: Array = np.maximum.accumulate(stamps - little) + little
    return stamps if np.all(np.diff(stamps) > 0) else ordered


@dataclass(frozen=True, eq=False)
class LastingErrors:
    """What a solution says of lasting errors x, beside all else: xᵀ `information` x / 2 - `vector`ᵀ x is the cost.

    x are the offsets of the clock, s, in stretches that begin at `begins` (n,) and before the first, then the place of
    the antenna (3,) m, then the scale of the gyroscope about its upright axis.
    """

    begins: Array
    information: Array
    vector: Array

    @classmethod
    def of(cls, problem: Problem, fit: Fit, begins: Array) -> "LastingErrors":
        """From a graph with or without constraints, linearised at its solution."""
        linear, k = gtsam.GaussianFactorGraph(), len(problem.intervals.keyframes)
        for row in _rows(problem, fit, begins):
            linear.push_back(row)
        groups, left = by_sections(fit.graph, k, shared_keys(fit.values, k)), list[gtsam.GaussianFactor]()
        deque(eliminate(split(linear, groups), groups, left), maxlen=0)
        whole = np.sum([factor.augmentedInformation() for factor in left], axis=0)
        return cls(begins, whole[:-1, :-1], whole[:-1, -1])

    def clock(self, steps: list[float]) -> Array:
        """The columns (d, s) of a clock that is off from the beginning, and further off from each step on."""
        size, stretches = len(self.vector), np.concatenate([[-np.inf], self.begins])
        columns = np.zeros((size, 1 + len(steps)))
        for n, begin in enumerate([-np.inf, *steps]):
            columns[: len(stretches), n] = stretches >= begin
        return columns

    @property
    def antenna(self) -> Array:
        """The columns (d, 3) of the place of the antenna."""
        return np.eye(len(self.vector))[:, -4:-1]

    @property
    def scale_error(self) -> float:
        """By which share the gyroscope turns too much about the vertical, if nothing else is wrong."""
        return float(self.vector[-1] / (self.information[-1, -1] + SCALE_STDDEV**-2))

    @property
    def scale_gain(self) -> float:
        """By how much the squared residuals fall then."""
        return self.scale_error * float(self.vector[-1])

    def estimate(self, columns: Array, stddevs: Array, before: Array | float = 0.0) -> tuple[Array, Array]:
        """Values (c,) of the errors in some columns, if there are no others, and their covariance.

        Before, they have `stddevs` (c,) about -`before`: what was corrected already.
        """
        precision: Array = columns.T @ self.information @ columns + np.diag(1 / stddevs**2)
        covariance = np.asarray(np.linalg.inv(precision), np.float64)
        found: Array = covariance @ (columns.T @ self.vector - before / stddevs**2)
        return found, covariance

    def gain(self, columns: Array, stddevs: Array) -> float:
        """By how much the squared residuals fall where there are these errors: chi-square by chance."""
        found, covariance = self.estimate(columns, stddevs)
        return float(found @ np.linalg.solve(covariance, found))

    def clock_offset(self, steps: list[float]) -> tuple[float, float]:
        """How late the clock is before it steps, s, and its standard deviation."""
        found, covariance = self.estimate(self.clock(steps), np.full(1 + len(steps), CLOCK_STDDEV))
        return float(found[0]), float(covariance[0, 0] ** 0.5)

    def step(self, steps: list[float]) -> tuple[float, float]:
        """Where the clock most likely steps once more than at `steps`, s, and by how much the squares fall then."""

        def gain(of: list[float]) -> float:
            return self.gain(self.clock(of), np.full(1 + len(of), CLOCK_STDDEV))

        gains = [(gain([*steps, begin]), begin) for begin in self.begins.tolist() if begin not in steps]
        best, begin = max(gains, default=(0.0, 0.0))
        return begin, best - gain(steps)


def correct(
    errors: LastingErrors, now: Calibration, given: Array, with_time: bool, with_lever: bool
) -> tuple[Calibration, float]:
    """The better calibration, and how many standard deviations it is away from the present one.

    `given` (3,) m is the lever arm as the user gave it: the prior stays there, and at no time offset. Steps of the
    clock are estimated where the present calibration has some.
    """
    of_time, of_steps, of_lever = int(with_time), len(now.clock_steps), 3 * with_lever
    columns = np.hstack([errors.clock(now.begins)[:, 1 - of_time :], errors.antenna[:, :of_lever]])
    moved = np.array(
        [now.time_offset_s, *(step for _, step, _ in now.clock_steps), *(now.p_imu_antenna - given)]
    )[1 - of_time : 1 + of_steps + of_lever]
    stddevs = np.repeat([CLOCK_STDDEV, ANTENNA_STDDEV], [of_time + of_steps, of_lever])
    found, covariance = errors.estimate(columns, stddevs, moved)
    sigma, better = np.sqrt(np.diag(covariance)), now
    if with_time:
        offset = now.time_offset_s + float(found[0])
        better = replace(better, time_offset_s=offset, time_offset_stddev_s=float(sigma[0]))
    if of_steps:
        of_each = zip(now.clock_steps, found[of_time:].tolist(), sigma[of_time:].tolist(), strict=False)
        steps = tuple((begin, step + more, stddev) for (begin, step, _), more, stddev in of_each)
        better = replace(
            better, clock_steps=tuple(one for one in steps if abs(one[1]) > BEYOND_DOUBT * one[2])
        )
        if len(better.clock_steps) < of_steps:  # beside a larger one it looked like one
            return better, np.inf
    if with_lever:
        better = replace(
            better, p_imu_antenna=now.p_imu_antenna + found[-3:], p_imu_antenna_stddevs=sigma[-3:]
        )
    return better, float(np.max(np.abs(found / sigma), initial=0.0))


def clock_errors(
    problem: Problem, fit: Fit, now: Calibration, may_step: bool
) -> tuple[LastingErrors, Calibration]:
    """What a solution says of lasting errors; and the calibration, with one more step where that is beyond doubt."""
    first, last = problem.fixes.stamps[[0, -1]].tolist()
    stretches = max(1, min(STRETCHES, int((last - first) / SHORTEST_S))) if may_step else 1
    known, coarse = now.begins, None
    while True:
        begins = np.linspace(first, last, stretches + 1)[1:-1]
        errors = LastingErrors.of(problem, fit, np.unique([*begins, *known]))
        at, gain = errors.step(known)
        if gain < quantile(1 - DOUBT / stretches, 1):
            return coarse or errors, now
        if (width := (last - first) / stretches) <= PLACED_S:
            return errors, replace(now, clock_steps=(*now.clock_steps, (at, 0.0, CLOCK_STDDEV)))
        coarse, first, last, stretches = errors, max(first, at - width), min(last, at + width), STRETCHES


def scale_error(problem: Problem, fit: Fit) -> float:
    """By which share the gyroscope turns too much about its upright axis; 0 where that is not beyond doubt."""
    errors = LastingErrors.of(problem, fit, np.empty(0))
    return errors.scale_error if errors.scale_gain > quantile(1 - DOUBT, 1) else 0.0


def _rows(problem: Problem, fit: Fit, begins: Array) -> Iterator[gtsam.GaussianFactor]:
    """The linear graph, with columns of lasting errors beside those of the IMU and of the fixes."""
    k, size, intervals = len(problem.intervals.keyframes), len(begins) + 5, problem.intervals
    T, velocities = motion_from(fit.values)
    turned = np.add.reduceat(intervals.angular_rate * intervals.durations[:, None], intervals.bounds[:-1])
    axis = upright_axis(intervals.specific_force)
    rates = turned[:, axis] / np.diff(intervals.keyframes)
    moving = np.einsum("mij,mi->mj", T[problem.at, :3, :3], velocities[problem.at])
    stretch, first_fix = np.searchsorted(begins, problem.fixes.stamps, side="right"), fit.motion.size()
    for n in range(fit.graph.size()):
        row = fit.graph.at(n).linearize(fit.values)
        if n < k - 1:
            A, b = row.jacobian()
            columns = np.zeros((len(b), size))
            columns[:, -1] = (A[:, axis - 9] + A[:, axis - 3]) * rates[n]
            terms = [(key, A[:, i:j]) for key, (i, j) in zip(row.keys(), pairwise(OF_IMU), strict=True)]
            row = _joined(terms, columns, b)
        elif first_fix <= n < first_fix + len(problem.at):
            A, b = row.jacobian()
            columns = np.zeros((3, size))
            columns[:, stretch[n - first_fix]], columns[:, -4:-1] = A[:, 3:] @ moving[n - first_fix], A[:, 3:]
            row = _joined([(row.keys()[0], A)], columns, b)
        yield row


def _joined(terms: list[tuple[int, Array]], columns: Array, b: Array) -> gtsam.JacobianFactor:
    """A factor of many keys: of GTSAM's constructors, only that of a conditional takes a list from Python."""
    unit = gtsam.noiseModel.Unit.Create(len(b))
    return gtsam.JacobianFactor(gtsam.GaussianConditional([*terms, (C(0), columns)], 1, b, unit))

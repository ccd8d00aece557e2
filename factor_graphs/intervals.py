"""The IMU between keyframes: where the keyframes are, and the steps that lead from one to the next."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.errors import MeasurementError
from factor_graphs.measurements import ImuNoise, ImuSamples

Array = NDArray[np.float64]

# A fix this close to a keyframe is taken at the keyframe; shorter intervals have no usable covariance.
SAME_STAMP_S = 5e-4
# Below this rate the samples miss motion between them: they show more noise than the sensor has.
ALIASED_BELOW_HZ = 50.0
# Longer steps are subdivided: noise is continuous, and the covariance of a single step would be singular;
# and the dense trajectory has a knot at every step.
MAX_STEP_S = 0.01
# What a road vehicle may do unseen while the IMU is silent: acceleration m/s², rate rad/s.
UNSEEN_FORCE, UNSEEN_RATE = 2.0, 0.3
# A whole day of steps; each costs 300 bytes.
MOST_STEPS = 10_000_000
# The steps are made in blocks of so many, few enough for the cache: in one piece, two hours took half as long again,
# and three times the memory.
BLOCK = 10_000
# Rates are means over so long, s: a single sample is noise.
RATE_WINDOW_S = 0.1


@dataclass(frozen=True, eq=False)
class ImuIntervals:
    """The IMU cut at keyframes into steps of constant specific force and angular rate (trapezoid).

    `keyframes` (k,) s; steps `bounds[i]:bounds[i + 1]` lead from keyframe i to i + 1; `nodes` (n + 1,) s are
    the ends of the steps; `specific_force` (n, 3), in the axes that the imu has at the start of the step,
    and `angular_rate` (n, 3); `blind` (k - 1,): no IMU there.
    """

    keyframes: Array
    bounds: NDArray[np.intp]
    nodes: Array
    specific_force: Array
    angular_rate: Array
    blind: NDArray[np.bool_]

    @property
    def durations(self) -> Array:
        """Length of every step, (n,) s."""
        return np.diff(self.nodes)

    @cached_property
    def rates(self) -> Array:
        """What the gyroscope says around every keyframe, (k, 3) rad/s."""
        turned = np.zeros((len(self.nodes), 3))
        np.cumsum(self.angular_rate * self.durations[:, None], axis=0, out=turned[1:])
        first = np.maximum(self.keyframes - RATE_WINDOW_S / 2, self.nodes[0])
        last = np.minimum(self.keyframes + RATE_WINDOW_S / 2, self.nodes[-1])
        by_first, by_last = (
            np.column_stack([np.interp(stamps, self.nodes, about) for about in turned.T])
            for stamps in (first, last)
        )
        return np.asarray((by_last - by_first) / (last - first)[:, None])

    def part(self, first: int, last: int) -> "ImuIntervals":
        """From one keyframe to another."""
        bounds = self.bounds[first : last + 1]
        steps = slice(bounds[0], bounds[-1])
        return ImuIntervals(
            self.keyframes[first : last + 1],
            bounds - bounds[0],
            self.nodes[bounds[0] : bounds[-1] + 1],
            self.specific_force[steps],
            self.angular_rate[steps],
            self.blind[first:last],
        )

    def noise(self, noise: ImuNoise) -> list[ImuNoise]:
        """The noise of every interval: `noise`, or where the IMU is silent what a vehicle may do unseen."""
        spans = np.diff(self.keyframes)
        return [
            _unseen(noise, span) if blind else noise for span, blind in zip(spans, self.blind, strict=True)
        ]

    def keyframe_of(self, stamps: Array) -> NDArray[np.intp]:
        """Index of the keyframe nearest to each stamp."""
        return nearest(self.keyframes, stamps)


def split(
    imu: ImuSamples, fix_stamps: Array, max_interval_s: float = 1.0, max_gap_s: float = 0.1
) -> ImuIntervals:
    """Cut the IMU at every fix, at both ends of every IMU gap, and at least every `max_interval_s`.

    `fix_stamps` (m,) s must lie inside the IMU's span. A step of the IMU longer than `max_gap_s`, and than
    two and a half usual steps, is a gap: an interval of its own, whose noise is that of an unseen vehicle.
    """
    steps = np.diff(imu.stamps)
    gap = np.flatnonzero(steps > max(max_gap_s, 2.5 * float(np.median(steps))))
    gap_ends = np.column_stack([imu.stamps[gap], imu.stamps[gap + 1]])
    marks = np.concatenate([imu.stamps[[0, -1]], gap_ends.ravel(), fix_stamps])
    keyframes = _fill(_distinct(np.sort(marks)), max_interval_s)
    _check_steps(imu.stamps, keyframes)
    edges = np.searchsorted(keyframes, imu.stamps[::BLOCK], side="right")
    edges = np.unique([0, *edges[1:], len(keyframes) - 1])
    parts = [_steps(imu, keyframes[first : last + 1]) for first, last in pairwise(edges.tolist())]
    nodes = np.concatenate([*(part[0][:-1] for part in parts), keyframes[-1:]])
    force, rate = (np.concatenate([part[n] for part in parts]) for n in (1, 2))
    middle = (keyframes[:-1] + keyframes[1:]) / 2
    blind = np.zeros(len(middle), dtype=bool)
    for first, last in gap_ends:
        blind |= (middle > first) & (middle < last)
    return ImuIntervals(keyframes, np.searchsorted(nodes, keyframes), nodes, force, rate, blind)


def _steps(imu: ImuSamples, keyframes: Array) -> tuple[Array, Array, Array]:
    """Ends (n + 1,) of the steps between some keyframes, their specific force and angular rate, (n, 3) each."""
    first = int(np.searchsorted(imu.stamps, keyframes[0], side="right")) - 1
    rows = slice(first, int(np.searchsorted(imu.stamps, keyframes[-1])) + 1)
    stamps = imu.stamps[rows]
    within = stamps[(stamps >= keyframes[0]) & (stamps <= keyframes[-1])]
    nodes = _fill(_distinct(np.union1d(within, keyframes), keep=keyframes), MAX_STEP_S)
    force, rate = (
        np.column_stack([np.interp(nodes, stamps, column) for column in values[rows].T])
        for values in (imu.specific_force, imu.angular_rate)
    )
    rate = (rate[:-1] + rate[1:]) / 2
    # the imu turns during the step; seen from its start, the later force is turned by the angular rate
    later = Rotation.from_rotvec(rate * np.diff(nodes)[:, None]).apply(force[1:])
    return nodes, (force[:-1] + later) / 2, rate


def nearest(known: NDArray[Any], wanted: NDArray[Any]) -> NDArray[np.intp]:
    """Index of the nearest of those `known`, sorted, to each one wanted; the earlier where both are as near."""
    right = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(np.abs(known[left] - wanted) <= np.abs(known[right] - wanted), left, right)


def noise_as_sampled(imu: ImuSamples, noise: ImuNoise) -> ImuNoise:
    """The white noise to expect of these samples: the sensor's, or for a slow log what the samples show.

    Under 50 Hz the motion between samples is lost, so the noise is read off the second differences
    (white noise of stddev s has second differences of stddev s √6); never less than the sensor's own.
    """
    step = float(np.median(np.diff(imu.stamps)))
    if step < 1 / ALIASED_BELOW_HZ or len(imu) < 10:
        return noise
    shown = [
        float(np.sqrt(np.mean(np.diff(samples, n=2, axis=0) ** 2) / 6 * step))
        for samples in (imu.specific_force, imu.angular_rate)
    ]
    return noise.model_copy(
        update={
            "accelerometer_noise_density": max(noise.accelerometer_noise_density, shown[0]),
            "gyroscope_noise_density": max(noise.gyroscope_noise_density, shown[1]),
        }
    )


def _unseen(noise: ImuNoise, span_s: float) -> ImuNoise:
    return noise.model_copy(
        update={
            "accelerometer_noise_density": UNSEEN_FORCE * np.sqrt(span_s),
            "gyroscope_noise_density": UNSEEN_RATE * np.sqrt(span_s),
        }
    )


def _distinct(stamps: Array, keep: Array | None = None) -> Array:
    """Sorted stamps without those that follow another too closely; the ones in `keep` stay."""
    if keep is None:
        # the last stamp is the end of the log: it stays, however many lie beside it
        apart = (np.diff(stamps, prepend=-np.inf) >= SAME_STAMP_S) & (stamps <= stamps[-1] - SAME_STAMP_S)
        apart[-1] = True
        distinct: Array = stamps[apart]
        return distinct
    distance = np.abs(keep[nearest(keep, stamps)] - stamps)
    kept: Array = stamps[(distance == 0) | (distance > SAME_STAMP_S)]
    return kept


def _check_steps(stamps: Array, keyframes: Array) -> None:
    """Refuse a log of too many steps before any is made."""
    span = float(keyframes[-1] - keyframes[0])
    if max(len(stamps), span / MAX_STEP_S) > MOST_STEPS:
        raise _too_many(span, span / MAX_STEP_S, MAX_STEP_S)


def _too_many(span: float, steps: float, step_s: float) -> MeasurementError:
    return MeasurementError(
        f"the IMU spans {span:.6g} s, {steps:.3g} steps of {step_s:g} s;"
        f" expected at most {MOST_STEPS}: are its stamps in seconds?"
    )


def _fill(stamps: Array, max_interval_s: float) -> Array:
    exact = np.maximum(1, np.ceil(np.diff(stamps) / max_interval_s - 0.05))
    if exact.sum() > MOST_STEPS:
        raise _too_many(stamps[-1] - stamps[0], exact.sum(), max_interval_s)
    parts = exact.astype(int)
    first = np.repeat(np.cumsum(parts) - parts, parts)
    share = (np.arange(parts.sum()) - first) / np.repeat(parts, parts)
    filled = np.repeat(stamps[:-1], parts) + share * np.repeat(np.diff(stamps), parts)
    return np.append(filled, stamps[-1])

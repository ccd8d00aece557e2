"""Fix by fix: the smoother's factors in an incremental fixed-lag smoother (iSAM2).

QR instead of Cholesky, which fails in GNSS outages of more than about 40 s; and when the solver throws all
the same, it starts again from its last state. `examples/streaming.py` shows how it is used.
"""

from dataclasses import dataclass
from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import ArrayLike, NDArray

from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.intervals import SAME_STAMP_S, ImuIntervals, split
from factor_graphs.measurements import GnssFixes, ImuSamples
from factor_graphs.model import gnss_factors, imu_factors, relative_pose_factors
from factor_graphs.problem import LOSSES, RELATIVE_LOSSES
from factor_graphs.relative_poses import NO_RELATIVE_POSES, RelativePoses
from factor_graphs.smoothing import Solution

Array = NDArray[np.float64]

# iSAM2 relinearises what moved by more than the threshold, at every tenth update.
RELINEARIZE_SKIP, RELINEARIZE_THRESHOLD = 10, 0.1


@dataclass(frozen=True, eq=False)
class StreamedState:
    """The state at the newest fix: `T_map_imu` (4, 4), `velocity` (3,) m/s, `biases` (6,)."""

    stamp: float
    T_map_imu: Array
    velocity: Array
    biases: Array


class StreamingSmoother:
    """Fixed-lag smoother that follows a vehicle online, from where a batch solution of its first seconds ends.

    `start` gives the first state, its covariance and the IMU noise; `p_imu_antenna` (3,) m is the lever arm. Raises
    MeasurementError when `lag_s` is below 0.
    `state` is the newest one, `restarts` counts how often the solver had to start again, and `unbound` the
    relative poses left out because their earlier moment is no keyframe within the lag.
    """

    def __init__(
        self,
        start: Solution,
        frame: LocalFrame,
        p_imu_antenna: ArrayLike = (0.0, 0.0, 0.0),
        lag_s: float = 10.0,
    ) -> None:
        if not lag_s >= 0:
            raise MeasurementError(f"lag_s: found {lag_s}, expected a number of seconds from 0 on")
        self.restarts = self.unbound = 0
        self._frame, self._lag_s = frame, lag_s
        self._lever = np.asarray(p_imu_antenna, dtype=np.float64)
        self._noise, self._keyframe = start.imu_noise, 0
        end, velocities = start.keyframes, start.keyframes.velocities
        assert velocities is not None
        self.state = StreamedState(end.end, end.T_map_imu[-1], velocities[-1], start.biases[-1])
        of_state = start.state_covariances[-1]
        self._covariances = [of_state[rows, rows] for rows in (slice(0, 6), slice(6, 9), slice(9, 15))]
        self._begin()

    def add(
        self, imu: ImuSamples, fix: GnssFixes, relative_poses: RelativePoses = NO_RELATIVE_POSES
    ) -> StreamedState:
        """The state at one new fix, given the IMU from the last state's stamp (or before) to the fix.

        `relative_poses` end after the last state and not after the fix; they begin there too, or where one of an
        earlier call ended. Raises MeasurementError when it is not one fix, is not newer, the IMU does not span
        the time between, or a relative pose ends outside it.
        """
        if len(fix) != 1 or not imu.stamps[0] <= self.state.stamp < fix.stamps[0] <= imu.stamps[-1]:
            raise MeasurementError(
                f"{len(fix)} fixes at {fix.stamps.tolist()} s, IMU {imu.stamps[0]:.3f}..{imu.stamps[-1]:.3f} s; "
                f"expected one fix after {self.state.stamp:.3f} s, and the IMU from there to the fix"
            )
        ends = relative_poses.stamps[:, 1]
        if np.any((ends <= self.state.stamp) | (ends > fix.stamps[0])):
            raise MeasurementError(
                f"relative poses end at {ends.min():.3f}..{ends.max():.3f} s; expected after {self.state.stamp:.3f} s"
                f" and not after the fix at {fix.stamps[0]:.3f} s: add them with the fix that follows them"
            )
        within = relative_poses.stamps[relative_poses.stamps > self.state.stamp]
        intervals = split(
            _between(imu, self.state.stamp, float(fix.stamps[0])), np.concatenate([fix.stamps, within])
        )
        try:
            self._extend(intervals, fix, relative_poses)
        except RuntimeError:
            # iSAM2 lost its footing: keep the last state and how sure it was, forget how it came about
            self.restarts += 1
            self._begin()
            self._extend(intervals, fix, relative_poses)
        return self.state

    def pose_covariance(self) -> Array:
        """Covariance (6, 6) of the newest pose, in the order and axes of `Trajectory.covariances`."""
        return self._smoother.marginalCovariance(X(self._keyframe))

    def _begin(self) -> None:
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")
        params.relinearizeSkip = RELINEARIZE_SKIP
        params.setRelinearizeThreshold(RELINEARIZE_THRESHOLD)
        self._smoother = gtsam.IncrementalFixedLagSmoother(self._lag_s, params)
        i, state = self._keyframe, self.state
        of_pose, of_velocity, of_bias = map(gtsam.noiseModel.Gaussian.Covariance, self._covariances)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose, bias = (
            gtsam.Pose3(state.T_map_imu),
            gtsam.imuBias.ConstantBias(state.biases[:3], state.biases[3:]),
        )
        graph.push_back(gtsam.PriorFactorPose3(X(i), pose, of_pose))
        graph.push_back(gtsam.PriorFactorVector(V(i), state.velocity, of_velocity))
        graph.push_back(gtsam.PriorFactorConstantBias(B(i), bias, of_bias))
        values.insert(X(i), pose3=pose)
        values.insert(V(i), state.velocity)
        values.insert(B(i), constant_bias=bias)
        self._smoother.update(graph, values, dict.fromkeys((X(i), V(i), B(i)), state.stamp))
        self._keyframe_stamps = {i: state.stamp}

    def _extend(self, intervals: ImuIntervals, fix: GnssFixes, relative: RelativePoses) -> None:
        graph, values, stamps = (
            gtsam.NonlinearFactorGraph(),
            gtsam.Values(),
            dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex](),
        )
        first = self._keyframe
        last = first + len(intervals.keyframes) - 1
        bias = gtsam.imuBias.ConstantBias(self.state.biases[:3], self.state.biases[3:])
        ahead = gtsam.NavState(gtsam.Pose3(self.state.T_map_imu), self.state.velocity)
        here = np.tile(self.state.T_map_imu[:3, 3], (last - first, 1))
        for i, factor in enumerate(
            imu_factors(intervals, intervals.noise(self._noise), self._frame, here, first), first + 1
        ):
            graph.push_back(factor)
            ahead = factor.preintegratedMeasurements().predict(ahead, bias)
            values.insert(X(i), pose3=ahead.pose())
            values.insert(V(i), ahead.velocity())
            values.insert(B(i), constant_bias=bias)
            stamps |= {key: float(intervals.keyframes[i - first]) for key in (X(i), V(i), B(i))}
        known = self._keyframe_stamps | dict(enumerate(intervals.keyframes.tolist(), first))
        at = np.array([_keyframe_at(known, stamp) for stamp in relative.stamps.ravel()], dtype=int).reshape(
            -1, 2
        )
        bound = at.min(axis=1, initial=0) >= 0
        for between in relative_pose_factors(relative[bound], at[bound], RELATIVE_LOSSES["huber"]):
            graph.push_back(between)
        for gnss in gnss_factors(fix, np.array([last]), self._lever, LOSSES["huber"]):
            graph.push_back(gnss)
        self._smoother.update(graph, values, stamps)
        self.unbound += int(np.count_nonzero(~bound))
        oldest = float(fix.stamps[0]) - self._lag_s
        self._keyframe_stamps = {i: stamp for i, stamp in known.items() if stamp > oldest}
        self._keyframe, self.state = last, self._newest(last, float(fix.stamps[0]))
        self._covariances = [self._smoother.marginalCovariance(key) for key in (X(last), V(last), B(last))]

    def _newest(self, i: int, stamp: float) -> StreamedState:
        smoother = self._smoother
        return StreamedState(
            stamp,
            smoother.calculateEstimatePose3(X(i)).matrix(),
            smoother.calculateEstimateVector(V(i)),
            smoother.calculateEstimateConstantBias(B(i)).vector(),
        )


def _keyframe_at(stamps: dict[int, float], stamp: float) -> int:
    """Number of the keyframe at a stamp, or -1."""
    nearest = min(stamps, key=lambda i: abs(stamps[i] - stamp))
    return nearest if abs(stamps[nearest] - stamp) <= SAME_STAMP_S else -1


def _between(imu: ImuSamples, first: float, last: float) -> ImuSamples:
    """The IMU from `first` to `last` s, its ends interpolated."""
    i, j = (int(n) for n in np.searchsorted(imu.stamps, [first, last], side="right"))
    inner = imu.stamps[i:j]
    stamps = np.concatenate([[first], inner[inner < last], [last]])
    near = slice(max(i - 1, 0), j + 1)
    both = np.hstack([imu.specific_force[near], imu.angular_rate[near]])
    at = np.column_stack([np.interp(stamps, imu.stamps[near], column) for column in both.T])
    return ImuSamples(stamps, at[:, :3], at[:, 3:])

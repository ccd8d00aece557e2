"""What a road vehicle cannot do: slide sideways, lift off, or move while it stands.

The velocity in the imu's own axes depends on pose and velocity, and GTSAM has no factor for it. It is
linearised here and held in a linear container; the smoother relinearises it in an outer loop, which costs
a tenth of a custom factor in Python.
"""

from collections.abc import Iterator

import gtsam
import numpy as np
from gtsam.symbol_shorthand import V, X
from numpy.typing import NDArray

from factor_graphs.intervals import ImuIntervals

Array = NDArray[np.float64]

# A vehicle that stands: slower than this, m/s, and its IMU not much noisier than in its quietest tenth.
STANDING_SPEED, QUIET = 0.3, 2.0


def body_velocity_factors(
    T: Array, velocities: Array, axis: int, stddev_mps: float
) -> Iterator[gtsam.LinearContainerFactor]:
    """The velocity along one axis of the imu (1 lateral, 2 vertical) is zero, linearised at these states.

    With v_imu = Rᵀ v and R perturbed on the right, d v_imu = [v_imu]× dθ + Rᵀ dv.
    """
    model = gtsam.noiseModel.Unit.Create(1)
    for i, (pose, velocity) in enumerate(zip(T, velocities, strict=True)):
        R = pose[:3, :3]
        in_imu = R.T @ velocity
        by_pose, by_velocity = np.zeros((1, 6)), R.T[axis : axis + 1] / stddev_mps
        by_pose[0, :3] = np.cross(in_imu, np.eye(3))[:, axis] / stddev_mps
        row = gtsam.JacobianFactor(
            X(i), by_pose, V(i), by_velocity, -in_imu[axis : axis + 1] / stddev_mps, model
        )
        here = gtsam.Values()
        here.insert(X(i), gtsam.Pose3(pose))
        here.insert(V(i), velocity)
        yield gtsam.LinearContainerFactor(row, here)


def zero_velocity_factors(
    standing: NDArray[np.bool_], stddev_mps: float
) -> Iterator[gtsam.PriorFactorVector]:
    """The velocity of every standing keyframe is zero."""
    model = gtsam.noiseModel.Isotropic.Sigma(3, stddev_mps)
    for i in np.flatnonzero(standing).tolist():
        yield gtsam.PriorFactorVector(V(i), np.zeros(3), model)


def standing(intervals: ImuIntervals, velocities: Array) -> NDArray[np.bool_]:
    """The keyframes at which the vehicle stands, (k,): slow there, and the IMU quiet on both sides."""
    slow = np.linalg.norm(velocities, axis=1) < STANDING_SPEED
    which = np.repeat(np.arange(len(intervals.keyframes) - 1), np.diff(intervals.bounds))
    quiet = np.ones(len(intervals.keyframes) - 1, dtype=bool)
    for samples in (intervals.specific_force, intervals.angular_rate):
        scatter = _scatter(samples, which, len(quiet))
        quiet &= scatter <= QUIET * np.quantile(scatter, 0.1)
    quiet &= ~intervals.blind
    still: NDArray[np.bool_] = slow & np.append(quiet, True) & np.append(True, quiet)
    return still


def _scatter(samples: Array, which: NDArray[np.intp], n: int) -> Array:
    """Standard deviation of the samples within every interval, all axes together, (n,)."""
    count = np.maximum(np.bincount(which, minlength=n), 1)
    variance = np.zeros(n)
    for column in samples.T:
        mean = np.bincount(which, column, n) / count
        variance += np.bincount(which, (column - mean[which]) ** 2, n) / count
    scatter: Array = np.sqrt(variance)
    return scatter

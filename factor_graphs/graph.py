"""One function per factor: how each measurement binds the pose X, velocity V and bias B of the keyframes."""

from collections.abc import Iterator
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray

from factor_graphs.alignment import AttitudePrior
from factor_graphs.geodesy import LocalFrame
from factor_graphs.intervals import ImuIntervals
from factor_graphs.measurements import GnssFixes, ImuNoise
from factor_graphs.relative_poses import RelativePoses

Array = NDArray[np.float64]

# GTSAM's own error of integration, m²/s: far below any IMU's, but it keeps short intervals regular.
INTEGRATION_VARIANCE = 1e-8
# Gravity is one within a cube of this edge: it turns by 1e-5 rad from the middle to the edge.
CELL_M = 100.0


def preintegration_params(
    noise: ImuNoise, frame: LocalFrame, gravity: Array
) -> gtsam.PreintegrationCombinedParams:
    """Everything GTSAM must know of the IMU and of the Earth: it presumes identity for what is not set."""
    params = gtsam.PreintegrationCombinedParams(gravity)
    params.setAccelerometerCovariance(noise.accelerometer_noise_density**2 * np.eye(3))
    params.setGyroscopeCovariance(noise.gyroscope_noise_density**2 * np.eye(3))
    params.setBiasAccCovariance(noise.accelerometer_bias_walk**2 * np.eye(3))
    params.setBiasOmegaCovariance(noise.gyroscope_bias_walk**2 * np.eye(3))
    params.setIntegrationCovariance(INTEGRATION_VARIANCE * np.eye(3))
    params.setOmegaCoriolis(frame.earth_rate)
    return params


def imu_factors(
    intervals: ImuIntervals, noise: list[ImuNoise], frame: LocalFrame, positions: Array, first: int = 0
) -> Iterator[gtsam.CombinedImuFactor]:
    """The preintegrated IMU from each keyframe to the next (Forster et al. 2017), bias walk included.

    The keyframes are numbered from `first`; `positions` (k - 1, 3) m are about where the intervals begin: gravity is
    that of there.
    """
    cells, cell = np.unique(np.round(positions / CELL_M), axis=0, return_inverse=True)
    gravity, known = frame.gravity_at(CELL_M * cells), dict[tuple[int, int], Any]()
    steps = zip(intervals.specific_force, intervals.angular_rate, intervals.durations.tolist(), strict=True)
    for i, (its_noise, place, count) in enumerate(
        zip(noise, cell.ravel().tolist(), np.diff(intervals.bounds).tolist(), strict=True), first
    ):
        key = id(its_noise), place
        if key not in known:
            known[key] = preintegration_params(its_noise, frame, gravity[place])
        pim = gtsam.PreintegratedCombinedMeasurements(known[key])
        integrate = pim.integrateMeasurement
        for _ in range(count):
            integrate(*next(steps))
        yield gtsam.CombinedImuFactor(X(i), V(i), X(i + 1), V(i + 1), B(i), B(i + 1), pim)


def gnss_factors(
    fixes: GnssFixes,
    keyframes: NDArray[np.intp],
    p_imu_antenna: Array,
    loss: gtsam.noiseModel.mEstimator.Base | None,
) -> Iterator[gtsam.GPSFactorArm]:
    """Every fix holds the antenna of its keyframe's pose."""
    models = (
        map(gtsam.noiseModel.Diagonal.Sigmas, fixes.stddevs)
        if fixes.correlations is None
        else map(gtsam.noiseModel.Gaussian.Covariance, fixes.covariances)
    )
    for keyframe, position, stated in zip(keyframes.tolist(), fixes.positions, models, strict=True):
        model: gtsam.noiseModel.Base = stated
        if loss is not None:
            model = gtsam.noiseModel.Robust.Create(loss, model)
        yield gtsam.GPSFactorArm(X(keyframe), position, p_imu_antenna, model)


def relative_pose_factors(
    relative: RelativePoses,
    keyframes: NDArray[np.intp],
    loss: gtsam.noiseModel.mEstimator.Base | None,
) -> Iterator[gtsam.BetweenFactorPose3]:
    """Every relative pose binds two keyframes, `keyframes` (k, 2)."""
    for (i, j), T, covariance in zip(
        keyframes.tolist(), relative.T_imu_imu, relative.covariances, strict=True
    ):
        model: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Covariance(covariance)
        if loss is not None:
            model = gtsam.noiseModel.Robust.Create(loss, model)
        yield gtsam.BetweenFactorPose3(X(i), X(j), gtsam.Pose3(T), model)


def prior_factors(
    pose: Array,
    velocity: Array,
    attitude: AttitudePrior,
    position_stddev: float,
    speed_stddev: float,
    noise: ImuNoise,
) -> Iterator[gtsam.NonlinearFactor]:
    """What is known of the first keyframe before any fix: finite in every direction, or GTSAM 4.3 fails."""
    covariance = position_stddev**2 * np.eye(6)
    covariance[:3, :3] = attitude.covariance
    model, rotation = gtsam.noiseModel.Gaussian.Covariance(covariance), gtsam.Rot3(attitude.R_map_imu)
    yield gtsam.PriorFactorPose3(X(0), gtsam.Pose3(rotation, pose[:3, 3]), model)
    yield gtsam.PriorFactorVector(V(0), velocity, gtsam.noiseModel.Isotropic.Sigma(3, speed_stddev))
    bias_stddevs = np.repeat([noise.accelerometer_bias_stddev, noise.gyroscope_bias_stddev], 3)
    yield gtsam.PriorFactorConstantBias(
        B(0), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(bias_stddevs)
    )


def to_values(T: Array, velocities: Array, biases: Array) -> gtsam.Values:
    """Keyframe states (k, 4, 4), (k, 3), (k, 6) as GTSAM values."""
    values = gtsam.Values()
    # named, or the binding tries all kinds of value in turn: 42 µs a bias in place of 10
    for i, (pose, velocity, bias) in enumerate(zip(T, velocities, biases, strict=True)):
        values.insert(X(i), pose3=gtsam.Pose3(pose))
        values.insert(V(i), velocity)
        values.insert(B(i), constant_bias=gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
    return values


def from_values(values: gtsam.Values, k: int) -> tuple[Array, Array, Array]:
    """GTSAM values as keyframe states: poses (k, 4, 4), velocities (k, 3), biases (k, 6)."""
    T, velocities = motion_from(values)
    return T, velocities, np.array([values.atConstantBias(B(i)).vector() for i in range(k)])


def motion_from(values: gtsam.Values) -> tuple[Array, Array]:
    """Poses (k, 4, 4) and velocities (k, 3) of all keyframes, without a call per keyframe."""
    rows, velocities = gtsam.utilities.extractPose3(values), gtsam.utilities.extractVectors(values, "v")
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    return T, velocities

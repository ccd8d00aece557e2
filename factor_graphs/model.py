"""The factor graph of a drive: its unknowns, and one function for each kind of factor.

    prior --- X(0) --- relative pose --- X(1) --- relative pose --- X(2) ...      pose of the IMU in the map
    prior --- V(0) ---+             +--- V(1) ---+             +--- V(2) ...      velocity in the map
    prior --- B(0) ---+---- IMU ----+--- B(1) ---+---- IMU ----+--- B(2) ...      biases of accelerometer and gyroscope

    GNSS fix        on X(i)              the antenna of the keyframe is where the receiver says
    axle            on X(i), V(i), M     a point on the axle does not slide; M is the mounting of the IMU, with a prior
    wheels          on X(i), V(i), W     it moves ahead as fast as they roll; W is their calibration, with a prior
    zero velocity   on V(i)              while the vehicle stands
    zero motion     on X(i), X(i + 1)    while it stands, the pose stays the same (zero angular rate)

Keyframes are at the fixes, at the ends of relative poses (LiDAR odometry), and in between where these are far apart.
`problem.optimise` adds the factors up and solves the graph.
"""

from collections.abc import Iterator
from dataclasses import dataclass
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


@dataclass(frozen=True, eq=False)
class BodyVelocities:
    """Velocities of the vehicle that are known, r of them at each of n keyframes, linearised.

    `off` (n, r) m/s: by how much a solution misses them; its Jacobians by pose tangent and velocity `by_state`
    (n, r, 9), and by `by_shared` (n, r, s), what all keyframes share; `stddevs` (n, r) m/s.
    """

    keyframes: NDArray[np.intp]
    off: Array
    by_state: Array
    by_shared: Array
    stddevs: Array


def body_velocity_factors(
    values: gtsam.Values, known: BodyVelocities, shared: int, prior: Array, prior_stddevs: Array
) -> Iterator[gtsam.NonlinearFactor]:
    """Axle or wheels: velocities in the axes of the vehicle, linearised at `values`; and the prior of what they share.

    GTSAM has no such factor, and one in Python costs ten times as much: so the smoother relinearises in an outer loop.
    """
    scale, unit = 1 / known.stddevs[:, :, None], gtsam.noiseModel.Unit.Create(known.off.shape[1])
    by_pose, by_velocity = known.by_state[:, :, :6] * scale, known.by_state[:, :, 6:] * scale
    by_shared, right = known.by_shared * scale, -known.off / known.stddevs
    for i, *of_keyframe in zip(known.keyframes.tolist(), by_pose, by_velocity, by_shared, right, strict=True):
        pose, velocity, of_shared, b = of_keyframe
        row = gtsam.JacobianFactor(X(i), pose, V(i), velocity, shared, of_shared, b, unit)
        yield gtsam.LinearContainerFactor(row, values)
    yield gtsam.PriorFactorVector(shared, prior, gtsam.noiseModel.Diagonal.Sigmas(prior_stddevs))


def zero_velocity_factors(
    standing: NDArray[np.bool_], stddev_mps: float
) -> Iterator[gtsam.PriorFactorVector]:
    """The velocity of every standing keyframe is zero."""
    model = gtsam.noiseModel.Isotropic.Sigma(3, stddev_mps)
    for i in np.flatnonzero(standing).tolist():
        yield gtsam.PriorFactorVector(V(i), np.zeros(3), model)


def zero_motion_factors(
    resting: NDArray[np.bool_], durations: Array, stddev_radps: float, stddev_mps: float
) -> Iterator[gtsam.BetweenFactorPose3]:
    """The pose stays the same in every interval at rest: what the gyroscope says there is its bias.

    `resting` (k - 1,), `durations` (k - 1,) s.
    """
    rates = np.repeat([stddev_radps, stddev_mps], 3)
    for i in np.flatnonzero(resting).tolist():
        model = gtsam.noiseModel.Diagonal.Sigmas(rates * durations[i])
        yield gtsam.BetweenFactorPose3(X(i), X(i + 1), gtsam.Pose3(), model)


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

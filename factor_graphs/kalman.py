"""The baseline: an error-state Kalman filter with gate and re-acquisition, and its RTS smoother.

The classical way to fuse IMU and GNSS (Groves 2013, chapter 14), on filterpy. The graph must beat it. The
error is (rotation in imu axes, position, velocity, accelerometer bias, gyroscope bias), truth minus estimate.
`examples/kalman_baseline.py` compares the two.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.chi_square import quantile
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples
from factor_graphs.problem import Problem, pose_problem
from factor_graphs.settings import SmootherSettings
from factor_graphs.trajectory import Trajectory

Array = NDArray[np.float64]

THETA, P, V, BA, BG = (slice(i, i + 3) for i in range(0, 15, 3))
# A fix this unlikely is not used. After so many in a row it is the filter that is wrong, not the fixes.
GATE, RE_ACQUIRE_AFTER = quantile(0.999, 3), 6
# What the first guess is good for: roll, pitch, heading rad, position m, speed m/s.
GUESS_STDDEVS = (0.1, 0.1, 0.2, 5.0, 5.0, 5.0, 3.0, 3.0, 3.0)
# The covariance is propagated once per so many IMU steps.
COVARIANCE_STEPS = 10


@dataclass(frozen=True, eq=False)
class KalmanSolution:
    """The filter's and the smoother's trajectory at the keyframes, with velocities and covariances.

    `nis` (m,): normalised innovation squared of every fix used or gated, about 3 when the filter is honest;
    `gated` (m,): the fix was not used.
    """

    filtered: Trajectory
    smoothed: Trajectory
    nis: Array
    gated: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class _State:
    """Navigation state and biases (6,) with the covariance (15, 15) of their error."""

    R: Array
    p: Array
    v: Array
    biases: Array
    covariance: Array

    def corrected(self, error: Array, covariance: Array) -> "_State":
        turn = Rotation.from_rotvec(error[THETA]).as_matrix()
        biases = self.biases + error[BA.start :]
        return _State(self.R @ turn, self.p + error[P], self.v + error[V], biases, covariance)

    def error_of(self, estimate: "_State") -> Array:
        """What must be added to the estimate to arrive here."""
        turn = Rotation.from_matrix(estimate.R.T @ self.R).as_rotvec()
        return np.concatenate([turn, self.p - estimate.p, self.v - estimate.v, self.biases - estimate.biases])


def kalman_smooth(
    imu: ImuSamples,
    fixes: GnssFixes,
    frame: LocalFrame,
    settings: SmootherSettings | None = None,
    p_imu_antenna: ArrayLike = (0.0, 0.0, 0.0),
) -> KalmanSolution:
    """Filter forwards, smooth backwards; measurements, keyframes and first attitude as in the graph.

    Noise is taken as given, and every fix passes the gate or not. Raises MeasurementError as `smooth` does.
    """
    lever = np.asarray(p_imu_antenna, dtype=np.float64)
    problem = pose_problem(imu, fixes, frame, settings or SmootherSettings(), lever, None)
    predicted, filtered, transitions, nis, gated = _filter(problem)
    smoothed = [filtered[-1]]
    for now, ahead, F in zip(filtered[-2::-1], predicted[:0:-1], transitions[::-1], strict=True):
        gain = np.linalg.solve(ahead.covariance, F @ now.covariance).T
        change = gain @ (smoothed[-1].covariance - ahead.covariance) @ gain.T
        smoothed.append(now.corrected(gain @ smoothed[-1].error_of(ahead), now.covariance + change))
    stamps = problem.intervals.keyframes
    return KalmanSolution(_trajectory(stamps, filtered), _trajectory(stamps, smoothed[::-1]), nis, gated)


def _filter(problem: Problem) -> tuple[list[_State], list[_State], list[Array], Array, NDArray[np.bool_]]:
    noise = problem.intervals.noise(problem.noise)
    fix_at = dict(zip(problem.at.tolist(), range(len(problem.fixes)), strict=True))
    nis, gated, refused = np.zeros(len(problem.fixes)), np.zeros(len(problem.fixes), dtype=bool), 0
    state, predicted, filtered, transitions = _restart(problem, 0, np.zeros(6)), [], [], []
    for i in range(len(problem.intervals.keyframes)):
        if i > 0:
            state, F = _predict(problem, i - 1, state, noise[i - 1])
            transitions.append(F)
        m = fix_at.get(i)
        if m is not None and refused >= RE_ACQUIRE_AFTER:
            # nothing is carried over a restart, forwards or backwards
            state, transitions[-1] = _restart(problem, i, state.biases), np.zeros((15, 15))
        predicted.append(state)
        if m is not None:
            state, nis[m], gated[m] = _update(problem, state, m)
            refused = refused + 1 if gated[m] else 0
        filtered.append(state)
    return predicted, filtered, transitions, nis, gated


def _restart(problem: Problem, i: int, biases: Array) -> _State:
    """The first guess of keyframe i: it comes from all fixes, so it is known better than from one alone."""
    T, velocities = problem.guess
    n = problem.noise
    stddevs = [*GUESS_STDDEVS, *[n.accelerometer_bias_stddev] * 3, *[n.gyroscope_bias_stddev] * 3]
    return _State(T[i, :3, :3], T[i, :3, 3], velocities[i], biases, np.diag(np.square(stddevs)))


def _predict(problem: Problem, i: int, state: _State, noise: ImuNoise) -> tuple[_State, Array]:
    """Strapdown over interval i, and the covariance in a few larger steps; also the transition over all."""
    intervals, frame = problem.intervals, problem.frame
    first, last = intervals.bounds[i], intervals.bounds[i + 1]
    dt = intervals.durations[first:last]
    force = intervals.specific_force[first:last] - state.biases[:3]
    rate = intervals.angular_rate[first:last] - state.biases[3:]
    turns = Rotation.from_rotvec(rate * dt[:, None]).as_matrix()
    R, p, v, covariance, whole = state.R, state.p, state.v, state.covariance, np.eye(15)
    gravity, earth = frame.gravity_at(state.p[None])[0], frame.earth_rate
    earth_turn = Rotation.from_rotvec(-earth * dt[0]).as_matrix()
    for start in range(0, len(dt), COVARIANCE_STEPS):
        some = slice(start, start + COVARIANCE_STEPS)
        F, Q = _transition(R, force[some].mean(axis=0), rate[some].mean(axis=0), float(dt[some].sum()), noise)
        covariance, whole = F @ covariance @ F.T + Q, F @ whole
        for f, turn, h in zip(force[some], turns[some], dt[some].tolist(), strict=True):
            a = R @ f + gravity - 2 * np.cross(earth, v)
            p, v, R = p + v * h + a * (h * h / 2), v + a * h, earth_turn @ R @ turn
    return _State(R, p, v, state.biases, covariance), whole


def _transition(R: Array, force: Array, rate: Array, dt: float, noise: ImuNoise) -> tuple[Array, Array]:
    """Transition and process noise of the error over a short step, second order in time."""
    A = np.zeros((15, 15))
    A[THETA, THETA], A[THETA, BG] = -_cross(rate), -np.eye(3)
    A[V, THETA], A[V, BA] = -R @ _cross(force), -R
    A[P, V] = np.eye(3)
    F = np.eye(15) + A * dt + A @ A * (dt * dt / 2)
    densities = [noise.gyroscope_noise_density, 0.0, noise.accelerometer_noise_density]
    densities += [noise.accelerometer_bias_walk, noise.gyroscope_bias_walk]
    white = np.diag(np.repeat(np.square(densities), 3)) * dt
    return F, (F @ white @ F.T + white) / 2


def _update(problem: Problem, state: _State, m: int) -> tuple[_State, float, bool]:
    """Use fix m, unless it fails the gate: the state, its squared normalised innovation, and whether it failed."""
    from filterpy.kalman import KalmanFilter

    kalman = KalmanFilter(dim_x=15, dim_z=3)
    kalman.H[:, THETA], kalman.H[:, P] = -state.R @ _cross(problem.p_imu_antenna), np.eye(3)
    kalman.R = problem.fixes.covariances[m]
    kalman.P = state.covariance
    innovation = problem.fixes.positions[m] - state.p - state.R @ problem.p_imu_antenna
    kalman.update(innovation)
    nis = float(kalman.mahalanobis) ** 2
    if nis > GATE:
        return state, nis, True
    return state.corrected(kalman.x[:, 0], kalman.P), nis, False


def _trajectory(stamps: Array, states: list[_State]) -> Trajectory:
    T, covariances = np.tile(np.eye(4), (len(states), 1, 1)), np.zeros((len(states), 6, 6))
    for i, s in enumerate(states):
        T[i, :3, :3], T[i, :3, 3] = s.R, s.p
        turn = np.eye(6)
        turn[3:, 3:] = s.R.T
        covariances[i] = turn @ s.covariance[:6, :6] @ turn.T
    return Trajectory(stamps, T, np.array([s.v for s in states]), covariances)


def _cross(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])

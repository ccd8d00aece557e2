"""From keyframes to every IMU stamp: propagated from one keyframe, closed on the next.

The IMU leads from each keyframe to the next and misses it by a little. That misclosure is spread over the
interval as a cubic in position and a constant turn in attitude: for white noise on force and rate this is
the most probable path between the two ends, and there is no step at a keyframe.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.geodesy import LocalFrame
from factor_graphs.intervals import ImuIntervals
from factor_graphs.measurements import ImuNoise
from factor_graphs.trajectory import Trajectory

Array = NDArray[np.float64]

# Intervals are made dense in blocks of so many nodes, few enough for the cache: in one piece, with 200 MB for every
# intermediate result, a drive of two hours took a sixth more CPU time as a whole.
BLOCK = 6_000


def densify(
    intervals: ImuIntervals, keyframes: Trajectory, biases: Array, noise: list[ImuNoise], frame: LocalFrame
) -> Trajectory:
    """The trajectory at every node of the intervals: all IMU stamps and all keyframes.

    `keyframes` (k) with velocities and covariances; `biases` (k, 6), accelerometer then gyroscope; `noise`
    of each of the k - 1 intervals.
    """
    count = len(intervals.nodes)
    T, velocities, covariances = np.empty((count, 4, 4)), np.empty((count, 3)), np.empty((count, 6, 6))
    edges = np.unique(np.searchsorted(intervals.bounds, [*range(0, count - 1, BLOCK), count - 1]))
    for first, last in pairwise(edges.tolist()):
        part, ends = intervals.part(first, last), slice(first, last + 1)
        rows = slice(intervals.bounds[first], intervals.bounds[last] + 1)
        T[rows], velocities[rows], covariances[rows] = _dense(
            part, keyframes[ends], biases[ends], noise[first:last], frame
        )
    for array in (T, velocities, covariances):
        array.setflags(write=False)
    return Trajectory(intervals.nodes, T, velocities, covariances)


def _dense(
    intervals: ImuIntervals, keyframes: Trajectory, biases: Array, noise: list[ImuNoise], frame: LocalFrame
) -> tuple[Array, Array, Array]:
    """Poses, velocities and covariances at every node."""
    assert keyframes.velocities is not None
    which = np.repeat(np.arange(len(keyframes) - 1), np.diff(intervals.bounds))
    last, spans = intervals.bounds[1:] - 1, np.diff(intervals.keyframes)[:, None]
    u = ((intervals.nodes[:-1] - intervals.keyframes[which]) / spans[which, 0])[:, None]
    bias = (1 - u) * biases[which] + u * biases[which + 1]
    R, R_end = _turn(intervals, keyframes.T_map_imu[:, :3, :3], intervals.angular_rate - bias[:, 3:], frame)
    v, v_end, p, p_end = _move(
        intervals, keyframes, R, intervals.specific_force - bias[:, :3], which, u, frame
    )

    turn = Rotation.from_matrix(np.swapaxes(R_end, 1, 2) @ keyframes.T_map_imu[1:, :3, :3]).as_rotvec()
    dv, dp = (keyframes.velocities[1:] - v_end[last]) * spans, keyframes.positions[1:] - p_end[last]
    square, cube = (3 * dp - dv)[which], (dv - 2 * dp)[which]
    T = np.concatenate([np.tile(np.eye(4), (len(p), 1, 1)), keyframes.T_map_imu[-1:]])
    T[:-1, :3, :3] = R @ Rotation.from_rotvec(u * turn[which]).as_matrix()
    T[:-1, :3, 3] = p + u**2 * (square + u * cube)
    v = v + u * (2 * square + 3 * u * cube) / spans[which]
    velocities = np.concatenate([v, keyframes.velocities[-1:]])
    return T, velocities, _covariances(keyframes, T, noise, which, u[:, 0])


def _turn(intervals: ImuIntervals, R_keyframes: Array, rate: Array, frame: LocalFrame) -> tuple[Array, Array]:
    """Attitude at the start of every step (n, 3, 3), and at the end of every interval (k - 1, 3, 3)."""
    dt, bounds = intervals.durations[:, None], intervals.bounds
    turns = Rotation.from_rotvec(rate * dt).as_matrix()
    earth = Rotation.from_rotvec(-frame.earth_rate * dt).as_matrix()
    # All intervals go on together, the longest first: those that have a step to come are always the first ones.
    counts = np.diff(bounds)
    order = np.argsort(-counts, kind="stable")
    first, now, R = bounds[order], R_keyframes[order], np.empty((len(dt), 3, 3))
    shorter = np.cumsum(np.bincount(counts))
    for step, active in enumerate((len(order) - shorter[:-1]).tolist()):
        at = first[:active] + step
        R[at] = now[:active]
        now[:active] = earth[at] @ now[:active] @ turns[at]
    return R, now[np.argsort(order)]


def _move(
    intervals: ImuIntervals,
    keyframes: Trajectory,
    R: Array,
    force: Array,
    which: NDArray[np.intp],
    u: Array,
    frame: LocalFrame,
) -> tuple[Array, Array, Array, Array]:
    """Velocity and position at the start and at the end of every step, (n, 3) each: v, v_end, p, p_end."""
    assert keyframes.velocities is not None
    dt = intervals.durations[:, None]
    about = (1 - u) * keyframes.velocities[which] + u * keyframes.velocities[which + 1]
    gravity = frame.gravity_at(keyframes.positions)[which]
    a = np.einsum("nij,nj->ni", R, force) - 2 * np.cross(frame.earth_rate, about) + gravity
    v_end = keyframes.velocities[which] + _sum_since_keyframe(a * dt, intervals.bounds, which)
    v = v_end - a * dt
    step = (v + a * dt / 2) * dt
    p_end = keyframes.positions[which] + _sum_since_keyframe(step, intervals.bounds, which)
    return v, v_end, p_end - step, p_end


def _sum_since_keyframe(steps: Array, bounds: NDArray[np.intp], which: NDArray[np.intp]) -> Array:
    total = np.cumsum(steps, axis=0)
    before = np.concatenate([np.zeros((1, 3)), total[bounds[1:-1] - 1]])
    since: Array = total - before[which]
    return since


def _covariances(
    keyframes: Trajectory, T: Array, noise: list[ImuNoise], which: NDArray[np.intp], u: Array
) -> Array:
    """Pose covariances at every node: the keyframes' own, mixed, and the noise of the bridge between them.

    The error of the path is the mixture of the two ends' errors, so the mixture of their covariances is an
    upper bound whatever their correlation. A bridge of white noise of density d over a span S adds
    d² S u (1 - u) to a turn and d² S³ (u (1 - u))³ / 3 to a position.
    """
    assert keyframes.covariances is not None
    in_map = _turned(keyframes.covariances, keyframes.T_map_imu[:, :3, :3])
    mixed, change = in_map[np.append(which, -1)], np.diff(in_map, axis=0)[which]
    change *= u[:, None, None]
    mixed[:-1] += change
    spans, bridge = np.diff(keyframes.stamps), u * (1 - u)
    rotation = np.array([n.gyroscope_noise_density**2 for n in noise]) * spans
    position = np.array([n.accelerometer_noise_density**2 for n in noise]) * spans**3 / 3
    for axis in range(3):
        mixed[:-1, axis, axis] += rotation[which] * bridge
        mixed[:-1, 3 + axis, 3 + axis] += position[which] * bridge**3
    return _turned(mixed, np.swapaxes(T[:, :3, :3], 1, 2))


def _turned(covariances: Array, R: Array) -> Array:
    """Covariances (n, 6, 6) of rotation and translation, both seen in axes turned by R (n, 3, 3)."""
    both = np.zeros_like(covariances)
    both[:, :3, :3] = both[:, 3:, 3:] = R
    back = np.swapaxes(both, 1, 2).copy()  # NumPy takes twice as long for a view
    return np.asarray(both @ covariances @ back, np.float64)

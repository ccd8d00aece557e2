"""A drive in short: what its whole graph says of some keyframes, the anchors, about a second apart.

All other keyframes are eliminated. What they leave is exact while corrections stay small enough to be linear: a rigid
motion of the whole drive is, in the tangents of its poses, however large it is.
"""

import io
from collections import deque
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from factor_graphs.elimination import PLACES, SIZE, eliminate, split, split_key, state_keys
from factor_graphs.model import motion_from
from factor_graphs.problem import Fit, Problem
from factor_graphs.trajectory import Trajectory

Array = NDArray[np.float64]

# Without relative poses anchors are so far apart, s.
ANCHOR_S = 1.5
# Standard deviations of what stands.
FIXED_RAD, FIXED_M = 1e-7, 1e-3


@dataclass(frozen=True, eq=False)
class Rows:
    """Some equations A x = b of unit variance: `anchors` (n,) they speak of, `A` (m, 15 n), `b` (m,).

    The 15 numbers of an anchor are the tangent of its pose, its velocity, its biases. One anchor beyond the last stands
    for what all keyframes share: the mounting of the IMU and the calibration of the wheels.
    """

    anchors: NDArray[np.intp]
    A: Array
    b: Array


@dataclass(frozen=True, eq=False)
class CondensedDrive:
    """The anchors of a drive, and what its graph says of corrections to them.

    `stamps` (a,) s; `T_map_imu` (a, 4, 4); `rows`: the equations of the corrections; `position_variances` (3,) m² east,
    north, up: how much all of them may be wrong together beside that, for an inertial unit whose positions drift.
    """

    stamps: Array
    T_map_imu: Array
    rows: tuple[Rows, ...]
    position_variances: Array

    @staticmethod
    def fixed() -> "CondensedDrive":
        """What stands: one anchor at the origin of the map, which hardly moves."""
        prior = np.zeros((6, SIZE))
        prior[:, :6] = np.diag(np.repeat([1 / FIXED_RAD, 1 / FIXED_M], 3))
        rows = (Rows(np.array([0]), prior, np.zeros(6)),)
        return CondensedDrive(np.zeros(1), np.eye(4)[None], rows, np.zeros(3))

    def __len__(self) -> int:
        return len(self.stamps)

    def at(self, trajectory: Trajectory) -> "CondensedDrive":
        """The same drive with the poses of its trajectory in another map frame: the equations stay as they are."""
        return replace(self, T_map_imu=trajectory.at(self.stamps))

    def to_bytes(self) -> bytes:
        """As a NumPy archive, nothing rounded."""
        file = io.BytesIO()
        np.savez(
            file,
            stamps=self.stamps,
            T_map_imu=self.T_map_imu,
            position_variances=self.position_variances,
            shapes=np.array([(len(part.anchors), len(part.b)) for part in self.rows], np.intp),
            anchors=np.concatenate([part.anchors for part in self.rows]),
            A=np.concatenate([part.A.ravel() for part in self.rows]),
            b=np.concatenate([part.b for part in self.rows]),
        )
        return file.getvalue()

    @staticmethod
    def from_bytes(content: bytes) -> "CondensedDrive":
        """What `to_bytes` made."""
        with np.load(io.BytesIO(content)) as arrays:
            anchors, m = arrays["shapes"].T
            parts = zip(
                np.split(arrays["anchors"], np.cumsum(anchors)[:-1]),
                np.split(arrays["A"], np.cumsum(m * SIZE * anchors)[:-1]),
                np.split(arrays["b"], np.cumsum(m)[:-1]),
                strict=True,
            )
            rows = tuple(Rows(of_part, A.reshape(len(b), -1), b) for of_part, A, b in parts)
            return CondensedDrive(arrays["stamps"], arrays["T_map_imu"], rows, arrays["position_variances"])


def condense(problem: Problem, fit: Fit, position_variances: Array) -> CondensedDrive:
    """The solution of a drive, reduced to its anchors."""
    anchors = _anchors(problem)
    place = {int(keyframe): n for n, keyframe in enumerate(anchors)} | {
        len(problem.intervals.keyframes): len(anchors)
    }
    T, _ = motion_from(fit.values)
    rows = tuple(_rows(factor, place) for factor in _remaining(fit, np.setdiff1d(np.arange(len(T)), anchors)))
    return CondensedDrive(problem.intervals.keyframes[anchors], T[anchors], rows, position_variances)


def _anchors(problem: Problem) -> NDArray[np.intp]:
    """Keyframes that relative poses lead from to more than the next one, the ends of the drive, and some in between.

    Between two of them, LiDAR odometry binds a keyframe to nothing but its neighbours and the last anchor: so what the
    keyframes in between leave speaks of two anchors.
    """
    stamps, (first, last) = problem.intervals.keyframes, problem.relative_at.T
    wanted = np.zeros(len(stamps), np.bool_)
    wanted[first[last > first + 1]] = True
    wanted[[0, -1]] = True
    before = -np.inf
    for i, stamp in enumerate(stamps.tolist()):
        wanted[i] |= stamp - before >= ANCHOR_S
        before = stamp if wanted[i] else before
    return np.flatnonzero(wanted)


def _remaining(fit: Fit, others: NDArray[np.intp]) -> list[gtsam.GaussianFactor]:
    """The factors between anchors that are left when all `others` are eliminated."""
    groups = [state_keys(i) for i in others.tolist()]
    *parts, between = split(fit.graph, groups)
    left: list[gtsam.GaussianFactor] = []
    deque(eliminate((part.linearize(fit.values) for part in parts), groups, left), maxlen=0)
    linear = between.linearize(fit.values)
    return [*(linear.at(n) for n in range(linear.size())), *left]


def _rows(factor: gtsam.GaussianFactor, place: dict[int, int]) -> Rows:
    A, b = factor.jacobian()
    keys = [split_key(key) for key in list(factor.keys())]
    anchors = sorted({place[index] for _, index in keys})
    start = {anchor: SIZE * n for n, anchor in enumerate(anchors)}
    spread, column = np.zeros((len(b), SIZE * len(anchors))), 0
    for letter, index in keys:
        part = PLACES[letter]
        width, first = part.stop - part.start, start[place[index]] + part.start
        spread[:, first : first + width] = A[:, column : column + width]
        column += width
    return Rows(np.array(anchors, np.intp), spread, np.asarray(b, np.float64))

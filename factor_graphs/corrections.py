"""A trajectory moved with its anchors: between two of them, the motion of one fades into that of the next."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Correction:
    """How some anchors of a trajectory move: `stamps` (a,) s, poses `before` and `after` (a, 4, 4) in one map frame.

    `covariances` (a, 6, 6) are of the tangents after, as in `Trajectory`. There are two anchors at least.
    """

    stamps: Array
    before: Array
    after: Array
    covariances: Array

    def of(self, trajectory: Trajectory) -> Trajectory:
        """The trajectory with its anchors moved; what a covariance has more than those of the anchors, it keeps."""
        i, u = _segments(trajectory.stamps, self.stamps)
        turns = Rotation.from_matrix(self.after[:, :3, :3] @ np.swapaxes(self.before[:, :3, :3], 1, 2))
        vectors = turns.as_rotvec()
        early, late = self._shifts(turns, i, trajectory), self._shifts(turns, i + 1, trajectory)
        turn = Rotation.from_rotvec((1 - u) * vectors[i] + u * vectors[i + 1]).as_matrix()
        T = trajectory.T_map_imu.copy()
        T[:, :3, 3] += (1 - u) * early + u * late
        T[:, :3, :3] = turn @ T[:, :3, :3]
        velocities = trajectory.velocities
        if velocities is not None:
            inside = (trajectory.stamps >= self.stamps[0]) & (trajectory.stamps <= self.stamps[-1])
            growing = (late - early) / np.diff(self.stamps)[i, None] * inside[:, None]
            velocities = np.einsum("kij,kj->ki", turn, velocities) + growing
        return Trajectory(trajectory.stamps, T, velocities, self._covariances(trajectory, i, u))

    def _shifts(self, turns: Rotation, anchor: NDArray[np.intp], trajectory: Trajectory) -> Array:
        """How far the rigid motions of these anchors, one for each pose, move the positions (k, 3)."""
        arm = trajectory.positions - self.before[anchor, :3, 3]
        moved: Array = self.after[anchor, :3, 3] - self.before[anchor, :3, 3] + turns[anchor].apply(arm) - arm
        return moved

    def _covariances(self, trajectory: Trajectory, i: NDArray[np.intp], u: Array) -> Array | None:
        if trajectory.covariances is None:
            return None
        at_anchors = np.searchsorted(trajectory.stamps, self.stamps).clip(max=len(trajectory) - 1)
        own, u = trajectory.covariances[at_anchors], u[:, :, None]
        more = trajectory.covariances - (1 - u) * own[i] - u * own[i + 1]
        values, axes = np.linalg.eigh((more + np.swapaxes(more, 1, 2)) / 2)
        more = (axes * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2)
        moved: Array = (1 - u) * self.covariances[i] + u * self.covariances[i + 1] + more
        return moved


def _segments(t: Array, stamps: Array) -> tuple[NDArray[np.intp], Array]:
    """The anchor before each stamp, and how far (k, 1) it is on the way to the next one, from 0 to 1."""
    i = np.clip(np.searchsorted(stamps, t, side="right") - 1, 0, len(stamps) - 2)
    return i, np.clip((t - stamps[i]) / (stamps[i + 1] - stamps[i]), 0.0, 1.0)[:, None]

"""How the vehicle moved from one moment to another, as LiDAR odometry and the like report it: no scans here."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from factor_graphs.errors import MeasurementError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RelativePoses:
    """Poses of the imu at one stamp in the imu frame of an earlier one, with covariance.

    `stamps` (k, 2) s, the earlier first; `T_imu_imu` (k, 4, 4): p_earlier = T_imu_imu p_later; `covariances`
    (k, 6, 6) of the tangent (rotation rad, translation m, in the axes of the later imu) with
    T = T_imu_imu Exp(tangent): the order of GTSAM's BetweenFactor. None at all is a legal value. Raises
    MeasurementError for another shape, values that are not finite, stamps out of order, a matrix that is no
    rigid transform and a covariance that is not positive definite.
    """

    stamps: Array
    T_imu_imu: Array
    covariances: Array

    def __post_init__(self) -> None:
        k = len(self.stamps)
        shapes = {"stamps": (k, 2), "T_imu_imu": (k, 4, 4), "covariances": (k, 6, 6)}
        for field in fields(self):
            array = np.array(getattr(self, field.name), dtype=np.float64)
            if array.shape != shapes[field.name] or not np.isfinite(array).all():
                raise MeasurementError(
                    f"RelativePoses.{field.name} has shape {array.shape}; expected {shapes[field.name]}, all finite"
                )
            array.setflags(write=False)
            object.__setattr__(self, field.name, array)
        self._check()

    def _check(self) -> None:
        R = self.T_imu_imu[:, :3, :3]
        off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        rigid = (off < 1e-6) & (np.linalg.det(R) > 0) & (self.T_imu_imu[:, 3] == [0, 0, 0, 1]).all(axis=1)
        least = np.linalg.eigvalsh(self.covariances).min(axis=1, initial=np.inf)
        for good, what in (
            (self.stamps[:, 1] > self.stamps[:, 0], "stamps do not go forward in time"),
            (rigid, "T_imu_imu is no rigid transform"),
            (least > 0, "covariance is not positive definite"),
        ):
            if not good.all():
                row = int(np.flatnonzero(~good)[0])
                earlier, later = self.stamps[row]
                raise MeasurementError(
                    f"RelativePoses[{row}], {earlier:.3f} to {later:.3f} s: {what}; leave such pairs out"
                )

    def __add__(self, other: RelativePoses) -> RelativePoses:
        return RelativePoses(
            *(
                np.concatenate([getattr(self, field.name), getattr(other, field.name)])
                for field in fields(self)
            )
        )

    def __len__(self) -> int:
        return len(self.stamps)

    def __getitem__(self, rows: slice | NDArray[np.bool_] | NDArray[np.intp]) -> RelativePoses:
        return RelativePoses(self.stamps[rows], self.T_imu_imu[rows], self.covariances[rows])


NO_RELATIVE_POSES = RelativePoses(np.empty((0, 2)), np.empty((0, 4, 4)), np.empty((0, 6, 6)))

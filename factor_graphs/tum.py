"""The trajectory as text files of the field: TUM for evo, and "wide TUM", with covariances, for smfeval."""

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.errors import MeasurementError
from factor_graphs.trajectory import Trajectory

TUM_FORMAT = ["%.9f", *["%.6f"] * 3, *["%.12f"] * 4]


def write_tum(trajectory: Trajectory, file: Path | str | BinaryIO) -> None:
    """Write `stamp tx ty tz qx qy qz qw` of T_map_imu, one pose per line, stamps in seconds of the log.

    Stamps keep the nanosecond, positions the micrometre. `file` is a path or a file open for writing. Raises OSError
    when it cannot be written.
    """
    np.savetxt(file, _tum_rows(trajectory), fmt=TUM_FORMAT)


def write_covariance_tum(trajectory: Trajectory, file: Path | str | BinaryIO) -> None:
    """Write every pose as `write_tum` does, then its covariance: 29 numbers per line, the "wide TUM" of smfeval.

    The last 21 are the lower triangle, row by row, of the covariance (6, 6) of the tangent (translation m, rotation
    rad, in the axes of the imu) with T_true = T Exp(tangent). Raises MeasurementError without covariances, and OSError
    as `write_tum` does.
    """
    if trajectory.covariances is None:
        raise MeasurementError("the trajectory has no covariances: write it with write_tum")
    order = [3, 4, 5, 0, 1, 2]  # the trajectory has rotations first
    rows, columns = np.tril_indices(6)
    lower = trajectory.covariances[:, order][:, :, order][:, rows, columns]
    np.savetxt(file, np.hstack([_tum_rows(trajectory), lower]), fmt=[*TUM_FORMAT, *["%.8g"] * 21])


def _tum_rows(trajectory: Trajectory) -> NDArray[np.float64]:
    quat_xyzw = Rotation.from_matrix(trajectory.T_map_imu[:, :3, :3]).as_quat(canonical=True)
    return np.column_stack([trajectory.stamps, trajectory.positions, quat_xyzw])

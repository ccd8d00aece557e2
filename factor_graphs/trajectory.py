"""Where the vehicle was: poses over stamps, at any stamp in between, and on disk."""

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.errors import MeasurementError

Array = NDArray[np.float64]

TANGENT = ("rx", "ry", "rz", "tx", "ty", "tz")
_UPPER = np.triu_indices(6)
_COVARIANCE_COLUMNS = [f"cov_{TANGENT[i]}_{TANGENT[j]}" for i, j in zip(*_UPPER, strict=True)]
AROUND_S = 0.1
MOST_BYTES, MOST_ROWS, MOST_COLUMNS = 1 << 30, 5_000_000, 100
_METADATA = {
    "frame": "pose of the imu frame (x forward, y left, z up) in the map frame (east, north, up)",
    "units": "stamp_s s; x y z m; qx qy qz qw unit quaternion, scalar last; vx vy vz m/s in the map frame",
    "covariance": "of (rx ry rz rad, tx ty tz m): T = T_estimate Exp(tangent), axes of the imu frame",
}


class _Segments(NamedTuple):
    """The way from each knot to the next."""

    duration: Array  # (k,) s
    step: Array  # (k, 3) m
    turn: Array  # (k, 3) rad, a rotation vector in the axes of the first


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of the imu frame in the map frame over time.

    `stamps` (k,) s, strictly increasing; `T_map_imu` (k, 4, 4); `velocities` (k, 3) m/s in the map frame,
    or None; `covariances` (k, 6, 6) or None, of the tangent (rotation rx ry rz in rad, translation tx ty tz
    in m, both in imu axes) with T = T_estimate Exp(tangent): the order of GTSAM's Pose3. Raises
    MeasurementError for another shape, values that are not finite, and stamps out of order.
    """

    stamps: Array
    T_map_imu: Array
    velocities: Array | None = None
    covariances: Array | None = None

    def __post_init__(self) -> None:
        k = len(self.stamps)
        for name, shape in (
            ("stamps", (k,)), ("T_map_imu", (k, 4, 4)), ("velocities", (k, 3)), ("covariances", (k, 6, 6))
        ):  # fmt: skip
            given = getattr(self, name)
            if given is None:
                continue
            array = np.asarray(given, dtype=np.float64)
            if array.flags.writeable:  # what nobody can change need not be copied
                array = array.copy()
                array.setflags(write=False)
            if k == 0 or array.shape != shape or not np.isfinite(array).all():
                raise MeasurementError(
                    f"Trajectory.{name} has shape {array.shape}; expected {shape}, not empty, all finite"
                )
            object.__setattr__(self, name, array)
        if np.any(np.diff(self.stamps) <= 0):
            raise MeasurementError(
                "Trajectory.stamps must be strictly increasing; sort them and drop repeats"
            )

    def __len__(self) -> int:
        return len(self.stamps)

    def __getitem__(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> "Trajectory":
        """Some of the poses, in order of time and at least one."""
        velocities, covariances = (
            None if each is None else each[rows] for each in (self.velocities, self.covariances)
        )
        return Trajectory(self.stamps[rows], self.T_map_imu[rows], velocities, covariances)

    @property
    def start(self) -> float:
        """First stamp, s."""
        return float(self.stamps[0])

    @property
    def end(self) -> float:
        """Last stamp, s."""
        return float(self.stamps[-1])

    @property
    def positions(self) -> Array:
        """Positions of the imu in the map frame, (k, 3) m."""
        return self.T_map_imu[:, :3, 3]

    @property
    def position_covariances(self) -> Array:
        """Covariances of the positions along east, north, up, (k, 3, 3) m²; raises MeasurementError without any."""
        if self.covariances is None:
            raise MeasurementError("this trajectory has no covariances")
        R = self.T_map_imu[:, :3, :3]
        return np.asarray(R @ self.covariances[:, 3:, 3:] @ np.swapaxes(R, 1, 2))

    @property
    def position_stddevs(self) -> Array:
        """Standard deviations of the positions along east, north, up, (k, 3) m."""
        return np.sqrt(np.diagonal(self.position_covariances, axis1=1, axis2=2))

    def during(self, first: float, last: float) -> "Trajectory":
        """The poses from `first` to `last` s, and those within 0.1 s around; all of them where there are none."""
        inside = (self.stamps >= first - AROUND_S) & (self.stamps <= last + AROUND_S)
        return self[inside] if inside.any() else self

    def moved(self, T: Array) -> "Trajectory":
        """The same trajectory in another map frame, T = T_other_map (4, 4); covariances are in imu axes and stay."""
        velocities = None if self.velocities is None else self.velocities @ T[:3, :3].T
        return Trajectory(self.stamps, T @ self.T_map_imu, velocities, self.covariances)

    def at(self, stamps: ArrayLike, extrapolate_s: float = 0.0) -> Array:
        """Poses at any stamps (j,) s -> T_map_imu (j, 4, 4), exact at the knots.

        Position: cubic Hermite where velocities are known, else linear; rotation: constant rate (slerp).
        Up to `extrapolate_s` beyond either end the last velocity and rate go on. Raises MeasurementError
        when a stamp lies farther outside.
        """
        t = np.asarray(stamps, dtype=np.float64)
        self._check_span(t, extrapolate_s)
        segments = self._segments
        i = np.clip(np.searchsorted(self.stamps, t, side="right") - 1, 0, len(self) - 1)
        u = ((t - self.stamps[i]) / segments.duration[i])[:, None]
        T = np.zeros((len(t), 4, 4))
        T[:, :3, :3] = self.T_map_imu[i, :3, :3] @ Rotation.from_rotvec(u * segments.turn[i]).as_matrix()
        T[:, :3, 3] = self.positions[i] + self._moved(i, u, segments)
        T[:, 3, 3] = 1.0
        return T

    def _moved(self, i: NDArray[np.intp], u: Array, segments: _Segments) -> Array:
        """How far from knots i (j,) the imu is at shares u (j, 1) of the segments after them, (j, 3) m."""
        step, h = segments.step[i], segments.duration[i, None]
        if self.velocities is None:
            return u * step
        last = len(self) - 1
        v0, v1 = self.velocities[i] * h, self.velocities[np.minimum(i + 1, last)] * h
        moved: Array = u * (v0 + u * (3 * step - 2 * v0 - v1 + u * (v0 + v1 - 2 * step)))
        beyond = (u < 0) | (i == last)[:, None]
        return np.where(beyond, u * v0, moved)

    def _check_span(self, t: Array, extrapolate_s: float) -> None:
        if t.ndim != 1 or not np.isfinite(t).all():
            raise MeasurementError(f"stamps have shape {t.shape}; expected (j,), all finite")
        if len(t) and (t.min() < self.start - extrapolate_s or t.max() > self.end + extrapolate_s):
            raise MeasurementError(
                f"stamps {t.min():.3f}..{t.max():.3f} s leave the trajectory "
                f"{self.start:.3f}..{self.end:.3f} s by more than {extrapolate_s:g} s; drop them"
            )

    @cached_property
    def _segments(self) -> _Segments:
        R = self.T_map_imu[:, :3, :3]
        h, step = np.diff(self.stamps), np.diff(self.positions, axis=0)
        turn = Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).as_rotvec() if len(h) else step
        # one more segment, after the last knot, goes on for a second as the one before it ends
        step, turn = (
            np.vstack([of_segment, of_segment[-1:] / h[-1:, None] if len(h) else np.zeros((1, 3))])
            for of_segment in (step, turn)
        )
        return _Segments(np.append(h, 1.0), step, turn)

    def save(self, path: Path | str) -> None:
        """Write the trajectory as a Parquet table, units and frame in its schema metadata."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        quat_xyzw = Rotation.from_matrix(self.T_map_imu[:, :3, :3]).as_quat()
        columns = dict(zip(("stamp_s", "x", "y", "z"), (self.stamps, *self.positions.T), strict=True))
        columns |= dict(zip(("qx", "qy", "qz", "qw"), quat_xyzw.T, strict=True))
        if self.velocities is not None:
            columns |= dict(zip(("vx", "vy", "vz"), self.velocities.T, strict=True))
        if self.covariances is not None:
            columns |= dict(zip(_COVARIANCE_COLUMNS, self.covariances[:, *_UPPER].T, strict=True))
        table = pa.table({name: np.ascontiguousarray(c) for name, c in columns.items()})
        pq.write_table(table.replace_schema_metadata(_METADATA), path)

    @staticmethod
    def load(path: Path | str) -> "Trajectory":
        """Read a trajectory that `save` wrote; raises MeasurementError when the file is not such a table."""
        columns = _columns(Path(path))
        pose = ("stamp_s", "x", "y", "z", "qx", "qy", "qz", "qw")
        missing = [name for name in pose if name not in columns]
        if missing:
            raise MeasurementError(f"{path}: no column {', '.join(missing)}; expected {', '.join(pose)}")
        stamps, *position_and_quat = (columns[name] for name in pose)
        quat_xyzw = np.column_stack(position_and_quat[3:])
        if not ((np.abs(quat_xyzw) <= 1.001).all() and np.allclose((quat_xyzw**2).sum(axis=1), 1, atol=2e-3)):
            raise MeasurementError(
                f"{path}: found quaternions that are no rotation; expected qx qy qz qw of length one"
            )
        T = np.tile(np.eye(4), (len(stamps), 1, 1))
        T[:, :3, 3] = np.column_stack(position_and_quat[:3])
        T[:, :3, :3] = Rotation.from_quat(quat_xyzw).as_matrix()
        velocities = covariances = None
        try:
            if "vx" in columns:
                velocities = np.column_stack([columns[name] for name in ("vx", "vy", "vz")])
            if _COVARIANCE_COLUMNS[0] in columns:
                covariances = np.zeros((len(stamps), 6, 6))
                covariances[:, *_UPPER] = np.column_stack([columns[name] for name in _COVARIANCE_COLUMNS])
                lower = _UPPER[::-1]
                covariances[:, *lower] = covariances[:, *_UPPER]
        except KeyError as error:
            raise MeasurementError(
                f"{path}: no column {error.args[0]} beside the others of its kind"
            ) from None
        return Trajectory(stamps, T, velocities, covariances)


def _columns(path: Path) -> dict[str, Array]:
    """The columns of a Parquet table of numbers; raises MeasurementError for anything else, before it is unpacked."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        if path.exists() and not path.is_file():
            raise MeasurementError(f"{path}: found no ordinary file; expected a saved trajectory")
        with path.open("rb") as file:
            if (size := os.fstat(file.fileno()).st_size) > MOST_BYTES:
                raise MeasurementError(f"{path}: found {size} bytes, expected at most {MOST_BYTES}")
            content = file.read()
        table_file = pq.ParquetFile(pa.BufferReader(content))
        rows, schema = table_file.metadata.num_rows, table_file.schema_arrow
        other = [field.name for field in schema if field.type != pa.float64()]
        if rows > MOST_ROWS or len(schema) > MOST_COLUMNS or other:
            raise MeasurementError(
                f"{path}: found {rows} rows of {len(schema)} columns, other than numbers {other[:5]}; expected a saved"
                " trajectory"
            )
        table = table_file.read()
        if gaps := [name for name in table.column_names if table[name].null_count]:
            raise MeasurementError(
                f"{path}: found gaps in the columns {gaps[:5]}; expected a saved trajectory"
            )
        # `to_numpy` imports pandas, which takes 0.3 s
        return {
            name: np.array(np.from_dlpack(table[name].combine_chunks()), np.float64)
            for name in table.column_names
        }
    except FileNotFoundError:
        raise MeasurementError(f"{path}: no such file; expected a saved trajectory") from None
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        if isinstance(error, MeasurementError):
            raise
        reason = " ".join(str(error).split())[:200]
        raise MeasurementError(f"{path}: not a Parquet file ({reason})") from None

"""The trajectory for the tools of inertial post-processing: SBET, and roll, pitch and heading as a table.

Their axes: north, east, down, and a body that looks forward, right, down. Roll is positive with the right side down,
pitch with the nose up, heading clockwise from north; R = Rz(heading) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.datasets.gnss_files.sbet import FRD_OF_FLU, NED_OF_ENU
from gnss_sem_map.datasets.gnss_files.time_systems import GPS_EPOCH_NS, WEEK_NS, gps_of_utc_ns
from gnss_sem_map.files.atomic import replacing

Array = NDArray[np.float64]

STEP_S = 0.1
"""Between the rows of the table."""
COLUMNS = (
    "stamp_s", "lat_deg", "lon_deg", "alt_m", "roll_deg", "pitch_deg", "heading_deg",
    "std_e_m", "std_n_m", "std_u_m", "std_roll_deg", "std_pitch_deg", "std_heading_deg", "fixes", "fixes_rejected",
    "nearest_fix_s",
)  # fmt: skip


def write_sbet(trajectory: Trajectory, frame: LocalFrame, epoch_ns: int, path: Path | str) -> None:
    """Write an SBET: 17 little-endian doubles per pose, SI units and radians (Applanix; PDAL's readers.sbet).

    GPS seconds of the week of the first pose; latitude, longitude, height; velocity north, east, down; roll, pitch,
    heading; wander angle, zero; acceleration of the body without gravity, and its angular rate, both forward, right,
    down. Raises DataError when the file cannot be written.
    """
    gps_ns = gps_of_utc_ns(epoch_ns + np.round(1e9 * trajectory.stamps).astype(np.int64)) - GPS_EPOCH_NS
    seconds = (gps_ns - gps_ns[0] // WEEK_NS * WEEK_NS) * 1e-9
    lat, lon, alt = frame.to_geodetic(trajectory.positions)
    R_map_ned, R = _axes(trajectory, frame)
    velocity = _velocities(trajectory)
    acceleration = np.gradient(velocity, trajectory.stamps, axis=0) if len(velocity) > 1 else 0 * velocity
    R_map_body = trajectory.T_map_imu[:, :3, :3] @ FRD_OF_FLU
    rows = np.column_stack([
        seconds, np.radians(lat), np.radians(lon), alt, _turned_back(R_map_ned, velocity), _angles(R),
        np.zeros(len(R)), _turned_back(R_map_body, acceleration), _rates(trajectory) @ FRD_OF_FLU,
    ])  # fmt: skip
    with replacing(path) as file:
        file.write(rows.astype("<f8").tobytes())


def write_attitude(
    trajectory: Trajectory,
    frame: LocalFrame,
    path: Path | str,
    fix_stamps: Array | None = None,
    rejected: NDArray[np.bool_] | None = None,
) -> None:
    """Write a CSV file of COLUMNS, a row in 0.1 s: place and attitude, their standard deviations, and the fixes.

    `fixes` is how many of `fix_stamps` (m,) s lie since the row before, `fixes_rejected` how many of these are
    `rejected` (m,); `nearest_fix_s` is from the nearest one that was not. Without covariances, deviations are empty.
    Raises DataError when the file cannot be written.
    """
    t = trajectory.stamps
    track = trajectory[
        np.unique(np.searchsorted(t, np.arange(t[0], t[-1] + STEP_S / 2, STEP_S)).clip(max=len(t) - 1))
    ]
    angles = np.degrees(_angles(_axes(track, frame)[1]))
    of_fixes = fixes_along(track.stamps, fix_stamps, rejected)
    numbers = np.column_stack(
        [track.stamps, *frame.to_geodetic(track.positions), angles, _stddevs(track, angles)]
    )
    with replacing(path) as file:
        file.write((",".join(COLUMNS) + "\n").encode())
        for values in np.column_stack([numbers, *of_fixes.values()]).tolist():
            cells = ("" if np.isnan(value) else f"{value:.10g}" for value in values[4:])
            place = f"{values[0]:.6f},{values[1]:.10f},{values[2]:.10f},{values[3]:.4f}"
            file.write(f"{place},{','.join(cells)}\n".encode())


def fixes_along(
    stamps: Array, fix_stamps: Array | None, rejected: NDArray[np.bool_] | None
) -> dict[str, Array]:
    """Columns of a track with `stamps` (k,) s, by fixes (m,): how many lie since the row before, and how many of these
    were rejected; how many seconds it is to the nearest that was not, NaN where there is none.
    """
    fixes = np.empty(0) if fix_stamps is None else fix_stamps
    bad = np.zeros(len(fixes), np.bool_) if rejected is None else rejected
    row = np.searchsorted(stamps, fixes)
    inside = (row < len(stamps)) & (fixes >= stamps[0])
    counts = [np.bincount(row[rows], minlength=len(stamps)) for rows in (inside, inside & bad)]
    used = np.concatenate([[-np.inf], np.sort(fixes[~bad]), [np.inf]])
    after = np.searchsorted(used, stamps)
    nearest = np.minimum(used[after] - stamps, stamps - used[after - 1])
    return {
        "fixes": counts[0], "fixes_rejected": counts[1],
        "nearest_fix_s": np.where(np.isfinite(nearest), nearest, np.nan),
    }  # fmt: skip


def _axes(trajectory: Trajectory, frame: LocalFrame) -> tuple[Array, Array]:
    """Axes north, east, down at every pose in the map's, and the body's axes in these, (k, 3, 3) each."""
    R_map_ned = frame.axes_at(trajectory.positions) @ NED_OF_ENU.T
    R_map_body = trajectory.T_map_imu[:, :3, :3] @ FRD_OF_FLU
    return R_map_ned, np.swapaxes(R_map_ned, 1, 2) @ R_map_body


def _angles(R_ned_body: Array) -> Array:
    """Roll, pitch, heading (k, 3) rad, heading from 0 to 2 pi."""
    angles = Rotation.from_matrix(R_ned_body).as_euler("ZYX")[:, ::-1]
    return np.column_stack([angles[:, :2], angles[:, 2] % (2 * np.pi)])


def _velocities(trajectory: Trajectory) -> Array:
    """(k, 3) m/s in the map frame."""
    if trajectory.velocities is not None:
        return np.asarray(trajectory.velocities)
    if len(trajectory) < 2:
        return np.zeros((len(trajectory), 3))
    return np.asarray(np.gradient(trajectory.positions, trajectory.stamps, axis=0))


def _rates(trajectory: Trajectory) -> Array:
    """Angular rate (k, 3) rad/s in the imu's axes, from pose to pose; that of the Earth is not in it."""
    R = trajectory.T_map_imu[:, :3, :3]
    if len(R) < 2:
        return np.zeros((len(R), 3))
    turns = Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).as_rotvec()
    rates = turns / np.diff(trajectory.stamps)[:, None]
    return np.asarray(np.vstack([rates[:1], (rates[1:] + rates[:-1]) / 2, rates[-1:]]))


def _turned_back(R: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("kij,ki->kj", R, vectors))


def _stddevs(track: Trajectory, angles_deg: Array) -> Array:
    """Of place east, north, up m, and of roll, pitch, heading degrees, (k, 6); NaN without covariances.

    How the angles change with a turn about the axes of the body: the matrix of Euler's rates (Groves 2013, eq. 2.59).
    """
    if track.covariances is None:
        return np.full((len(track), 6), np.nan)
    (roll, pitch, _), ones = np.radians(angles_deg).T, np.ones(len(track))
    J = np.array([
        [ones, np.sin(roll) * np.tan(pitch), np.cos(roll) * np.tan(pitch)],
        [0 * ones, np.cos(roll), -np.sin(roll)],
        [0 * ones, np.sin(roll) / np.cos(pitch), np.cos(roll) / np.cos(pitch)],
    ]).transpose(2, 0, 1) @ FRD_OF_FLU  # fmt: skip
    variances = np.einsum("kij,kjl,kil->ki", J, track.covariances[:, :3, :3], J)
    return np.hstack([track.position_stddevs, np.degrees(np.sqrt(variances))])

"""SBET, the smoothed best estimate of trajectory of an inertial unit: 17 doubles per row, in SI units and radians.

Times are seconds of the GPS week; roll, pitch and platform heading turn north, east, down to a body that looks forward,
right, down: R = Rz(heading - wander angle) Ry(pitch) Rx(roll).

Its errors are in a file of their own (smrmsg), ten doubles per row: time, then the RMS of north, east and down.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.datasets.gnss_files.positions import STEP_S, Positions, thinned
from gnss_sem_map.datasets.gnss_files.time_systems import (
    GPS_EPOCH_NS,
    WEEK_NS,
    gps_minus_utc_s,
    nearest,
)
from gnss_sem_map.files.untrusted import read_bytes, refused

Array = NDArray[np.float64]

COLUMNS, ACCURACY_COLUMNS = 17, 10
MOST_TESTED = 100
WEEK_S = 7 * 86_400.0
NED_OF_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_OF_FLU = np.diag([1.0, -1.0, -1.0])


def read(path: Path, near_ns: int | None, accuracy: Path | None, has_stddevs: bool) -> Positions:
    """Positions at 10 Hz; raises DataError for a file that is no SBET, or whose accuracy or week is unknown."""
    seconds, lat, lon, height = _sbet_rows(path)[:, :4].T
    if accuracy is None and not has_stddevs:
        raise refused(path, "an SBET tells no accuracy; set `accuracy:` to its smrmsg file, or `stddevs_m:`")
    if near_ns is None:
        raise refused(path, "an SBET does not tell its week, and no other sensor of this log does")
    kept = thinned(seconds)
    stamps = _gps_ns(seconds[kept], near_ns)
    stddevs = np.ones((len(kept), 3)) if accuracy is None else _stddevs(accuracy, seconds[kept])
    geodetic = np.column_stack([np.degrees(lat), np.degrees(lon), height])[kept]
    return Positions(stamps, geodetic, stddevs, "gps", [])


def is_sbet(content: bytes) -> bool:
    """Whether bytes are rows of an SBET, by their number, their times and their latitudes."""
    if not content or len(content) % (8 * COLUMNS):
        return False
    rows = np.frombuffer(content, "<f8").reshape(-1, COLUMNS)[:MOST_TESTED]
    with np.errstate(invalid="ignore"):
        is_of_week = (rows[:, 0] > 0).all() and (rows[:, 0] < 2 * WEEK_S).all()
        return bool(
            is_of_week and (np.abs(rows[:, 1]) <= np.pi / 2).all() and (np.diff(rows[:, 0]) > 0).all()
        )


def read_poses(path: Path, near_ns: int) -> tuple[NDArray[np.int64], Array, Array]:
    """Unix ns (n,), in the week nearest to `near_ns`; degrees and m (n, 3); R_local_imu (n, 3, 3), east, north, up.

    Our imu looks forward, left, up. Raises DataError for a file that is no SBET.
    """
    rows = _sbet_rows(path)
    stamps = _gps_ns(rows[:, 0], near_ns)
    if not (np.abs(rows[:, 7:11]) <= 4 * np.pi).all():
        raise refused(path, f"found attitudes that are no radians, expected rows of {COLUMNS} doubles (SBET)")
    roll, pitch, heading = rows[:, 7], rows[:, 8], rows[:, 9] - rows[:, 10]
    R = Rotation.from_euler("ZYX", np.column_stack([heading, pitch, roll])).as_matrix()
    geodetic = np.column_stack([np.degrees(rows[:, 1]), np.degrees(rows[:, 2]), rows[:, 3]])
    return stamps - gps_minus_utc_s(stamps) * 1_000_000_000, geodetic, NED_OF_ENU.T @ R @ FRD_OF_FLU


def over_weeks(seconds: Array) -> Array:
    """Times of a week (n,) s that begin anew with the next one, going on."""
    return seconds + WEEK_S * np.cumsum(np.diff(seconds, prepend=seconds[:1]) < -WEEK_S / 2)


def _gps_ns(seconds: Array, near_ns: int) -> NDArray[np.int64]:
    """Times of a week, s, as ns of GPS time since 1970."""
    return nearest(GPS_EPOCH_NS + np.round(seconds * 1e9).astype(np.int64), WEEK_NS, near_ns)


def _sbet_rows(path: Path) -> Array:
    rows = _rows(path, COLUMNS)
    lat, lon, height = rows[:, 1:4].T
    if not ((np.abs(lat) <= np.pi / 2) & (np.abs(lon) <= 2 * np.pi) & (np.abs(height) < 1e5)).all():
        raise refused(path, f"found no latitudes in radians, expected rows of {COLUMNS} doubles (SBET)")
    return rows


def _rows(path: Path, columns: int) -> Array:
    content = read_bytes(path)
    if not content or len(content) % (8 * columns):
        raise refused(path, f"found {len(content)} bytes, expected rows of {columns} doubles; truncated?")
    rows = np.frombuffer(content, "<f8").reshape(-1, columns).copy()
    with np.errstate(invalid="ignore"):
        rows[:, 0] = over_weeks(rows[:, 0])
        steps = np.diff(rows[:, 0])
        is_clock = (
            np.isfinite(rows[:, 0]).all() and (rows[:, 0] >= 0).all() and (rows[:, 0] < 2 * WEEK_S).all()
        )
    if not is_clock or not (steps > 0).all():
        raise refused(path, "its first column is no rising time of a week, s; is it an SBET, or smrmsg?")
    return rows


def _stddevs(path: Path, seconds: Array) -> Array:
    """East, north, up (n, 3), m, at times of the week."""
    rows = _rows(path, ACCURACY_COLUMNS)
    rows[:, 0] += WEEK_S * np.round(
        (seconds[0] - rows[:, 0].mean()) / WEEK_S
    )  # one may begin before the week
    if seconds[0] < rows[0, 0] - STEP_S * 20 or seconds[-1] > rows[-1, 0] + STEP_S * 20:
        raise refused(path, "does not cover the time of the SBET; is it of another drive?")
    return np.column_stack([np.interp(seconds, rows[:, 0], rows[:, column]) for column in (2, 1, 3)])

"""Positions as a file has them, before anything is known of its clock; and what a receiver measured, by their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import Transformer

from factor_graphs.csv_log import NOT_DEFINITE
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import AntennaHeadings, GnssFixes, GnssVelocities
from factor_graphs.receiver_rows import fixes_of, headings_of, velocities_of, with_more
from gnss_sem_map.sensor_log import Skip, repaired

Array = NDArray[np.float64]
FLAT_STDDEV_M = 100.0
"""Of the height 0 m of a fix without one."""
STEP_S = 0.1
"""Of a row in so many seconds: neighbouring ones of inertial units share their errors, and are no measurements."""


@dataclass(frozen=True, eq=False)
class Positions:
    """Positions of a receiver, as its file has them."""

    stamps_ns: NDArray[np.int64]
    """(n,) since 1970, in the file's own time system."""
    geodetic: Array
    """(n, 3) latitude and longitude °, height m."""
    stddevs: Array
    """(n, 3) east, north, up, m."""
    time: Literal["utc", "gps"]
    skips: list[Skip]
    more: dict[str, Array] = field(default_factory=dict)
    """What else it tells, (n, 3) each, by the names of `receiver_rows.with_more`; NaN where a row does not."""
    above_geoid: NDArray[np.bool_] | None = None
    """(n,) of which the height is above the geoid; of the others it is above the ellipsoid."""


def rows_of(
    found: Positions, zero_ns: int, stamps_ns: NDArray[np.int64], stddevs_m: Sequence[float] | None
) -> Array:
    """Rows (n, 18) as `receiver_rows.ROW_COLUMNS`, with seconds from `zero_ns` on, and other deviations if given."""
    stddevs = found.stddevs if stddevs_m is None else np.tile(stddevs_m, (len(stamps_ns), 1))
    table = np.column_stack([(stamps_ns - zero_ns) * 1e-9, found.geodetic, stddevs])
    more = {} if stddevs_m is None else {"correlations": np.full((1, 3), np.nan)}
    return with_more(table, **found.more | more)


def without_heights(where: str, count: int) -> Skip:
    """What is told of fixes that have none."""
    told = f"{count} fixes have none: taken as 0 m; the trajectory is one of two dimensions"
    return Skip("height", where, told, count)


def geodetic_of_ecef(places: Array) -> Array:
    """Geocentric coordinates (n, 3) m as latitude, longitude °, height above the ellipsoid m."""
    x, y, z = places.T
    lon, lat, alt = Transformer.from_crs(4978, 4979, always_xy=True).transform(x, y, z)
    return np.column_stack([lat, lon, alt])


def enu_of_ecef(geodetic: Array) -> Array:
    """R (n, 3, 3) that turns geocentric axes to east, north, up at places (n, 3)."""
    lat, lon = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    zero = np.zeros(len(lat))
    east = np.stack([-np.sin(lon), np.cos(lon), zero], axis=1)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    return np.stack([east, np.cross(up, east), up], axis=1)


def thinned(seconds: Array) -> NDArray[np.intp]:
    """The first row of every `STEP_S` of times that rise."""
    return np.flatnonzero(np.diff(np.floor((seconds - seconds[0]) / STEP_S + 1e-6), prepend=-1.0) > 0)


@dataclass(frozen=True, eq=False)
class Receiver:
    """What a receiver measured; nothing where there is none."""

    frame: LocalFrame | None = None
    gnss: GnssFixes | None = None
    velocities: GnssVelocities | None = None
    headings: AntennaHeadings | None = None


def measured(
    rows: NDArray[np.float64],
    where: str,
    baseline: ArrayLike | None,
    velocity: NDArray[np.float64] | None = None,
    heading: NDArray[np.float64] | None = None,
) -> tuple[Receiver, list[Skip]]:
    """What valid rows (n, 18) say, as `receiver_rows.ROW_COLUMNS`, and what was skipped; `baseline` as `headings_of`.

    `velocity` and `heading`: likewise, where these come by topics of their own.
    Raises MeasurementError.
    """
    frame = LocalFrame(*(float(v) for v in rows[0, 1:4]))
    gnss, gnss_repairs, no_covariance = fixes_of(rows, frame)
    velocities, velocity_repairs = velocities_of(rows if velocity is None else velocity, frame)
    headings, heading_repairs = headings_of(rows if heading is None else heading, frame, baseline)
    skips = repaired(where, gnss_repairs, velocity_repairs, heading_repairs)
    if no_covariance:
        skips.append(Skip("covariance", where, f"{no_covariance} fixes: {NOT_DEFINITE}", no_covariance))
    return Receiver(frame, gnss, velocities, headings), skips

"""What a receiver measured, from the rows that every reader makes, in the frame at the first of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factor_graphs.csv_log import NOT_DEFINITE
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import AntennaHeadings, GnssFixes, GnssVelocities
from factor_graphs.receiver_rows import fixes_of, headings_of, velocities_of
from gnss_sem_map.sensor_log import Skip, repaired


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

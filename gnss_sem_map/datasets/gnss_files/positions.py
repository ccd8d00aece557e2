"""Positions as a file has them, before anything is known of its clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.sensor_log import Skip


@dataclass(frozen=True, eq=False)
class Positions:
    """Positions of a receiver, as its file has them."""

    stamps_ns: NDArray[np.int64]
    """(n,) since 1970, in the file's own time system."""
    geodetic: NDArray[np.float64]
    """(n, 3) latitude and longitude °, height above the ellipsoid m."""
    stddevs: NDArray[np.float64]
    """(n, 3) east, north, up, m."""
    time: Literal["utc", "gps"]
    skips: list[Skip]
    more: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    """What else it tells, (n, 3) each, by the names of `receiver_rows.with_more`; NaN where a row does not."""

"""GPS time and UTC: by how many leap seconds they differ."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from factor_graphs.table_dates import LEAPS_NS
from factor_graphs.table_dates import gps_minus_utc_s as gps_minus_utc_s

GPS_EPOCH_NS: Final = int(np.datetime64("1980-01-06", "ns").astype(np.int64))
WEEK_NS: Final = 7 * 86_400 * 1_000_000_000
DAY_NS: Final = 86_400 * 1_000_000_000
LEAP_S: Final = len(LEAPS_NS)
"""Since 2017."""


def gps_of_utc_ns(stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """GPS time (n,) of stamps of UTC, both ns since 1970 as if days had no leap seconds."""
    return stamps_ns + 1_000_000_000 * np.searchsorted(LEAPS_NS, stamps_ns, side="right")


def nearest(stamp_ns: NDArray[np.int64], period_ns: int, near_ns: int) -> NDArray[np.int64]:
    """Times of a day or a week, ns from its start, moved by whole periods so that their middle is nearest to a moment.

    Where that is the middle of a drive, they share as much time with it as they can.
    """
    middle_ns = (int(stamp_ns.min()) + int(stamp_ns.max())) // 2
    shift = round((near_ns - middle_ns) / period_ns) * period_ns
    return np.asarray(stamp_ns + shift)

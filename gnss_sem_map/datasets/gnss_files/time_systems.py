"""GPS time and UTC: by how many leap seconds they differ."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

GPS_EPOCH_NS: Final = int(np.datetime64("1980-01-06", "ns").astype(np.int64))
WEEK_NS: Final = 7 * 86_400 * 1_000_000_000
DAY_NS: Final = 86_400 * 1_000_000_000
# IERS Bulletin C: the days from which UTC was one second more behind GPS time.
_LEAPS: Final = np.array([
    "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01", "1992-07-01",
    "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01",
    "2015-07-01", "2017-01-01",
], "datetime64[ns]").astype(np.int64)  # fmt: skip
LEAP_S: Final = len(_LEAPS)
"""Since 2017."""


def gps_minus_utc_s(stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Leap seconds (n,) at stamps of GPS time, ns since 1970 as if days had no leap seconds."""
    at = _LEAPS + np.arange(1, len(_LEAPS) + 1) * 1_000_000_000
    return np.asarray(np.searchsorted(at, stamps_ns, side="right"), np.int64)


def gps_of_utc_ns(stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """GPS time (n,) of stamps of UTC, both ns since 1970 as if days had no leap seconds."""
    return stamps_ns + 1_000_000_000 * np.searchsorted(_LEAPS, stamps_ns, side="right")


def nearest(stamp_ns: NDArray[np.int64], period_ns: int, near_ns: int) -> NDArray[np.int64]:
    """Times of a day or a week, ns from its start, moved by whole periods so that their middle is nearest to a moment.

    Where that is the middle of a drive, they share as much time with it as they can.
    """
    middle_ns = (int(stamp_ns.min()) + int(stamp_ns.max())) // 2
    shift = round((near_ns - middle_ns) / period_ns) * period_ns
    return np.asarray(stamp_ns + shift)

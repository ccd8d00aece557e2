"""Which times of a log are dates: without a date, seconds since some moment are no Unix time."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

FIRST_DATE = np.datetime64("1980-01-01", "ns").astype(np.int64)
"""Unix ns. Times before are no dates, but count from some moment: no drive with GNSS is as old."""
UNIX_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def are_dates(unix_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask (n,) of the times (n,) that are dates."""
    return np.asarray(unix_ns >= FIRST_DATE)


def date_of(epoch_ns: int, stamp_s: float) -> datetime | None:
    """The date of a stamp, s after the epoch, to 1 us; None where it is none."""
    unix_us = epoch_ns // 1000 + round(1e6 * stamp_s)
    is_date = are_dates(np.array([1000 * unix_us]))[0]
    return UNIX_EPOCH + timedelta(microseconds=unix_us) if is_date else None

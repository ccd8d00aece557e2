"""Stamps of tables that are dates, or Unix time in another unit than seconds."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from factor_graphs.tables import Column, Layout

Array = NDArray[np.float64]

DATE = re.compile(
    r"\s*((?:19|20|21)[0-9]{2})[-/.]([0-9]{2})[-/.]([0-9]{2})[T ]+([0-9]{2}:[0-9]{2}:[0-9]{2})(?:[.,]([0-9]+))?"
    r"\s*(?:Z|UTC|GMT|([+-])([0-9]{2}):?([0-9]{2})?)?\s*",
    re.IGNORECASE,
)
"""ISO 8601 and its neighbours; without a zone it is UTC. Years are those of nanoseconds in 64 bits."""
UNIX_FROM = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Larger numbers are no seconds of any year, but Unix time in ns, us, ms."""


def is_date(layout: Layout, column: Column) -> bool:
    """Whether the first cell of a column that has one is a date."""
    for row in bytes(layout.rows[:10_000]).decode("utf-8", "replace").split("\n")[1:]:
        cells = row.split(layout.separator)
        if column.at < len(cells) and cells[column.at].strip():
            return DATE.fullmatch(cells[column.at].strip().strip('"')) is not None
    return False


def seconds_of_dates(texts: Iterable[str | None], epoch_ns: int) -> Array:
    """Dates as seconds (n,) since an epoch, Unix ns; NaN for what is none."""
    return np.array([_seconds(text or "", epoch_ns) for text in texts])


def _seconds(text: str, epoch_ns: int) -> float:
    found = DATE.fullmatch(text)
    if found is None:
        return float("nan")
    year, month, day, clock, part, sign, hours, minutes = found.groups()
    try:
        moment = np.datetime64(f"{year}-{month}-{day}T{clock}.{(part or '0')[:9]}", "ns")
    except ValueError:  # a day that no month has
        return float("nan")
    ahead_s = 0 if sign is None else int(f"{sign}1") * (int(hours) * 3600 + int(minutes or 0) * 60)
    return (int(moment.astype(np.int64)) - ahead_s * 10**9 - epoch_ns) * 1e-9


def unix_scale(stamps: Array) -> float:
    """What stamps (n,) of an unknown unit are multiplied by to be seconds: 1, if they may be."""
    known = np.abs(stamps[np.isfinite(stamps)])
    middle = float(np.median(known)) if len(known) else 0.0
    return next((scale for least, scale in UNIX_FROM if middle > least), 1.0)

"""Stamps of tables that are dates, or Unix time in another unit than seconds."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from factor_graphs.tables import Column, Layout

if TYPE_CHECKING:
    from pyarrow import ChunkedArray

Array = NDArray[np.float64]

DATE = (
    r"^\s*(?P<day>[0-9]{4}[-/.][0-9]{2}[-/.][0-9]{2})[T ]+(?P<clock>[0-9]{2}:[0-9]{2}:[0-9]{2}(?:[.,][0-9]{1,9})?)"
    r"[0-9]*\s*(?P<zone>Z|z|UTC|GMT|[+-][0-9]{2}(?::?[0-9]{2})?)?\s*$"
)
"""ISO 8601 and its neighbours; without a zone it is UTC."""
UNIX_FROM = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Larger numbers are no seconds of any year, but Unix time in ns, us, ms."""


def is_date(layout: Layout, column: Column) -> bool:
    """Whether the first cell of a column that has one is a date."""
    for row in bytes(layout.rows[:10_000]).decode("utf-8", "replace").split("\n")[1:]:
        cells = row.split(layout.separator)
        if column.at < len(cells) and cells[column.at].strip():
            return re.match(DATE, cells[column.at].strip().strip('"')) is not None
    return False


def seconds_of_dates(texts: ChunkedArray, epoch_ns: int) -> Array:
    """Dates as seconds (n,) since an epoch, Unix ns; NaN for what is none."""
    from pyarrow import compute, timestamp

    parts = compute.extract_regex(texts, DATE)
    day, clock, zone = (compute.struct_field(parts, name) for name in ("day", "clock", "zone"))
    day = compute.replace_substring_regex(day, "[/.]", "-")
    text = compute.binary_join_element_wise(day, compute.replace_substring(clock, ",", "."), "T")
    try:
        moments = text.cast(timestamp("ns"))
    except ValueError:  # a day that no month has, or of another century
        moments = _one_by_one(text)
    unknown = moments.is_null().to_numpy(zero_copy_only=False)
    ns = moments.cast("int64").fill_null(0).to_numpy()
    zones = zone.fill_null("").to_numpy(zero_copy_only=False)
    ahead = {one: _ahead_ns(one) for one in set(zones.tolist())}
    since = ns - np.array([ahead[one] for one in zones], np.int64) - epoch_ns
    return np.where(unknown, np.nan, since * 1e-9)


def _one_by_one(texts: ChunkedArray) -> ChunkedArray:
    import pyarrow as pa

    found = []
    for text in texts.to_pylist():
        try:
            moment = np.datetime64(text or "NaT", "ns")
        except ValueError:
            moment = np.datetime64("NaT", "ns")
        found.append(None if np.isnat(moment) else int(moment.astype(np.int64)))
    return pa.chunked_array([pa.array(found, "int64")]).cast(pa.timestamp("ns"))


def _ahead_ns(zone: str) -> int:
    digits = re.sub("[^0-9]", "", zone)
    if not digits:
        return 0
    minutes = int(digits[:2]) * 60 + int(digits[2:4] or 0)
    return (-1 if zone[0] == "-" else 1) * minutes * 60 * 10**9


def unix_scale(stamps: Array) -> float:
    """What stamps (n,) of an unknown unit are multiplied by to be seconds: 1, if they may be."""
    known = np.abs(stamps[np.isfinite(stamps)])
    middle = float(np.median(known)) if len(known) else 0.0
    return next((scale for least, scale in UNIX_FROM if middle > least), 1.0)

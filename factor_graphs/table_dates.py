"""Stamps of tables that are dates or times of a day, of UTC or of GPS, or Unix time in another unit than seconds."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from factor_graphs.stamps import DAY_S

Array = NDArray[np.float64]

DATE = re.compile(
    r"\s*(?:([0-9]{4}[-/.][0-9]{1,2}[-/.][0-9]{1,2}|[0-9]{1,2}[-/.](?:[0-9]{1,2}|[a-z]{3})[-/.][0-9]{4})[T, ]+)?"
    r"([0-9]{1,2}):([0-9]{2}):([0-9]{2})(?:[.,]([0-9]+))?\s*(am|pm)?\s*(?:Z|UTC|GMT|([+-])([0-9]{2}):?([0-9]{2})?)?\s*",
    re.IGNORECASE,
)
"""ISO 8601 and its neighbours, or a time of day alone; without a zone it is UTC."""
GPS_TIME = re.compile(r"\bGPST\b|\bGPS[ _]?time\b", re.IGNORECASE)
"""What says of dates that they are of GPS time."""
ZONE = re.compile(r"(?:Z|UTC|GMT|[+-][0-9]{2}:?[0-9]{2})\s*$", re.IGNORECASE)
"""How a date ends that tells its zone itself."""
LEAPS_NS = np.array([
    "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01", "1992-07-01",
    "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01",
    "2015-07-01", "2017-01-01",
], "datetime64[ns]").astype(np.int64)  # fmt: skip
"""The days from which UTC was one second more behind GPS time (IERS Bulletin C)."""
MONTHS = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
FIRST_YEAR, LAST_YEAR = 1900, 2199
"""Of nanoseconds in 64 bits."""
UNIX_FROM = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Larger numbers are no seconds of any year, but Unix time in ns, us, ms."""
YEAR_FIRST, MONTH_FIRST, DAY_FIRST = (0, 1, 2), (2, 0, 1), (2, 1, 0)
"""Places of year, month and day."""


def are_dates(texts: Sequence[str]) -> bool:
    """Whether the first cell that has something is a date, or a time of day."""
    first = next((text for text in texts if text.strip()), "")
    return DATE.fullmatch(first) is not None


def gps_minus_utc_s(stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Leap seconds (n,) at stamps of GPS time, ns since 1970 as if days had no leap seconds."""
    at = LEAPS_NS + np.arange(1, len(LEAPS_NS) + 1) * 1_000_000_000
    return np.asarray(np.searchsorted(at, stamps_ns, side="right"), np.int64)


def seconds_of_dates(texts: Iterable[str | None], epoch_ns: int, are_gps: bool = False) -> Array:
    """Dates as seconds (n,) since an epoch, Unix ns; NaN for what is none.

    Times alone are seconds of the first day. `are_gps`: they are of GPS time, ahead of UTC by the leap seconds.
    """
    found = [DATE.fullmatch(text or "") for text in texts]
    names = [one[1] for one in found if one is not None and one[1] is not None]
    days = dict(zip(names, days_of(names).tolist(), strict=True))
    seconds = np.array([
        np.nan if one is None else _seconds(one, days.get(one[1]), epoch_ns) for one in found
    ])  # fmt: skip
    if names:
        return seconds - gps_minus_utc_s((np.nan_to_num(seconds) * 1e9).astype(np.int64) + epoch_ns) * are_gps
    known = np.isfinite(seconds)
    of_day = seconds[known]
    seconds[known] += DAY_S * np.cumsum(np.diff(of_day, prepend=of_day[:1]) < -DAY_S / 2)
    return seconds


def _seconds(found: re.Match[str], day_s: float | None, epoch_ns: int) -> float:
    _, hours, minutes, seconds, part, half, sign, zone_hours, zone_minutes = found.groups()
    hour = int(hours) if half is None else int(hours) % 12 + 12 * (half.lower() == "pm")
    is_none = hour > 23 or int(minutes) > 59 or int(seconds) > 59 or (day_s is not None and np.isnan(day_s))
    if is_none:
        return float("nan")
    ns = ((hour * 60 + int(minutes)) * 60 + int(seconds)) * 10**9 + int(((part or "") + "0" * 9)[:9])
    if day_s is None:
        return ns * 1e-9
    ahead_s = 0 if sign is None else int(f"{sign}1") * (int(zone_hours) * 3600 + int(zone_minutes or 0) * 60)
    return (int(day_s) * 10**9 + ns - ahead_s * 10**9 - epoch_ns) * 1e-9


def days_of(texts: Iterable[str]) -> Array:
    """Dates (n,) as s since 1970; NaN for what is none.

    One that does not begin with its year begins with the day where it has dots or the name of the month, else with
    the month, unless some number there is larger than 12.
    """
    texts = list(texts)
    parts = {text: _parts(text) for text in texts}
    firsts = [part[0] for part in parts.values() if len(part) == 3]
    has_dots = any("." in text or re.search("[A-Za-z]", text) for text in parts)
    order = YEAR_FIRST if max(firsts, default=0) > 31 else MONTH_FIRST
    if order == MONTH_FIRST and (has_dots or max(firsts, default=0) > 12):
        order = DAY_FIRST
    days = {text: _day(part, order) for text, part in parts.items()}
    return np.array([days[text] for text in texts])


def _parts(text: str) -> list[int]:
    """The numbers of a date; a month may have a name."""
    words = re.findall(r"[0-9]{1,4}|[a-z]{3,}", text.lower())[:3]
    known = [MONTHS.index(word[:3]) + 1 if word[:3] in MONTHS else word for word in words]
    return [int(word) for word in known] if all(str(word).isdecimal() for word in known) else []


def _day(part: list[int], order: tuple[int, int, int]) -> float:
    if len(part) < 3 or not FIRST_YEAR <= part[order[0]] <= LAST_YEAR:
        return float("nan")
    year, month, day = (part[k] for k in order)
    try:
        return float(np.datetime64(f"{year:04d}-{month:02d}-{day:02d}", "s").astype(np.int64))
    except ValueError:  # a day that no month has
        return float("nan")


def unix_scale(stamps: Array) -> float:
    """What stamps (n,) of an unknown unit are multiplied by to be seconds: 1, if they may be."""
    known = np.abs(stamps[np.isfinite(stamps)])
    middle = float(np.median(known)) if len(known) else 0.0
    return next((scale for least, scale in UNIX_FROM if middle > least), 1.0)

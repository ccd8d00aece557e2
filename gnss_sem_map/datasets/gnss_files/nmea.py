"""NMEA 0183: positions of GGA or GNS, else of RMC, dates of RMC or ZDA, standard deviations of GST, speed and course.

And headings of HDT or THS. Parsed by `pynmeagps`. VTG, HDT and THS have no time: it is that of the sentence before.

Heights are above the geoid; with the geoid's own height, which GGA and GNS also tell, they are above the ellipsoid. RMC
tells none: then the trajectory is one of two dimensions, at a height of 0 m.
"""

from __future__ import annotations

import datetime
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from functools import reduce
from importlib.util import find_spec
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.gnss_files.positions import FLAT_STDDEV_M, Positions, without_heights
from gnss_sem_map.datasets.gnss_files.time_systems import DAY_NS, WEEK_NS, nearest
from gnss_sem_map.errors import how_to_install
from gnss_sem_map.files.untrusted import refused, shown
from gnss_sem_map.sensor_log import Skip, skipped

STDDEVS_M = {1: (2.0, 4.0), 2: (0.6, 1.2), 3: (2.0, 4.0), 4: (0.02, 0.03), 5: (0.3, 0.5)}
"""Horizontal and vertical, m, at a HDOP of 1: autonomous, differential, PPS, fixed and float RTK. Other qualities are
no measurements: 0 none, 6 dead reckoning, 7 entered by hand, 8 simulated."""
MODES = {"R": 4, "F": 5, "P": 2, "D": 2, "A": 1}
"""Quality of a mode of GNS, of which each system has one, and of RMC; the best counts. Others are no measurements."""
USED = {
    "GGA": "time lat lon quality HDOP alt sep", "GNS": "time lat lon posMode HDOP alt sep",
    "RMC": "time status lat lon spd cog date", "ZDA": "time day month year", "GST": "time stdLat stdLong stdAlt",
    "VTG": "cogt sogn", "HDT": "headingT", "THS": "headt mi",
}  # fmt: skip
"""Sentences, and their fields that are read; one without some of them was cut."""
SENTENCE = re.compile(rf"\$([A-Z]{{2}}(?:{'|'.join(USED)}),[^$*\r\n]*)(?:\*([0-9A-Fa-f]{{1,2}}))?")
"""What stands between $ and *, and the checksum behind it, if there is one."""
TIMELESS = ("VTG", "HDT", "THS")
MPS_PER_KNOT = 1852 / 3600
ERA_NS = 1024 * WEEK_NS
AT_REST_MPS = 0.1
"""Slower than this, receivers leave the course out."""


Fix = tuple[int, bool, list[float], bool]
"""ns, of the day or since 1970, and which; position and its deviations, and whether the height is above the geoid."""


def is_nmea(lines: list[str]) -> bool:
    """Whether lines of text hold sentences that are read."""
    return any(SENTENCE.search(line) for line in lines)


def read(path: Path, lines: list[str], near_ns: int | None) -> Positions:
    """The positions of a file; what is no fix is skipped and counted. Raises DataError where there is none."""
    if find_spec("pynmeagps") is None:
        raise refused(path, f"NMEA needs pynmeagps; {how_to_install('ros')}")
    now: int | None = None  # by the last sentence with a date
    deviations: dict[int, tuple[float, float, float]] = {}
    velocities: dict[int, tuple[float, float]] = {}
    headings: dict[int, float] = {}
    clock: int | None = None  # of the last sentence with a time
    fixes, flat, lost = list[Fix](), list[Fix](), Counter[str]()
    for sentence in _sentences(lines):
        if isinstance(sentence, str):
            lost[sentence] += 1
            continue
        if sentence.msgID not in TIMELESS:
            clock = _clock_ns(sentence.time)
        if sentence.msgID in ("RMC", "ZDA"):
            now = _moment_ns(sentence) or now
        if clock is not None and (velocity := _velocity(sentence)) is not None:
            velocities[clock] = velocity
        if clock is not None and (heading := _heading(sentence)) is not None:
            headings[clock] = heading
        if clock is not None and sentence.msgID == "GST":
            deviations[clock] = (sentence.stdLong, sentence.stdLat, sentence.stdAlt)
        if sentence.msgID in ("GGA", "GNS", "RMC"):
            why = _fault(sentence, clock)
            if why and sentence.msgID != "RMC":
                lost[why] += 1
            elif not why and clock is not None:
                stamp = clock if now is None else clock + round((now - clock) / DAY_NS) * DAY_NS
                one = (stamp, now is not None, *_position(sentence))
                (flat if sentence.msgID == "RMC" else fixes).append(one)
    skips = skipped("fix", path, "sentences", lost)
    if flat and not fixes:
        skips.append(without_heights(shown(path), len(flat)))
        fixes, deviations = flat, {}
    if not fixes:
        why = f" ({'; '.join(skip.reason for skip in skips)})" if skips else "; expected NMEA 0183"
        raise refused(path, f"found no GGA, GNS or RMC sentence with a fix{why}")
    found = _joined(path, fixes, deviations, near_ns, skips)
    clocks = (found.stamps_ns % DAY_NS).tolist()
    found.more["headings_deg"] = np.array([headings.get(ns, np.nan) for ns in clocks])
    level = [velocities.get(ns, (np.nan, np.nan)) for ns in clocks]
    found.more["velocities"] = np.array([(*v, np.nan) for v in level])
    return found


def _joined(
    path: Path,
    fixes: list[Fix],
    deviations: dict[int, tuple[float, float, float]],
    near_ns: int | None,
    skips: list[Skip],
) -> Positions:
    dated = np.array([is_dated for _, is_dated, *_ in fixes])
    stamps = np.array([stamp for stamp, *_ in fixes], np.int64)
    if dated.any() and not dated.all():
        skips.append(Skip("fix", shown(path), "before the first date (RMC or ZDA)", int((~dated).sum())))
        fixes = [fix for fix in fixes if fix[1]]
        stamps = stamps[dated]
    elif not dated.any():
        if near_ns is None:
            raise refused(path, "has no date, expected RMC or ZDA sentences beside GGA")
        midnights = np.concatenate([[0], np.cumsum(np.diff(stamps) < -DAY_NS // 2)])
        stamps = nearest(stamps + midnights * DAY_NS, DAY_NS, near_ns)
    stamps = _of_this_era(stamps, near_ns if dated.any() else None, path, skips)
    table = np.array([[*values, is_above_geoid] for *_, values, is_above_geoid in fixes])
    best = _best(stamps, table, path, skips)
    stamps, table = stamps[best], table[best]
    given = [deviations.get(int(stamp % DAY_NS)) for stamp in stamps]
    stddevs = np.array([
        one if one is not None and all(isinstance(v, float) and v > 0 for v in one) else by_quality
        for one, by_quality in zip(given, table[:, 3:6].tolist(), strict=True)
    ])  # fmt: skip
    return Positions(stamps, table[:, :3], stddevs, "utc", skips, above_geoid=table[:, 6] > 0)


def _of_this_era(
    stamps_ns: NDArray[np.int64], near_ns: int | None, path: Path, skips: list[Skip]
) -> NDArray[np.int64]:
    """Stamps that are 1,024 weeks off the drive, once or more, moved there: a receiver began to count weeks anew."""
    if near_ns is None:
        return stamps_ns
    off_ns = near_ns - int(np.median(stamps_ns))
    eras = round(off_ns / ERA_NS)
    if eras == 0 or abs(off_ns - eras * ERA_NS) > DAY_NS:
        return stamps_ns
    told = f"dates are {1024 * eras} weeks early, for the receiver counts weeks anew: corrected"
    skips.append(Skip("date", shown(path), told, len(stamps_ns)))
    return stamps_ns + eras * ERA_NS


def _best(
    stamps: NDArray[np.int64], table: NDArray[np.float64], path: Path, skips: list[Skip]
) -> NDArray[np.intp]:
    """The rows, in order, of the best fix of each moment."""
    order = np.lexsort((np.arange(len(stamps)), table[:, 3], stamps))
    first = np.append(True, np.diff(stamps[order]) > 0)
    if lost := int((~first).sum()):
        skips.append(Skip("fix", shown(path), "of the moment of a better or earlier one", lost))
    return np.asarray(np.sort(order[first]))


def _velocity(sentence: Any) -> tuple[float, float] | None:
    """East and north, m/s, of a sentence with speed and course; None where it tells nothing."""
    speed, course = None, None
    if sentence.msgID == "RMC" and sentence.status == "A":
        speed, course = sentence.spd, sentence.cog
    elif sentence.msgID == "VTG":
        speed, course = sentence.sogn, sentence.cogt
    if not isinstance(speed, float | int):
        return None
    speed *= MPS_PER_KNOT
    if not isinstance(course, float | int):
        return (0.0, 0.0) if speed < AT_REST_MPS else None
    return speed * float(np.sin(np.radians(course))), speed * float(np.cos(np.radians(course)))


def _heading(sentence: Any) -> float | None:
    """Degrees from true north, of a measurement; None where it tells nothing."""
    said = getattr(sentence, "headingT", None)
    if sentence.msgID == "THS" and sentence.mi == "A":  # others: dead reckoning, by hand, simulated, void
        said = sentence.headt
    return float(said) if isinstance(said, float | int) else None


def _sentences(lines: list[str]) -> Iterator[Any]:
    """The sentences that are used, and for what looks like one why it is not.

    Bytes of other messages may stand before and behind them. Where no sentence of a file has a checksum, none needs it.
    """
    found = [one for line in lines for one in SENTENCE.findall(line)]
    are_checked = any(checksum for _, checksum in found)
    for body, checksum in found:
        if checksum or not are_checked:
            yield _sentence(body, checksum or f"{reduce(xor, body.encode(), 0):02X}")
        else:
            yield "damaged"


def _sentence(body: str, checksum: str) -> Any:
    from pynmeagps import NMEAReader, exceptions

    faults = (exceptions.NMEAParseError, exceptions.NMEAMessageError, exceptions.NMEATypeError, ValueError)
    if int(checksum, 16) != reduce(xor, body.encode("utf-8"), 0):
        return "wrong checksum"
    if body[2:5] == "GGA":  # the name of a station behind, which is to be a number, is not of interest
        body = ",".join(body.split(",")[:13]) + ",,"
    try:
        sentence = NMEAReader.parse(f"${body}*{checksum}\r\n", validate=0)
    except faults:
        return "damaged"
    return sentence if {*USED[sentence.msgID].split()} <= sentence.__dict__.keys() else "damaged"


def _moment_ns(sentence: Any) -> int | None:
    """Date and time of a sentence, ns since 1970; None where the receiver does not know them yet."""
    if sentence.msgID == "RMC" and sentence.status != "A":
        return None
    clock, date = _clock_ns(sentence.time), getattr(sentence, "date", None)
    if sentence.msgID == "ZDA":
        with suppress(ValueError, TypeError):
            date = datetime.date(int(sentence.year), int(sentence.month), int(sentence.day))
    if not isinstance(date, datetime.date) or clock is None:
        return None
    return int(np.datetime64(date, "D").astype("datetime64[ns]").astype(np.int64)) + clock


def _clock_ns(time: Any) -> int | None:
    """ns since midnight."""
    if not isinstance(time, datetime.time):
        return None
    seconds = (time.hour * 60 + time.minute) * 60 + time.second
    return seconds * 1_000_000_000 + time.microsecond * 1000


def _quality(sentence: Any) -> int | None:
    """As GGA has it; None where the sentence says otherwise that there is no fix."""
    if sentence.msgID == "GGA":
        return sentence.quality if sentence.quality in STDDEVS_M else None
    if sentence.msgID == "RMC" and sentence.status != "A":
        return None
    modes = getattr(sentence, "posMode", "") or ("A" if sentence.msgID == "RMC" else "")  # NMEA before 2.3
    known = [MODES[mode] for mode in modes if mode in MODES]
    return min(known, key=lambda quality: STDDEVS_M[quality], default=None)


def _fault(sentence: Any, clock: int | None) -> str:
    """Why a sentence is no fix; empty if it is one."""
    is_placed = isinstance(sentence.lat, float) and isinstance(sentence.lon, float)
    if clock is None or _quality(sentence) is None or not is_placed:
        return f"no fix (quality {getattr(sentence, 'quality', getattr(sentence, 'posMode', ''))})"
    if sentence.msgID != "RMC" and not isinstance(sentence.alt, float):
        return "no height"
    return ""


def _position(sentence: Any) -> tuple[list[float], bool]:
    """Position and deviations of a fix, and whether its height is above the geoid."""
    quality = _quality(sentence)
    across, up = STDDEVS_M[quality or 1]
    if sentence.msgID == "RMC":
        return [sentence.lat, sentence.lon, 0.0, across, across, FLAT_STDDEV_M], False
    dilution = max(sentence.HDOP, 1.0) if isinstance(sentence.HDOP, float) and quality in (1, 2, 3) else 1.0
    separation = sentence.sep if isinstance(sentence.sep, float) else None
    place = [sentence.lat, sentence.lon, sentence.alt + (separation or 0.0)]
    return [*place, across * dilution, across * dilution, up * dilution], separation is None

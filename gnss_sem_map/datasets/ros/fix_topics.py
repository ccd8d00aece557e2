"""Positions of a receiver in a topic: NavSatFix, GPSFix, or its NMEA sentences, as rows like those of a table."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factor_graphs.csv_log import NOT_DEFINITE
from factor_graphs.position_covariances import split_covariances
from factor_graphs.receiver_rows import with_more
from gnss_sem_map.datasets.gnss_files import nmea
from gnss_sem_map.datasets.gnss_files.positions import FLAT_STDDEV_M, rows_of, without_heights
from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.datasets.ros.decoding import decode
from gnss_sem_map.datasets.ros.kinds import SENTENCE, STRING
from gnss_sem_map.datasets.ros.rig import GnssTopic
from gnss_sem_map.datasets.ros.stamps import JUMP_NS, stamps_of
from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.sensor_log import Skip, skipped

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

NO_FIX = -1
"""NavSatStatus.status, and GPSStatus.status."""
UNKNOWN_COVARIANCE, DIAGONAL_COVARIANCE = 0, 2
"""position_covariance_type."""
OF_95_PERCENT = 1.96
"""GPSFix tells errors that are smaller in 95 of 100 cases: so many standard deviations."""


def fix_rows(bag: Bag, topic: str, about: GnssTopic) -> tuple[Array, Ints, list[Skip]]:
    """Rows (n, 18) as `receiver_rows.ROW_COLUMNS`, their Unix times ns, and the skipped fixes; raises DataError."""
    messages = bag.messages(topic)
    said, believed, skips = stamps_of(bag, messages, about.stamps)
    if messages.kind in (SENTENCE, STRING):
        rows, ns, lost = _of_sentences(bag, messages, said, about)
        return rows, ns, skips + lost
    places, stamps, covariances = [], [], []
    counts = Counter[str]()
    for k in np.flatnonzero(believed).tolist():
        fix = decode(bag, messages, k)
        why, covariance = covariance_of(fix)
        if why and about.stddevs_m is not None:
            covariance = np.diag(np.square(about.stddevs_m))
        if fix.status.status == NO_FIX:
            counts["no fix"] += 1
        elif covariance is None:
            counts[why] += 1
        else:
            places.append([fix.latitude, fix.longitude, fix.altitude])
            covariances.append(covariance)
            stamps.append(int(said[k]))
    if not places:
        raise refused(
            messages.topic,
            f"not one of {len(messages)} messages is a fix"
            f" ({', '.join(f'{count}: {why}' for why, count in counts.items()) or 'no messages'});"
            " where only covariances are unknown or zero, set gnss.stddevs_m in rig.yaml",
        )
    skips += skipped("fix", messages.topic, "messages", counts)
    if np.isnan(np.array(places)[:, 2]).all():
        skips.append(without_heights(messages.topic, len(places)))
        places = [[lat, lon, 0.0] for lat, lon, _ in places]
        covariances = [_flat(covariance) for covariance in covariances]
    ns = np.array(stamps, np.int64)
    stddevs, correlations, wrong = split_covariances(np.array(covariances))
    if count := int((wrong & (stddevs > 0).all(axis=1)).sum()):  # others are no fixes
        skips.append(Skip("covariance", messages.topic, f"{count} fixes: {NOT_DEFINITE}", count))
    table = np.column_stack([(ns - ns[0]) * 1e-9, np.array(places), stddevs])
    return with_more(table, correlations=correlations), ns, skips


def _flat(covariance: Array) -> Array:
    """Of a fix without height: what is told of east and north, and a height that nobody knows."""
    whole = np.diag([0.0, 0.0, FLAT_STDDEV_M**2])
    whole[:2, :2] = covariance[:2, :2]
    return whole


def covariance_of(fix: Any) -> tuple[str, Array | None]:
    """Why a fix has no covariance, or nothing; and the covariance (3, 3) m² that its message tells."""
    covariance = np.array(fix.position_covariance, np.float64).reshape(3, 3)
    kind = fix.position_covariance_type
    if kind != UNKNOWN_COVARIANCE and (covariance.diagonal() > 0).all():
        return "", covariance * np.eye(3) if kind == DIAGONAL_COVARIANCE else covariance
    across, up = getattr(fix, "err_horz", 0.0), getattr(fix, "err_vert", 0.0)
    if across > 0 and up > 0:
        return "", np.diag(np.square(np.array([across, across, up]) / OF_95_PERCENT))
    return f"its covariance is {'unknown' if kind == UNKNOWN_COVARIANCE else 'not above zero'}", None


def _of_sentences(
    bag: Bag, messages: Messages, said: Ints, about: GnssTopic
) -> tuple[Array, Ints, list[Skip]]:
    """The fixes of NMEA sentences at their own time, UTC; on the clock of their stamps where that is another one."""
    name = "sentence" if messages.kind == SENTENCE else "data"
    lines = [str(getattr(decode(bag, messages, k), name)) for k in range(len(messages))]
    near_ns = int(np.median(said)) if len(said) else None
    found = nmea.read(Path(messages.topic), lines, near_ns)
    stamps, skips = found.stamps_ns, found.skips
    are_fixes = [re.search(r"GGA(,[^,]*){5},[1-9]", line) is not None for line in lines]
    off_ns = round(float(np.median(said[are_fixes])) - float(np.median(stamps))) if any(are_fixes) else 0
    if abs(off_ns) > JUMP_NS:
        stamps = stamps + off_ns
        reason = f"the stamps are {off_ns * 1e-9:+.1f} s off the times in the sentences: their clock is taken"
        skips.append(Skip("clock", messages.topic, reason))
    return rows_of(found, int(stamps[0]), stamps, about.stddevs_m), stamps, skips

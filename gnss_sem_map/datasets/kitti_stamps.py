"""Stamp files of KITTI: line k belongs to frame k, and is blank when the frame is missing."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from gnss_sem_map.datasets.stamps import FIRST_YEAR, LAST_YEAR
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import expect_file, read_lines, refused, shown
from gnss_sem_map.sensor_log import Skip

STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d(:\d\d(\.\d{1,18})?)?", re.ASCII)


def stamps_ns(path: Path) -> tuple[dict[int, int], list[Skip]]:
    """Unix nanoseconds by frame number; blank lines are missing frames.

    Stamps of impossible years are skipped, and those in a leap second, which Unix time does not have.
    """
    expect_file(path, "stamps, one line `date time` per frame")
    stamps, skips = {}, []
    for number, line in enumerate(read_lines(path)):
        text = line.strip()
        if not text:
            continue
        if STAMP.fullmatch(text) is None:
            raise _no_stamp(path, number, text)
        is_leap_second = text[17:19] == "60"
        if is_leap_second or not FIRST_YEAR <= int(text[:4]) <= LAST_YEAR:
            why = "in a leap second" if is_leap_second else "no time of a drive"
            skips.append(Skip("stamp", f"{shown(path)}: line {number + 1}", f"found {text}, {why}"))
            continue
        try:
            stamps[number] = int(np.datetime64(text.replace(" ", "T"), "ns").astype(np.int64))
        except ValueError:
            raise _no_stamp(path, number, text) from None
    return stamps, skips


def _no_stamp(path: Path, number: int, text: str) -> DataError:
    return refused(path, f"line {number + 1}: found {text[:40]!r}, expected `yyyy-mm-dd hh:mm:ss.nnnnnnnnn`")

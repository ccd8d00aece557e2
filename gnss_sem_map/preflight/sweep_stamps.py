"""Check of sweep times: consecutive, as long as the time to the next sweep, with the stamp in the middle."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.preflight.findings import ONE_CLOCK, Finding, amber, green, red
from gnss_sem_map.preflight.sample import Sample

Array = NDArray[np.float64]
NAME = "sweep stamps"
LENGTHS_S = (0.02, 0.5)
"""Scanners turn 2 to 50 times a second."""
OFF = 0.3
"""Lengths and middles may be off by this part of a sweep: scanners turn evenly, to a few percent."""
GAP_SWEEPS, GAP_S = 10, 1.0
"""A step from scan to scan that is longer than both is a gap: a reader may miss a sweep or two."""
FEW, MANY = 0.02, 0.2
"""More than the first share of odd sweeps is amber, more than the second red: a lost line shifts all that follow."""


def check(sample: Sample) -> Iterator[Finding]:
    """Stamps of all sweeps: no file of points is read."""
    scans = sample.log.scans
    backwards = sum("ends before it starts" in skip.reason for skip in sample.log.skips)
    if backwards > FEW * (len(scans) + backwards):
        yield red(
            NAME,
            f"{backwards} of {len(scans) + backwards} sweeps end before they start, and are left out",
            "a lost line in timestamps_start.txt (or one too many in timestamps_end.txt)",
            "restore timestamps_start.txt of velodyne_points: line k belongs to frame k",
        )
        return
    if len(scans) < 2:
        return
    moving = _span_of_motion(sample)
    if moving is not None and (scans[-1].stamp < moving[0] or scans[0].stamp > moving[1]):
        yield red(
            NAME,
            f"scans are of {scans[0].stamp:.1f} to {scans[-1].stamp:.1f} s,"
            f" what tells the motion is of {moving[0]:.1f} to {moving[1]:.1f} s",
            "scan stamps are of another clock, or of another drive",
            ONE_CLOCK,
        )
        return
    stamps = np.array([scan.stamp for scan in scans])
    steps = np.diff(stamps)
    interval = float(np.median(steps))
    if not LENGTHS_S[0] <= interval <= 10 * LENGTHS_S[1]:
        yield amber(
            NAME,
            f"scans are {interval:.4g} s apart; expected {LENGTHS_S[0]:g} to {LENGTHS_S[1]:g} s",
            "scan stamps are of another unit, or not of the scans",
            "give the stamps in seconds",
        )
        return
    yield from _gaps(stamps, interval)
    spans = np.array([scan.sweep or (np.nan, np.nan) for scan in scans])
    if np.isnan(spans).any():
        yield green(NAME, f"{len(scans)} scans, {interval:.3f} s apart")
        return
    yield _spans(stamps, spans, interval)


def _gaps(stamps: Array, interval: float) -> Iterator[Finding]:
    steps = np.diff(stamps)
    gaps = np.flatnonzero(steps > max(GAP_SWEEPS * interval, GAP_S))
    if len(gaps):
        longest = int(gaps[steps[gaps].argmax()])
        yield amber(
            NAME,
            f"there is no scan for {steps[longest]:.1f} s after {stamps[longest]:.3f} s; usually one comes every"
            f" {interval:.3f} s (gaps: {len(gaps)}, {steps[gaps].sum():.1f} s in all)",
            "the LiDAR was off, or its messages were lost",
            "the map has holes there: look for files or messages that are missing, or record again",
        )


def _span_of_motion(sample: Sample) -> tuple[float, float] | None:
    """When the drive's motion is known from and to, s."""
    given, imu = sample.log.given, sample.log.imu
    if given is not None:
        return given.start, given.end
    return (float(imu.stamps[0]), float(imu.stamps[-1])) if imu is not None and len(imu) else None


def _spans(stamps: Array, spans: Array, interval: float) -> Finding:
    lengths = spans[:, 1] - spans[:, 0]
    usual = float(np.median(lengths))
    begins, ends, middles = _errors(stamps, spans, interval)
    odd = (np.abs(begins) > OFF) | (np.abs(ends) > OFF) | (np.abs(middles) > OFF)
    share = float(odd.mean())
    found = (
        f"{odd.sum()} of {len(odd)} sweeps do not fit the {interval:.3f} s between scans"
        f" (they last {lengths.min():.3f} to {lengths.max():.3f} s)"
    )
    if share <= FEW:
        return green(NAME, f"{len(stamps)} sweeps of {usual:.3f} s, {interval:.3f} s apart")
    shifts = {
        "_end": float(np.median(ends[odd])),
        "_start": float(np.median(begins[odd])),
        "": float(np.median(middles[odd])),
    }
    name = max(shifts, key=lambda key: abs(shifts[key]))
    shift = shifts[name]
    if abs(shift) > 0.5:
        lines = max(1, round(abs(shift)))
        what = f"{lines} lost line{'s' if lines > 1 else ''}" if shift > 0 else "a line too many"
        which = "after" if shift > 0 else "before"
        mistake = f"{what} in timestamps{name}.txt: each sweep has the stamp of one {which} it"
        remedy = f"restore timestamps{name}.txt of velodyne_points: line k belongs to frame k"
    else:
        mistake = "start, middle and end of the sweeps do not belong together"
        remedy = "check timestamps_start.txt, timestamps.txt and timestamps_end.txt of velodyne_points"
    return (red if share > MANY else amber)(NAME, found, mistake, remedy)


def _errors(stamps: Array, spans: Array, interval: float) -> tuple[Array, Array, Array]:
    """How far start, end and stamp are from where the other two put them, in sweeps; (n,) each.

    A sweep lasts one interval: two of the three stamps agree on where it lies, the third one is off.
    """
    start, end = spans.T
    by_start, by_stamp, by_end = start + interval / 2, stamps, end - interval / 2
    agreed = np.median(np.column_stack([by_start, by_stamp, by_end]), axis=1)
    return (by_start - agreed) / interval, (by_end - agreed) / interval, (by_stamp - agreed) / interval

"""Checks of LiDAR sweeps: stamps, points, point times, and their motion against the trajectory."""

from __future__ import annotations

from collections.abc import Iterator

from gnss_sem_map.errors import DataError, PointTimesError
from gnss_sem_map.evaluation.preflight import extrinsics, point_times, sweep_stamps
from gnss_sem_map.evaluation.preflight.findings import Finding, amber, green, red
from gnss_sem_map.evaluation.preflight.lidar_motion import Stretch
from gnss_sem_map.evaluation.preflight.sample import Sample

SCANS = "scans"


def check(sample: Sample) -> Iterator[Finding]:
    """Stamps first, which are cheap; then a few seconds of scans."""
    yield from sweep_stamps.check(sample)
    if not sample.log.scans:
        return
    yield from _scans(sample)
    yield from point_times.check(sample)
    yield from extrinsics.check(sample)


def _scans(sample: Sample) -> Iterator[Finding]:
    """Whether scans can be read and registered to each other."""
    tried = sample.tried
    if not tried:
        yield green(SCANS, "not observable: no ten scans in a row")
        return
    unreadable = [why for why in tried.values() if isinstance(why, DataError)]
    fit = sum(isinstance(seen, Stretch) for seen in tried.values())
    found = f"{fit} of {len(tried)} stretches of a second have scans that fit onto each other"
    if unreadable:
        level = red if len(unreadable) > len(tried) / 2 else amber
        yield level(SCANS, f"{found}; {unreadable[0]}", *_why_unreadable(unreadable[0]))
    elif len(tried) - fit > len(tried) / 2:
        yield amber(
            SCANS,
            found,
            "scans hold few points, are not in metres, or in another order of columns",
            "expected rows of x y z intensity, m, in the lidar frame",
        )
    else:
        yield green(SCANS, found)


def _why_unreadable(error: DataError) -> tuple[str, str]:
    """The probable mistake, and its remedy."""
    if isinstance(error, PointTimesError):
        return error.mistake, "give each point's time minus the scan's stamp, s"
    return (
        "scans are damaged, cut short, or other bytes than points",
        "copy the scans again: little-endian float32 x y z intensity, m",
    )

"""LiDAR sweeps: stamps, points, times of points, and the motion that they see against the trajectory."""

from __future__ import annotations

from collections.abc import Iterator

from gnss_sem_map.preflight import extrinsics, point_times, sweep_stamps
from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.preflight.sample import UNMATCHED, Sample

SCANS = "scans"


def check(sample: Sample) -> Iterator[Finding]:
    """Stamps first, which cost nothing; then a few seconds of scans."""
    yield from sweep_stamps.check(sample)
    if not sample.log.scans:
        return
    yield from _scans(sample)
    yield from point_times.check(sample)
    yield from extrinsics.check(sample)


def _scans(sample: Sample) -> Iterator[Finding]:
    """Whether scans can be read, and laid onto each other."""
    tried = sample.tried
    if not tried:
        yield green(SCANS, "not observable: no ten scans in a row")
        return
    unreadable = [why for why in tried.values() if isinstance(why, str) and why != UNMATCHED]
    fit = sum(not isinstance(seen, str) for seen in tried.values())
    unmatched = [why for why in tried.values() if why == UNMATCHED]
    found = f"{fit} of {len(tried)} stretches of a second have scans that fit onto each other"
    if unreadable:
        yield (red if len(unreadable) > len(tried) / 2 else amber)(
            SCANS,
            f"{found}; {unreadable[0]}",
            "scans are damaged, cut short, or other bytes than points",
            "copy the scans again: little-endian float32 x y z intensity, m",
        )
    elif len(unmatched) > len(tried) / 2:
        yield amber(
            SCANS,
            found,
            "scans hold few points, are not in metres, or in another order of columns",
            "expected rows of x y z intensity, m, in the lidar frame",
        )
    else:
        yield green(SCANS, found)

"""Checks of LiDAR sweeps: stamps, points, point times, and their motion against the trajectory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gnss_sem_map.errors import DataError, PointTimesError, counted
from gnss_sem_map.preflight import extrinsics, point_times, sweep_stamps
from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.preflight.lidar_motion import Stretch
from gnss_sem_map.preflight.sample import Sample, first_readable

SCANS, INTENSITY = "scans", "intensity"
STEP = 1 / 255
"""Of intensities in the map."""


def check(sample: Sample) -> Iterator[Finding]:
    """Stamps first, which are cheap; then a few seconds of scans."""
    yield from sweep_stamps.check(sample)
    if not sample.log.scans:
        yield green(SCANS, "no LiDAR scan: the drive has a trajectory, but makes no map")
        return
    yield from _scans(sample)
    yield _intensity(sample)
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
    found = f"{fit} of {counted(len(tried), 'stretch', 'stretches')} of a second have scans that fit onto each other"
    if unreadable:
        level = red if len(unreadable) > len(tried) / 2 else amber
        why, mistake, remedy = _why_unreadable(unreadable[0])
        yield level(SCANS, f"{found}; {why}", mistake, remedy)
    elif len(tried) - fit > len(tried) / 2:
        yield amber(
            SCANS,
            found,
            "scans hold few points, are not in metres, or in another order of columns",
            "expected rows of x y z intensity, m, in the lidar frame",
        )
    else:
        yield green(SCANS, found)


def _intensity(sample: Sample) -> Finding:
    """Whether intensities are from 0 to 1: nothing else tells their scale."""
    found = []
    for log in sample.log.by_lidar:
        first = sample.first_points if log.scans is sample.log.scans else first_readable(log.scans)
        values = np.zeros(0) if first is None else first[0].intensity
        values = values[np.isfinite(values) & (values > 0)]
        if len(values):
            found.append((float(np.median(values)), float(values.max()), log.lidar))
    if not found:
        return green(INTENSITY, "not observable: no point has one")
    wrong = [one for one in found if not STEP / 2 < one[0] <= 1]
    middle, largest, name = (wrong or found)[0]
    evidence = (
        f"{f'of {name} ' if name else ''}half of those above 0 are above {middle:.3g}, up to {largest:.3g};"
        " expected 0 to 1"
    )
    if not wrong:
        return green(INTENSITY, evidence)
    return amber(
        INTENSITY,
        evidence,
        "intensities have another scale: in the map most are all the same",
        "set intensity_max of this LiDAR in rig.yaml or log.yaml: what its driver writes for 1, most often 255",
    )


def _why_unreadable(error: DataError) -> tuple[str, str, str]:
    """What was found, the probable mistake, and its remedy."""
    if isinstance(error, PointTimesError):
        remedy = "give each point's time minus the scan's stamp, s; of a bag, point_times_unit in rig.yaml"
        return error.found, error.mistake, remedy
    return (
        str(error),
        "scans are damaged, cut short, of another count of columns, or other bytes than points",
        "copy the scans again: little-endian float32 x y z intensity, m; of a CSV log also the time of each point,"
        " unless lidar_is_compensated is true; of a bag, its message says what is to do",
    )

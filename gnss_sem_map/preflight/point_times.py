"""Check of the point times of a sweep: wrong times make the surfaces in a second of sweeps thicker.

A moving scanner bends what it sees by how far it moves in a sweep. Deskewed with the right times, by the LiDAR's own
motion, surfaces of several sweeps lie on each other; with other times they are thicker. Every cube of space is compared
with itself under each of the times, so that the scene cancels out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import counted
from gnss_sem_map.preflight.findings import Finding, amber, green, red
from gnss_sem_map.preflight.lidar_motion import Stretch, Surfaces, Sweep, turns
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.sensor_log import Points

Array = NDArray[np.float64]
NAME, THICKNESS = "point times", "deskewing"
UNITS = {1e3: "ms", 1e6: "µs", 1e9: "ns"}
LONGEST_SWEEPS = 3.0
"""Times of one sweep span no more sweeps than this."""
FULL_CIRCLE = 0.75
"""A scanner that saw so much of the circle turned: its points cannot all have one time."""
AT_ONCE_S = 1e-4
OF_BAG = "; of a bag, point_times: compensated in rig.yaml"
LEAST_MOTION_M = 0.1
"""What a sweep must be bent by before surfaces tell anything."""
LEAST, RAW_SURE, COMPENSATED_SURE, CLEAR = 1.0, 3.0, 4.0, 3.0
"""Standard errors: that both measures must find for other times, that their sum must be for scans with times and for
compensated ones, and by which one of two other times is clearly the better. Right times of raw scans are never worse
than none (ten drives: -1 at most); what compensation leaves may look like times by chance, 2 in a stretch."""


@dataclass(frozen=True)
class _Times:
    """Times that the points may have: each a multiple of the given ones, or of those that the azimuth tells."""

    name: str
    given: float
    by_azimuth: float

    def of(self, sweep: Sweep, interval: float) -> tuple[Array, Array] | None:
        if self.given and sweep.after_s is not None and sweep.dense_after_s is not None:
            return self.given * sweep.after_s, self.given * sweep.dense_after_s
        if self.by_azimuth:
            step = self.by_azimuth * interval
            return step * turns(sweep.p_lidar), step * turns(sweep.dense)
        return None


GIVEN = _Times("the given times", 1.0, 0.0)
NONE = _Times("no times", 0.0, 0.0)
REVERSED = _Times("reversed times", -1.0, 0.0)
CLOCKWISE = _Times("a clockwise turn", 0.0, 1.0)
ANTICLOCKWISE = _Times("an anticlockwise turn", 0.0, -1.0)


def check(sample: Sample) -> Iterator[Finding]:
    """Times as numbers first, then by what they do to surfaces."""
    first = sample.first_points
    if first is None or len(sample.log.scans) < 2:
        return
    points, stamp = first
    interval = float(np.median(np.diff([scan.stamp for scan in sample.log.scans])))
    if points.stamps is not None:
        found = _as_numbers(points, stamp, interval)
        yield found
        if found.mistake:
            return
    yield _by_surfaces(sample, interval)


def _as_numbers(points: Points, stamp: float, interval: float) -> Finding:
    assert points.stamps is not None
    usable = np.isfinite(points.stamps) & np.isfinite(points.xyz).all(axis=1) & points.xyz.any(axis=1)
    after = points.stamps[usable] - stamp
    if not len(after):
        return green(NAME, "not observable: no point with a time")
    span, middle = float(np.ptp(after)), float(np.median(after))
    seen = float((np.histogram(turns(points.xyz[usable]), 36, (-0.5, 0.5))[0] > 0).mean())
    found = f"{span:.4g} s from the first point of a sweep to the last, for scans {interval:.3f} s apart"
    if span < AT_ONCE_S and seen >= FULL_CIRCLE:
        return red(
            NAME,
            f"{found}, that see {seen:.0%} of the circle",
            "point times are all zero, or all the same: nothing is deskewed",
            "write each point's time minus the scan's stamp, s, into the fifth column;"
            f" or say lidar_is_compensated: true where the scans are{OF_BAG}",
        )
    if span > LONGEST_SWEEPS * interval:
        factor = min(UNITS, key=lambda unit: abs(np.log(span / interval / unit)))
        fits = 0.3 < span / interval / factor < LONGEST_SWEEPS
        return red(
            NAME,
            found,
            f"point times are in {UNITS[factor]}" if fits else "point times are no seconds of one sweep",
            "give point times in seconds after the scan's stamp; of a bag, their point_times_unit in rig.yaml",
        )
    if abs(middle) > LONGEST_SWEEPS * interval:
        return red(
            NAME,
            f"points are {middle:.4g} s after their scan's stamp, expected within {interval:.3f} s",
            "point times are absolute, or of another clock than the scan stamps",
            "give each point's time minus the scan's stamp, s",
        )
    if 0 < span < 0.2 * interval and seen >= FULL_CIRCLE:
        return amber(
            NAME,
            f"{found}, that see {seen:.0%} of the circle",
            "point times are of another unit",
            "give point times in seconds after the scan's stamp; of a bag, their point_times_unit in rig.yaml",
        )
    return green(NAME, found)


def _by_surfaces(sample: Sample, interval: float) -> Finding:
    stretches = [s for s in sample.stretches if _bent(s, interval) > LEAST_MOTION_M]
    if not stretches:
        return green(THICKNESS, "not observable: the vehicle hardly moved where scans were looked at")
    sweep = stretches[0].sweeps[0]
    has_times = sweep.after_s is not None and float(np.ptp(sweep.after_s)) > AT_ONCE_S
    as_given = GIVEN if has_times else NONE
    given = [_surfaces(s, as_given, interval, sample) for s in stretches]

    def gain(times: _Times) -> tuple[float, float]:
        return _gain(given, [_surfaces(s, times, interval, sample) for s in stretches])

    first, second = (NONE, REVERSED) if has_times else (CLOCKWISE, ANTICLOCKWISE)
    gains = {first: gain(first)}
    if not has_times or sum(gains[NONE]) > -RAW_SURE:
        gains[second] = gain(second)  # no times lie between right ones and reversed ones
    best = max(gains, key=lambda other: sum(gains[other]))
    extents, thicknesses = gains[best]
    found = (
        f"surfaces of {counted(len(stretches), 'stretch', 'stretches')} of a second: {best.name} against"
        f" {as_given.name} make them thinner by {thicknesses:.1f} standard errors (spread {extents:.1f})"
    )
    sure = min(extents, thicknesses) > LEAST and (
        extents + thicknesses > RAW_SURE
        if has_times
        else len(stretches) > 1 and extents + thicknesses > COMPENSATED_SURE
    )
    if not sure:
        return green(THICKNESS, found)
    if not has_times:
        return amber(
            THICKNESS,
            found,
            "raw scans are called compensated (lidar_is_compensated), or their times are lost",
            "set lidar_is_compensated: false and give point times in a fifth column; of a bag, the name of their field"
            " as point_times in rig.yaml",
        )
    reverse = (
        "point times are reversed: the scanner turns the other way",
        "change the sign of the point times",
    )
    twice = (
        "compensated scans are called raw: they are deskewed twice",
        f"set lidar_is_compensated: true, with scans of four columns{OF_BAG}",
    )
    likely, other = (reverse, twice) if best is REVERSED else (twice, reverse)
    if extents + thicknesses - min(sum(both) for both in gains.values()) > CLEAR:
        return amber(THICKNESS, found, *likely)
    return amber(THICKNESS, found, f"{likely[0]}; or {other[0]}", f"{likely[1]}; or {other[1]}")


def _surfaces(stretch: Stretch, times: _Times, interval: float, sample: Sample) -> Surfaces:
    if times is GIVEN:
        return sample.deskewed(stretch)[1]
    return stretch.deskewed(tuple(times.of(sweep, interval) for sweep in stretch.sweeps))[1]


def _gain(given: list[Surfaces], other: list[Surfaces]) -> tuple[float, float]:
    """By how many standard errors points spread less, and surfaces are thinner, with other times than the given."""
    pairs = [_paired(a, b) for a, b in zip(given, other, strict=True)]
    extents, thicknesses = (_in_errors([pair[k] for pair in pairs]) for k in (0, 1))
    return extents, thicknesses


def _paired(a: Surfaces, b: Surfaces) -> tuple[Array, Array]:
    """Differences (c,) in each cube that both have."""
    _, in_a, in_b = np.intersect1d(a.cubes, b.cubes, assume_unique=True, return_indices=True)
    return a.extents[in_a] - b.extents[in_b], a.thicknesses[in_a] - b.thicknesses[in_b]


def _in_errors(differences: list[Array]) -> float:
    means = np.array([d.mean() for d in differences if len(d) > 1])
    variances = np.array([d.var() / len(d) for d in differences if len(d) > 1])
    return float(means.sum() / np.sqrt(variances.sum() + 1e-12)) if len(means) else 0.0


def _bent(stretch: Stretch, interval: float) -> float:
    """By how much a sweep is bent, m: the way in it, and its turn at 10 m."""
    angular, velocity = stretch.rates[2]
    return interval * float(np.linalg.norm(velocity) + 10.0 * np.linalg.norm(angular))

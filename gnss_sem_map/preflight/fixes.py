"""Fixes for the diagnosis of the IMU: without outliers and without frozen positions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factor_graphs.dead_reckoning import integral
from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuSamples
from factor_graphs.screening import are_new, plausible

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Fixes that differ by less, m, are the same one again: receivers scatter by more, even where they stand.
SAME_PLACE_M = 1e-3
# So long, s, they must stand still to be called frozen, and this often be reported.
FROZEN_S, FROZEN_FIXES = 2.0, 3
# What a car brakes or speeds up with at most, m/s², and what its speed may differ by besides, m/s.
HARD_BRAKING, SPEED_MARGIN = 6.0, 1.0
# Numbers per degree: four to six decimals, or three and four of minutes.
ROUNDED_TO, DEGREE_M = (1e4, 6e4, 1e5, 6e5, 1e6), 111_320.0
FEWEST_PLACES = 5
# Noise seldom exceeds so many times its median.
SPIKE = 6.0
# Who stands gains no speed by the accelerometer, m/s (rms about a slope, which is tilt and bias).
STANDING_MPS = 0.4
RADIANS = float(np.degrees(1.0))


@dataclass(frozen=True, eq=False)
class Fixes:
    """The fixes of a drive, and what is odd about them."""

    usable: GnssFixes
    """Those by which an IMU can be judged; as metres even where the log has radians."""
    implausible: int
    """Number of fixes that a vehicle cannot have reached."""
    frozen: Array
    """(k, 2) first and last stamp, s, of runs that stand still while the vehicle drives."""
    grain_m: float
    """Degrees are rounded to so many metres; 0 where they are finer than receivers are."""
    are_radians: bool
    moves_from_s: float
    """When the track first leaves its start; the first stamp where it never does."""


def examine(fixes: GnssFixes, frame: LocalFrame, imu: ImuSamples, max_speed_mps: float) -> Fixes:
    """Look at all fixes, before anything is known of the IMU."""
    credible = plausible(fixes, max_speed_mps)
    kept = fixes[credible]
    kept = kept[~_spikes(kept)]
    grain = grain_m(kept, frame)
    frozen = frozen_runs(kept, imu, frame.gravity, grain)
    thawed = np.ones(len(kept), dtype=bool)
    for first, last in frozen:
        thawed &= (kept.stamps < first) | (kept.stamps > last)
    kept = kept[thawed]
    kept = kept[are_new(kept)]
    are_radians = _look_like_radians(kept, frame)
    if are_radians:
        kept = replace(kept, positions=kept.positions * RADIANS)
    return Fixes(kept, int(np.sum(~credible)), frozen, grain, are_radians, _moves_from(fixes))


def _spikes(fixes: GnssFixes) -> Mask:
    """Fixes farther from the line between their neighbours than driving and usual noise can be, (m,)."""
    out = np.zeros(len(fixes), dtype=bool)
    if len(fixes) < 5:
        return out
    p, t = fixes.positions[:, :2], fixes.stamps
    share = ((t[1:-1] - t[:-2]) / (t[2:] - t[:-2]))[:, None]
    off = np.linalg.norm(p[1:-1] - (1 - share) * p[:-2] - share * p[2:], axis=1)
    pause = (t[2:] - t[:-2]) / 2
    limit = HARD_BRAKING * pause**2 + SPIKE * float(np.median(off))
    padded = np.pad(off, 1)
    out[1:-1] = (off > limit) & (off >= padded[:-2]) & (off >= padded[2:])
    out[[0, -1]] = out[[1, -2]]  # at an end it may be either of two
    return out


def _look_like_radians(fixes: GnssFixes, frame: LocalFrame) -> bool:
    """Whether all lie where latitude and longitude in radians lie: at sea, off West Africa."""
    if len(fixes) == 0:
        return False
    lat, lon, _ = frame.to_geodetic(fixes.positions)
    return bool(np.all(np.abs(lat) <= np.pi / 2) and np.all(np.abs(lon) <= np.pi))


def _moves_from(fixes: GnssFixes) -> float:
    if len(fixes) == 0:
        return 0.0
    away = np.linalg.norm(fixes.positions[:, :2] - fixes.positions[0, :2], axis=1)
    left = np.flatnonzero(away > 10.0)
    return float(fixes.stamps[left[0] if len(left) else 0])


def grain_m(fixes: GnssFixes, frame: LocalFrame) -> float:
    """What latitude and longitude, or their minutes, were rounded to, m; 0 where to less than 0.1 m."""
    lat, lon, _ = frame.to_geodetic(fixes.positions)
    for per_degree in ROUNDED_TO:
        units = np.stack([lat, lon]) * per_degree
        whole = np.round(units)
        if np.unique(whole, axis=1).shape[1] >= FEWEST_PLACES and np.abs(units - whole).max() < 1e-2:
            return DEGREE_M / per_degree
    return 0.0


def frozen_runs(fixes: GnssFixes, imu: ImuSamples, gravity: float, grain: float = 0.0) -> Array:
    """Runs of one and the same position that the vehicle drove into, out of, or in: (k, 2) stamps, s.

    Where positions were rounded to a `grain`, m, they stay the same while it crawls, and then jump by it.
    """
    steps = np.linalg.norm(np.diff(fixes.positions[:, :2], axis=0), axis=1)
    durations = np.diff(fixes.stamps)
    same = np.concatenate([[False], steps < SAME_PLACE_M, [False]])
    edges = np.flatnonzero(np.diff(same.astype(int)))
    speeds = np.maximum(steps - np.sqrt(2) * grain, 0.0) / durations
    found = []
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first + 1 < FROZEN_FIXES or fixes.stamps[last] - fixes.stamps[first] < FROZEN_S:
            continue
        into = first > 0 and speeds[first - 1] > SPEED_MARGIN + HARD_BRAKING * durations[first - 1]
        out = last < len(speeds) and speeds[last] > SPEED_MARGIN + HARD_BRAKING * durations[last]
        if into or out or (not grain and _moves(imu, gravity, fixes.stamps[first], fixes.stamps[last])):
            found.append((fixes.stamps[first], fixes.stamps[last]))
    return np.array(found).reshape(-1, 2)


def _moves(imu: ImuSamples, gravity: float, start: float, end: float) -> bool:
    """Whether the accelerometer, in whatever unit and axes, gains and loses speed between two stamps."""
    within = slice(*np.searchsorted(imu.stamps, [start, end]))
    stamps, force = imu.stamps[within], imu.specific_force[within]
    if len(stamps) < 4:
        return False
    mean = force.mean(axis=0)
    size = float(np.linalg.norm(mean))
    if size == 0.0:
        return False
    level = (force - np.outer(force @ mean, mean) / size**2) * (gravity / size)
    speed = integral(stamps, level - level.mean(axis=0))
    slope = stamps - stamps.mean()
    speed = speed - speed.mean(axis=0) - np.outer(slope, slope @ speed / (slope @ slope))
    return float(np.sqrt(np.mean(np.sum(speed**2, axis=1)))) > STANDING_MPS

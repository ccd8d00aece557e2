"""Passes of one place, bound into one graph: how each drive's trajectory moves, and how far surfaces lay apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factor_graphs.condensing import CondensedDrive
from factor_graphs.corrections import Correction
from factor_graphs.errors import EstimationError
from factor_graphs.sessions import Bound, bind, components
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.process.machine import one_blas_thread
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.scans.base_cloud import BaseCloud
from gnss_sem_map.scans.revisits import (
    Registrar,
    Revisits,
    RevisitSettings,
    pass_of,
    register_passes,
    register_to_base,
)
from gnss_sem_map.scans.thinned_sweeps import ThinnedSweeps

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LocatedDrive:
    """A drive that can be bound to others, in the frame of all."""

    name: str
    sweeps: ThinnedSweeps
    """Along its track, see `local_maps.sweeps_along`."""
    trajectory: Trajectory
    condensed: CondensedDrive


@dataclass(frozen=True)
class TwoPasses:
    """What binds a drive to another one, or to itself: distances between the surfaces of both, medians, m."""

    first: str
    second: str
    places: int
    """Registered."""
    bound: int
    """Of them, those that hold the drives together."""
    before_m: float
    after_m: float


@dataclass(frozen=True, eq=False)
class Together:
    """Drives that are bound: corrections of each, None where no pair holds one; `refused` places did not match.

    `warnings` name the drives that stay as they are because their equations have no solution.
    """

    corrections: list[Correction | None]
    passes: tuple[TwoPasses, ...]
    refused: int
    warnings: tuple[str, ...]
    places: tuple[int, ...]
    """Of each drive: so many were tried."""


@one_blas_thread()
def bind_passes(
    drives: Sequence[LocatedDrive],
    settings: RevisitSettings,
    base: BaseCloud | None = None,
    registrar: Registrar | None = None,
) -> Together:
    """Find what the drives passed again, and bind those together that have a place in common.

    A `base` stands, and counts as one more drive. Of several drives, one that only passes its own places again is left
    to bind itself. `registrar`: see `register_passes`.
    """
    passes = [pass_of(drive.sweeps, drive.trajectory, drive.condensed, settings) for drive in drives]
    revisits = register_passes(passes, settings, registrar)
    condensed = [drive.condensed for drive in drives]
    names = [drive.name for drive in drives]
    if base is not None:
        revisits += register_to_base(base, len(drives), passes, settings)
        condensed, names = [*condensed, CondensedDrive.fixed()], [*names, base.name]
    for one in passes:
        one.maps.forget()
    corrections: list[Correction | None] = [None] * len(names)
    table: list[TwoPasses] = []
    warnings: list[str] = []
    for group in components(len(names), revisits.pairs.drives):
        inside = revisits.of(np.isin(revisits.pairs.drives[:, 0], group))
        if not len(inside.pairs) or len(group) == 1 < len(names):
            continue
        number = np.full(len(names), -1)
        number[group] = np.arange(len(group))
        inside = inside.numbered(number)
        try:
            bound = bind([condensed[n] for n in group], inside.pairs)
        except EstimationError as error:
            warnings.append(
                f"{', '.join(names[n] for n in group)}: not bound where they passed again; {error}"
            )
            continue
        for n in np.unique(inside.pairs.drives[bound.used]).tolist():
            corrections[group[n]] = bound.corrections[n]
        table += _table([names[n] for n in group], inside, bound)
    places = tuple(len(one.anchors) for one in passes)
    return Together(corrections[: len(drives)], tuple(table), revisits.refused, tuple(warnings), places)


def count_passes(together: Together, stats: RunStats) -> None:
    """Count what was passed again, and what of it was left out; warn of what could not be bound."""
    stats.counts["places passed again"] += sum(row.places for row in together.passes) + together.refused
    stats.counts["places bound"] += sum(row.bound for row in together.passes)
    stats.warnings.extend(together.warnings)


def _table(names: Sequence[str], revisits: Revisits, bound: Bound) -> list[TwoPasses]:
    pairs, table = revisits.pairs, []
    after = [
        np.linalg.inv(bound.corrections[a].after[i]) @ bound.corrections[b].after[j]
        for (a, b), (i, j) in zip(pairs.drives.tolist(), pairs.anchors.tolist(), strict=True)
    ]
    for a, b in np.unique(pairs.drives, axis=0).tolist():
        rows = np.flatnonzero((pairs.drives == (a, b)).all(axis=1)).tolist()
        before_m, after_m = (
            float(np.median(np.concatenate([revisits.distances(n, T[n]) for n in rows])))
            for T in (revisits.guesses, after)
        )
        used = int(bound.used[rows].sum())
        table.append(TwoPasses(names[a], names[b], len(rows), used, before_m, after_m))
    return table

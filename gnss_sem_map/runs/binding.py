"""Drives that pass the same places are bound to each other, and each to itself, before they are mapped.

Only drives whose tracks come near each other are looked at. Each group that is bound is solved alone: so the result for
a drive depends on those that it is bound to, not on the order, nor on who else is in the map. A drive that no other one
holds is bound to its own first pass, in its own frame.

FOLDER/group.npz, alone.npz    how a drive moves because of others, or of itself (`files.memo`)
       revisits/N.npz          what some pairs of places say, in the folder of the first drive of a group
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from factor_graphs.condensing import CondensedDrive
from factor_graphs.sessions import components
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.archives import npz_of
from gnss_sem_map.files.memo import arrays_of, recall, remember
from gnss_sem_map.files.work_folder import REVISITS
from gnss_sem_map.mapping.passes import LocatedDrive, TwoPasses, bind_passes, count_passes
from gnss_sem_map.mapping.trajectory import in_frame
from gnss_sem_map.process.execution import InProcess, Task, path_of, run_tasks
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.runs.drive_job import DriveJob, job_of, opened
from gnss_sem_map.runs.drive_tasks import ALONE, GROUP, LOCATED, matched_along
from gnss_sem_map.runs.map_job import MapJob
from gnss_sem_map.scans.base_cloud import BaseCloud
from gnss_sem_map.scans.downsampling import one_per_cube
from gnss_sem_map.scans.local_maps import sweeps_along
from gnss_sem_map.scans.revisits import Found, Pair, Pass, pass_of, register_pair
from gnss_sem_map.voxels.reuse import digest

Array = NDArray[np.float64]

NEAR_M = 50.0
"""Tracks that come nearer may have passed the same place: receivers err by metres, and a map reaches 60 m."""
EVERY_M = 10.0
"""Tracks are compared by one point per cube of this edge."""
BASE = "/base"
"""Stands for the base among the names of drives, none of which holds a slash."""
PAIRS_PER_TASK = 24
"""Two seconds of work; pairs in a row have local maps in common."""


@dataclass(frozen=True)
class LocatedJob:
    """A drive whose trajectory is known: the digests of its matches (None: it has none), and of what was found."""

    job: DriveJob
    matches: str | None
    located: str

    def track(self) -> Array:
        """Where it was, (n, 3) m in the map."""
        found = self.job.needed(LOCATED, self.located)
        track = replace(Trajectory(**found.of("track")), covariances=None)
        return in_frame(opened(*self.job.key).log, track, self.job.origin)[1].positions

    def to_bind(self, is_own: bool) -> LocatedDrive | None:
        """The drive in the map, or in its own frame; None where its trajectory cannot be bound."""
        found = self.job.needed(LOCATED, self.located)
        if "condensed" not in found.arrays or self.matches is None:
            return None
        drive, first = matched_along(*self.job.key, self.matches)
        track = Trajectory(**found.of("track"))
        condensed = CondensedDrive.from_bytes(found.arrays["condensed"].tobytes())
        sweeps = sweeps_along(drive.log, first, self.job.saved)
        if is_own:
            return LocatedDrive(drive.log.name, sweeps, track, condensed)
        track = in_frame(drive.log, track, self.job.origin)[1]
        return LocatedDrive(self.job.name, sweeps, track, condensed.at(track))


@dataclass(frozen=True, eq=False)
class BoundDrives:
    """What binds drives to each other.

    `keys`: digest of how each drive moves, empty where it stays; `held`: of those that others hold, that of the
    correction; `places`: so many of each were tried; `warnings` name drives that could not be bound.
    """

    keys: Mapping[str, str]
    held: Mapping[str, str] = field(default_factory=dict)
    passes: tuple[TwoPasses, ...] = ()
    warnings: tuple[str, ...] = ()
    places: Mapping[str, int] = field(default_factory=dict)


def bind(
    drives: Mapping[str, LocatedJob], tracks: Mapping[str, Array], run: MapJob, base: BaseCloud | None = None
) -> BoundDrives:
    """Bind located drives that pass the same places, and what is near a `base`; then each of the others to itself.

    `tracks` are those of all drives of the map, in its frame.
    """
    keys, held, passes, warnings, places = dict.fromkeys(drives, ""), {}, [], [], {}
    if not is_bindable(run):
        return BoundDrives(keys)
    for group in groups_near(tracks, run, base):
        names = [name for name in group if name in drives]
        made_from, found = _bound(
            [drives[name] for name in names], GROUP, run, base if BASE in group else None
        )
        for name, about in found.items():
            places[name] = about["places"]
            if about["correction"]:
                keys[name], held[name] = made_from, about["correction"]
        for about in list(found.values())[:1]:
            passes += [TwoPasses(**row) for row in about["passes"]]
            warnings += about["warnings"]
    for name in [name for name in drives if name not in held]:
        made_from, found = _bound([drives[name]], ALONE, run)
        if found:
            keys[name] = made_from
    return BoundDrives(keys, held, tuple(passes), tuple(warnings), places)


def is_bindable(run: MapJob) -> bool:
    """Whether the settings let places that are passed again bind anything."""
    return run.settings.trajectory.revisits.enabled and run.settings.trajectory.lidar_odometry


def groups_near(tracks: Mapping[str, Array], run: MapJob, base: BaseCloud | None) -> list[list[str]]:
    """Names of drives that may be bound to each other, or to a base."""
    there = dict(tracks) | ({} if base is None else {BASE: base.points})
    return [group for group in groups_of(there) if len(group) > 1] if is_bindable(run) else []


def groups_of(tracks: Mapping[str, Array]) -> list[list[str]]:
    """Names of drives whose tracks come near each other, directly or by others; in the order of names."""
    names = sorted(tracks)
    thin = [one_per_cube(np.ascontiguousarray(tracks[name]), EVERY_M) for name in names]
    trees = [cKDTree(track) for track in thin]
    edges = [
        (a, b)
        for b in range(len(names))
        for a in range(b)
        if np.isfinite(trees[a].query(thin[b], distance_upper_bound=NEAR_M)[0]).any()
    ]
    groups = components(len(names), np.array(edges, np.intp).reshape(-1, 2))
    return [[names[n] for n in group] for group in groups]


def _bound(
    group: Sequence[LocatedJob], name: str, run: MapJob, base: BaseCloud | None = None
) -> tuple[str, dict[str, dict[str, Any]]]:
    """Bind drives that are near each other, or one to itself, and remember how each moves.

    Returns the digest of what they are bound from, and drive -> what was found, of those that can be bound.
    """
    is_own, revisits = name == ALONE, run.settings.trajectory.revisits
    of_base = None if base is None else [base.name, hashlib.sha256(base.points.tobytes()).hexdigest()]
    made_from = digest([[one.located for one in group], revisits.model_dump(mode="json"), of_base, is_own])
    known = {one.job.name: one.job.found(name, made_from) for one in group}
    if all(found is not None for found in known.values()):
        return made_from, {
            key: found.about for key, found in known.items() if found is not None and found.about
        }
    opened = {one.job.name: found for one in group if (found := one.to_bind(is_own)) is not None}
    bindable = [one for one in group if one.job.name in opened]
    abouts: dict[str, dict[str, Any]] = {}
    if bindable and (is_own or len(bindable) > 1 or base is not None):
        registrar = None
        if not isinstance(run.executor, InProcess):
            registrar = partial(_registered, bindable, is_own, digest([made_from, "pairs"]), run)
        together, stats = bind_passes(list(opened.values()), revisits, base, registrar), RunStats()
        if is_own:
            count_passes(together, stats)
        for one, correction, places in zip(bindable, together.corrections, together.places, strict=True):
            abouts[one.job.name] = {
                "correction": "" if correction is None else hashlib.sha256(npz_of(correction)).hexdigest(),
                "passes": [asdict(row) for row in together.passes],
                "warnings": list(together.warnings), "places": places, "stats": stats.as_dict(),
            }  # fmt: skip
            arrays = arrays_of("correction", correction)
            remember(one.job.folder / f"{name}.npz", made_from, abouts[one.job.name], arrays)
    for one in group:
        if one.job.name not in abouts:
            remember(one.job.folder / f"{name}.npz", made_from, {}, {})
    return made_from, abouts


def _registered(
    group: Sequence[LocatedJob],
    is_own: bool,
    made_from: str,
    run: MapJob,
    passes: Sequence[Pass],
    pairs: Sequence[Pair],
) -> Iterator[Found | None]:
    """Pairs of places, registered on the workers of an executor."""
    if len(pairs) <= PAIRS_PER_TASK:  # a worker would take as long to open the drives
        yield from (register_pair(passes, pair, run.settings.trajectory.revisits) for pair in pairs)
        return
    drives = [[*one.job.key, one.matches, one.located] for one in group]
    groups = [pairs[start : start + PAIRS_PER_TASK] for start in range(0, len(pairs), PAIRS_PER_TASK)]
    tasks = [
        Task(
            f"{group[0].job.name}, places that are passed again",
            REGISTER,
            (drives, is_own, made_from, n, some),
        )
        for n, some in enumerate(groups)
    ]
    results = {task.arguments[3]: found for task, found in run_tasks(tasks, run.executor)}
    for n in range(len(groups)):
        yield from map(_unpacked, results[n])


def register(
    drives: list[list[str]], is_own: bool, made_from: str, number: int, pairs: list[list[int]]
) -> list[Any]:
    """Register pairs of places of some drives, and remember what was found: a task. Raises DataError."""
    folder = job_of(*drives[0][:2]).folder / REVISITS
    key = digest([made_from, pairs])
    if (known := recall(folder / f"{number}.npz", key)) is not None:
        return list(known.about["found"])
    passes, settings = _opened(tuple(map(tuple, drives)), is_own)
    found = [_packed(register_pair(passes, (a, i, b, j), settings)) for a, i, b, j in pairs]
    remember(folder / f"{number}.npz", key, {"found": found}, {})
    return found


REGISTER = path_of(register)


@lru_cache(1)
def _opened(drives: tuple[tuple[str, str, str, str], ...], is_own: bool) -> tuple[list[Pass], Any]:
    """The places of drives: opened once for all tasks of a worker."""
    passes, settings = [], None
    for folder, key, matches, located in drives:
        job = job_of(folder, key)
        settings = job.settings.trajectory.revisits
        found = LocatedJob(job, matches, located).to_bind(is_own)
        assert found is not None
        passes.append(pass_of(found.sweeps, found.trajectory, found.condensed, settings))
    return passes, settings


def _packed(found: Found | None) -> Any:
    """As JSON, in which numbers keep all their digits."""
    if found is None:
        return None
    return [found.T.tolist(), found.covariance.tolist(), [a.tolist() for a in found.sample]]


def _unpacked(packed: Any) -> Found | None:
    if packed is None:
        return None
    T, covariance, (points, normals) = packed
    return Found(np.array(T), np.array(covariance), (np.array(points), np.array(normals)))


def with_unheld(tracks: Mapping[str, Array], bound: BoundDrives, base: BaseCloud, force: bool) -> BoundDrives:
    """With a warning for each drive that a base does not hold.

    Raises DataError where it fits to none of them, unless by `force`.
    """
    held, before = {base.name}, 0
    while len(held) > before:  # by others, too
        before = len(held)
        held |= {
            name for row in bound.passes if row.bound and held & {row.first, row.second}
            for name in (row.first, row.second)
        }  # fmt: skip
    warnings, fits = [], len(held) > 1
    for name in [name for name in tracks if name not in held]:
        found = max(
            (row.places for row in bound.passes if {row.first, row.second} == {name, base.name}), default=0
        )
        tried = bound.places.get(name, 0)
        fits |= 0 < tried <= 2 * found  # of the right place, but too short a drive to hold it
        fit = f"{found} of its {tried} places fit" if tried else "none of its places is near"
        aside_m, below_m = base.beside(tracks[name])
        warnings.append(
            f"{name}: not held onto {base.name}: {fit}; the cloud begins {aside_m:.1f} m"
            f" aside of its track, and lies {abs(below_m):.1f} m {'above' if below_m < 0 else 'below'} it; is it of"
            " this place, with heights above the ellipsoid, or the CRS of its heights?"
        )
    if warnings and not fits and not force:
        raise DataError(f"{warnings[0]} correct it, leave --align-to out, or run with --force")
    return replace(bound, warnings=(*bound.warnings, *warnings))


def refuse_unbindable(base: BaseCloud, run: MapJob) -> None:
    """Raise DataError where the settings let nothing be held onto a base."""
    if not is_bindable(run):
        raise DataError(
            f"{base.name}: nothing is held onto it without trajectory.revisits.enabled=true and"
            " trajectory.lidar_odometry=true; set both, or leave --align-to out"
        )

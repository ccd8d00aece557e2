"""Drives that pass the same places are bound to each other before they are mapped.

WORK/bound/NAME/job.json, trajectory.npz    a drive that was located, in the frame of all (`runs.drive_job`)
               condensed.npz               what its graph says of its anchors (`factor_graphs.condensing`)
               located.json                from what, and the checksums of these
               correction.npz              how its anchors move once all drives are known

Only drives whose tracks come near each other are looked at; one that had no fix for long is located to know its track.
Each group that is bound is solved alone: so the result for a drive depends on those that it is bound to, not on the
order, nor on who else is in the map.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from factor_graphs.condensing import CondensedDrive
from factor_graphs.corrections import Correction
from factor_graphs.geodesy import LocalFrame
from factor_graphs.sessions import components
from gnss_sem_map import config
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.archives import npz_of
from gnss_sem_map.files.atomic import write_whole
from gnss_sem_map.files.untrusted import read_bytes
from gnss_sem_map.files.work_folder import BOUND, DRIVES, JOB, SWEEPS, TRAJECTORY, writing_to
from gnss_sem_map.mapping import fingerprints
from gnss_sem_map.mapping.passes import LocatedDrive, TwoPasses, bind_passes
from gnss_sem_map.process.execution import failure_of
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.runs import pipeline, run_folder
from gnss_sem_map.runs.drive_job import read_job, read_trajectory, write_job
from gnss_sem_map.runs.match_tasks import SavedMatches
from gnss_sem_map.runs.several_drives import SeveralDrives, refuse_earlier
from gnss_sem_map.runs.source import Source
from gnss_sem_map.scans.base_cloud import BaseCloud
from gnss_sem_map.scans.downsampling import one_per_cube
from gnss_sem_map.scans.local_maps import sweeps_of
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels.reuse import read_record, write_record

Array = NDArray[np.float64]

NEAR_M = 50.0
"""Tracks that come nearer may have passed the same place: receivers err by metres, and a map reaches 60 m."""
EVERY_M = 10.0
"""Tracks are compared by one point per cube of this edge."""
BASE = "/base"
"""Stands for the base among the names of drives, none of which holds a slash."""
CONDENSED, CORRECTION, LOCATED = "condensed.npz", "correction.npz", "located.json"


@dataclass(frozen=True, eq=False)
class KnownTrack:
    """Where a drive is known to have been before it is bound."""

    positions: Array
    """(n, 3) m."""
    has_gaps: bool = False
    """Whether it may have been elsewhere, too: it had no fix for so long."""


@dataclass(frozen=True, eq=False)
class BoundDrives:
    """Name -> file of the correction of each drive that is bound to others, and what binds them.

    `warnings` name drives that could not be bound; `failed`: name -> reason of drives that could not be located.
    """

    corrections: Mapping[str, Path]
    passes: tuple[TwoPasses, ...] = ()
    warnings: tuple[str, ...] = ()
    failed: Mapping[str, str] = field(default_factory=dict)
    places: Mapping[str, int] = field(default_factory=dict)
    """Of each drive that was located: so many were tried."""


def bind_drives(
    sources: Sequence[Source],
    tracks: Mapping[str, KnownTrack],
    run: SeveralDrives,
    base: BaseCloud | None = None,
    force: bool = False,
) -> BoundDrives:
    """Locate the drives that may have passed the same places, and bind those that did, and what is near a `base`.

    `tracks` are of drives by name; a drive without one, or that cannot be located, is left as it is. Raises DataError
    where the base fits to none of them, unless by `force`: then it is a warning.
    """
    settings = run.settings
    if not (settings.trajectory.revisits.enabled and settings.trajectory.lidar_odometry):
        if base is not None:
            raise DataError(
                f"{base.name}: nothing is held onto it without trajectory.revisits.enabled=true and"
                " trajectory.lidar_odometry=true; set both, or leave --align-to out"
            )
        return BoundDrives({})
    groups, reasons = _located_groups(sources, tracks, run, base)
    corrections: dict[str, Path] = {}
    passes: list[TwoPasses] = []
    warnings: list[str] = []
    places: dict[str, int] = {}
    for group in groups:
        names = [name for name in group if name != BASE and not reasons[name]]
        found = _bound(names, settings, run.work, base if BASE in group else None)
        corrections |= found.corrections
        passes += found.passes
        warnings += found.warnings
        places |= found.places
    failed = {name: reason for name, reason in reasons.items() if reason}
    bound = BoundDrives(corrections, tuple(passes), tuple(warnings), failed, places)
    return bound if base is None else _with_unheld([one.name for one in sources], tracks, bound, base, force)


def _with_unheld(
    names: Sequence[str], tracks: Mapping[str, KnownTrack], bound: BoundDrives, base: BaseCloud, force: bool
) -> BoundDrives:
    """With a warning for each drive that a base does not hold; raises DataError where it fits to none."""
    held, before = {base.name}, 0
    while len(held) > before:  # by others, too
        before = len(held)
        held |= {
            name for row in bound.passes if row.bound and held & {row.first, row.second}
            for name in (row.first, row.second)
        }  # fmt: skip
    warnings, fits = [], len(held) > 1
    for name in [name for name in names if name not in held]:
        found = max(
            (row.places for row in bound.passes if {row.first, row.second} == {name, base.name}), default=0
        )
        tried = bound.places.get(name, 0)
        fits |= 0 < tried <= 2 * found  # of the right place, but too short a drive to hold it
        fit = f"{found} of its {tried} places fit" if tried else "none of its places is near"
        aside_m, below_m = base.beside(tracks[name].positions) if name in tracks else (np.nan, np.nan)
        warnings.append(
            f"{name}: not held onto {base.name}: {fit}; the cloud begins {aside_m:.1f} m"
            f" aside of its track, and lies {abs(below_m):.1f} m {'above' if below_m < 0 else 'below'} it; is it of"
            " this place, with heights above the ellipsoid, or the CRS of its heights?"
        )
    if warnings and not fits and not force:
        raise DataError(f"{warnings[0]} correct it, leave --align-to out, or run with --force")
    return replace(bound, warnings=(*bound.warnings, *warnings))


def _located_groups(
    sources: Sequence[Source],
    tracks: Mapping[str, KnownTrack],
    run: SeveralDrives,
    base: BaseCloud | None,
) -> tuple[list[list[str]], dict[str, str]]:
    """The groups of drives that come near each other, all located, and name -> why one could not be, or nothing.

    Once a drive is located, its track has no gaps: it may come near others that its fixes did not.
    """
    places = {name: track.positions for name, track in tracks.items()}
    places |= {} if base is None else {BASE: base.points}
    reasons: dict[str, str] = {}
    while True:
        groups = [group for group in groups_of(places) if len(group) > 1]
        sought = {name for group in groups for name in group}
        if len(places) > 1:
            sought |= {name for name, track in tracks.items() if track.has_gaps}
        wanted = [source for source in sources if source.name in sought - reasons.keys()]
        if not wanted:
            return groups, reasons
        reasons |= run.call(locate_one, "locating", ((source, (str(run.work),)) for source in wanted))
        for source in wanted:
            folder = run.work / BOUND / source.name
            if not reasons[source.name] and (folder / JOB).is_file():  # others have no LiDAR odometry
                places[source.name] = read_trajectory(folder / TRAJECTORY).positions


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


def locate_one(source: Mapping[str, Any], settings: str, origin: Sequence[float], work: str) -> str:
    """Locate a drive, and save its trajectory and condensed graph: a task. Returns the reason when it fails.

    What was matched stays in the work folder of the drive, where its mapping finds it.
    """
    return failure_of(lambda: _locate_one(Source(**source), Path(settings), LocalFrame(*origin), Path(work)))


def _locate_one(source: Source, settings_file: Path, frame: LocalFrame, work: Path) -> None:
    settings = config.load(settings_file)
    log, folder = source.open_log().in_our_conventions(settings.sensors), work / BOUND / source.name
    fingerprint = _fingerprint(log, settings, frame)
    if _is_located(folder, fingerprint):  # before an interruption
        return
    with run_folder.claimed_run(work / DRIVES / source.name, waits=True) as claim:
        # it has waited where a cluster called it again while the call that it took for lost went on
        refuse_earlier(settings_file)
        if _is_located(folder, fingerprint):
            return
        for name in (LOCATED, JOB):  # of the drive as it was
            (folder / name).unlink(missing_ok=True)
        match = SavedMatches(source, claim.work, resume=True, mapped_next=False)
        found = pipeline.locate(log, settings, RunStats(), match=match, bound=False)
        if found.solution is None or found.solution.condensed is None or found.sweeps is None:
            return
        log, trajectory = pipeline.in_frame(log, found.trajectory, frame)
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / CONDENSED, found.solution.condensed.to_bytes())
        write_job(
            folder, source, settings, trajectory, fingerprint,
            sweeps=sorted(found.sweeps.numbers), saved=str((claim.work / SWEEPS).resolve()),
        )  # fmt: skip
        write_record({"fingerprint": fingerprint, "sha256": _checksums(folder)}, folder / LOCATED)


def _is_located(folder: Path, fingerprint: str) -> bool:
    """Whether a folder holds this drive, located and undamaged."""
    try:
        said = {"fingerprint": fingerprint, "sha256": _checksums(folder)}
    except DataError:
        return False
    return read_record(folder / LOCATED) == said


def _checksums(folder: Path) -> list[str]:
    return [hashlib.sha256(read_bytes(folder / name)).hexdigest() for name in (JOB, TRAJECTORY, CONDENSED)]


def _fingerprint(log: SensorLog, settings: Settings, frame: LocalFrame) -> str:
    said = [fingerprints.of_log(log), settings.model_dump(mode="json"), asdict(frame)]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _bound(
    names: Sequence[str], settings: Settings, work: Path, base: BaseCloud | None = None
) -> BoundDrives:
    """Bind located drives, and save how each moves."""
    names = [name for name in names if (work / BOUND / name / JOB).is_file()]  # others have no LiDAR odometry
    if not names or (len(names) == 1 and base is None):
        return BoundDrives({})
    drives = [_read(work / BOUND / name) for name in names]
    together = bind_passes(drives, settings.trajectory.revisits, base)
    files = {}
    for name, correction in zip(names, together.corrections, strict=True):
        if correction is not None:
            files[name] = work / BOUND / name / CORRECTION
            with writing_to(files[name].parent):
                write_whole(files[name], npz_of(correction))
    places = dict(zip(names, together.places, strict=True))
    return BoundDrives(files, together.passes, together.warnings, places=places)


def _read(folder: Path) -> LocatedDrive:
    about, source, _, log, trajectory = read_job(folder)
    condensed = CondensedDrive.from_bytes(read_bytes(folder / CONDENSED))
    sweeps = sweeps_of(log, about["sweeps"], Path(about["saved"]))
    return LocatedDrive(source.name, sweeps, trajectory, condensed.at(trajectory))


def read_correction(file: str) -> tuple[Correction | None, str]:
    """The correction in a file of `bind_drives`, and its digest; neither of them without a file."""
    if not file:
        return None, ""
    content = read_bytes(Path(file))
    with np.load(io.BytesIO(content)) as arrays:
        return Correction(**arrays), hashlib.sha256(content).hexdigest()

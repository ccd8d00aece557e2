"""Maps of several drives: what makes or changes one prepares the folder, and calls the stages of the `pipeline`.

Sums are exact. So adding a drive later, or taking one out, gives the same bytes as a run of the same drives at once:
drives that it was bound to are mapped again, the others stay.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from factor_graphs.errors import FactorGraphError
from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.laz_cloud import read_base
from gnss_sem_map.errors import DataError, SemMapError
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.files import work_folder
from gnss_sem_map.files.output_folder import Claim
from gnss_sem_map.files.run_json import inputs_of, read_run
from gnss_sem_map.files.untrusted import is_folder, shown
from gnss_sem_map.files.work_folder import DRIVES, REMOVED
from gnss_sem_map.mapping.raw_map import MAP
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.runs import pipeline, run_folder
from gnss_sem_map.runs.binding import bind, groups_near, refuse_unbindable, with_unheld
from gnss_sem_map.runs.drive_job import closing_drives, job_for
from gnss_sem_map.runs.executors import executor_of
from gnss_sem_map.runs.map_job import MapJob
from gnss_sem_map.runs.pipeline import write_drives
from gnss_sem_map.runs.run_settings import read_settings
from gnss_sem_map.runs.same_run import is_map_of
from gnss_sem_map.runs.source import Source, source_of
from gnss_sem_map.runs.tracks import tracks_of
from gnss_sem_map.scans.base_cloud import BaseCloud
from gnss_sem_map.voxels.map_json import read_frame
from gnss_sem_map.voxels.reuse import read_record, write_record


@dataclass(frozen=True)
class HowMapped:
    """What is the same for all drives; `{drive}` in segmenter and trajectory stands for the name of the drive."""

    segmenter: str | None = "none"
    frames: str | None = None
    drive_format: str | None = None
    device: str = "auto"
    force: bool = False
    resume: bool = False
    trajectory: Path | str | None = None

    def source(self, drive: Path) -> Source:
        """What the run of this drive reads."""
        return source_of(drive, self.segmenter, self.frames, self.drive_format, self.device, self.trajectory)


@dataclass(frozen=True)
class ManyDrives:
    """The drives of a map, and those that failed."""

    folder: Path
    about: dict[str, Any]
    """The content of run.json."""

    @property
    def failed(self) -> dict[str, str]:
        """Name -> reason of the drives that were left out of this run."""
        return dict(self.about["failed"])


def run_drives(
    drives: Sequence[Path],
    out: Path,
    settings: Settings,
    how: HowMapped,
    *,
    origin: LocalFrame | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    write_labels: bool = False,
    align_to: Path | None = None,
    progress: Progress = silent,
) -> ManyDrives:
    """Map several drives into one map, in the frame `origin`, by default that of the first drive.

    `align_to` is a georeferenced LAS or LAZ, which stands: the drives are held onto it.

    The tasks of all drives are shared among `workers` processes, or the workers of the Dask scheduler at the address
    `scheduler`. A drive that fails, or whose worker dies three times, is left out, and named in run.json. Raises
    DataError when all fail, when two drives have one name or are the same, or the first has no georeference.
    """
    drives = [_absolute(drive) for drive in drives]
    sources = [how.source(drive) for drive in drives]
    frame = frame_of_all(sources, settings, origin)
    places = run_folder.places_read(sources, settings)
    with run_folder.claimed_run(out, [*places, align_to], is_resumable=True) as claim:
        if how.resume and align_to is None and is_map_of(out, sources, settings, frame, write_labels):
            return _finished_before(claim)
        begin(claim.work, how.resume)
        with executor_of(workers, scheduler, claim.work, places) as executor:
            run = MapJob(settings, frame, claim.work, executor, progress)
            base = _base(align_to, run)
            jobs = [job_for(source, run, force=how.force) for source in sources]
            with closing_drives():
                bound, made = pipeline.bound_and_mapped(jobs, run, base, how.force)
            if not made:
                raise DataError(f"{out}: no drive could be mapped; {_first(run.failed)}")
            labelled = [source for source in sources if source.name in made and write_labels]
            return ManyDrives(out, write_drives(out, made, bound, run, labelled, align_to))


def frame_of_all(sources: Sequence[Source], settings: Settings, origin: LocalFrame | None) -> LocalFrame:
    """The frame of the map of several drives, `origin` if it is given.

    Raises DataError and ConfigError as `run_drives` does: for two drives of one name, and a map without a georeference
    or that cannot be delivered.
    """
    _check_distinct([(source.name, Path(source.drive)) for source in sources])
    frame = origin or _frame_of(sources)
    Georeference.of(frame, settings.delivery)
    return frame


def add_drive(
    out: Path,
    drive: Path,
    how: HowMapped,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Progress = silent,
) -> ManyDrives:
    """Add a drive to a finished map, with its settings and in its frame; raises DataError when the drive fails."""
    drive = _absolute(drive)
    added = [how.source(drive)]
    with run_folder.claimed_run(out, run_folder.places_read(added), is_resumable=True) as claim:
        settings, frame, there = _opened(out)  # now no other command can change it
        if how.resume and drive.name in there and _is_of(there[drive.name], added[0]):
            return _finished_before(claim)
        known = [(name, Path(inputs_of(folder).get("drive", folder))) for name, folder in there.items()]
        _check_distinct([*known, (drive.name, drive)])
        begin(claim.work, how.resume)
        with executor_of(workers, scheduler, claim.work, _places_read(there, added, settings)) as executor:
            run = MapJob(settings, frame, claim.work, executor, progress)
            return ManyDrives(out, _changed(out, there, added, how.force, run))


def _finished_before(claim: Claim) -> ManyDrives:
    """The map that a command had made when it was killed while it cleaned up."""
    with suppress(OSError):  # the next command tries again
        work_folder.clear(claim.work)
    return ManyDrives(claim.out, read_run(claim.out))


def _places_read(
    there: Mapping[str, Path], added: Sequence[Source], settings: Settings
) -> list[Path | str | None]:
    """All inputs of a map to which drives are added: those that are there may be mapped again."""
    known = [_source_of(name, folder) for name, folder in there.items()]
    return run_folder.places_read([*known, *added], settings)


def remove_drive(
    out: Path,
    name: str,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    resume: bool = False,
    progress: Progress = silent,
) -> ManyDrives:
    """Take a drive out of a finished map; raises DataError when it is not there, or the only one."""
    with run_folder.claimed_run(out, is_resumable=True) as claim:
        settings, frame, there = _opened(out)
        stay = {known: folder for known, folder in there.items() if known != name}
        being_removed = read_record(claim.work / REMOVED)
        if name not in there and resume and being_removed == {"name": name}:
            return _finished_before(claim)
        if name not in there:
            raise DataError(f"{shown(out)}: holds no drive {name!r}; expected one of {', '.join(there)}")
        if not stay:
            raise DataError(f"{shown(out)}: {name} is its only drive; remove the folder instead")
        begin(claim.work, resume)
        write_record({"name": name}, claim.work / REMOVED)
        with executor_of(workers, scheduler, claim.work, _places_read(stay, [], settings)) as executor:
            run = MapJob(settings, frame, claim.work, executor, progress)
            return ManyDrives(out, _changed(out, stay, [], True, run))


def _changed(
    out: Path,
    there: Mapping[str, Path],
    added: Sequence[Source],
    force: bool,
    run: MapJob,
) -> dict[str, Any]:
    """Write the map of drives that were mapped before and of new ones; what is bound in another way is mapped again."""
    aligned_to = read_run(out).get("aligned_to")
    align_to = None if aligned_to is None else Path(aligned_to)
    base, before = _base(align_to, run), {name: _correction_of(folder) for name, folder in there.items()}
    with closing_drives():
        drives, read = pipeline.locate_drives([job_for(source, run, force=force) for source in added], run)
        _refuse_failed(out, run)
        tracks = {name: tracks_of(folder)[0].positions for name, folder in there.items()}
        tracks |= {name: one.track() for name, one in drives.items()}
        near = {name for group in groups_near(tracks, run, base) for name in group}
        again = [_source_of(name, folder) for name, folder in there.items() if name in near or before[name]]
        known, known_read = pipeline.locate_drives([job_for(one, run, force=True) for one in again], run)
        for name, reason in run.failed.items():
            raise DataError(
                f"{out}: stays as it was; {name} passes the same places, and would have to be bound and mapped again:"
                f" {reason}; put it back, or make a map with trajectory.revisits.enabled=false"
            )
        tracks |= {name: one.track() for name, one in known.items()}
        bound = bind({**known, **drives}, tracks, run, base)
        if base is not None:
            bound = with_unheld(tracks, bound, base, force)
        moved = {name: one for name, one in known.items() if before[name] != bound.held.get(name, "")}
        new = pipeline.map_drives({**moved, **drives}, {**known_read, **read}, bound, run)
    _refuse_failed(out, run)
    return write_drives(out, {**there, **new}, bound, run, align_to=align_to)


def _refuse_failed(out: Path, run: MapJob) -> None:
    if run.failed:
        raise DataError(f"{out}: stays as it was; {_first(run.failed)}")


def _base(align_to: Path | None, run: MapJob) -> BaseCloud | None:
    """The cloud that stands; raises DataError, also where nothing can be held onto it."""
    if align_to is None or run.frame is None:
        return None
    base = read_base(align_to, run.frame, run.settings.delivery.geoid)
    refuse_unbindable(base, run)
    return base


def _source_of(name: str, folder: Path) -> Source:
    """What a drive of a finished map was made from."""
    inputs = inputs_of(folder)
    drive = str(inputs.get("drive", folder / name))
    segmenter, frames, drive_format = (inputs.get(key) for key in ("segmenter", "frames", "drive_format"))
    return Source(drive, segmenter, frames, drive_format, called=name, trajectory=inputs.get("trajectory"))


def _is_of(folder: Path, source: Source) -> bool:
    """Whether a drive of a finished map was made from this."""
    return inputs_of(folder) == {name: said for name, said in source.inputs.items() if said is not None}


def _correction_of(folder: Path) -> str:
    """Digest of the correction with which a drive was mapped."""
    return str(read_run(folder).get("correction", ""))


def begin(work: Path, resume: bool) -> None:
    """Prepare the work folder of a map; raises DataError."""
    with work_folder.writing_to(work):
        if not resume:
            work_folder.remove_drives(work)
        (work / REMOVED).unlink(missing_ok=True)
        work_folder.make(work)
        (work / DRIVES).mkdir(exist_ok=True)
        work_folder.remove_damaged_drives(work)


def _opened(out: Path) -> tuple[Settings, LocalFrame, dict[str, Path]]:
    """Settings, frame and drives of a finished map, which may be that of one drive; raises DataError."""
    about, settings = read_run(out), read_settings(out)
    frame = read_frame(out / MAP)
    if frame is None:
        raise DataError(f"{shown(out)}: its map has no georeference, so no other drive fits to it")
    run_folder.georeference_of(settings, frame)
    if is_folder(out / DRIVES):
        return settings, frame, {path.name: path for path in sorted((out / DRIVES).iterdir())}
    name = about.get("drive")
    if not isinstance(name, str) or Path(name).name != name or name in ("", ".."):
        raise DataError(f"{shown(out / 'run.json')}: damaged (drive: found {name!r}, expected a name)")
    return settings, frame, {name: out}


def _absolute(drive: Path) -> Path:
    """The folder of a drive under the name that was given, links included; that of `.` is the current folder."""
    return Path(os.path.abspath(drive))


def _check_distinct(drives: Sequence[tuple[str, Path]]) -> None:
    """Raise DataError when two drives, each a name and its folder, have one name, or are one."""
    names: set[str] = set()
    places: dict[Path, str] = {}
    for name, folder in drives:
        if name in names:
            raise DataError(
                f"{folder}: two drives have the name {name}, and all evidence of one drive counts once; leave one out,"
                " or give the other a name of its own"
            )
        place = folder.resolve()
        if place in places:
            raise DataError(
                f"{folder}: is the drive {places[place]}, whose evidence counts once; leave one of them out"
            )
        names.add(name)
        places[place] = name


def _frame_of(sources: Sequence[Source]) -> LocalFrame:
    """The frame of the first drive that can be read and has one."""
    for one in sources:
        try:
            frame = open_drive(one.drive, one.drive_format, with_imu=False, trajectory=one.trajectory).frame
        except (SemMapError, FactorGraphError, OSError):
            continue  # its own task says why
        if frame is not None:
            return frame
    raise DataError(
        f"{sources[0].drive}: neither it nor another drive has a georeference; expected drives with GNSS"
    )


def _first(failed: Mapping[str, str]) -> str:
    name, reason = next(iter(failed.items()))
    return f"{name}: {reason}"

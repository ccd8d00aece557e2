"""A finished run as an object: its map can be read, refined, relabelled and exported again."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from numpy.typing import ArrayLike

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import DeliverySettings, Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.export.changes import copy_changes
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.formats import FORMATS, Format
from gnss_sem_map.export.georeference import check_delivery
from gnss_sem_map.files import work_folder
from gnss_sem_map.files.atomic import link_or_copy
from gnss_sem_map.files.output_folder import (
    locked,
    new_folder,
    parents_made,
    read_whole,
    real_path,
    refuse_inputs,
    restore,
)
from gnss_sem_map.files.ownership import amend_all
from gnss_sem_map.files.run_json import inputs_of, read_run
from gnss_sem_map.files.untrusted import is_folder, shown
from gnss_sem_map.files.work_folder import DRIVES
from gnss_sem_map.labels.label_set import LabelSet, open_label_set
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.classifying import OFF
from gnss_sem_map.mapping.fusion import map_scans, without_images
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.mapping.raw_map import MAP
from gnss_sem_map.process.run_stats import Progress, RunStats, silent
from gnss_sem_map.runs import pipeline, run_folder
from gnss_sem_map.runs.about import about_map, about_skips
from gnss_sem_map.runs.delivery import write_summary
from gnss_sem_map.runs.drive_job import closing_drives, give, job_for
from gnss_sem_map.runs.drive_tasks import with_answers, write_map
from gnss_sem_map.runs.executors import executor_of
from gnss_sem_map.runs.many_drives import begin
from gnss_sem_map.runs.map_job import MapJob
from gnss_sem_map.runs.point_label_files import (
    LABELS,
    RAW_LABELS,
    LabelledDrive,
    write_point_labels,
)
from gnss_sem_map.runs.run_settings import SETTINGS, differing, read_settings, write_settings
from gnss_sem_map.runs.same_run import digest_of, is_run_of
from gnss_sem_map.runs.source import Source, absolute, source_of
from gnss_sem_map.runs.tracks import tracks_of
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.segmentation.classes import unknown_classes
from gnss_sem_map.sensor_log import SensorLog, Skip
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.attributes import ATTRIBUTES
from gnss_sem_map.voxels.map_json import read_frame
from gnss_sem_map.voxels.semantic_map import SemanticMap

__all__ = ["Run", "Settings", "open_drive", "run"]


def run(
    drive: Path | str,
    out: Path | str,
    segmenter: str | None = "none",
    settings: Settings | None = None,
    *,
    log: SensorLog | None = None,
    frames: str | None = None,
    drive_format: str | None = None,
    device: str = "auto",
    trajectory: Path | str | None = None,
    origin: LocalFrame | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    resume: bool = False,
    write_labels: bool = False,
    force: bool = False,
    progress: Progress = silent,
) -> Run:
    """Map one drive into a run folder, as `gnss-sem-map run` does.

    `segmenter` is `labels:FOLDER`, `refinenet:FILE`, ..., or `none` for geometry only, and `{drive}` in it the name of
    the drive; `frames` is `A:B`; `trajectory` is a file of poses in place of the drive's own; `log` is what these
    open, if it is open already. The scans are shared among `workers`
    processes, or the workers of the Dask scheduler at the address `scheduler`. Raises PreflightError where the drive
    looks wrong (see `force`), DataError, ConfigError, and what the smoother raises.
    """
    drive, out, settings = Path(drive), Path(out), settings or Settings()
    source = source_of(drive, segmenter, frames, drive_format, device, trajectory)
    places = run_folder.places_read([source], settings)
    with run_folder.claimed_run(out, places, is_resumable=True) as claim:
        log = log or source.open_log()
        run_folder.georeference_of(settings, origin or log.frame)
        refuse_inputs(claim.out, sorted(log.folders))
        read = digest_of(log, source, settings)
        if resume and is_run_of(out, source, settings, origin or log.frame, read, write_labels):
            with suppress(OSError):  # it was killed while it cleaned up
                work_folder.clear(claim.work)
            return Run(out)
        begin(claim.work, resume)
        with executor_of(workers, scheduler, claim.work, places) as executor:
            making = MapJob(settings, origin or log.frame, claim.work, executor, progress, True)
            job = job_for(source, making, force)
            with closing_drives():
                give(job, log)
                pipeline.bound_and_mapped([job], making)
            pipeline.write_one(out, job, making, write_labels)
    return Run(out)


@dataclass(frozen=True)
class Run:
    """A finished run in its folder, of one drive or several; `Run.open(OUT)` checks it."""

    folder: Path

    @classmethod
    def open(cls, folder: Path | str) -> Run:
        """Raises DataError for a folder that holds no finished map, or one of the former command `merge`."""
        folder = Path(folder)
        restore(folder, run_folder.is_run_file)
        read_run(folder)
        if not is_folder(folder / "refined"):
            raise DataError(f"{shown(folder)}: found no map in it; expected the -o of `gnss-sem-map run`")
        return cls(folder)

    @property
    def about(self) -> dict[str, Any]:
        """The content of run.json."""
        return read_run(self.folder)

    @property
    def is_merged(self) -> bool:
        """Whether it is a map of several drives: then it has no drive, no trajectory and no point labels of its own."""
        return "merged" in self.about

    @cached_property
    def settings(self) -> Settings:
        """The settings of the run."""
        return read_settings(self.folder)

    @cached_property
    def trajectory(self) -> Trajectory:
        """Poses of the IMU in the map, with covariances; raises DataError for a map of several drives."""
        self._refuse_several("trajectory", f"see {DRIVES}/NAME/trajectory.parquet in it")
        return Trajectory.load(self.folder / "trajectory.parquet")

    @cached_property
    def frame(self) -> LocalFrame | None:
        """The local frame of the map; None for a map without a georeference."""
        return read_frame(self.folder / "map")

    @cached_property
    def label_set(self) -> LabelSet:
        """The classes of the map."""
        return open_label_set(self.settings.classes)

    def map(self, box: tuple[ArrayLike, ArrayLike] | None = None, *, refined: bool = True) -> SemanticMap:
        """The map, or its part in a box (low, high), each (3,) m; only the tiles of the box are read.

        It holds the voxels that refinement removed, too, with the label of what moved there and `State.REMOVED`:
        `map[map.shown]` are the labelled voxels that stand, `map.standing` are all that stand.
        """
        return tiles.read(self.folder / ("refined" if refined else "map"), self.label_set, box)

    def refine(
        self, settings: Settings, out: Path | str | None = None, *, progress: Progress = silent
    ) -> Run:
        """Refine the map again with other settings, in place or into `out`; nothing is matched or segmented again.

        The coordinates of the files may be others as well. Scans are read only if the run has point labels. Raises
        ConfigError if other settings differ too.
        """
        reads = [inputs_of(self.folder).get("drive")] if self._has_labels else []
        with self._rewritten(out, reads) as (folder, run):
            _check_same_map(run.settings, settings)
            warnings = _still_true(run, settings)
            georeference = run_folder.georeference_of(settings, run.frame)
            log = run.drive() if run._has_labels else None
            old_labels = shutil.ignore_patterns(*LABELS)
            for name in (MAP, ATTRIBUTES, evidence.FOLDER, DRIVES):
                if is_folder(run.folder / name):
                    shutil.copytree(
                        run.folder / name, folder / name, copy_function=link_or_copy, ignore=old_labels
                    )
            for known in folder.glob(f"{DRIVES}/*/{SETTINGS}"):
                known.unlink()  # a second name of that of the run as it was
                write_settings(known.parent, settings)
            stats = RunStats()
            refined = pipeline.refine(folder, settings, stats, progress, work=folder.parent)
            if run.is_merged:
                before = run_folder.georeference_of(run.settings, run.frame)
                if before is not None and georeference is not None:
                    copy_changes(run.folder, folder, before, georeference, run.label_set)
                for file in run.folder.glob("objects.*"):
                    link_or_copy(file, folder / file.name)
                if labelled := sorted(run.folder.glob(f"{DRIVES}/*/{RAW_LABELS}")):
                    drives = (_labelled(known, folder) for known in labelled)
                    write_point_labels(folder, drives, refined.kerbs, settings, progress)
                about = run.about | {"map": about_map(folder, refined.report)}
                about |= {"warnings": list(dict.fromkeys([*warnings, *stats.warnings]))}
                write_summary(folder, settings, about, progress)
            else:
                known = run.folder / RAW_LABELS
                run_folder.write_again(
                    folder, run.folder, run.trajectory, refined, stats, settings, log, {"warnings": warnings},
                    known, progress,
                )  # fmt: skip
        return Run(self.folder if out is None else Path(out))

    def relabel(
        self,
        segmenter: str,
        out: Path | str | None = None,
        *,
        device: str = "auto",
        progress: Progress = silent,
    ) -> Run:
        """Map the drive again along the same trajectory with the labels of another segmenter.

        Raises DataError for a map of several drives, and if the drive was moved or removed.
        """
        spec = absolute(segmenter.replace("{drive}", str(self.about.get("drive"))))
        reads = run_folder.places_read([Source(inputs_of(self.folder).get("drive", ""), spec)])
        with self._rewritten(out, reads) as (folder, run):
            run._refuse_several(
                "relabelling", "map the drives again with `gnss-sem-map run` and the other --segmenter"
            )
            log = replace(run.drive(), frame=run.frame)  # --origin, or another drive, may have given it
            settings, before, stats = run.settings, run.about, RunStats()
            network = open_segmenter(spec, run.label_set, device, log.calibration.image_sizes)
            if unknown := unknown_classes(network.class_names, run.label_set):
                stats.warnings.append(f"{spec}: {unknown}")
            drive = Drive(log, run.trajectory, network, settings)
            with TemporaryDirectory(prefix=".work.", dir=folder) as work:
                with stats.stage("mapping"):
                    drive = with_answers(drive, Path(work) / "work", spec)
                    store = map_scans(drive, Path(work) / "work", stats, progress, labels_from=spec)
                    write_map(drive, store, folder, stats)
                objects, untracked = store.objects(), store.untracked()
            refined = pipeline.refine(folder, settings, stats, progress)
            refined = replace(refined, report=replace(refined.report, tracked=objects, untracked=untracked))
            run_folder.write_objects(folder, str(before["drive"]), log, objects, settings)
            skips = [Skip(**skip) for skip in before["skips"]["listed"] if skip["what"] != "labels"]
            changed = {
                "inputs": before["inputs"] | {"segmenter": spec},
                "skips": about_skips([*skips, *stats.skips]),
                "warnings": [w for w in _still_true(run, settings) if without_images(settings) not in w],
            }
            with_labels = log if is_folder(run.folder / "labels") else None
            run_folder.write_again(
                folder, run.folder, run.trajectory, refined, stats, settings, with_labels, changed,
                progress=progress,
            )  # fmt: skip
        return Run(self.folder if out is None else Path(out))

    def export(
        self,
        formats: Iterable[str],
        to: Path | str | None = None,
        delivery: DeliverySettings | None = None,
        progress: Progress = silent,
    ) -> list[Path]:
        """Write the map in formats (`laz`, `ply`, ...; see `export.formats`), into the run or the folder `to`.

        `delivery`: in other coordinates than those of the run, or with another least confidence, into a folder of
        their own. Raises ConfigError for an unknown format or CRS, and DataError for files that are there already.
        """
        known = {each.name: each for each in FORMATS}
        chosen = list(formats)
        if unknown := [name for name in chosen if name not in known]:
            raise ConfigError(f"export: found {unknown[0]!r}, expected some of {sorted(known)}")
        if to is None:
            written = []
            with locked(real_path(self.folder)):
                exported = Run(self.folder)._exported(delivery, is_inside=True)
                for done, name in enumerate(chosen, 1):
                    written.append(self._amended(known[name], exported))
                    progress("export", done, len(chosen))
            return written
        refuse_inputs(real_path(Path(to)), [self.folder])
        files = [Path(to) / known[name].file for name in chosen]
        if there := [file for file in files if file.exists()]:
            raise DataError(f"{shown(there[0])}: exists; move it away or choose another folder")
        with parents_made(Path(to) / "file"), read_whole(self.folder):
            exported = Run(self.folder)._exported(delivery)
            for done, (name, file) in enumerate(zip(chosen, files, strict=True), 1):
                known[name].write(exported, file)
                progress("export", done, len(files))
        return files

    def _exported(self, delivery: DeliverySettings | None, is_inside: bool = False) -> Exported:
        """What is exported, delivered so; files inside the run are delivered as the run says."""
        if is_inside and delivery not in (None, self.settings.delivery):
            raise ConfigError(
                "export: other coordinates, or another least confidence, robot or terrain, than those of the run need a"
                " folder of their own: -o DIR"
            )
        about, delivery = self.about, delivery or self.settings.delivery
        check_delivery(delivery.crs, delivery.geoid)
        return run_folder.exported_of(
            self.folder, tracks_of(self.folder), str(about["name"]), delivery, about.get("changes", ()),
            self.label_set,
        )  # fmt: skip

    def _amended(self, format_: Format, exported: Exported) -> Path:
        with TemporaryDirectory(prefix="gnss-sem-map-") as folder:
            format_.write(exported, Path(folder) / format_.file)
            amend_all(self.folder, Path(folder))
        return self.folder / format_.file

    def drive(self, place: Path | None = None) -> SensorLog:
        """The log of the run's drive, which is at `place` if it was moved; raises DataError if it is not there."""
        inputs = inputs_of(self.folder)
        if place is None and "drive" not in inputs:
            raise DataError(f"{shown(self.folder)}: its run.json names no drive")
        # as it was read, and maybe held by LiDAR odometry; its file may be gone
        poses = self.folder / "trajectory.parquet" if "trajectory" in inputs else None
        log = open_drive(place or inputs["drive"], inputs.get("drive_format"), trajectory=poses)
        log = log.between(inputs.get("frames"))
        return log.in_our_conventions(self.settings.sensors)

    @property
    def _has_labels(self) -> bool:
        """Whether it is a run of one drive with point labels."""
        return not self.is_merged and is_folder(self.folder / "labels")

    def _refuse_several(self, what: str, instead: str) -> None:
        """Raise DataError for a map of several drives; `instead` is what to do."""
        if self.is_merged:
            names = " and ".join(map(str, self.about["merged"]))
            raise DataError(
                f"{shown(self.folder)}: is a map of {names}, expected a run of one drive for {what}; {instead}"
            )

    @contextmanager
    def _rewritten(
        self, out: Path | str | None, reads: Iterable[Path | str | None]
    ) -> Iterator[tuple[Path, Run]]:
        """A new folder for this run with another map, and the run as it is now: what is known of it may be old.

        The folder takes the place of the run, or of `out`. An `out` that is or holds what the run `reads`, or lies in
        it, is refused, and a run that another command replaces meanwhile.
        """
        place = self.folder if out is None else Path(out)
        inputs = [self.folder, *reads] if place.resolve() != self.folder.resolve() else []
        with run_folder.claimed_run(place, inputs), new_folder(place) as folder, read_whole(self.folder):
            yield folder, Run(self.folder)


def _labelled(known_raw: Path, folder: Path) -> LabelledDrive:
    """A drive of a map of several that is made again in `folder`, whose labels before refinement are known."""
    drive = Run(known_raw.parent)
    return LabelledDrive(folder / DRIVES / known_raw.parent.name, drive.drive(), drive.trajectory, known_raw)


def _still_true(run: Run, settings: Settings) -> list[str]:
    """Warnings of a run that is refined with other settings; what there is to say of its classifier is said anew."""
    of_images = without_images(run.settings), without_images(settings)
    return [said.replace(*of_images) for said in run.about.get("warnings", ()) if OFF not in said]


def _check_same_map(before: Settings, after: Settings) -> None:
    """Raise ConfigError if settings other than those of the refinement differ."""
    free = ("refinement", "geometric_classifier", "delivery")
    same = after.model_copy(update={name: getattr(before, name) for name in free})
    differ = differing(same, before)
    if differ:
        raise ConfigError(
            f"refine: {', '.join(differ)} differ from those of the run; refine changes those of {', '.join(free)}:"
            " run the drive again"
        )

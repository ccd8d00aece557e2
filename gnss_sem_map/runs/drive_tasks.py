"""The tasks of one drive, from its log to its map: each remembers what it found in the work folder of the drive.

    check       pre-flight, and the trajectory along which scans are matched     checked.npz
    match       LiDAR odometry of a section of its scans                         matches/N.npz
    locate      its trajectory, smoothed with all relative poses                 located.npz
    place       that trajectory in the map, as `binding` moves it; sharpness     placed.npz
    map_range   chunks of its scans                                              0/, 1/, ... (`mapping.checkpoints`)
    finish      raw map, evidence, trajectory, run.json and report               ../NAME/

A task is the name of a function, and JSON; the first two arguments say which drive (`runs.drive_job`).
"""

from __future__ import annotations

import shutil
import time
from collections import Counter
from dataclasses import asdict, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np

from factor_graphs.corrections import Correction
from factor_graphs.relative_poses import RelativePoses
from factor_graphs.trajectory import Trajectory
from factor_graphs.trajectory_plot import write_trajectory_plot
from gnss_sem_map.evaluation.map_sharpness import SweepSample, of_sample
from gnss_sem_map.files import ownership, work_folder
from gnss_sem_map.files.atomic import unfinished
from gnss_sem_map.files.memo import arrays_of, remember
from gnss_sem_map.files.output_folder import refuse_inputs
from gnss_sem_map.files.work_folder import MATCHES, writing_to
from gnss_sem_map.mapping import fingerprints, fusion
from gnss_sem_map.mapping.checkpoints import ChunkStore
from gnss_sem_map.mapping.chunks import chunks_of
from gnss_sem_map.mapping.classifying import opened_model
from gnss_sem_map.mapping.labelled_scans import Drive, pattern_sweeps
from gnss_sem_map.mapping.raw_map import write_raw
from gnss_sem_map.mapping.refining import opened_sensor_model
from gnss_sem_map.mapping.trajectory import (
    check_georeference,
    check_heights,
    final_trajectory,
    first_trajectory,
    in_frame,
)
from gnss_sem_map.preflight import check_drive
from gnss_sem_map.preflight.findings import Preflight
from gnss_sem_map.process.execution import report
from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.runs import run_folder
from gnss_sem_map.runs.about import about_run, about_solution
from gnss_sem_map.runs.drive_job import FINISHED, DriveJob, OpenDrive, job_of, opened, other_drive
from gnss_sem_map.scans.lidar_odometry import ScanMatches, match_section, sections_of
from gnss_sem_map.scans.local_maps import sweeps_along
from gnss_sem_map.segmentation.cached import CachedLabels
from gnss_sem_map.segmentation.cached_segmenter import CachedSegmenter, probabilities_folder
from gnss_sem_map.sensor_log import SensorLog, Skip
from gnss_sem_map.voxels.reuse import digest

CHECKED, LOCATED, PLACED = "checked", "located", "placed"
GROUP, ALONE = "group", "alone"
"""How a drive moves because it is bound to others, and to itself (`runs.binding`)."""


def check(folder: str, key: str) -> dict[str, Any]:
    """Check a drive, and smooth it for the first time.

    Returns the digest of all that is read, that of the matches of its scans (None: they are not matched), and the
    number of scans. Raises PreflightError, DataError, and what the smoother raises.
    """
    drive = opened(folder, key, with_imu=True)
    job, log, settings, network = drive.job, drive.log, drive.job.settings, drive.network
    log.check_scans()
    check_georeference(log, job.origin, settings.mapping.voxel_size_m)
    refuse_inputs(job.folder, sorted(log.folders))
    opened_sensor_model(settings)  # one of other classes is refused now
    opened_model(settings)
    made_from = digest([drive.read, key])
    if job.found(CHECKED, made_from) is None:
        stats = RunStats(skips=list(log.skips))
        page = check_drive(drive.keeping, network, settings, stats, job.force)
        with stats.stage("trajectory"):
            first = first_trajectory(log, settings, page.solution)
        about = {
            "read": drive.read, "scans": len(log.scans), "page": page.as_dict(), "gnss_lag_s": page.gnss_lag_s,
            "matches": None if first is None else fingerprints.of_matches(log, first, settings),
            "stats": stats.as_dict(),
        }  # fmt: skip
        work_folder.remove_matches(job.folder)
        remember(job.folder / f"{CHECKED}.npz", made_from, about, arrays_of("first", first))
        release_memory(always=True)  # of the graph
    found = job.needed(CHECKED, made_from)
    return {name: found.about[name] for name in ("read", "matches", "scans")}


def match(folder: str, key: str, matches: str, number: int) -> None:
    """Match a section of the scans of a drive, whose matches have this digest. Raises DataError."""
    job = job_of(folder, key)
    if job.found(f"{MATCHES}/{number}", matches) is not None:
        return
    drive, first = matched_along(folder, key, matches)
    start, chosen = time.perf_counter(), job.settings.trajectory.scan_matching
    job.saved.mkdir(exist_ok=True)
    section = sections_of(len(drive.log.scans), chosen)[number]
    found = match_section(
        _saving_sweeps(drive, first), first, chosen, section, lambda _, done, total: report(done), job.saved
    )
    about = {
        "counts": dict(found.counts),
        "skips": [asdict(skip) for skip in found.skips],
        "seconds": time.perf_counter() - start,
    }
    remember(job.folder / MATCHES / f"{number}.npz", matches, about, arrays_of("poses", found.relative_poses))


def matched_along(folder: str, key: str, matches: str) -> tuple[OpenDrive, Trajectory]:
    """A drive, and the trajectory along which its scans are matched; raises DataError if it is another one here."""
    drive = opened(folder, key)
    if matches not in drive.known:
        first = Trajectory(**drive.job.needed(CHECKED).of("first"))
        if fingerprints.of_matches(drive.log, first, drive.job.settings) != matches:
            raise other_drive(drive.job.source)
        drive.known[matches] = first
    return drive, drive.known[matches]


def _saving_sweeps(drive: OpenDrive, first: Trajectory) -> SensorLog:
    """The log, of which what later stages need of its sweeps is saved when they are read."""
    log, saved = drive.taking, drive.job.saved
    if drive.job.is_one:
        log = SweepSample(log, folder=saved).sweeps.listening()
        log = pattern_sweeps(log, saved).listening()
    if drive.job.settings.trajectory.revisits.enabled:
        log = sweeps_along(log, first, saved).listening()
    return log


def locate(folder: str, key: str, matches: str | None) -> str:
    """Smooth a drive with the relative poses of its scans; returns the digest of what was found.

    Raises DataError, and what the smoother raises.
    """
    drive = opened(folder, key, with_imu=True)
    job, log = drive.job, drive.log
    made_from = digest([drive.read, key, matches])
    if job.found(LOCATED, made_from) is not None:
        return made_from
    checked, stats, first, matched = job.needed(CHECKED), RunStats(), None, None
    with stats.stage("trajectory"):
        if matches is not None:
            first = Trajectory(**checked.of("first"))
            matched, seconds = _all_matches(job, matches, len(log.scans))
            stats.seconds["trajectory"] = seconds
        found = final_trajectory(log, job.settings, stats, first, matched)
    solution, arrays = found.solution, arrays_of("track", found.trajectory)
    if found.without_lidar is not None:
        arrays |= arrays_of("first", found.without_lidar)
    if solution is not None:
        arrays["rejected"] = solution.rejected
        if solution.condensed is not None:
            arrays["condensed"] = np.frombuffer(solution.condensed.to_bytes(), np.uint8)
    if solution is not None and log.gnss is not None:
        plot = unfinished(job.folder / "plot")
        with stats.stage("export"), writing_to(job.folder):
            write_trajectory_plot(solution.in_short(), log.gnss, plot)
            arrays["plot"] = np.fromfile(plot, np.uint8)
            plot.unlink()
    clock = None
    if solution is not None:
        page = Preflight((), 0.0, gnss_lag_s=checked.about["gnss_lag_s"])
        clock = page.other_clock(solution.calibration.time_offset_s)
    about = {
        "solution": about_solution(solution), "from_lidar_odometry": found.from_lidar_odometry,
        "other_clock": clock, "stats": stats.as_dict(),
    }  # fmt: skip
    remember(job.folder / f"{LOCATED}.npz", made_from, about, arrays)
    release_memory(always=True)  # of the graph: holes too small for the arrays of scans
    return made_from


def _all_matches(job: DriveJob, matches: str, scans: int) -> tuple[ScanMatches, float]:
    """The matches of all sections, and how long they took."""
    found = [
        job.needed(f"{MATCHES}/{number}", matches)
        for number in range(len(sections_of(scans, job.settings.trajectory.scan_matching)))
    ]
    parts = [
        ScanMatches(
            RelativePoses(**one.of("poses")),
            tuple(Skip(**skip) for skip in one.about["skips"]),
            Counter(one.about["counts"]),
        )
        for one in found
    ]
    return reduce(add, parts), sum(one.about["seconds"] for one in found)


def correction_of(job: DriveJob, bound: str) -> tuple[Correction | None, bool, dict[str, Any]]:
    """How a drive moves, whether that is because it is bound to itself, and what was said of it."""
    for name in (GROUP, ALONE):
        if bound and (found := job.found(name, bound)) is not None:
            arrays = found.of("correction")
            return Correction(**arrays) if arrays else None, name == ALONE, found.about
    if bound:
        job.needed(ALONE, bound)
    return None, False, {"correction": "", "passes": [], "stats": RunStats().as_dict()}


def _tracks(
    job: DriveJob, log: SensorLog, located: str, bound: str, with_covariances: bool
) -> list[Trajectory]:
    """The trajectory of a drive in the map, and that before it was bound, if it was."""
    track = Trajectory(**job.needed(LOCATED, located).of("track"))
    if not with_covariances:
        track = replace(track, covariances=None)
    correction, is_own, _ = correction_of(job, bound)
    before = in_frame(log, track, job.origin)[1]
    if correction is None:
        return [before]
    return [in_frame(log, correction.of(track), job.origin)[1] if is_own else correction.of(before), before]


def place(folder: str, key: str, located: str, bound: str) -> dict[str, Any]:
    """Find the trajectory of a drive in the map, and how sharp it is.

    Returns the digest of what is mapped along it, and the number of scans of each chunk. Raises DataError, ConfigError.
    """
    drive, made_from = opened(folder, key), digest([located, bound])
    job, settings = drive.job, drive.job.settings
    if job.found(PLACED, made_from) is None:
        found, stats = job.needed(LOCATED, located), RunStats()
        track = _tracks(job, drive.log, located, bound, with_covariances=False)[0]
        check_heights(drive.log.name, track, settings.mapping.voxel_size_m)
        run_folder.check_deliverable(
            track, drive.log.frame if job.origin is None else job.origin, settings.delivery
        )
        correction, is_own, _ = correction_of(job, bound)
        own = replace(Trajectory(**found.of("track")), covariances=None)
        shown = [correction.of(own) if correction is not None and is_own else own]
        if first := found.of("first"):
            shown.append(Trajectory(**first))
        saved = job.saved if job.saved.is_dir() else None
        with stats.stage("sharpness"):
            sample = SweepSample(drive.taking, folder=saved)
            figures = of_sample(sample, shown)
            sample.sweeps.forget()  # 100 MB
        drive.forget()
        names = "map", "gnss and imu" if drive.log.given is None else "given poses"
        mapped = _labelled(drive, track)
        about = {
            "sharpness": {name: one.as_dict() for name, one in zip(names, figures, strict=False)},
            "map": fingerprints.of_map(mapped, job.source.labels_from),
            "chunks": [len(chunk) for chunk in chunks_of(mapped)],
            "stats": stats.as_dict(),
        }
        remember(job.folder / f"{PLACED}.npz", made_from, about, arrays_of("track", track))
        release_memory(always=True)
    about = job.needed(PLACED, made_from).about
    return {name: about[name] for name in ("map", "chunks")}


def _labelled(drive: OpenDrive, track: Trajectory) -> Drive:
    """The drive in the map."""
    job, saved = drive.job, drive.job.saved if drive.job.saved.is_dir() else None
    log = drive.log if job.origin is None else replace(drive.log, frame=job.origin)
    return with_answers(
        Drive(log, track, drive.network, job.settings, saved), job.folder, job.source.labels_from
    )


def with_answers(drive: Drive, folder: Path, labels_from: str) -> Drive:
    """The drive with a network whose answers are kept in a work folder: no image is segmented twice."""
    if drive.segmenter is None or not drive.log.cameras or isinstance(drive.segmenter, CachedLabels):
        return drive
    sizes = drive.log.calibration.image_sizes
    answers = probabilities_folder(folder, fingerprints.of_probabilities(drive, labels_from), True, sizes)
    return replace(drive, segmenter=CachedSegmenter(drive.segmenter, drive.label_set, sizes, answers))


def map_range(folder: str, key: str, mapped: str, start: int, stop: int) -> float:
    """Map the chunks of a range that are not mapped yet; returns how long it took, s. Raises DataError."""
    begun, (drive, store) = time.perf_counter(), _to_map(folder, key, mapped)
    # a chunk may be of an earlier run, of which a cluster still mapped something when this one began
    left = [number for number in range(start, stop) if not store.is_whole(number)]
    if left:
        fusion.map_range(drive, store, range(left[0], stop), lambda _, done, total: report(done))
    return time.perf_counter() - begun


def _to_map(folder: str, key: str, mapped: str) -> tuple[Drive, ChunkStore]:
    """A drive that is mapped; raises DataError if it is another one here."""
    drive = opened(folder, key)
    if mapped in drive.known:
        known: tuple[Drive, ChunkStore] = drive.known[mapped]
        return known
    placed = drive.job.needed(PLACED)
    found = _labelled(drive, Trajectory(**placed.of("track")))
    if not fingerprints.of_map(found, drive.job.source.labels_from) == placed.about["map"] == mapped:
        raise other_drive(drive.job.source)
    store = fusion.store_of(drive.job.folder, mapped, len(placed.about["chunks"]), drive.job.settings)
    drive.known[mapped] = found, store
    return found, store


def finish(folder: str, key: str, steps: dict[str, str], mapping_s: float) -> None:
    """Write the map of a drive, whose `steps` have these digests, into a folder of its own. Raises DataError."""
    (mapped, store), job = _to_map(folder, key, steps["mapped"]), job_of(folder, key)
    settings, stats = job.settings, RunStats()
    checked, located, placed = (job.needed(name).about for name in (CHECKED, LOCATED, PLACED))
    _, is_own, bound = correction_of(job, steps["bound"])
    for part in (checked, located, bound, placed):
        stats += RunStats.of(part["stats"])
        if part is bound and located["other_clock"]:
            stats.warnings.append(located["other_clock"])
    with writing_to(job.folder):
        beside = unfinished(job.made)
        beside.mkdir()
        try:
            with stats.stage("export"):
                _write_trajectory(job, mapped.log, steps, beside)
            stats.seconds["mapping"] = mapping_s
            with stats.stage("mapping"):
                fusion.summarise(mapped, store, stats)
                write_map(mapped, store, beside, stats)
            run_folder.write_objects(beside, job.name, mapped.log, store.objects(), settings)
            about = about_run(job.name, mapped.log, stats) | {
                "inputs": job.source.inputs,
                "scans_s": [mapped.log.scans[0].stamp, mapped.log.scans[-1].stamp],
                "preflight": checked["page"],
                "trajectory": located["solution"],
                "from_lidar_odometry": located["from_lidar_odometry"],
                "passes": bound["passes"] if is_own else [],
                "read": checked["read"],
                "correction": "" if is_own else bound["correction"],
            }
            run_folder.write_about(beside, settings, about, {"sharpness": placed["sharpness"]})
            tracked = {"objects": store.objects_as_json(), "untracked": store.untracked()}
            remember(job.folder / f"{FINISHED}.npz", key, tracked, {})
            ownership.write_list(beside, all_content=True)
            _put(beside, job, about)
        finally:
            shutil.rmtree(beside, ignore_errors=True)


def _write_trajectory(job: DriveJob, log: SensorLog, steps: dict[str, str], folder: Path) -> None:
    """Write the trajectory of a drive, with covariances, in all formats, and the plot of it."""
    found = job.needed(LOCATED, steps["located"])
    track, *alone = _tracks(
        job, opened(*job.key).log, steps["located"], steps["bound"], with_covariances=True
    )
    run_folder.write_trajectory_files(
        folder, log, track, alone[0] if alone else None, found.arrays.get("rejected")
    )
    if "plot" in found.arrays:
        found.arrays["plot"].tofile(folder / "trajectory.png")


def write_map(drive: Drive, store: ChunkStore, folder: Path, stats: RunStats) -> None:
    """Write raw map and evidence of a drive whose chunks are mapped, and counted in `stats`. Raises DataError."""
    release_memory(always=True)  # of the chunks: a tile of the map is the sum of those of many
    write_raw(store, folder, drive.log.frame)
    if stats.counts["points"] - stats.counts["points left out"] == stats.counts["points of moving objects"]:
        stats.warnings.append("all points were removed as moving: the pictures show the removed points")


def _put(beside: Path, job: DriveJob, about: dict[str, Any]) -> None:
    """Give the folder its name; a cluster may have called the task twice, and then the first one stays."""
    if job.is_made(about["read"], about["correction"]) and ownership.is_whole(job.made):
        return
    shutil.rmtree(job.made, ignore_errors=True)
    try:
        beside.rename(job.made)
    except OSError:
        if not job.is_made(about["read"], about["correction"]):
            raise

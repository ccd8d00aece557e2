"""The demo: a simulated drive, its images segmented, mapped, and scored against the exact truth.

It does the same as `simulate`, `segment`, `run` and `evaluate`, and is an example of the Python API.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gnss_sem_map import config
from gnss_sem_map.cli.compile_ahead import compiling_ahead
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.evaluation.score_run import score_run
from gnss_sem_map.export.report import write_report
from gnss_sem_map.files.output_folder import claimed, new_folder, real_path
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.process.run_stats import Progress, RunStats, silent
from gnss_sem_map.runs import finished_run
from gnss_sem_map.runs.run_folder import claimed_run
from gnss_sem_map.segmentation import DEMO_CALIBRATION, open_segmenter
from gnss_sem_map.segmentation.cache import write_cache
from gnss_sem_map.simulation import simulate, write_corrupted_labels

PROBABILITIES = "probabilities"
"""Folder of the class probabilities, beside the drive."""
LABELS = {
    "network": "of the small network trained on simulated streets (not of seeds 0, 101 to 105); not for real images",
    "corrupted": "the true class images, corrupted as a network would: blurred borders, confused classes",
}
"""Sources of the demo's class probabilities."""
PICTURES = ("flight.webp", "perspective.png", "topview.png", "trajectory.png", "report.html", "viewer.html")


@dataclass(frozen=True, eq=False)
class Demo:
    """Result of a demo."""

    about: dict[str, Any]
    """As run.json, with the seconds of simulation and segmentation before those of the run."""
    metrics: dict[str, Any]
    pictures: tuple[Path, ...]


def demonstrate(
    out: Path,
    seconds: float = 30.0,
    seed: int = 0,
    source: Literal["network", "corrupted"] = "network",
    progress: Progress = silent,
) -> Demo:
    """Simulate a drive into `<out>_drive`, segment it, map it into `out` and score it, with `source` one of `LABELS`.

    Earlier demos in both folders are replaced. Raises DataError when either holds other files, and ConfigError
    when the network needs a package that is not installed.
    """
    world = real_path(out).with_name(f"{real_path(out).name}_drive")
    with claimed_run(out), claimed(world), compiling_ahead():
        return _demonstrate(out, world, seconds, seed, source, progress)


def _demonstrate(out: Path, world: Path, seconds: float, seed: int, source: str, progress: Progress) -> Demo:
    label_set = open_label_set()
    # a missing package is reported now, not after the simulation
    network = open_segmenter("demo", label_set) if source == "network" else None
    settings = config.load(overrides=[f"calibration={DEMO_CALIBRATION}"] if network else [])

    stats = RunStats()
    with new_folder(world) as folder:
        with stats.stage("simulate"):
            drive = simulate(folder, seconds, seed, lambda done, total: progress("simulate", done, total))
        log = open_drive(drive)
        with stats.stage("segment"):
            if network is not None:
                write_cache(log.images, network, label_set, folder / PROBABILITIES, "demo", 1, progress)
            else:
                write_corrupted_labels(
                    drive, folder / PROBABILITIES, seed, lambda done, total: progress("segment", done, total)
                )

    drive, spec = world / drive.relative_to(folder), f"labels:{world / PROBABILITIES}"
    finished = finished_run.run(drive, out, spec, settings, write_labels=True, progress=progress)
    about, metrics = finished.about, score_run(out, drive / "truth")
    write_report(out, about, metrics)
    with stats.stage("flight"):
        finished.export(["flight"])
    return Demo(
        about | {"seconds": stats.seconds | about["seconds"]},
        metrics,
        tuple(out / name for name in PICTURES if (out / name).is_file()),
    )

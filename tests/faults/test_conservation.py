"""Nothing is lost without a word: on random damage every point and every frame is accounted for, and no label shifts.

Points that were read are left out, unlabelled or labelled; all hits of the map are in the refined one, what was removed
included; every frame is used, or skipped with its reason; and labels of undamaged frames stay where they were.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import scenes
import street
from faults.damage import SWEEPS, Harm, Place, damage
from faults.harness import gnss_sem_map

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.mapping.labelled_scans import Drive, LabelledScan, labelled_scans
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.runs import pipeline
from gnss_sem_map.runs.map_job import MapJob
from gnss_sem_map.runs.point_label_files import LabelledDrive, write_point_labels
from gnss_sem_map.runs.run_folder import about_run
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels import tiles

SETTINGS = Settings()
CARS = [  # one that drives ahead, and one that scrapes along a parked one
    ((16.0, -1.2, 0.0), (20.0, 0.6, 1.5), (6.0, 0.0, 0.0)),
    ((9.0, 3.9, 0.0), (9.8, 4.55, 1.7), (9.0, 0.0, 0.0)),
]
LAYOUTS = ("raw", "odometry", "table", "moving")


@dataclass
class Clean:
    """An undamaged drive, its trajectory, and what its images show of each scan."""

    place: Place
    trajectory: Trajectory
    seen: dict[int, LabelledScan]


def look(log: SensorLog, trajectory: Trajectory, segmenter: Segmenter | None) -> dict[int, LabelledScan]:
    return {seen.scan.number: seen for seen in labelled_scans(Drive(log, trajectory, segmenter, SETTINGS))}


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Clean]:
    raw, odometry, table, moving = (tmp_path_factory.mktemp(name) for name in LAYOUTS)
    driven = street.write(raw)
    places = [Place("raw", raw, driven.drive, driven.labels)]
    for name, root, write in (
        ("odometry", odometry, street.write_odometry),
        ("table", table, street.write_table_log),
    ):
        shutil.copytree(driven.labels, root / "probabilities")
        places.append(Place(name, root, write(root, driven), root / "probabilities"))
    drive = scenes.write_table_log(moving / "drive", scenes.street(CARS), SWEEPS)
    places.append(Place("moving", moving, drive, None))
    found = {}
    for place in places:
        log = open_drive(place.drive)
        trajectory, _ = pipeline.estimate_trajectory(log, SETTINGS, RunStats())
        found[place.layout] = Clean(place, trajectory, look(log, trajectory, place.segmenter(log)))
    return found


def hits(folder: Path) -> int:
    """All hits of a map, as any reader of Parquet finds them."""
    return sum(int(pq.read_table(path)["hits"].to_numpy().sum()) for path in folder.glob("*.parquet"))


def unaccounted(place: Place, harm: Harm, out: Path, with_labels: bool) -> list[str]:
    """Map a drive, and say which laws do not hold."""
    log = open_drive(place.drive)
    segmenter = place.segmenter(log) if with_labels else None
    run = MapJob(SETTINGS, log.frame, out, is_one=True)
    mapped = pipeline.map_log(log, segmenter, run, force=True)  # so short and damaged, it may look wrong
    out = mapped.folder
    kerbs = pipeline.refine(out, SETTINGS, mapped.stats).kerbs
    write_point_labels(out, [LabelledDrive(out, mapped.log, mapped.trajectory)], kerbs, SETTINGS)
    refined, static = tiles.read(out / "refined"), tiles.read(out / "refined").standing
    about = about_run(place.drive.name, log, mapped.stats)
    counts, frames = about["counts"], about["skips"]["frames"]
    labelled = {path.stem: path.stat().st_size // 4 for path in (out / "labels").iterdir()}
    removed = sum(int(np.fromfile(path, "<u4").sum()) for path in (out / "removed").iterdir())
    parts = [counts[f"points {part}"] for part in ("left out", "unlabelled", "labelled")]
    unlabelled = {s.where for s in mapped.stats.skips if s.what == "labels"}
    used = {scan.number for scan in log.scans if scan.name in labelled}
    laws = {
        "points read": (counts["points"], sum(parts)),
        "points of label files": (sum(labelled.values()), counts["points"]),
        "hits of the map": (hits(out / "map"), counts["points"] - counts["points left out"]),
        "hits of the refined map": (hits(out / "refined"), hits(out / "map")),
        "points removed": (removed, int(refined.removed_hits.sum())),
        "hits removed": (
            int((tiles.read(out / "map").voxels - static).hits.sum()),
            removed,
        ),
        "scans used": (counts["scans"], len(labelled)),
        "scans": (counts["scans"] + frames.get("scan", 0), len(place.known("scan")) + harm.extra["scan"]),
        "images": (
            len(log.images) + frames.get("image", 0),
            len(place.known("image")) + harm.extra["image"],
        ),
        "frames without labels": (
            unlabelled,
            {f"frame {n}" for n in harm.unlabelled & used} if with_labels else set(),
        ),
        "reasons": (all(skip["reason"] for skip in about["skips"]["listed"]), True),
    }
    if place.layout == "raw" and log.reference is not None:
        rows = len(place.drive.joinpath("oxts/timestamps.txt").read_text().splitlines())
        laws["oxts"] = (len(log.reference) + frames.get("oxts", 0), rows + harm.extra["oxts"])
    if place.layout == "moving":
        laws["something moves"] = (removed > 0, True)
    return [f"{name}: found {a}, expected {b}" for name, (a, b) in laws.items() if a != b]


def shifted(place: Place, harm: Harm, before: Clean) -> list[str]:
    """Undamaged frames whose points are elsewhere, or show something else, than before the damage."""
    log = open_drive(place.drive)
    after, faults = look(log, before.trajectory, place.segmenter(log)), []
    for number in set(range(SWEEPS)) - harm.scans:
        was, now = before.seen[number], after.get(number)
        expected = np.full_like(was.labels, -1) if number in harm.unlabelled else was.labels
        if now is None or not np.array_equal(was.keys, now.keys) or not np.array_equal(expected, now.labels):
            faults.append(f"frame {number} is not what it was")
    return faults


def conserve(clean: dict[str, Clean], layout: str, seed: int, trial: Callable[..., None], tmp: Path) -> None:
    chance, before = np.random.default_rng([LAYOUTS.index(layout), seed]), clean[layout]
    place = before.place.copy(tmp / f"{seed}")
    harm = damage(place, chance)
    with_labels = place.labels is not None and seed % 3 > 0
    faults = unaccounted(place, harm, tmp / f"out{seed}", with_labels) + shifted(place, harm, before)
    trial(f"conservation {layout}", faults, f"seed {seed}: {', '.join(harm.done)}")
    shutil.rmtree(place.root)


@pytest.mark.parametrize(
    "seeds",
    [
        range(1, 2),
        pytest.param(range(2, 5), marks=pytest.mark.slow),
        pytest.param(range(5, 48), marks=pytest.mark.faults),
    ],
)
@pytest.mark.parametrize(
    "layout",
    ["raw", *(pytest.param(name, marks=pytest.mark.slow) for name in ("odometry", "table")), "moving"],
)
def test_nothing_is_lost_on_random_damage(
    layout: str, seeds: range, clean: dict[str, Clean], trial: Callable[..., None], tmp_path: Path
) -> None:
    for seed in seeds:
        conserve(clean, layout, seed, trial, tmp_path)


ALWAYS = ("--write-labels", "--force")
"""The pre-flight is not what these drives are made for."""
WRITTEN = {
    "map", "refined", "map.ply", "map.laz", "topview.png", "perspective.png", "viewer.html", "topview_class.tif",
    "report.html", "run.json", "labels",
}  # fmt: skip


@pytest.mark.slow
def test_a_map_without_labels_but_with_movers_is_written(
    clean: dict[str, Clean], trial: Callable[..., None], tmp_path: Path
) -> None:
    drive, out = clean["moving"].place.drive, tmp_path / "out"
    outcome = gnss_sem_map("run", drive, "-o", out, "--segmenter", "none", *ALWAYS, folder=tmp_path / "1")
    assert outcome.code == 0, outcome
    assert {path.name for path in out.iterdir()} >= WRITTEN
    assert json.loads((out / "run.json").read_text())["map"]["points_removed"] > 100
    trial("whole runs", outcome.faults, outcome)


@pytest.mark.slow
def test_all_label_files_damaged_is_said_early_and_one_is_a_skip(
    clean: dict[str, Clean], trial: Callable[..., None], tmp_path: Path
) -> None:
    place = clean["odometry"].place.copy(tmp_path / "copy")
    assert place.labels is not None
    arguments = ("run", place.drive, "--segmenter", f"labels:{place.labels}", "-o", tmp_path / "out", *ALWAYS)
    files = sorted(place.labels.glob("*.npz"))
    files[0].write_bytes(files[0].read_bytes()[:1000])
    outcome = gnss_sem_map(*arguments, folder=tmp_path / "1")
    assert outcome.code == 0, outcome
    about = json.loads((tmp_path / "out/run.json").read_text())
    assert [s["where"] for s in about["skips"]["listed"] if s["what"] == "labels"] == ["frame 0"]
    trial("whole runs", outcome.faults, outcome)
    for path in files:
        path.write_bytes(b"")
    outcome = gnss_sem_map(*arguments, folder=tmp_path / "2")
    assert outcome.code == 1
    assert "none of 12 label files that were tried can be used" in outcome.err
    trial("whole runs", outcome.faults, outcome)


@pytest.mark.faults
@pytest.mark.parametrize("layout", ["raw", "table"])
@pytest.mark.parametrize("lack", ["calibration of the camera", "images", "known labels"])
def test_a_run_that_reaches_its_end_writes_what_it_has(
    layout: str, lack: str, clean: dict[str, Clean], trial: Callable[..., None], tmp_path: Path
) -> None:
    place = clean[layout].place.copy(tmp_path / "copy")
    segmenter = "none"
    match lack:
        case "images":
            shutil.rmtree(place.images)
        case "known labels":
            (tmp_path / "void").mkdir()
            for number in range(SWEEPS):
                void = np.full((street.HEIGHT, street.WIDTH), 255, np.uint8)
                assert cv2.imwrite(str(tmp_path / f"void/{number}.png"), void)
            segmenter = f"labels:{tmp_path / 'void'}"
        case _ if layout == "table":
            (place.drive / "log.yaml").unlink()
        case _:
            shutil.rmtree(place.drive / "image_02")
    out = tmp_path / "out"
    outcome = gnss_sem_map(
        "run", place.drive, "-o", out, "--segmenter", segmenter, *ALWAYS, folder=tmp_path / "1"
    )
    assert outcome.code == 0, outcome
    assert {path.name for path in out.iterdir()} >= WRITTEN
    assert (outcome.err.count("they hold no class at all") == 1) == (lack == "known labels"), (
        "said once, where it was hoped for"
    )
    trial("whole runs", outcome.faults, outcome)

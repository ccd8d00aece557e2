"""Nothing is lost without a word: on random damage every point and every frame is accounted for, and no label shifts.

Points that were read are left out, unlabelled or labelled; all hits of the map are in the refined one, what was removed
included; every frame is used, or skipped with its reason; and labels of undamaged frames stay where they were.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import scenes
import street
from faults.harness import gnss_sem_map

from factor_graphs.trajectory import Trajectory
from gnss_sem_map import pipeline
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.labelled_scans import Drive, LabelledScan, labelled_scans
from gnss_sem_map.run_stats import RunStats
from gnss_sem_map.runs.run_folder import about_run, write_point_labels
from gnss_sem_map.segmentation import Segmenter, open_segmenter
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.voxels import tiles

SETTINGS = Settings()
SWEEPS = 12
CARS = [  # one that drives ahead, and one that scrapes along a parked one
    ((16.0, -1.2, 0.0), (20.0, 0.6, 1.5), (6.0, 0.0, 0.0)),
    ((9.0, 3.9, 0.0), (9.8, 4.55, 1.7), (9.0, 0.0, 0.0)),
]
LAYOUTS = ("raw", "odometry", "table", "moving")


@dataclass
class Place:
    """One drive on disk, undamaged or a copy to damage."""

    layout: str
    root: Path
    """All of it, what lies around the drive included."""
    drive: Path
    labels: Path | None

    @property
    def scans(self) -> Path:
        parts = {"raw": "velodyne_points/data", "odometry": "velodyne"}
        return self.drive / parts.get(self.layout, "lidar")

    @property
    def images(self) -> Path:
        parts = {"raw": "image_02/data", "odometry": "image_2"}
        return self.drive / parts.get(self.layout, "images")

    def stamps(self, what: str) -> Path:
        """The file of stamps, a line per frame, of "scan" or "image"."""
        data = self.scans if what == "scan" else self.images
        at = {"raw": data.parent / "timestamps.txt", "odometry": self.drive / "times.txt"}
        return at.get(self.layout, data / "stamps.csv")

    def known(self, what: str) -> set[int]:
        """Frames that stamps or files tell of."""
        data = self.scans if what == "scan" else self.images
        found = {int(path.stem) for path in data.glob("*.*") if path.stem.isdecimal()}
        if not data.is_dir():
            return found
        lines = self.stamps(what).read_text().splitlines()
        if self.layout in ("raw", "odometry"):
            return found | {number for number, line in enumerate(lines) if line.strip()}
        return found | {int(line.split(",")[0]) for line in lines[1:]}

    def copy(self, to: Path) -> Place:
        shutil.copytree(self.root, to)
        labels = None if self.labels is None else to / self.labels.relative_to(self.root)
        return Place(self.layout, to, to / self.drive.relative_to(self.root), labels)

    def segmenter(self, log: SensorLog) -> Segmenter | None:
        if self.labels is None:
            return None
        return open_segmenter(f"labels:{self.labels}", open_label_set(), sizes=log.calibration.image_sizes)


@dataclass
class Harm:
    """What was done to a drive, and what must come of it."""

    scans: set[int] = field(default_factory=set)
    """Frames whose scan is not what it was."""
    unlabelled: set[int] = field(default_factory=set)
    """Frames whose image or labels are gone."""
    extra: Counter[str] = field(default_factory=Counter)
    """Files and lines beyond one per frame."""
    done: list[str] = field(default_factory=list)


Chance = np.random.Generator
Way = Callable[[Place, Chance, int, Harm], None]


def scan_file(place: Place, frame: int) -> Path:
    return next(path for path in sorted(place.scans.glob("*.bin")) if int(path.stem) == frame)


def of_file(path: Path, chance: Chance) -> None:
    """Cut short, emptied, gone, or all zeros."""
    content = path.read_bytes()
    match chance.integers(4):
        case 0:
            path.write_bytes(content[: int(chance.integers(1, len(content) // 16)) * 16 + 3])
        case 1:
            path.write_bytes(b"")
        case 2:
            path.unlink()
        case _:
            path.write_bytes(bytes(len(content)))


def harm_scan(place: Place, chance: Chance, frame: int, harm: Harm) -> None:
    of_file(scan_file(place, frame), chance)
    harm.scans.add(frame)


def harm_points(place: Place, chance: Chance, frame: int, harm: Harm) -> None:
    """Some, or all, of a scan's numbers become NaN or absurd, or only one point is left."""
    path, columns = scan_file(place, frame), 5 if place.layout in ("table", "moving") else 4
    rows = np.fromfile(path, "<f4").reshape(-1, columns)
    if chance.random() < 0.2:
        rows = rows[:1]
    else:
        value = chance.choice(np.array([np.nan, np.inf, 1e9, 0.0], np.float32))
        rows[chance.random(len(rows)) < chance.choice([0.01, 0.5, 1.0]), :3] = value
    rows.tofile(path)
    harm.scans.add(frame)


def repeat_scan(place: Place, chance: Chance, frame: int, harm: Harm) -> None:
    shutil.copyfile(scan_file(place, frame), place.scans / f"{frame:0{chance.integers(11, 15)}d}.bin")
    harm.extra["scan"] += 1


def harm_stamp(place: Place, chance: Chance, frame: int, harm: Harm) -> None:
    """A scan's stamp is lost or repeated, or that of its end comes before that of its start."""
    path = place.stamps("scan")
    lines = path.read_text().splitlines()
    if place.layout == "raw":
        name = str(chance.choice(["", "_start", "_end"]))
        path = path.with_name(f"timestamps{name}.txt")
        lines = path.read_text().splitlines()
        lines[frame] = "" if name == "" or chance.random() < 0.5 else lines[0 if name == "_end" else -1]
        if name != "" and lines[frame] and frame in (0, SWEEPS - 1):
            lines[frame] = ""
        harm.scans.add(frame)
    else:
        row = next(n for n, line in enumerate(lines) if line.startswith(f"{frame},"))
        if chance.random() < 0.5:
            del lines[row]
            harm.scans.add(frame)
        else:
            lines.insert(row + 1, f"{frame},99.5")
            harm.extra["scan"] += 1
    path.write_text("\n".join(lines) + "\n")


def harm_image(place: Place, chance: Chance, frame: int, harm: Harm) -> None:
    """The image is gone; a damaged one is not looked at where labels are read."""
    path = next(path for path in place.images.glob("*.png") if int(path.stem) == frame)
    if chance.random() < 0.3:
        shutil.copyfile(path, place.images / f"{frame:013d}.png")
        harm.extra["image"] += 1
        return
    of_file(path, chance)
    if not path.exists():
        harm.unlabelled.add(frame)


def harm_labels(place: Place, chance: Chance, frame: int, harm: Harm) -> None:
    assert place.labels is not None
    path = next(path for path in place.labels.glob("*.npz") if int(path.stem) == frame)
    if chance.random() < 0.5:
        of_file(path, chance)
    else:
        with np.load(path) as content:
            probabilities, names = content["probabilities"], content["class_names"]
        if chance.random() < 0.5:
            probabilities = probabilities[:-3]
        else:
            probabilities, names = probabilities[:, :, :-1], names[:-2]
        np.savez_compressed(path, probabilities=probabilities, class_names=names)
    harm.unlabelled.add(frame)


def harm_oxts(place: Place, chance: Chance, frame: int, harm: Harm) -> None:
    """A row of the navigation unit is gone, damaged or there twice; the first one is the map's origin."""
    path = place.drive / f"oxts/data/{max(frame, 1):010d}.txt"
    if chance.random() < 0.3:
        shutil.copyfile(path, path.with_name(f"{int(path.stem)}.txt"))
        harm.extra["oxts"] += 1
    elif path.exists():
        of_file(path, chance)


WAYS: dict[str, tuple[Way, ...]] = {
    "raw": (
        harm_scan, harm_points, repeat_scan, harm_stamp, harm_image, harm_labels, harm_labels, harm_oxts, harm_oxts
    ),
    "odometry": (harm_scan, harm_points, repeat_scan, harm_image, harm_labels, harm_labels),
    "table": (harm_scan, harm_points, repeat_scan, harm_stamp, harm_image, harm_labels, harm_labels),
    "moving": (harm_scan, harm_points, repeat_scan, harm_stamp),
}  # fmt: skip


def damage(place: Place, chance: Chance) -> Harm:
    """One to five kinds of harm, each to a frame of its own."""
    harm = Harm()
    frames = chance.permutation(SWEEPS)[: chance.integers(1, 6)].tolist()
    for frame in frames:
        ways = WAYS[place.layout]
        way = ways[int(chance.integers(len(ways)))]
        way(place, chance, frame, harm)
        harm.done.append(f"{way.__name__} {frame}")
    return harm


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
    out.mkdir()
    work = out.with_name(f"{out.name}.work")
    mapped = pipeline.run(
        log, segmenter, SETTINGS, out, work, force=True
    )  # so short and damaged, it may look wrong
    kerbs = pipeline.refine(out, SETTINGS, mapped.stats).kerbs
    write_point_labels(out, mapped.log, mapped.trajectory, kerbs, SETTINGS)
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


@pytest.mark.parametrize("layout", LAYOUTS)
def test_nothing_is_lost_on_random_damage(
    layout: str, clean: dict[str, Clean], trial: Callable[..., None], tmp_path: Path
) -> None:
    for seed in range(4):
        conserve(clean, layout, seed, trial, tmp_path)


@pytest.mark.faults
@pytest.mark.parametrize("layout", LAYOUTS)
def test_nothing_is_lost_on_much_random_damage(
    layout: str, clean: dict[str, Clean], trial: Callable[..., None], tmp_path: Path
) -> None:
    for seed in range(4, 47):
        conserve(clean, layout, seed, trial, tmp_path)


ALWAYS = ("--write-labels", "--force")
"""The pre-flight is not what these drives are made for."""
WRITTEN = {
    "map", "refined", "map.ply", "map.laz", "topview.png", "perspective.png", "viewer.html", "topview_class.tif",
    "report.html", "run.json", "labels",
}  # fmt: skip


def test_a_map_without_labels_but_with_movers_is_written(
    clean: dict[str, Clean], trial: Callable[..., None], tmp_path: Path
) -> None:
    drive, out = clean["moving"].place.drive, tmp_path / "out"
    outcome = gnss_sem_map("run", drive, "-o", out, "--segmenter", "none", *ALWAYS, folder=tmp_path / "1")
    assert outcome.code == 0, outcome
    assert {path.name for path in out.iterdir()} >= WRITTEN
    assert json.loads((out / "run.json").read_text())["map"]["points_removed"] > 100
    trial("whole runs", outcome.faults, outcome)


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
    assert ("no point got a label" in outcome.err) == (lack == "known labels"), (
        "said once, where it was hoped for"
    )
    trial("whole runs", outcome.faults, outcome)

"""Random damage to a drive on disk: scans, images, stamps and labels, and what must come of it."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import Segmenter, open_segmenter
from gnss_sem_map.sensor_log import SensorLog

SWEEPS = 12
"""Frames of a drive."""


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

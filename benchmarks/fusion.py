"""From pixels to voxels: what a single image says, what eq. 6 makes of many, and what everything else adds.

    python benchmarks/fusion.py [--data FOLDER] [--seconds 10] [--seeds 103 104]

prints the tables and writes benchmarks/results/fusion.json. Every method is judged on the same points: those that the
image of their own scan labels. A point without a prediction there is a miss (strict); counts are pooled over all scans.
A calibration file is learnt on the other excerpts of the same kind, never on the one that it is tried on.

SemanticKITTI excerpts (frames 0 to 9 of 00 and 08, a real network's output) come from FOLDER, by default
$GNSS_SEM_MAP_DATA or ../shared/data; where there are none, only simulated drives are measured. These are seen by the
demo's network, which has learnt from seeds 1 to 100 and was chosen and calibrated on 101 and 102: take others.
"""

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from real_data import DATA
from results_file import RESULTS, keep

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.label_files import label_files, read_labels
from gnss_sem_map.evaluation import metrics
from gnss_sem_map.evaluation.fit_sensor_model import fit_temperature, measure
from gnss_sem_map.evaluation.metrics import Tables
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.labels.sensor_model import LabelCalibration
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.labelled_scans import Drive, labelled_scans
from gnss_sem_map.mapping.point_labels import label_points
from gnss_sem_map.runs import pipeline
from gnss_sem_map.runs.map_job import MapJob
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.segmentation.cache import write_cache
from gnss_sem_map.simulation import simulate
from gnss_sem_map.voxels import tiles

URBAN = open_label_set("urban")
TABLES = Tables.of(URBAN)
IDS = np.append(URBAN.legend.semantic_kitti_ids, 0).astype(np.uint32)
"""Raw id of every class and `other`; -1, unlabelled, is the last."""
SINGLE, PAPER, PLAIN, DEFAULT, CALIBRATED = (
    "single frame",
    "eq. 6, floor 1 %",
    "eq. 6",
    "default",
    "calibrated",
)
Labels = dict[str, NDArray[np.uint32]]


@dataclass(frozen=True)
class Excerpt:
    """A drive with its truth and what a network saw in its images."""

    name: str
    drive: Path
    segmenter: str
    truth: Path
    single_frame: Path | None = None
    """What the image of its own scan says of every point; None: found here."""


@dataclass(frozen=True)
class Score:
    """What is counted of one method on one excerpt; scores add up."""

    confusion: NDArray[np.int64]
    calibration: NDArray[np.float64]

    def __add__(self, other: "Score") -> "Score":
        return Score(self.confusion + other.confusion, self.calibration + other.calibration)

    def figures(self) -> dict[str, Any]:
        """Strict accuracy and IoU, per class and on average, and the calibration error."""
        found = metrics.semantics(self.confusion, URBAN)
        hits, true = np.diag(self.confusion), self.confusion.sum(axis=1)
        union = np.maximum(true + self.confusion[:5, :-1].sum(axis=0) - hits, 1)
        return found["strict"] | {
            "coverage": found["coverage"],
            "iou": {name: float(hits[i] / union[i]) for i, name in enumerate(URBAN.names) if true[i]},
            "ece": metrics.calibration(self.calibration)["ece"],
        }


def single_frame(excerpt: Excerpt, drive: Drive) -> Labels:
    """The most probable of the five classes in each visible point's own pixel."""
    if excerpt.single_frame is not None:
        return {name: read_labels(path) for name, path in label_files(excerpt.single_frame).items()}
    found = {}
    for seen in labelled_scans(drive):
        entries = np.zeros(len(seen.valid), np.uint32)
        five = seen.classes[:, :-1]
        of_pixel = np.append(np.where(five.any(axis=1), IDS[five.argmax(axis=1)], 0), 0)  # -1 is the last
        entries[seen.valid] = of_pixel[seen.pixels]
        found[seen.scan.name] = entries
    return found


def score(predicted: Labels, confidence: dict[str, NDArray[np.float32]], truth: Path, only: Labels) -> Score:
    """Counts over all scans, of the points that their own image labels."""
    total = Score(
        np.zeros((6, 7), np.int64), np.zeros((2, 2, len(metrics.LOOKS), metrics.CALIBRATION_BINS, 3))
    )
    for name, path in label_files(truth).items():
        if name not in predicted:
            continue
        is_seen = only[name] & 0xFFFF != 0
        true, one_look = (
            np.where(is_seen, read_labels(path), 0).astype(np.uint32),
            np.ones(len(is_seen), np.uint8),
        )
        total += Score(
            metrics.confusion(predicted[name], true, TABLES, name),
            metrics.calibration_counts(confidence[name], predicted[name], true, TABLES, one_look, is_seen),
        )
    return total


def mapped(excerpt: Excerpt, drive: Drive, settings: Settings, only: Labels) -> tuple[Score, Score]:
    """The map before and after refinement."""
    both: tuple[Labels, Labels] = ({}, {})
    sure: tuple[dict[str, NDArray[np.float32]], dict[str, NDArray[np.float32]]] = ({}, {})
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        run = MapJob(settings, drive.log.frame, folder / "work", is_one=True)
        done = pipeline.map_log(drive.log, drive.segmenter, run)
        folder = done.folder
        kerbs = pipeline.refine(folder, settings, done.stats).kerbs
        maps = [tiles.open_map(folder / name, URBAN) for name in ("map", "refined")]
        moving = evidence.read(folder, URBAN).moving_points
        for scan, found in label_points(done.log, done.trajectory, maps, settings, moving, kerbs):
            for stage, of_map in enumerate(found):
                both[stage][scan.name], sure[stage][scan.name] = IDS[of_map.labels], of_map.confidence
    raw, refined = (score(both[i], sure[i], excerpt.truth, only) for i in range(2))
    return raw, refined


def learn(drives: list[tuple[Excerpt, Drive]]) -> LabelCalibration:
    """A calibration file from labelled excerpts."""
    counted = []
    for excerpt, drive in drives:
        with tempfile.TemporaryDirectory() as folder:
            run = MapJob(drive.settings, drive.log.frame, Path(folder) / "work", is_one=True)
            raw = tiles.read(pipeline.map_log(drive.log, drive.segmenter, run).folder / "map", URBAN)
        counted.append(measure(drive, raw.voxels, label_files(excerpt.truth)))
    points = zip(*(points for _, points in counted), strict=True)
    temperature = fit_temperature(*(np.concatenate(parts) for parts in points))
    return LabelCalibration(URBAN.name, URBAN.names, tuple(street for street, _ in counted), temperature)


def compare(excerpts: list[Excerpt], folder: Path) -> dict[str, dict[str, Score]]:
    """Method -> excerpt -> score."""
    drives = [(excerpt, opened(excerpt)) for excerpt in excerpts]
    table: dict[str, dict[str, Score]] = {}
    for excerpt, drive in drives:
        only = single_frame(excerpt, drive)
        certain = {name: np.ones(len(entries), np.float32) for name, entries in only.items()}
        scores = {SINGLE: score(only, certain, excerpt.truth, only)}
        scores[PLAIN], scores[DEFAULT] = mapped(excerpt, drive, drive.settings, only)
        scores[PAPER], _ = mapped(excerpt, drive, Settings(fusion="paper"), only)
        others = [pair for pair in drives if pair[0] is not excerpt]
        if others:
            file = folder / f"{excerpt.name}.yaml"
            file.write_text(learn(others).to_yaml(), "utf-8")
            _, scores[CALIBRATED] = mapped(excerpt, drive, Settings(calibration=file), only)
        for method, found in scores.items():
            table.setdefault(method, {})[excerpt.name] = found
    return table


def opened(excerpt: Excerpt) -> Drive:
    """The drive, with the trajectory that a run would use."""
    log, settings = open_drive(excerpt.drive), Settings()
    network = open_segmenter(excerpt.segmenter, URBAN, sizes=log.calibration.image_sizes)
    trajectory, _ = pipeline.estimate_trajectory(log, settings, pipeline.RunStats())
    return Drive(log, trajectory, network, settings)


def report(title: str, table: dict[str, dict[str, Score]]) -> dict[str, Any]:
    """Print every excerpt and all of them pooled; returns the figures."""
    figures: dict[str, Any] = {}
    for method, by_excerpt in table.items():
        parts = list(by_excerpt.values())
        pooled = sum(parts[1:], parts[0])
        figures[method] = {name: part.figures() for name, part in by_excerpt.items()}
        figures[method]["pooled"] = pooled.figures()
    for name in (*next(iter(table.values())), "pooled"):
        print(f"\n{title} {name:26} mIoU   acc   ECE   " + "  ".join(f"{n[:8]:>8}" for n in URBAN.names))
        for method in figures:
            f = figures[method][name]
            shares = (f["mean_iou"], f["mean_accuracy"], f["ece"])
            means = " ".join(f"{100 * share:5.1f}" for share in shares)
            per_class = "  ".join(f"{100 * f['iou'].get(n, float('nan')):8.1f}" for n in URBAN.names)
            print(f"  {method:34} {means}   {per_class}")
    return figures


def semantic_kitti(data: Path) -> Iterator[Excerpt]:
    """Excerpts that are there."""
    for name in ("00", "08"):
        drive = data / "semantic_kitti" / "sequences" / name
        if drive.is_dir():
            probabilities = data / "labels" / "semantic_kitti" / name / "probabilities"
            yield Excerpt(
                name, drive, f"labels:{probabilities}", drive / "labels", data / "single_frame" / name
            )


def simulated(folder: Path, seeds: list[int], seconds: float) -> Iterator[Excerpt]:
    """Simulated drives, seen by the demo's network."""
    network = open_segmenter("demo", URBAN)
    for seed in seeds:
        drive, probabilities = (
            simulate(folder / f"drive{seed}", seconds, seed),
            folder / f"probabilities{seed}",
        )
        write_cache(open_drive(drive).images, network, URBAN, probabilities, "demo", batch_size=1)
        yield Excerpt(f"seed {seed}", drive, f"labels:{probabilities}", drive / "truth" / "labels")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--seeds", type=int, nargs="*", default=[103, 104])
    parser.add_argument("--out", type=Path, default=RESULTS / "fusion.json")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        real = list(semantic_kitti(asked.data))
        if real:
            keep(asked.out, {"semantic_kitti": report("SemanticKITTI", compare(real, folder))})
        towns = list(simulated(folder, asked.seeds, asked.seconds))
        if towns:
            keep(asked.out, {"simulated": report("simulated", compare(towns, folder))}, "torch")


if __name__ == "__main__":
    main()

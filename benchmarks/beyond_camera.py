"""What the map says of places that no camera saw: scores on all points with truth, share of labelled voxels, cost.

    python benchmarks/beyond_camera.py [--data FOLDER] [--runs FOLDER] [--only streets raw demo cost] [--ablations]

prints the figures and writes benchmarks/results/beyond_camera.json. `streets`: SemanticKITTI 00 and 08 (ten scans each,
labels of a small network), without a classifier, with one that each drive fits itself, and with one of both drives;
counts of both are pooled. `raw`: share of the voxels of KITTI raw 0005 that stand and have a class or `other`. `demo`:
the simulated drive of the demo. `cost`: CPU time of the classifier, of one thread. `ablations`: the streets without
single steps of the refinement; only where asked for.

Data come from FOLDER, by default $GNSS_SEM_MAP_DATA or ../shared/data. Finished runs in --runs are used again; without
it, all are made in a temporary folder. What every figure counts is in docs/formats.md.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from real_data import DATA
from results_file import RESULTS, keep

from gnss_sem_map import Run
from gnss_sem_map.evaluation.score_run import Counts, count_points
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.geometric_classifier import training
from gnss_sem_map.labels.label_set import UNLABELLED, open_label_set
from gnss_sem_map.mapping.classifying import drives_of
from gnss_sem_map.mapping.raw_map import MAP
from gnss_sem_map.refinement.by_block import geometry_halo_m
from gnss_sem_map.refinement.potts_mrf import mean_field
from gnss_sem_map.refinement.state import Evidence, MapState
from gnss_sem_map.voxels.blocks import blocks_of
from gnss_sem_map.voxels.map_json import files_of, tile_of
from gnss_sem_map.voxels.semantic_map import State

URBAN = open_label_set()
STREETS = ("00", "08")
RAW_0005 = "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync"
STEPS = (
    "discount",
    "geometric_prior",
    "systematic_error",
    "count_grid",
    "potts_mrf",
    "geometric_labels",
)
"""Steps to switch off."""
WITHOUT = "geometric_classifier.enabled=false"
ALL = "streets", "raw", "demo", "cost"
ASKED = *ALL, "ablations"
Figures = dict[str, Any]
Scored = list[tuple[Path, Path]]
"""Folders of runs, each with its truth."""


def command(*words: str | Path) -> float:
    """Run a command of the package; returns its seconds. An error ends the benchmark."""
    start = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "gnss_sem_map.cli", "-q", *map(str, words)],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return time.perf_counter() - start


def mapped(drive: Path, probabilities: Path, out: Path, *more: str) -> Path:
    """The run of a drive with the default settings."""
    if not (out / "run.json").exists():
        command("run", drive, "--segmenter", f"labels:{probabilities}", "-o", out, *more)
    return out


def refined(run: Path, name: str, *settings: str) -> Path:
    """The same run with other settings, beside it."""
    out = run.with_name(f"{run.name}_{name}")
    command("refine", run, "-o", out, *(word for setting in settings for word in ("--set", setting)))
    return out


def scores(runs: Scored) -> Figures:
    """Figures of the points of all runs together."""
    counts = reduce(Counts.plus, (count_points(out, truth, URBAN) for out, truth in runs))
    found = counts.figures(URBAN)
    of_all = found["semantics"]["refined"]
    parts = {
        "all": (of_all, counts.refined),
        "seen": (of_all["seen"], counts.seen),
        "unseen": (of_all["unseen"], counts.refined - counts.seen),
    }
    errors = {name: value for name, value in found["calibration"].items() if name.startswith("ece")}
    return {name: compact(*part) for name, part in parts.items()} | rounded(errors)


def compact(figures: Figures, counts: NDArray[np.int64]) -> Figures:
    """Single figures, and strict IoU per class."""
    c = len(URBAN.names)
    hits, true = np.diag(counts)[:c], counts[:c].sum(axis=1)
    iou = hits / np.maximum(true + counts[:c, :c].sum(axis=0) - hits, 1)
    return rounded(
        {name: figures[name] for name in ("coverage", "answered", "open", "wrong")}
        | {"strict": figures["strict"]["mean_iou"]}
        | {f"strict {name}": iou[i] for i, name in enumerate(URBAN.names) if true[i]}
    ) | {"other": figures["other"] and rounded(figures["other"])}


def rounded(figures: Figures) -> Figures:
    """To a hundredth of a percent."""
    return {name: None if value is None else round(float(value), 4) for name, value in figures.items()}


def cost(runs: list[Path]) -> Figures:
    """Seconds of the stages of refinement, and per voxel; `classifier` is the fit."""
    about = [read_run(run) for run in runs]
    voxels = sum(one["map"]["voxels"] for one in about)
    found: Figures = {"voxels": voxels}
    for stage in (
        "refinement",
        *sorted({name for one in about for name in one["seconds"] if "classifier" in name}),
    ):
        seconds = sum(one["seconds"].get(stage, 0.0) for one in about)
        found |= {f"{stage}_s": round(seconds, 2), f"{stage}_us_per_voxel": round(1e6 * seconds / voxels, 2)}
    return found


def street_runs(data: Path, runs: Path) -> Scored:
    """The runs of the two streets with the default settings, and their truth."""
    found = []
    for street in STREETS:
        drive = data / "semantic_kitti" / "sequences" / street
        probabilities = data / "labels" / "semantic_kitti" / street / "probabilities"
        found.append((mapped(drive, probabilities, runs / street, "--write-labels"), drive))
    return found


def streets(data: Path, runs: Path) -> Iterator[tuple[str, Figures]]:
    """Without a classifier, with one of each drive, with one of both."""
    alone, model = street_runs(data, runs), runs / "classifier"
    yield "one of each drive", scores(alone) | cost([out for out, _ in alone])
    yield "none", scores([(refined(out, "none", WITHOUT), truth) for out, truth in alone])
    seconds = command("fit-classifier", *(out for out, _ in alone), "-o", model)
    use = f"geometric_classifier.model={model}"
    both = [(refined(out, "both", use), truth) for out, truth in alone]
    fitted = {"fit_s": round(seconds, 2)}
    yield "one of both", scores(both) | cost([out for out, _ in both]) | fitted


def raw(data: Path, runs: Path) -> Iterator[tuple[str, Figures]]:
    """Of a drive without truth: how much of the map has a class, or is `other`."""
    run = mapped(data / RAW_0005, data / "labels" / "kitti_raw_0005" / "probabilities", runs / "raw")
    for name, out in (("none", refined(run, "none", WITHOUT)), ("own", run)):
        whole = Run.open(out).map()
        labels = whole.labels[whole.states != State.REMOVED]
        yield (
            name,
            cost([out])
            | {
                "standing_voxels": len(labels),
                "answered": round(float((labels != UNLABELLED).mean()), 4),
                "classes": rounded({kind: (labels == i).mean() for i, kind in enumerate(URBAN.legend.names)}),
            },
        )


def demo(data: Path, runs: Path) -> Iterator[tuple[str, Figures]]:
    """The drive of the demo, with and without the classifier."""
    out = runs / "demo"
    if not (out / "run.json").exists():
        command("demo", "-o", out)
    [drive] = runs.glob("demo_drive/*/*_sync")
    yield "own", scores([(out, drive / "truth")]) | cost([out])
    yield "none", scores([(refined(out, "none", WITHOUT), drive / "truth")])


def classifier_cost(data: Path, runs: Path) -> Iterator[tuple[str, Figures]]:
    """CPU seconds of one thread, for a fit, and for what is done with a classifier."""
    for street, (out, _) in zip(STREETS, street_runs(data, runs), strict=True):
        yield street, costs_of(Run.open(out))


def costs_of(run: Run) -> Figures:
    """Of a run of one drive."""
    [drive], voxels, steps = drives_of(run.folder, run.settings), run.map().voxels, run.settings.refinement
    size, files = voxels.voxel_size_m, files_of(run.folder / MAP)
    blocks = blocks_of({tile_of(name): about["voxels"] for name, about in files.items()})
    margin, coupling = geometry_halo_m(steps, size), steps.geometric_labels.coupling_nat
    scores, everywhere = MapState.of(voxels, Evidence()).scores, np.ones(len(voxels), np.bool_)
    fit = seconds_of(lambda: training.fit([drive.rows()], URBAN, size, drive.has_intensity))
    judge = seconds_of(lambda: [drive.geometric_evidence(block, margin) for block in blocks])
    smooth = seconds_of(lambda: mean_field(voxels.keys, scores, everywhere, coupling))
    per_voxel = {"features and trees": judge, "Potts model": smooth, "together": judge + smooth}
    return {"voxels": len(voxels), "fit, s": round(fit, 2)} | {
        f"{part}, us per voxel": round(1e6 * seconds / len(voxels), 2) for part, seconds in per_voxel.items()
    }


def seconds_of(done: Callable[[], object]) -> float:
    """CPU seconds of this process for what is done, the second time: then it is compiled."""
    done()
    start = time.process_time()
    done()
    return time.process_time() - start


def ablations(data: Path, runs: Path) -> Iterator[tuple[str, Figures]]:
    """The streets without single steps of the refinement."""
    alone = street_runs(data, runs)
    yield "all steps", scores(alone)
    for step in STEPS:
        off = f"refinement.{step}.enabled=false"
        yield f"without {step}", scores([(refined(out, step, off), truth) for out, truth in alone])


def show(part: str, name: str, figures: Figures) -> None:
    """One line for all points, one for the seen and one for the unseen; without truth, one line."""
    rest = {key: value for key, value in figures.items() if key not in ("all", "seen", "unseen")}
    for which in ("all", "seen", "unseen"):
        if which in figures:
            shares = (f"{key} {100 * v:.1f}" for key, v in figures[which].items() if isinstance(v, float))
            print(f"{part}, {name}, {which}: " + ", ".join(shares))
    print(f"{part}, {name}: {rest}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--runs", type=Path, help="folder in which runs are kept")
    parser.add_argument("--only", nargs="+", choices=ASKED, default=ALL)
    parser.add_argument("--ablations", action="store_true", help="the ablations as well")
    parser.add_argument("--out", type=Path, default=RESULTS / "beyond_camera.json")
    asked = parser.parse_args()
    parts = dict.fromkeys((*asked.only, *(["ablations"] if asked.ablations else [])))
    measure = {"streets": streets, "raw": raw, "demo": demo, "cost": classifier_cost, "ablations": ablations}
    with tempfile.TemporaryDirectory() as temporary:
        runs = (asked.runs or Path(temporary)).resolve()
        runs.mkdir(parents=True, exist_ok=True)
        for part in parts:
            found = {}
            for name, figures in measure[part](asked.data.resolve(), runs):
                show(part, name, figures)
                found[name] = figures
            keep(asked.out, {part: found}, "numpy")


if __name__ == "__main__":
    main()

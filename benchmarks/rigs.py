"""Rigs of other sensors through the simulated town: two LiDARs and four cameras, LiDARs of 16 to 128 rings, and bags.

    python benchmarks/rigs.py FOLDER [--only surround | rings | bags] [--seeds 101 102 103]

`surround`: simulates the surround rig for 30 s into FOLDER, corrupts its true class images as the demo does without
torch, maps it, and scores every point of both LiDARs. `rings`: LiDARs of 16, 32 and 128 rings at KITTI's place, each
mapped alone with KITTI's camera, on drives of several seeds. `bags`: the figures of `bags.py`. All take 30 minutes and
6 GB; what is in FOLDER already is used again. Writes results/rigs.json.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import bags
import numpy as np
from results_file import keep

from gnss_sem_map import open_drive, run
from gnss_sem_map.evaluation.score_run import score_run
from gnss_sem_map.simulation import Lidar, Simulation, prepare, write_corrupted_labels
from gnss_sem_map.simulation.kitti_rig import T_IMU_LIDAR
from gnss_sem_map.simulation.rigs import RIGS, MountedLidar, Rig, kitti
from gnss_sem_map.simulation.table_drive import write_table

RESULTS = Path(__file__).parent / "results" / "rigs.json"
SECONDS, SEED = 30.0, 0
RINGS = {
    "16": Lidar(np.radians(np.linspace(15.0, -15.0, 16)), columns=1800, range_m=100.0, blind_m=1.0),
    "32": Lidar(np.radians(np.linspace(10.67, -30.67, 32)), columns=1800, range_m=100.0, blind_m=1.0),
    "128": Lidar(np.radians(np.linspace(22.5, -22.5, 128)), columns=1024, range_m=100.0, blind_m=1.0),
}
"""Rows like those of a VLP-16, an HDL-32E and an OS1-128."""
CASES = ("surround", "rings", "bags")


def main() -> None:
    """Write the figures; those of cases that are left out stay."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=CASES)
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102, 103])
    parser.add_argument("--out", type=Path, default=RESULTS)
    chosen = parser.parse_args()
    for case in CASES if chosen.only is None else (chosen.only,):
        found = (
            surround(chosen.folder) if case == "surround"
            else rings(chosen.folder, chosen.seeds) if case == "rings"
            else bags.figures(chosen.folder)
        )  # fmt: skip
        keep(chosen.out, {case: found})
        print(json.dumps({case: found}, indent=1))


def simulated(simulation: Simulation, folder: Path, seed: int) -> tuple[Path, Path]:
    """The drive and its corrupted class images, in a folder."""
    drive, labels = folder / simulation.name, folder / "probabilities"
    if not drive.exists():
        write_table(simulation, folder)
    if not labels.exists():
        write_corrupted_labels(drive, labels, seed)
    return drive, labels


def rings(folder: Path, seeds: list[int]) -> dict[str, dict[str, Any]]:
    """Scores of what moved, by the number of rings and the seed."""
    lidars = tuple(MountedLidar(name, T_IMU_LIDAR, lidar) for name, lidar in RINGS.items())
    found: dict[str, dict[str, Any]] = {name: {} for name in RINGS}
    for seed in seeds:
        here = folder / f"rings-{seed}"
        drive, labels = simulated(prepare(SECONDS, seed, rig=Rig(lidars, kitti().cameras)), here, seed)
        for log in open_drive(drive).by_lidar:
            out = here / log.lidar
            run(drive, out, segmenter=f"labels:{labels / 'camera'}", log=log, write_labels=True)
            found[log.lidar][str(seed)] = _moving(score_run(out, drive / "truth"))
    return found


def surround(folder: Path) -> dict[str, Any]:
    """Scores of the map of the surround rig, over the points of both LiDARs."""
    simulation, out = prepare(SECONDS, SEED, rig=RIGS["surround"]()), folder / "out"
    drive, labels = simulated(simulation, folder, SEED)
    about = run(drive, out, segmenter=f"labels:{labels}", write_labels=True).about
    scores = score_run(out, drive / "truth")
    semantics, trajectory = scores["semantics"], scores["trajectory"]
    return {
        "seconds": SECONDS,
        "lidars": len(simulation.rig.lidars),
        "cameras": len(simulation.rig.cameras),
        "scans": about["counts"]["scans"],
        "points": about["counts"]["points"],
        "coverage": round(semantics["refined"]["coverage"], 4),
        "raw": _means(semantics["raw"]),
        "refined": _means(semantics["refined"]),
        "moving": _moving(scores),
        "ate_m": round(trajectory["ate_m"], 3),
        "run_s": {name: round(value, 1) for name, value in about["seconds"].items()},
    }


def _moving(scores: dict[str, Any]) -> dict[str, float]:
    return {name: round(scores["dynamic"][name], 4) for name in ("SA", "DA", "AA")}


def _means(scores: dict[str, Any]) -> dict[str, float]:
    return {name: round(scores[name], 4) for name in ("mean_accuracy", "mean_iou")}


if __name__ == "__main__":
    main()

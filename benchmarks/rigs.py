"""A rig with two LiDARs and four cameras through the demo town, and what it costs to read a bag.

    python benchmarks/rigs.py FOLDER

Simulates the surround rig for 30 s into FOLDER, corrupts its true class images as the demo does without torch, maps it,
scores every point of both LiDARs, and adds the figures of `bags.py`. Takes 15 minutes and 4 GB; what is in FOLDER
already is used again. Writes results/rigs.json.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bags

from gnss_sem_map import run
from gnss_sem_map.evaluation.score_run import score_run
from gnss_sem_map.simulation import prepare, write_corrupted_labels
from gnss_sem_map.simulation.rigs import RIGS
from gnss_sem_map.simulation.table_drive import write_table

RESULTS = Path(__file__).parent / "results" / "rigs.json"
SECONDS, SEED = 30.0, 0


def main(folder: Path) -> None:
    """Write the figures."""
    found = {"surround": surround(folder), "bags": bags.figures(folder)}
    RESULTS.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


def surround(folder: Path) -> dict[str, Any]:
    """Scores of the map of the surround rig, over the points of both LiDARs."""
    simulation = prepare(SECONDS, SEED, rig=RIGS["surround"]())
    drive, labels, out = folder / simulation.name, folder / "probabilities", folder / "out"
    if not drive.exists():
        write_table(simulation, folder)
        write_corrupted_labels(drive, labels, SEED)
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
        "moving": {name: round(scores["dynamic"][name], 4) for name in ("SA", "DA", "AA")},
        "ate_m": round(trajectory["ate_m"], 3),
        "run_s": {name: round(value, 1) for name, value in about["seconds"].items()},
    }


def _means(scores: dict[str, Any]) -> dict[str, float]:
    return {name: round(scores[name], 4) for name in ("mean_accuracy", "mean_iou")}


if __name__ == "__main__":
    main(Path(sys.argv[1]))

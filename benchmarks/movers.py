"""Speed, size and class of what moved, against the exact truth of simulated drives.

    python benchmarks/movers.py DRIVE [DRIVE ...] [--without-labels]

prints the figures and writes them into benchmarks/results/movers.json; drives that were not asked for stay as they are
there. Poses are those that a run finds, labels the true class images. A mover is scored at every place of its track:
its speed against that of the true object whose middle is nearest, at most NEAR_M away. `within` is the share of speeds
within two standard deviations of the truth, `places_within_90` that of places within the ellipses that should hold
90 %, both relative to the LiDAR: where the drive's own trajectory is off, objects are off with it.
"""

from __future__ import annotations

import argparse
import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from refinement import mapped, perfectly_seen, what_they_do
from results_file import keep
from scipy.interpolate import CubicSpline
from scipy.stats import chi2

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.datasets.given_trajectory import read_tum
from gnss_sem_map.dynamics.movers import Mover, movers_of

RESULTS = Path(__file__).parent / "results" / "movers.json"
NEAR_M = 3.0
HOLDS_90 = float(chi2.ppf(0.9, 2))
"""Squared distance, in standard deviations, to the edge of an ellipse that holds 90 %."""
CLASSES = {"person": "person", "cyclist": "cyclist"}
"""Class of a model; all others are vehicles."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrueObject:
    """An object that moves in a simulated drive."""

    model: str
    case: str
    stamps: Array
    places: CubicSpline
    size_m: Array


def main() -> None:
    """Measure the drives that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drives", nargs="+", type=Path, help="simulated drives in KITTI raw layout")
    parser.add_argument("--without-labels", action="store_true", help="by free space and tracks alone")
    options = parser.parse_args()
    for folder in options.drives:
        drive = perfectly_seen(folder)
        if options.without_labels:
            drive = replace(drive, segmenter=None)
        objects = [one for chunk in mapped(drive) for one in chunk.objects]
        ways = drive.trajectory, read_tum(folder / "truth" / "trajectory.tum")
        figures = scored(movers_of(objects, ("vehicle",)), true_objects(folder), *ways)
        name = f"{folder.name}{', without labels' if options.without_labels else ''}"
        print(json.dumps({name: figures}, indent=1), flush=True)
        keep(RESULTS, {name: figures})


def true_objects(folder: Path) -> list[TrueObject]:
    """The movers of a simulated drive, by the poses at its scans."""
    with (folder / "truth" / "vehicles.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["moving"] == "1"]
    cases, by_instance = what_they_do(folder), {}
    for row in rows:
        by_instance.setdefault(int(row["instance"]), []).append(row)
    found = []
    for instance, its in by_instance.items():
        at = np.array([[float(row[key]) for key in ("stamp_s", "x_m", "y_m")] for row in its])
        size = np.array([float(its[0][key]) for key in ("length_m", "width_m", "height_m")])
        if len(at) > 3:
            spline = CubicSpline(at[:, 0], at[:, 1:])
            found.append(TrueObject(its[0]["name"], cases[instance], at[:, 0], spline, size))
    return found


def scored(
    movers: tuple[Mover, ...], truth: list[TrueObject], found_way: Trajectory, true_way: Trajectory
) -> dict[str, Any]:
    """Figures of all movers, and of every case."""
    off, within, inside, means, by_case, right, unknown = [], [], [], [], {}, [], 0
    for mover in movers:
        one = nearest(mover, truth)
        if one is None:
            unknown += 1
            continue
        true = np.linalg.norm(one.places(mover.stamps, 1), axis=1)
        errors = mover.speeds - true
        off.append(errors)
        within.append(np.abs(errors) < 2 * mover.speed_stddevs)
        places = placed(mover, found_way, true_way) - one.places(mover.stamps)
        inside.append(((places / mover.position_stddevs) ** 2).sum(axis=1) < HOLDS_90)
        way = np.linalg.norm(np.diff(one.places(mover.stamps), axis=0), axis=1).sum()
        speed, stddev = mover.mean_speed
        means.append((speed - way / (mover.stamps[-1] - mover.stamps[0]), stddev))
        right.append(CLASSES.get(one.model, "vehicle") == mover.name)
        by_case.setdefault(one.case, []).append(errors)
    errors, (of_means, stddevs) = np.concatenate(off), np.array(means).T
    return {
        "movers": len(off),
        "movers without a true one": unknown,
        "places": len(errors),
        "speed_rms_mps": rms(errors),
        "speed_median_error_mps": round(float(np.median(np.abs(errors))), 3),
        "within": round(float(np.concatenate(within).mean()), 3),
        "places_within_90": round(float(np.concatenate(inside).mean()), 3),
        "mean_speed_rms_mps": rms(of_means),
        "mean_speed_within": round(float((np.abs(of_means) < 2 * stddevs).mean()), 3),
        "class_right": round(float(np.mean(right)), 3),
        "cases": {
            case: {"movers": len(some), "speed_rms_mps": rms(np.concatenate(some))}
            for case, some in sorted(by_case.items())
        },
    }


def placed(mover: Mover, found_way: Trajectory, true_way: Trajectory) -> Array:
    """Places (k, 2) m of a mover, had the drive been where it truly was."""
    p_map = np.column_stack([mover.positions, np.ones(len(mover.stamps))])
    p_imu = np.linalg.solve(found_way.at(mover.stamps), p_map[:, :, None])
    return np.asarray((true_way.at(mover.stamps) @ p_imu)[:, :2, 0])


def nearest(mover: Mover, truth: list[TrueObject]) -> TrueObject | None:
    """The true object on whose way it is, all the time."""
    distances = []
    for one in truth:
        if one.stamps[0] - 0.1 <= mover.stamps[0] and mover.stamps[-1] <= one.stamps[-1] + 0.1:
            off = one.places(mover.stamps) - mover.track.positions
            distances.append((float(np.median(np.linalg.norm(off, axis=1))), one))
    off_m, best = min(distances, key=lambda pair: pair[0], default=(np.inf, None))
    return best if off_m < NEAR_M else None


def rms(values: Array) -> float:
    """Root of the mean square, rounded."""
    return round(float(np.sqrt(np.mean(values**2))), 3)


if __name__ == "__main__":
    main()

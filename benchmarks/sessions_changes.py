"""Changes that were found in a map of two sessions, against those that the simulator made.

One that was found is right when most of its voxels lie in boxes of the truth; one that is there is found when half of
its voxels that are seen through are among those that were found. What one session hardly saw does not count.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.dynamics.visibility import WIDE_RATIO, hits_and_misses
from gnss_sem_map.evaluation.changes import ChangeSettings
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.files.run_json import read_run
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.raw_map import RawMap, open_raw

Array = NDArray[np.float64]
Figures = dict[str, Any]

SETTINGS = ChangeSettings()
NEAR_M, SEEN_M = 0.3, 0.1
"""How far from a box a voxel that was found may lie, and one that counts as the box's own."""


def score_changes(
    out: Path, drives: Sequence[Path], true: Trajectory, bound: Trajectory, frame: LocalFrame
) -> Figures:
    """Counts of objects that were found and that there are.

    `true` and `bound` are the second drive's trajectory by truth and in the map; `frame` is the truth's own.
    """
    label_set = open_label_set(Settings().classes)
    sessions = [open_raw(out / "drives" / drive.name, label_set) for drive in drives]
    map_frame = LocalFrame(**read_run(out)["local_frame"])
    T_map_truth = map_frame.pose_of(frame)
    offset = _offset(true, bound)
    found, voxels = read_run(out)["changes"], _voxels_of_changes(out, map_frame)
    covered = [np.zeros(len(of_thing), np.bool_) for of_thing in voxels]
    told = kinds = there = recalled = 0
    for box in json.loads((drives[1] / "truth" / "changes.json").read_text())["changes"]:
        centre = T_map_truth[:3, :3] @ [box["x_m"], box["y_m"], box["z_m"]] + T_map_truth[:3, 3] + offset
        appeared = box["change"] == "appeared"
        inside = {
            n: _inside(voxels[n], box, centre, NEAR_M)
            for n, thing in enumerate(found)
            if (thing["change"] == "appeared") == appeared
        }
        for n, rows in inside.items():
            covered[n] |= rows
        mine = [n for n, rows in inside.items() if rows.mean() > 0.5]
        if mine and found[mine[0]]["kind"] != "unknown":
            told, kinds = told + 1, kinds + (found[mine[0]]["kind"] == box["cause"])
        if max(box["length_m"], box["width_m"], box["height_m"]) >= SETTINGS.least_size_m:
            seen = _seen_through(sessions[int(appeared)], sessions[1 - int(appeared)], box, centre)
            of_box = sum(int(rows.sum()) for rows in inside.values())
            there, recalled = there + (seen > 0), recalled + (0 < seen <= 2 * of_box)
    right = sum(bool(rows.mean() > 0.5) for rows in covered)
    return {
        "found": len(found),
        "right": right,
        "there": there,
        "recalled": recalled,
        "told": told,
        "kind_right": kinds,
    }


def _offset(true: Trajectory, bound: Trajectory) -> Array:
    """Where the map has what the truth has elsewhere, by the error of its place: (3,) m."""
    stamps = np.arange(true.start + 0.5, true.end - 0.5, 0.5)
    T = bound.at(stamps) @ np.linalg.inv(true.at(stamps))
    p = true.at(stamps)[:, :3, 3]
    return np.asarray(np.median(np.einsum("kij,kj->ki", T[:, :3, :3], p) + T[:, :3, 3] - p, axis=0))


def _voxels_of_changes(out: Path, frame: LocalFrame) -> list[Array]:
    """The voxels of every object that was found, (n, 3) m in the map, from the file that users get."""
    points = laspy.read(out / "changes.laz")
    places = Georeference(frame).to_map(np.column_stack([points.x, points.y, points.z]))
    numbers = np.asarray(points.point_source_id, np.int64)
    return [places[numbers == n] for n in range(numbers.max(initial=-1) + 1)]


def _inside(points: Array, box: Figures, centre: Array, margin_m: float) -> NDArray[np.bool_]:
    off, half = points - centre, np.array([box["length_m"], box["width_m"], box["height_m"]]) / 2 + margin_m
    c, s = np.cos(box["yaw_rad"]), np.sin(box["yaw_rad"])
    turned = np.column_stack([off[:, 0] * c + off[:, 1] * s, off[:, 1] * c - off[:, 0] * s, off[:, 2]])
    return np.asarray((np.abs(turned) <= half).all(axis=1))


def _seen_through(stands: RawMap, gone: RawMap, box: Figures, centre: Array) -> int:
    """How many voxels of an object one session has, and the other one looks through; 0 where that is not most of it."""
    centres = np.concatenate([stands.around((tile,), 0.0).centres for tile in stands.fused.tiles])
    places = centres[_inside(centres, box, centre, SEEN_M)]
    places = places[places[:, 2] > centre[2] - box["height_m"] / 2 + SETTINGS.over_ground_m]
    if len(places) < SETTINGS.least_voxels:
        return 0
    counts = np.zeros((2, len(places)), np.int32)
    keyframes = gone.evidence.keyframes_near(places, SETTINGS.farthest_m)
    for part in keyframes.parts() if keyframes is not None else ():
        counts += hits_and_misses(places, part, SETTINGS.farthest_m, WIDE_RATIO)
    through = int(
        ((counts[1] >= SETTINGS.least_misses) & (counts[1] > SETTINGS.misses_per_hit * counts[0])).sum()
    )
    return through if through >= max(SETTINGS.least_voxels, len(places) / 2) else 0

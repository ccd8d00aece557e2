"""What refinement does, on real and simulated drives, and how fast its kernels are beside what others use.

    python benchmarks/refinement.py [kernels] [raw] [semantics] [simulated] [jam]
        [--data ../shared/data] [--simulated DRIVE ...] [--seeds N --seconds S] [--large] [--run OUT]

prints the figures and writes them into benchmarks/results/refinement.json; parts that were not asked for stay as they
are there. Removal: share of moving vehicle points removed (DA), of static vehicle points kept (SA_vehicle) and of all
static points kept (SA), AA = sqrt(SA DA); on real data and with `semantics` the paper's rule beside ours. Simulated:
what every mover does, how much of it was removed, and how many voxels are left over roads where nothing stands. Both
also without labels, by free space and tracks alone; jams only so.
Semantics: strict IoU on the points that their own image labels, before and after. Times are CPU time of this process;
what counts is their ratio.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
import tracklets
from chunks import build_maps
from numpy.typing import NDArray
from refinement_kernels import block_by_block, clocked, count_grid_beside_bincount, dbscan_beside_sklearn
from results_file import keep
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.given_trajectory import read_tum
from gnss_sem_map.dynamics.visibility import KeyframeScans
from gnss_sem_map.evaluation.metrics import MOVING_IDS, Tables, confusion, dynamic, dynamic_counts, semantics
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.chunks import MappedChunk, chunks_of, map_chunks
from gnss_sem_map.mapping.edge_windows import EdgeWindows
from gnss_sem_map.mapping.labelled_scans import Drive, labelled_scans
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.refinement.by_block import refine
from gnss_sem_map.refinement.state import Evidence
from gnss_sem_map.refinement.steps import RefinementSettings
from gnss_sem_map.runs.pipeline import estimate_trajectory
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.voxel_map import keys_of, unpack

URBAN = open_label_set()
TABLES = Tables.of(URBAN)
RAW_0005 = "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync"
RESULTS = Path(__file__).parent / "results" / "refinement.json"
AS_IT_RUNS, WITHOUT_LABELS = "as the pipeline runs", "without labels"
PARTS = ["kernels", "raw", "semantics", "simulated", "jam"]
Figures = dict[str, Any]
GROUND_IDS = (40, 48)
HIGHEST = 20
"""So many voxels over a road, 4 m, something is over it."""
Points = Mapping[int, NDArray[np.int64]]
PAPER = RefinementSettings.model_validate(
    {
        "vehicles": {"method": "paper"},
        "count_grid": {"method": "paper"},
        "geometric_prior": {"enabled": False},
        "potts_mrf": {"enabled": False},
        "discount": {"exponent": 1.0},
    }
)


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help="what to measure (default: all)")
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument(
        "--simulated", type=Path, nargs="*", default=[], help="drives that are already simulated"
    )
    parser.add_argument("--seeds", type=int, default=0, help="drives to simulate here")
    parser.add_argument("--seconds", type=float, default=12.0, help="length of each")
    parser.add_argument(
        "--large", action="store_true", help="a million voxels for DBSCAN, fifty for the count grid"
    )
    parser.add_argument("--run", type=Path, help="a finished run whose map is refined tile by tile")
    options = parser.parse_args()
    parts = options.parts or PARTS
    if unknown := set(parts) - set(PARTS):
        parser.error(f"found parts {sorted(unknown)}, expected some of {PARTS}")
    if options.run is not None:
        report(f"blocks, {options.run.name}", block_by_block(options.run))
    if "kernels" in parts:
        report("dbscan", dbscan_beside_sklearn(options.large))
        report("count_grid", count_grid_beside_bincount(options.large))
    if "raw" in parts and (options.data / RAW_0005).is_dir():
        report("removal, raw drive 0005, excerpt", on_raw_drive(options.data))
    if "semantics" in parts and (options.data / RAW_0005).is_dir():
        report("semantics, SemanticKITTI 00 and 08", on_semantic_kitti(options.data))
    with tempfile.TemporaryDirectory() as folder:
        if "jam" in parts:
            report("removal, jams without labels", in_jams(Path(folder), options.seeds or 5))
        drives = [*options.simulated, *simulated(Path(folder), options.seeds, options.seconds)]
        for drive in drives if "simulated" in parts else []:
            report(f"removal, simulated, {drive.name}", on_simulated_drive(drive))
        for drive in drives if "semantics" in parts else []:
            report(f"semantics, simulated, {drive.name}", semantics_of_simulated_drive(drive))


def report(name: str, figures: Figures) -> None:
    """Print them, and write them among those of the parts that were measured before."""
    print(json.dumps({name: figures}, indent=1), flush=True)
    keep(RESULTS, {name: figures}, "numpy", "scikit-learn")


def by_the_paper(drive: Drive) -> Points:
    """Points in voxels that eq. 12 and 13 remove."""
    maps = build_maps(drive, RunStats())
    refined, _ = refine(maps.static + maps.removed, PAPER)
    gone = refined.states == State.REMOVED
    points = {}
    for seen in labelled_scans(drive):
        places = refined.voxels.indices_of(keys_of(seen.p_map, refined.voxels.voxel_size_m))
        points[seen.scan.number] = np.flatnonzero((places >= 0) & gone[places])
    return points


def refined_map(chunks: list[MappedChunk]) -> SemanticMap:
    """The map that a run makes of all chunks."""
    static, moved = (
        reduce(add, (getattr(chunk, name) for chunk in chunks)) for name in ("static", "removed")
    )
    known = [chunk.keyframes for chunk in chunks if chunk.keyframes is not None]
    keyframes = KeyframeScans(
        np.concatenate([one.images for one in known]), np.concatenate([one.T_lidar_map for one in known]),
        known[0].rows,
    ) if known else None  # fmt: skip
    return refine(static, beside=Evidence(moved=moved, keyframes=keyframes))[0]


def removed_in_all(drive: Drive, chunks: list[MappedChunk], refined: SemanticMap) -> Points:
    """The points of what moved and, as in a run, those in voxels that refinement removes."""
    empty = np.append(refined.states == State.REMOVED, False)  # the place -1 finds the last
    moving = {number: points for chunk in chunks for number, points in chunk.moving.items()}
    points = {}
    for seen in labelled_scans(replace(drive, segmenter=None)):
        places = refined.voxels.indices_of(keys_of(seen.p_map, refined.voxels.voxel_size_m))
        moved = moving.get(seen.scan.number, np.empty(0, np.int64))
        points[seen.scan.number] = np.union1d(moved, np.flatnonzero(empty[places]))
    return points


def mapped(drive: Drive) -> list[MappedChunk]:
    """What every chunk of a drive says."""
    with tempfile.TemporaryDirectory() as folder:
        return list(
            map_chunks(drive, range(len(chunks_of(drive))), Path(folder), EdgeWindows(Path(folder), ""))
        )


def timed_mapping(drive: Drive) -> tuple[list[MappedChunk], dict[str, float]]:
    """The chunks, and what finding what moved costs per scan: beside mapping alone, and with it."""
    mapped(replace(drive, log=replace(drive.log, scans=drive.log.scans[:10])))  # compiles
    found: list[MappedChunk] = []
    nothing_sought = drive.settings.dynamics.model_copy(update={"enabled": False})
    alone = replace(drive, settings=drive.settings.model_copy(update={"dynamics": nothing_sought}))
    fusing, waiting_to_fuse = clocked(lambda: mapped(alone))
    both, waiting = clocked(lambda: found.extend(mapped(drive)))
    per_scan = 1e3 / len(drive.log.scans)
    return found, {
        "cpu_ms_per_scan": per_scan * (both - fusing),
        "wall_ms_per_scan": per_scan * (waiting - waiting_to_fuse),
        "wall_ms_per_scan_with_mapping": per_scan * waiting,
    }


def on_raw_drive(data: Path) -> Figures:
    """A van ahead, a car that pulls out, nine parked vehicles; boxes as truth."""
    log = open_drive(data / RAW_0005)
    segmenter = open_segmenter(f"labels:{data / 'labels/kitti_raw_0005/probabilities'}", URBAN)
    alone = Settings()
    alone = alone.model_copy(
        update={"trajectory": alone.trajectory.model_copy(update={"lidar_odometry": False})}
    )
    figures: Figures = {}
    as_it_runs = estimate_trajectory(log, Settings(), RunStats())[0]
    for name, trajectory in (
        (AS_IT_RUNS, as_it_runs),
        ("the unit's own poses", log.reference),
        ("GNSS and IMU alone", estimate_trajectory(log, alone, RunStats())[0]),
    ):
        drive = Drive(log, trajectory, segmenter, Settings())
        found, cost = timed_mapping(drive)
        figures[name] = (
            tracklets.removal(drive, removed_in_all(drive, found, refined_map(found)), data / RAW_0005) | cost
        )
        figures[f"{name}, paper's rule"] = tracklets.removal(drive, by_the_paper(drive), data / RAW_0005)
    drive = Drive(log, as_it_runs, None, Settings())
    found = mapped(drive)
    removed = removed_in_all(drive, found, refined_map(found))
    return figures | {WITHOUT_LABELS: tracklets.removal(drive, removed, data / RAW_0005)}


def simulated(folder: Path, seeds: int, seconds: float) -> list[Path]:
    """Drives of other seeds than the demo's, simulated here."""
    from gnss_sem_map.simulation import simulate

    return [simulate(folder / f"seed_{seed}", seconds, seed) for seed in range(101, 101 + seeds)]


def in_jams(folder: Path, seeds: int) -> Figures:
    """Slow traffic without labels: by the poses that a run finds, and by given ones that are not quite sharp."""
    from gnss_sem_map.simulation import simulate

    figures: Figures = {}
    for seed in range(201, 201 + seeds):
        drive = simulate(folder / f"jam_{seed}", 20.0, seed, jam=True)
        log, exact = open_drive(drive), read_tum(drive / "truth" / "trajectory.tum")
        for name, trajectory in (
            (AS_IT_RUNS, estimate_trajectory(log, Settings(), RunStats())[0]),
            ("poses off by 2 cm and 0.1 deg", with_errors(exact, seed, 0.02, 0.1)),
            ("poses off by 5 cm and 0.2 deg", with_errors(exact, seed, 0.05, 0.2)),
        ):
            one = Drive(log, trajectory, None, Settings())
            found = against_truth(one, drive, mapped(one))
            figures[f"{seed}, {name}"] = found
            print(seed, name, {key: round(found[key], 4) for key in ("SA", "DA", "SA_vehicle")}, flush=True)
    return figures


def with_errors(exact: Trajectory, seed: int, stddev_m: float, stddev_deg: float) -> Trajectory:
    """The poses with errors that change within a second."""
    rng, scans = np.random.default_rng(seed), 1.0 / float(np.median(np.diff(exact.stamps)))
    off = gaussian_filter1d(rng.standard_normal((len(exact.stamps), 6)), scans, axis=0)
    off *= np.repeat([np.radians(stddev_deg), stddev_m], 3) / off.std(axis=0)
    T = exact.T_map_imu.copy()
    T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(off[:, :3]).as_matrix()
    T[:, :3, 3] += off[:, 3:]
    return Trajectory(exact.stamps, T)


def perfectly_seen(folder: Path) -> Drive:
    """A simulated drive with the poses that a run finds, and perfect class images."""
    log = open_drive(folder)
    segmenter = open_segmenter(f"labels:{folder / 'truth/train_ids'}", URBAN)
    return Drive(
        log,
        estimate_trajectory(log, Settings(), RunStats())[0],
        segmenter,
        Settings(),
    )


def on_simulated_drive(folder: Path) -> Figures:
    """Removal all around, mover by mover; with labels, what it costs, and without."""
    drive = perfectly_seen(folder)
    found, cost = timed_mapping(drive)
    unlabelled = replace(drive, segmenter=None)
    return (
        {"scans": len(drive.log.scans)}
        | cost
        | against_truth(drive, folder, found)
        | {WITHOUT_LABELS: against_truth(unlabelled, folder, mapped(unlabelled))}
    )


def against_truth(drive: Drive, folder: Path, chunks: list[MappedChunk]) -> Figures:
    """Removal in a simulated drive, against the instance that every point is of."""
    refined = refined_map(chunks)
    points = removed_in_all(drive, chunks, refined)
    cases = what_they_do(folder)
    counts = np.zeros((3, 2), np.int64)
    movers: dict[str, NDArray[np.int64]] = {}
    size, keys = refined.voxels.voxel_size_m, ([], [])
    for seen in labelled_scans(Drive(drive.log, drive.trajectory, None, drive.settings)):
        truth = np.fromfile(folder / "truth" / "labels" / f"{seen.scan.name}.label", "<u4")[seen.valid]
        removed = np.zeros(len(truth), np.uint32)
        removed[points.get(seen.scan.number, [])] = 1
        counts += dynamic_counts(removed, truth, TABLES, seen.scan.name)
        moving = np.isin(truth & 0xFFFF, list(MOVING_IDS))
        for kind, which in zip(keys, (~moving, np.isin(truth & 0xFFFF, GROUND_IDS)), strict=True):
            kind.append(np.unique(keys_of(seen.p_map[which], size)))
        for instance in np.unique(truth[moving] >> 16):
            of_it = moving & (truth >> 16 == instance)
            found = np.array([of_it.sum(), removed[of_it].sum()])
            movers[cases[int(instance)]] = movers.get(cases[int(instance)], 0) + found
    return dynamic(counts) | {
        "left_over_road": left_over_road(refined, *map(np.concatenate, keys)),
        "movers": {
            case: {"points": int(n), "removed": round(float(k / n), 4)}
            for case, (n, k) in sorted(movers.items())
        },
    }


def left_over_road(refined: SemanticMap, static: NDArray[np.int64], ground: NDArray[np.int64]) -> int:
    """Voxels of the shown map over a road or sidewalk in which, by the truth, nothing stands.

    `static` and `ground` are the keys of all voxels with a point of what stands, and of road or sidewalk.
    """
    left = unpack(np.setdiff1d(refined.voxels.keys[refined.states != State.REMOVED], static))
    known = unpack(np.unique(ground))
    under, place = np.unique(known[:, :2], axis=0, return_index=True)
    top = dict(zip(map(tuple, under.tolist()), np.maximum.reduceat(known[:, 2], place).tolist(), strict=True))
    over = [z - top[x, y] for x, y, z in left.tolist() if (x, y) in top]
    return sum(0 < height <= HIGHEST for height in over)


def what_they_do(folder: Path) -> dict[int, str]:
    """What the mover of every instance number does in this drive: the traffic of its seed, once more."""
    from gnss_sem_map.simulation.drive import prepare

    about = json.loads((folder / "truth" / "world.json").read_text("utf-8"))
    scans = len(list((folder / "velodyne_points" / "data").glob("*.bin")))
    world = prepare(scans / 10, about["seed"], jam=about.get("jam", False)).world
    return dict(
        zip(world.instances[len(world.town.things) :].tolist(), (m.name for m in world.movers), strict=True)
    )


def semantics_of_simulated_drive(folder: Path) -> Figures:
    """Strict figures of every stage, and what the paper's rule removes."""
    drive = perfectly_seen(folder)
    truth, alone = folder / "truth" / "labels", folder / "truth" / "single_frame"
    return before_and_after(drive, truth, alone)


def on_semantic_kitti(data: Path) -> Figures:
    """Ten scans of two streets each, pooled."""
    total: dict[str, NDArray[np.int64]] = {}
    for sequence in ("00", "08"):
        folder = data / "semantic_kitti" / "sequences" / sequence
        log = open_drive(folder)
        segmenter = open_segmenter(
            f"labels:{data / 'labels/semantic_kitti' / sequence / 'probabilities'}", URBAN
        )
        drive = Drive(log, log.given, segmenter, Settings())
        counts = strict_counts(drive, folder / "labels", data / "single_frame" / sequence)
        total = {name: total.get(name, 0) + part for name, part in counts.items()}
    return {name: compact(part) for name, part in total.items()}


def before_and_after(drive: Drive, truth: Path, single_frame: Path) -> Figures:
    """Strict figures of every stage."""
    return {name: compact(part) for name, part in strict_counts(drive, truth, single_frame).items()}


def strict_counts(drive: Drive, truth: Path, single_frame: Path) -> dict[str, NDArray[np.int64]]:
    """Confusion of single image, fused map, refined map and the paper's refinement, on the points of the first."""
    maps = build_maps(drive, RunStats())
    raw = maps.static + maps.removed
    stages = {
        "fused (eq. 6)": SemanticMap.of(raw),
        "refined": refine(maps.static, beside=Evidence(moved=maps.removed))[0],
        "paper": refine(raw, PAPER)[0],
    }
    counts = {
        name: np.zeros((len(URBAN.names) + 1, len(URBAN.names) + 2), np.int64)
        for name in ("single image", *stages)
    }
    ids = np.append(URBAN.legend.semantic_kitti_ids, 0).astype("<u4")
    for seen in labelled_scans(drive):
        true = np.fromfile(truth / f"{seen.scan.name}.label", "<u4")[seen.valid]
        alone = np.fromfile(single_frame / f"{seen.scan.name}.label", "<u4")[seen.valid]
        of_image = alone & 0xFFFF != 0
        counts["single image"] += confusion(alone[of_image], true[of_image], TABLES, seen.scan.name)
        keys = keys_of(seen.p_map[of_image], raw.voxel_size_m)
        for name, stage in stages.items():
            places = stage.voxels.indices_of(keys)
            shown = np.where((places >= 0) & (stage.labels[places] >= 0), stage.labels[places], -1)
            if name == "paper":
                shown[stage.states[places] == State.REMOVED] = -1
            counts[name] += confusion(ids[shown], true[of_image], TABLES, seen.scan.name)
    return counts


def compact(counts: NDArray[np.int64]) -> Figures:
    """Strict mean IoU and accuracy, and IoU per class."""
    figures = semantics(counts, URBAN)
    classes = {name: None if c is None else round(c["iou"], 4) for name, c in figures["classes"].items()}
    return {name: round(figures["strict"][name], 4) for name in ("mean_iou", "mean_accuracy")} | {
        "iou": classes
    }


if __name__ == "__main__":
    main()

"""How fast the map is built, beside other people's tools doing the same, and what it costs in memory and on disk.

    python benchmarks/mapping.py DRIVE SEGMENTER [DRIVE SEGMENTER ...] [--scans 240] [--large]

prints the figures and writes benchmarks/results/mapping.json. SEGMENTER as in `gnss-sem-map run`, such as
labels:DRIVE/truth/train_ids. Of a drive with more scans than `--scans`, every so manieth is used. Times are CPU time of
this process, each tool in turn on every scan, medians over the scans after the first; what counts is their ratio. Peers
(open3d, kiss-icp, pandas, duckdb, polars) that are not installed are left out and named. `--large` adds the table of
fifty million voxels (5 GB of memory, minutes).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
import numpy_chain
from mapping_peers import duckdb_groups, kiss_icp_map, open3d_hash, pandas_groups, polars_groups
from numba import njit
from numpy.typing import NDArray
from results_file import keep

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.labels.probabilities import KeepsLabels
from gnss_sem_map.mapping import labelled_scans
from gnss_sem_map.mapping.fusion import map_scans
from gnss_sem_map.mapping.labelled_scans import Drive, LabelledScan
from gnss_sem_map.mapping.raw_map import write_raw
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.scans.projection import ClassImage, class_image, image_exposed_at
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.sensor_log import Calibration, Image, Points, Scan, SensorLog
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.kernels import prefetch_row
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.voxel_map import VoxelTable

SETTINGS = Settings.model_validate({"dynamics": {"enabled": False}})
"""What moves is the matter of refinement.py."""
SIZE = SETTINGS.mapping.voxel_size_m
URBAN = open_label_set()
Figures = dict[str, Any]


class Race:
    """CPU time of several contestants, alternated."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = {}

    def run(self, name: str, work: Callable[[], Any]) -> Any:
        """Run and time one turn of a contestant."""
        start = time.process_time()
        result = work()
        self.seconds.setdefault(name, []).append(time.process_time() - start)
        return result

    def medians(self) -> dict[str, float]:
        """s per turn, the first left out."""
        return {name: float(np.median(s[1:] if len(s) > 1 else s)) for name, s in self.seconds.items()}


def open_job(drive: Path, spec: str, scans: int) -> Drive:
    """A drive with the trajectory that its own navigation system reports, and so many scans from all along it."""
    log = open_drive(drive)
    segmenter = open_segmenter(spec, URBAN, sizes=log.calibration.image_sizes)
    trajectory = log.given or log.reference
    if trajectory is None:
        raise SystemExit(f"{drive}: has no trajectory of its own")
    camera = log.calibration.camera()
    with_image = [scan for scan in log.scans if image_exposed_at(scan.stamp, log, camera, SETTINGS.labelling)]
    evenly = with_image[:: max(len(with_image) // scans, 1)][:scans]
    return Drive(_only(log, evenly), trajectory, segmenter, SETTINGS)


def _only(log: SensorLog, scans: Sequence[Scan]) -> SensorLog:
    return replace(log, scans=tuple(scans))


def image_of(job: Drive, scan: Scan) -> tuple[Image, ClassImage]:
    """The image of a scan, decoded."""
    image = image_exposed_at(scan.stamp, job.log, job.log.calibration.camera(), SETTINGS.labelling)
    assert image is not None
    assert job.segmenter is not None
    look = job.segmenter.kept if isinstance(job.segmenter, KeepsLabels) else job.segmenter
    seen = look(image)
    return image, class_image(
        seen, job.segmenter.class_names, URBAN, job.log.calibration.camera().image_size, ""
    )


def whole_chain(job: Drive) -> Figures:
    """Read, deskew, project, occlusion, fuse: compiled against numpy, with decoded labels and with decoding them."""
    race, log = Race(), job.log
    table, plain = VoxelTable(SIZE, URBAN), numpy_chain.NumpyMap(SIZE, URBAN)
    looks = labelled_scans.Looks(job, RunStats())
    points = 0

    def compiled(scan: Scan, image: Image, classes: ClassImage) -> None:
        seen = labelled_scans._see(job, scan, scan.read(), [(image, classes)], looks, RunStats())
        assert seen is not None
        table.add(seen.keys, seen.pixels, seen.classes, seen.heights)

    def in_numpy(scan: Scan, image: Image, classes: ClassImage, rows: NDArray[np.uint8]) -> None:
        p_map = numpy_chain.points_in_map(
            scan.read(), scan.stamp, job.trajectory, log.calibration.T_imu_lidar, SETTINGS.mapping
        )
        pixels = numpy_chain.pixels_seen(
            p_map, image, job.trajectory, log.calibration, classes, SETTINGS.labelling
        )
        plain.add(numpy_chain.keys_of(p_map, SIZE), pixels, rows, numpy_chain.heights_of(p_map, SIZE))

    for scan in log.scans:
        image, classes = race.run("decode", lambda scan=scan: image_of(job, scan))
        race.run("ours", lambda a=(scan, image, classes): compiled(*a))
        race.run("numpy", lambda a=(scan, image, classes, classes.rows): in_numpy(*a))
        points += len(scan.read().xyz)
    fused, oracle = table.to_map(), plain.to_map()
    same = all(
        np.array_equal(getattr(fused, n), getattr(oracle, n)) for n in ("keys", "evidence", "hits", "heights")
    )
    s = race.medians()
    return {
        "scans": len(log.scans), "points_per_scan": points // len(log.scans), "voxels": len(fused),
        "ms_per_scan": {name: 1e3 * value for name, value in s.items()}, "bit_identical_to_numpy": same,
        "ratio_labels_decoded": s["numpy"] / s["ours"],
        "ratio_with_decoding": (s["numpy"] + s["decode"]) / (s["ours"] + s["decode"]),
    }  # fmt: skip


def fused(job: Drive) -> VoxelTable:
    """All scans of a drive in a table."""
    table = VoxelTable(SIZE, URBAN)
    for seen in labelled_scans.labelled_scans(job):
        table.add(seen.keys, seen.pixels, seen.classes, seen.heights)
    return table


def real_time(job: Drive) -> Figures:
    """The pipeline's own loop, decoding included, all threads counted: CPU seconds against 0.1 s a scan."""
    best = np.inf
    for _ in range(3):
        start = time.process_time()
        fused(job)
        best = min(best, (time.process_time() - start) / len(job.log.scans))
    return {"cpu_ms_per_scan": 1e3 * best, "real_time_factor": 0.1 / best}


def seen_of(job: Drive) -> list[LabelledScan]:
    """The scans, placed and looked at once, for those who only fuse."""
    return list(labelled_scans.labelled_scans(job))


def against_peers(job: Drive, seen: list[LabelledScan]) -> tuple[Figures, list[str]]:
    """Transform with one pose a scan, for no peer knows more, and fuse, as far as each peer goes."""
    race, missing = Race(), []
    table, bare = VoxelTable(SIZE, URBAN), VoxelTable(SIZE, URBAN)
    contestants: dict[str, Callable[[LabelledScan, Points], Any]] = {
        "ours, classes": lambda s, p: table.add(_keys(job, s, p), s.pixels, s.classes),
        "ours, no classes": lambda s, p: bare.add(_keys(job, s, p)),
    }
    for name, build in (("open3d HashSet + numpy", open3d_hash), ("kiss-icp VoxelHashMap", kiss_icp_map)):
        try:
            contestants[name] = build(job)
        except ImportError as error:
            missing.append(f"{name}: {error}")
    for one in seen:
        read = one.scan.read()
        points = Points(read.xyz, read.intensity, None)
        for name, work in contestants.items():
            race.run(name, lambda work=work, a=(one, points): work(*a))
    s = race.medians()
    return {
        "ms_per_scan": {name: 1e3 * value for name, value in s.items()},
        "ratio": {
            "open3d": s.get("open3d HashSet + numpy", np.nan) / s["ours, classes"],
            "kiss-icp": s.get("kiss-icp VoxelHashMap", np.nan) / s["ours, no classes"],
        },
    }, missing  # fmt: skip


def _keys(job: Drive, seen: LabelledScan, points: Points) -> NDArray[np.int64]:
    placed = labelled_scans._see(
        job, seen.scan, points, [], labelled_scans.Looks(job, RunStats()), RunStats()
    )
    assert placed is not None
    return placed.keys


def against_group_by(seen: list[LabelledScan]) -> tuple[Figures, list[str]]:
    """Ten scans at once, all in memory, keys and log-likelihoods ready: who groups fastest."""
    race, missing, seen = Race(), [], seen[:10]
    logs = numpy_chain.log_table(5, 5)
    keys = np.concatenate([s.keys for s in seen])
    looks = np.zeros((len(keys), 5), np.int32)
    pixels = np.concatenate([s.pixels for s in seen])
    looks[pixels >= 0] = np.concatenate([numpy_chain.log_likelihoods(s.classes, logs, 5) for s in seen])
    columns = {
        "key": keys,
        **{f"e{c}": looks[:, c].copy() for c in range(5)},
        "hits": np.ones(len(keys), np.uint32),
    }
    parts = [(s.keys, s.pixels, s.classes) for s in seen]

    def ours() -> int:
        table = VoxelTable(SIZE, URBAN)
        for part in parts:
            table.add(*part)
        return len(table)

    contestants: dict[str, Callable[[], int]] = {"ours": ours}
    for name, build in (("pandas", pandas_groups), ("duckdb", duckdb_groups), ("polars", polars_groups)):
        try:
            contestants[name] = build(columns)
        except ImportError as error:
            missing.append(f"{name}: {error}")
    for _ in range(4):
        found = {name: race.run(name, work) for name, work in contestants.items()}
        assert len(set(found.values())) == 1, found
    s = race.medians()
    return {
        "ns_per_point": {name: 1e9 * value / len(keys) for name, value in s.items()},
        "ratio": {name: value / s["ours"] for name, value in s.items() if name != "ours"},
    }, missing  # fmt: skip


@njit(cache=True, nogil=True)
def _touch(rows: Any, ints: Any, places: Any, nothing: Any) -> None:
    """The least that fusing a point into any voxel can cost: fetch its row, add to all of its 32 bytes."""
    for i in range(len(places)):
        if i + 16 < len(places):
            prefetch_row(rows, places[i + 16])
        for c in range(8):
            ints[places[i], c] += nothing[c]


def over_the_floor(seen: list[LabelledScan], voxels: int) -> Figures:
    """Fusing the scans into a map of so many voxels, against random prefetched updates of a table of the same size."""
    rng, table = np.random.default_rng(0), VoxelTable(SIZE, URBAN)
    while len(table) < voxels:  # surface voxels far from the scans
        indices = rng.integers(-(1 << 19), 1 << 19, (min(1_000_000, voxels - len(table)), 3))
        table.add(numpy_chain.pack(indices * (1, 1, 0) + (1 << 19, 0, 0)))
    keys = [s.keys for s in seen]
    for part, s in zip(keys, seen, strict=True):
        table.add(part, s.pixels, s.classes)
    shuffled = [rng.permutation(part) for part in keys]
    places = [rng.integers(0, len(table._table.rows), len(part)) for part in keys]
    race, nothing = Race(), np.zeros(8, np.int32)
    for i, s in enumerate(seen):
        race.run("drive order, looks", lambda i=i, s=s: table.add(keys[i], s.pixels, s.classes))
        race.run("drive order", lambda i=i: table.add(keys[i]))
        race.run("random order", lambda i=i: table.add(shuffled[i]))
        race.run(
            "floor",
            lambda i=i: _touch(table._table.rows, table._table.rows.view(np.int32), places[i], nothing),
        )
    n = np.median([len(part) for part in keys])
    s_ = {name: 1e9 * value / n for name, value in race.medians().items()}
    return {
        "voxels": len(table), "bytes_per_voxel": table.nbytes / len(table), "ns_per_point": s_,
        "over_the_floor": s_["drive order, looks"] / s_["floor"],
    }  # fmt: skip


def on_disk(job: Drive) -> Figures:
    """Bytes of the tiles of the drive's map, and what writing and reading them costs."""
    table = fused(job)
    raw, race = SemanticMap.of(table.to_map()), Race()
    with tempfile.TemporaryDirectory() as folder:
        race.run("write", lambda: tiles.write(raw, Path(folder) / "map", None))
        race.run("read", lambda: tiles.read(Path(folder) / "map", URBAN))
        size = sum(path.stat().st_size for path in (Path(folder) / "map").glob("*.parquet"))
    s = race.medians()
    return {
        "voxels": len(raw), "disk_bytes_per_voxel": size / len(raw), "ram_bytes_per_voxel": table.nbytes / len(table),
        "ns_per_voxel": {name: 1e9 * value / len(raw) for name, value in s.items()},
    }  # fmt: skip


def cheap_drive(scans: int) -> Drive:
    """A straight street at 10 m/s: the same sweep of 120,000 points again and again, 1 m farther each time."""
    rng, n = np.random.default_rng(0), 60_000
    road = np.column_stack([rng.uniform(-80, 80, n), rng.uniform(-9, 9, n), np.full(n, -1.7)])
    walls = np.column_stack([rng.uniform(-80, 80, n), rng.choice([-9.0, 9.0], n), rng.uniform(-1.7, 8, n)])
    xyz = np.vstack([road, walls]).astype(np.float32)
    xyz = xyz[np.lexsort((np.arctan2(xyz[:, 1], xyz[:, 0]), np.round(xyz[:, 2], 1)))]
    points = Points(xyz, np.zeros(len(xyz), np.float32), None)
    stamps = np.arange(scans + 1) * 0.1
    T = np.tile(np.eye(4), (scans + 1, 1, 1))
    T[:, 0, 3] = 10 * stamps
    log = SensorLog(
        "street", 0, Calibration(np.eye(4)),
        tuple(Scan(str(k), k, float(stamps[k]), lambda: points) for k in range(scans)), (),
        given=Trajectory(stamps, T),
    )  # fmt: skip
    return Drive(log, Trajectory(stamps, T), None, SETTINGS)


def peak_of(scans: int) -> None:
    """In a process of its own: map the cheap drive to tiles on disk, and print the peak memory in MB."""
    with tempfile.TemporaryDirectory() as folder:
        job = cheap_drive(scans)
        write_raw(map_scans(job, Path(folder) / "work", RunStats()), Path(folder), None)
        about = json.loads((Path(folder) / "map/map.json").read_text())
    status = Path("/proc/self/status").read_text()  # ru_maxrss would begin at the parent's
    peak = int(status.split("VmHWM:")[1].split()[0]) / 1024
    print(json.dumps({"scans": scans, "voxels": about["voxels"], "peak_mb": peak}))


def first_scan(drive: str, spec: str) -> None:
    """In a process of its own: seconds from the imports' end to the first fused scan, compiled code cached."""
    job = open_job(Path(drive), spec, 1)
    start, cpu = time.perf_counter(), time.process_time()
    fused(job)
    print(json.dumps({"wall_s": time.perf_counter() - start, "cpu_s": time.process_time() - cpu}))


def _child(call: str) -> Figures:
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import mapping; mapping.{call}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def measure(drive: Path, spec: str, scans: int) -> tuple[Figures, list[str]]:
    """Everything that one drive can say."""
    job = open_job(drive, spec, scans)
    fused(replace(job, log=_only(job.log, job.log.scans[:2])))  # compile
    figures: Figures = {"full chain": whole_chain(job), "real time": real_time(job), "map": on_disk(job)}
    seen = seen_of(replace(job, log=_only(job.log, job.log.scans[-40:])))
    figures["peers"], missing = against_peers(job, seen)
    figures["one-shot group-by"], more = against_group_by(seen)
    figures["floor, 1e6 voxels"] = over_the_floor(seen, 1_000_000)
    first_scan_call = f"first_scan({str(drive)!r}, {spec!r})"
    figures["first scan"] = min((_child(first_scan_call) for _ in range(3)), key=lambda f: float(f["cpu_s"]))
    return figures, missing + more


def main() -> None:
    """Measure, print, and write the results."""
    parser = argparse.ArgumentParser()
    parser.add_argument("drives", nargs="*", help="DRIVE SEGMENTER pairs")
    parser.add_argument("--scans", type=int, default=240)
    parser.add_argument("--large", action="store_true")
    given = parser.parse_args()
    drives: Figures = {}
    for drive, spec in zip(given.drives[::2], given.drives[1::2], strict=True):
        drives[Path(drive).name], missing = measure(Path(drive), spec, given.scans)
        write({"drives": drives, "not installed": missing})
    short, long = _child("peak_of(277)"), _child("peak_of(2769)")
    peaks = {"277 scans": short, "2769 scans": long, "ratio": long["peak_mb"] / short["peak_mb"]}
    write({"peak memory": peaks})
    if given.large:
        job = open_job(Path(given.drives[0]), given.drives[1], 20)
        write({"floor, 5e7 voxels": over_the_floor(seen_of(job), 50_000_000)})


def write(results: Figures) -> None:
    """Print and keep some results."""
    print(json.dumps(results, indent=1, default=float), flush=True)
    keep(Path(__file__).parent / "results" / "mapping.json", results, "numpy", "numba", "pyarrow")


if __name__ == "__main__":
    main()

"""Memory, time and disk of whole runs, short and long, on one process, two, and Dask; and whether bytes are the same.

    python benchmarks/scale.py DRIVE PROBABILITIES [--work FOLDER] [--only memory reads ...]

DRIVE is a long simulated drive in KITTI raw format (`gnss-sem-map simulate --seconds 600 --seed 7`), PROBABILITIES its
class probabilities (`gnss-sem-map segment`, or `simulation.write_corrupted_labels`, which takes a tenth of the time).
It is cut into shorter drives (`cut_drive.py`). Prints the figures and writes benchmarks/results/scale.json. Every run
is a process of its own.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from cut_drive import cut_all
from results_file import keep

RESULTS = Path(__file__).parent / "results" / "scale.json"
COUNT_READS = """
import sys, threading
counts, lock = {}, threading.Lock()
def look(event, details):
    if event == "open" and isinstance(details[0], str) and details[0].endswith(".bin"):
        with lock:
            counts[details[0]] = counts.get(details[0], 0) + 1
sys.addaudithook(look)
from gnss_sem_map.cli import main
try:
    main()
finally:
    import json
    print("READS", json.dumps(sorted(counts.values())), file=sys.stderr)
"""
Figures = dict[str, Any]
DASK_SETTINGS = {
    "GNSS_SEM_MAP_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",
    "MALLOC_TRIM_THRESHOLD_": f"{64 << 20}",
    "MALLOC_MMAP_THRESHOLD_": f"{4 << 20}",
}
"""Environment of the workers."""
TILED = ("trajectory", "mapping", "refinement")
"""Stages that workers share: sections, chunks and tiles."""
DASK = Path(sys.executable).with_name("dask")


def run(words: Sequence[str | Path], *, program: str | None = None, cores: int | None = None) -> Figures:
    """Run `gnss-sem-map` with these words: wall and CPU seconds, peak memory in MB, and what it said.

    On so many `cores`, by default all: a limit of threads is none of cores, as files are read by threads of their own.
    """
    command = [sys.executable, "-c", program] if program else [sys.executable, "-m", "gnss_sem_map.cli"]
    if cores is not None:
        command = ["taskset", "--cpu-list", f"0-{cores - 1}", *command]
    begun = time.perf_counter()
    process = subprocess.Popen(
        [*command, *map(str, words)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    said = process.stderr.read()
    _, status, used = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status) != 0:
        raise SystemExit(f"{' '.join(map(str, words))}: {said}")
    return {
        "wall_s": time.perf_counter() - begun,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss / 1024,
        "said": said,
    }


def checksums(out: Path) -> dict[str, str]:
    """Of all products that do not tell the time."""
    told = {"run.json", "report.html", ".gnss-sem-map.json"}
    return {
        path.relative_to(out).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name not in told
    }


class Drives:
    """The drives of the benchmark, cut from a long one when they are first needed."""

    def __init__(self, drive: Path, probabilities: Path, work: Path) -> None:
        self.drive, self.probabilities, self.work = drive, probabilities, work

    def of(self, seconds: float) -> list[Path]:
        """All drives of this length."""
        folder = self.work / f"drives_{seconds:g}"
        if not folder.exists():
            cut_all(self.drive, self.probabilities, folder, seconds)
        return sorted(folder.glob("*/*_sync"))

    def words(self, drives: Sequence[Path], out: Path, *more: str | Path) -> list[str | Path]:
        """A run of them."""
        labels = f"labels:{drives[0].parents[1] / 'probabilities'}/{{drive}}"
        if len(drives) == 1:
            labels = labels.replace("{drive}", drives[0].name)
        return ["run", *drives, "-o", out, "--segmenter", labels, "--force", *more]


def memory(drives: Drives, out: Path) -> Figures:
    """Peak memory and time of drives of growing length, one worker: from some chunks on, memory does not grow."""
    found: Figures = {}
    for seconds in (60, 120, 240, 480):
        words = drives.words(drives.of(seconds)[:1], out / f"{seconds}", "--workers", "1")
        figures = run(words)
        about = json.loads((out / f"{seconds}" / "run.json").read_text())
        found |= {
            f"peak_mb_{seconds}_s": round(figures["peak_mb"]),
            f"peak_mb_by_stage_{seconds}_s": about["peak_memory_mb"],
            f"real_time_factor_{seconds}_s": seconds / figures["wall_s"],
            f"cpu_ms_per_scan_{seconds}_s": 1000 * figures["cpu_s"] / about["counts"]["scans"],
            f"seconds_by_stage_{seconds}_s": about["seconds"],
            f"sizes_{seconds}_s": sizes(out / f"{seconds}"),
        }
    for seconds in (60, 120, 240):
        found[f"peak_480_over_{seconds}"] = found["peak_mb_480_s"] / found[f"peak_mb_{seconds}_s"]
    return found


def sizes(run: Path) -> Figures:
    """What the result of one drive holds: its length, its voxels, and the bytes of each part."""
    about, refined = (
        json.loads((run / "run.json").read_text()),
        json.loads((run / "refined/map.json").read_text()),
    )
    stamps_and_positions = np.loadtxt(run / "trajectory.tum", usecols=(0, 1, 2, 3))
    steps = np.linalg.norm(np.diff(stamps_and_positions[:, 1:], axis=0), axis=1)
    parts = ("map", "refined", "evidence/moved", "evidence/keyframes", "evidence/moving_points")
    products = [path for path in run.glob("*") if path.name.startswith(("map.", "viewer", "topview"))]
    return {
        "seconds": stamps_and_positions[-1, 0] - stamps_and_positions[0, 0],
        "km": steps.sum() / 1000,
        "scans": about["counts"]["scans"],
        "voxels": about["map"]["voxels"],
        "tiles": refined["tiles"],
        "bytes": {part: bytes_in(run / part) for part in parts}
        | {
            "products": sum(map(bytes_in, products)),
            "trajectory": sum(map(bytes_in, run.glob("trajectory.*"))),
            "run.json": bytes_in(run / "run.json"),
            "refined/map.json": bytes_in(run / "refined/map.json"),
        },
    }


def bytes_in(path: Path) -> int:
    """Of a file, or of all files of a folder."""
    return sum(each.stat().st_size for each in [path, *path.rglob("*")] if each.is_file())


def reads(drives: Drives, out: Path) -> Figures:
    """How often a run opens the file of a scan, on a drive of several sections that passes places again."""
    words = drives.words(drives.of(240)[:1], out / "reads", "--workers", "1")
    told = run(words, program=COUNT_READS)["said"].rpartition("READS ")[2]
    counts, about = json.loads(told), json.loads((out / "reads" / "run.json").read_text())
    return {
        "reads_of_a_scan_mean": sum(counts) / len(counts),
        "reads_of_a_scan_most": max(counts),
        "places_passed_again": about["counts"]["places passed again"],
    }


def disk(drives: Drives, out: Path) -> Figures:
    """Bytes on disk of the layers of a map, per voxel."""
    run(drives.words(drives.of(30)[:1], out / "disk", "--workers", "1"))
    folder = out / "disk"
    found: Figures = {}
    for layer in ("map", "refined", "evidence/moved"):
        voxels = json.loads((folder / layer / "map.json").read_text())["voxels"]
        found[f"bytes_per_voxel_{layer}"] = bytes_in(folder / layer) / max(voxels, 1)
    return found


def refinement(drives: Drives, out: Path) -> Figures:
    """Microseconds per voxel of a refinement alone, on one core: the least of five, after one that loads its code."""
    run(drives.words(drives.of(30)[:1], out / "refined", "--workers", "1"))
    program = (
        "import shutil, sys, time\n"
        "from pathlib import Path\n"
        "from tempfile import TemporaryDirectory\n"
        "from gnss_sem_map import config\nfrom gnss_sem_map.runs import pipeline\n"
        "from gnss_sem_map.labels.label_set import open_label_set\n"
        "from gnss_sem_map.mapping.raw_map import open_raw\n"
        "from gnss_sem_map.mapping.refining import refine_map\n"
        "run = Path(sys.argv[1])\n"
        "settings = config.load(run / 'config.yaml')\n"
        "took = []\n"
        "for again in range(6):\n"
        "    with TemporaryDirectory() as folder:\n"
        "        copy = Path(shutil.copytree(run, Path(folder) / 'run', ignore=shutil.ignore_patterns('refined')))\n"
        "        raw, begun = open_raw(copy, open_label_set(settings.classes)), time.process_time()\n"
        "        refine_map(raw, copy, settings)\n"
        "        took.append(time.process_time() - begun)\n"
        "print('TOOK', min(took[1:]), file=sys.stderr)\n"
    )
    told = run([out / "refined"], program=program, cores=1)["said"]
    voxels = json.loads((out / "refined/map/map.json").read_text())["voxels"]
    return {"refinement_us_per_voxel": 1e6 * float(told.rpartition("TOOK ")[2]) / voxels}


def stages(drives: Drives, out: Path) -> Figures:
    """A long drive by one worker on one core and by two on two: whole run, and its stages; the same bytes."""
    found: Figures = {}
    for count in (1, 2):
        words = drives.words(drives.of(480)[:1], out / f"{count}", "--workers", f"{count}")
        figures = run(words, cores=count)
        seconds = json.loads((out / f"{count}" / "run.json").read_text())["seconds"]
        found |= {
            f"wall_s_{count}": figures["wall_s"],
            f"cpu_s_{count}": figures["cpu_s"],
            f"real_time_factor_{count}": 480 / figures["wall_s"],
            f"seconds_by_stage_{count}": seconds,
        }
    one, two = (found[f"seconds_by_stage_{count}"] for count in (1, 2))
    for stage in TILED:
        found[f"two_over_one_{stage}"] = one[stage] / two[stage]
    found["two_over_one"] = sum(map(one.get, TILED)) / sum(map(two.get, TILED))
    return found | {"same_bytes": checksums(out / "1") == checksums(out / "2")}


def workers(drives: Drives, out: Path) -> Figures:
    """Two processes over one, and Dask over processes, for six drives; the same bytes from all."""
    some = drives.of(30)[:6]
    found: Figures = {"drives": len(some)}
    sums = {}
    with _dask(2) as (address, _):
        for name, cores, how in (
            ("1", 1, ["--workers", "1"]),
            ("2", 2, ["--workers", "2"]),
            ("dask", 2, ["--scheduler", address]),
        ):
            figures = run(drives.words(some, out / name, *how), cores=cores)
            found[f"wall_s_{name}"] = figures["wall_s"]
            sums[name] = checksums(out / name)
    found["two_workers_over_one"] = found["wall_s_1"] / found["wall_s_2"]
    found["dask_over_processes"] = found["wall_s_2"] / found["wall_s_dask"]
    found["same_bytes"] = sums["1"] == sums["2"] == sums["dask"]
    return found


def twenty(drives: Drives, out: Path) -> Figures:
    """Twenty drives, one map: one process on one core, two on two, and Dask with a worker killed on the way."""
    some, sums = drives.of(30)[:20], []
    found: Figures = {"drives": len(some)}
    for count in (1, 2):
        figures = run(drives.words(some, out / f"twenty{count}", "--workers", str(count)), cores=count)
        found[f"wall_s_{count}"] = figures["wall_s"]
        sums.append(checksums(out / f"twenty{count}"))
    with _dask(2) as (address, processes):
        killer = subprocess.Popen(["sh", "-c", f"sleep 60; pkill -KILL -P {processes[1].pid}"])
        found["wall_s_dask"] = run(drives.words(some, out / "dask", "--scheduler", address))["wall_s"]
        sums.append(checksums(out / "dask"))
        killer.wait()
    return found | {"twenty_same_bytes": sums[0] == sums[1] == sums[2], "files": len(sums[0])}


@contextmanager
def _dask(count: int) -> Iterator[tuple[str, list[subprocess.Popen[str]]]]:
    """A scheduler and workers, each in a process of its own with one thread, set as docs/cluster.md advises."""
    address = "tcp://127.0.0.1:8786"
    words = (
        ["scheduler", "--port", "8786", "--no-dashboard"],
        *[["worker", address, "--nthreads", "1", "--no-dashboard"]] * count,
    )
    quiet = subprocess.DEVNULL
    environment = os.environ | DASK_SETTINGS
    processes = [
        subprocess.Popen(
            [DASK, *each], stdout=quiet, stderr=quiet, text=True, start_new_session=True, env=environment
        )
        for each in words
    ]
    try:
        time.sleep(5)
        yield address, processes
    finally:
        for process in processes:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait()


CASES: dict[str, Callable[[Drives, Path], Figures]] = {
    one.__name__: one for one in (memory, reads, disk, refinement, stages, workers, twenty)
}


def main() -> None:
    """All cases, or those that are asked for; figures of the others stay as they are."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("probabilities", type=Path)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--only", nargs="*", choices=sorted(CASES), default=sorted(CASES))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = given.work or Path(temporary)
        drives = Drives(given.drive.resolve(), given.probabilities.resolve(), work)
        for name in given.only:
            with tempfile.TemporaryDirectory(dir=work) as out:
                found = CASES[name](drives, Path(out))
            print(name, json.dumps(found, indent=1), flush=True)
            keep(RESULTS, {name: found})


if __name__ == "__main__":
    main()

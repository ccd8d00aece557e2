"""What it costs to read a bag: time per scan against the raw files, and memory by the length of the bag.

    python benchmarks/bags.py FOLDER

Simulates 3 s of a drive into FOLDER, writes it as KITTI raw and as MCAP, and reads both in turn, by CPU time. Then it
repeats the messages of that drive, with new stamps, in bags of about 1 and 4 GB, and reads each in a process of its
own: all scans and images. What it wrote in FOLDER is removed at the end.
"""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.datasets.ros.kinds import decode, typestore
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.simulation import simulate
from gnss_sem_map.simulation.layouts import rewrite

ROUNDS = 15
SIZES_GB = (1.0, 4.0)
STEP_NS = 3_000_000_000


def figures(folder: Path) -> dict[str, Any]:
    """Time per scan, and memory by the length of the bag."""
    folder.mkdir(parents=True, exist_ok=True)
    work = folder / "bags-benchmark"
    work.mkdir()
    try:
        raw = simulate(work / "kitti", 3.0, 11)
        mcap = rewrite(raw, work / "mcap", "mcap")
        times = time_per_scan(open_drive(raw), open_drive(mcap))
        found = {}
        for size in SIZES_GB:
            long = repeated(mcap, work / f"long_{size:g}", size)
            found[f"{size:g} GB"] = json.loads(
                subprocess.check_output([sys.executable, __file__, "--read", str(long)])
            )
            shutil.rmtree(long)
        small, large = (found[f"{size:g} GB"]["peak_mb"] for size in SIZES_GB)
        return {"scan": times, "memory": found | {"ratio": round(large / small, 3)}}
    finally:
        shutil.rmtree(work)


def time_per_scan(raw: SensorLog, bag: SensorLog) -> dict[str, float]:
    """Medians of the CPU time of one scan, ms, and their ratio; the two are read in turn."""
    for log in (raw, bag):
        log.scans[0].read()
    times: dict[str, list[float]] = {"raw": [], "mcap": []}
    for _ in range(ROUNDS):
        for name, log in (("raw", raw), ("mcap", bag)):
            begun = time.process_time()
            for scan in log.scans:
                scan.read()
            times[name].append((time.process_time() - begun) / len(log.scans) * 1e3)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    return {f"{name}_ms": round(value, 3) for name, value in medians.items()} | {
        "ratio": round(medians["mcap"] / medians["raw"], 2)
    }


def repeated(bag_folder: Path, out: Path, size_gb: float) -> Path:
    """The messages of a bag again and again, later every time, until the bag is large enough."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    bag, store = Bag(bag_folder), typestore(is_ros1=False)
    shutil.rmtree(out, ignore_errors=True)
    written = times = 0
    with Writer(out, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in bag.kinds.items()
        }
        while written < size_gb * 1e9:
            for messages in map(bag.messages, bag.kinds):
                if messages.topic == "/tf_static" and times:
                    continue
                for k in range(len(messages)):
                    if times and messages.received_ns[k] >= messages.received_ns[0] + STEP_NS:
                        continue
                    message = decode(bag, messages, k)
                    ns = int(messages.received_ns[k]) + times * STEP_NS
                    if hasattr(message, "header"):
                        message.header.stamp.sec, message.header.stamp.nanosec = ns // 10**9, ns % 10**9
                    data = store.serialize_cdr(message, messages.kind)
                    writer.write(connections[messages.topic], ns, data)
                    written += len(data)
            times += 1
    shutil.copy(bag_folder / "rig.yaml", out)
    return out


def read_all(folder: Path) -> None:
    """Print what it takes to open a bag and read all its scans and images."""
    begun = time.process_time()
    log = open_drive(folder)
    opened = time.process_time() - begun
    for item in (*log.scans, *log.images):
        item.read()
    peak = peak_mb()
    size = sum(path.stat().st_size for path in folder.iterdir()) / 1e9
    print(json.dumps({
        "gb": round(size, 2), "scans": len(log.scans), "open_s": round(opened, 2), "peak_mb": round(peak, 1),
    }))  # fmt: skip


def peak_mb() -> float:
    """Most memory of this process; on Linux not that of the one it was forked from, which `getrusage` counts, too."""
    status = Path("/proc/self/status")
    if status.is_file():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # macOS: bytes


if __name__ == "__main__":
    if sys.argv[1] == "--read":
        read_all(Path(sys.argv[2]))
    else:
        print(json.dumps(figures(Path(sys.argv[1])), indent=1))

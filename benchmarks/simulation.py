"""How fast the simulator renders: scans and images per second on all cores, against the 10 Hz of the real sensors.

python benchmarks/simulation.py [--seed 0]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from results_file import keep

from gnss_sem_map.simulation import prepare

RESULTS = Path(__file__).parent / "results" / "simulation.json"
SECONDS, SENSOR_HZ = 30.0, 10.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    simulation = prepare(SECONDS, arguments.seed)
    cores = os.cpu_count() or 1
    result = {
        "seed": arguments.seed,
        "cores": cores,
        "scans": rate(simulation.scan, range(0, 300, 2), cores),
        "images": rate(simulation.image, range(0, 300, 6), cores),
    }
    keep(arguments.out, result)
    print(json.dumps(result, indent=1))


def rate(render: Callable[[int], Any], frames: range, cores: int) -> dict[str, float]:
    """What rendering frames of a drive costs on one thread per core, once the kernels are compiled."""
    render(frames[0])
    wall, cpu = time.perf_counter(), time.process_time()
    with ThreadPoolExecutor(cores) as pool:
        for _ in pool.map(render, frames):
            pass
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    per_second = len(frames) / wall
    return {
        "per_second": round(per_second, 1),
        "times_real_time": round(per_second / SENSOR_HZ, 2),
        "cpu_ms_each": round(1e3 * cpu / len(frames), 1),
    }


if __name__ == "__main__":
    main()

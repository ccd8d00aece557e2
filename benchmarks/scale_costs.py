"""What 10, 1,000 and 100,000 km cost: the tables of docs/scale.md, from the constants that `scale.py` measured.

    python benchmarks/scale_costs.py

reads benchmarks/results/scale.json, prints the tables and writes them into docs/scale.md, between their marks.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "scale.json"
PAGE = HERE.parent / "docs" / "scale.md"
KILOMETRES = (10, 1_000, 100_000)
SCANS_PER_KM = 1_000
"""At 10 Hz and 10 m/s."""
BYTES_OF_A_SCAN = 1.7e6
"""105,000 points of 16 bytes."""
SHARED = ("preflight", "trajectory", "sharpness", "mapping")
"""Stages of a drive, which all workers share; the others are of the map."""
LARGEST_JSON = 64 << 20
"""Bytes; a larger file is refused."""
Row = tuple[str, ...]


def constants(measured: dict[str, Any]) -> dict[str, float]:
    """Per scan, voxel, and km, from a run of 480 s."""
    memory = measured["memory"]
    long, seconds = memory["sizes_480_s"], memory["seconds_by_stage_480_s"]
    of_drive = sum(seconds[stage] for stage in SHARED) / sum(seconds.values())
    cpu_s = memory["cpu_ms_per_scan_480_s"] * long["scans"] / 1000
    per_voxel = {part: size / long["voxels"] for part, size in long["bytes"].items()}
    per_km = {part: size / long["km"] for part, size in long["bytes"].items()}
    grows = memory["peak_mb_by_stage_480_s"]["trajectory"] - memory["peak_mb_by_stage_60_s"]["trajectory"]
    return {
        "CPU per scan, ms": memory["cpu_ms_per_scan_480_s"],
        "of it trajectory and mapping, ms": of_drive * memory["cpu_ms_per_scan_480_s"],
        "refinement and exports, µs per voxel": 1e6 * (1 - of_drive) * cpu_s / long["voxels"],
        "speed over real time, one worker on one core": measured["stages"]["real_time_factor_1"],
        "the same, two on two": measured["stages"]["real_time_factor_2"],
        "reads of a scan": measured["reads"]["reads_of_a_scan_mean"],
        "voxels per km of street": long["voxels"] / long["km"],
        "tiles per km of street": long["tiles"] / long["km"],
        "`map/`, B per voxel": per_voxel["map"],
        "`refined/`, B per voxel": per_voxel["refined"],
        "`evidence/moved/`, B per voxel of the map": per_voxel["evidence/moved"],
        "`map.laz`, `map.ply`, viewer, B per voxel": per_voxel["products"],
        "keyframes, moving points, MB per km": 1e-6
        * (per_km["evidence/keyframes"] + per_km["evidence/moving_points"]),
        "`trajectory.*`, MB per km": 1e-6 * per_km["trajectory"],
        "`run.json`, kB per km": 1e-3 * per_km["run.json"],
        "`refined/map.json`, kB per tile": 1e-3 * long["bytes"]["refined/map.json"] / long["tiles"],
        "peak memory, drive of 480 s, MB": memory["peak_mb_480_s"],
        "the same over 60 s": memory["peak_480_over_60"],
        "smoothing and binding, MB per hour of a drive": grows / (480 - 60) * 3600,
    }


def costs(constant: dict[str, float], km: float) -> dict[str, float]:
    """Of so many km of street, each driven once."""
    scans, voxels = km * SCANS_PER_KM, km * constant["voxels per km of street"]
    layers = constant["`map/`, B per voxel"] + constant["`evidence/moved/`, B per voxel of the map"]
    of_drives = constant["keyframes, moving points, MB per km"] + constant["`trajectory.*`, MB per km"]
    products = constant["`refined/`, B per voxel"] + constant["`map.laz`, `map.ply`, viewer, B per voxel"]
    of_map_hours = voxels * constant["refinement and exports, µs per voxel"] / 3.6e9
    return {
        "scans": scans,
        "voxels": voxels,
        "tiles": km * constant["tiles per km of street"],
        "core hours": scans * constant["of it trajectory and mapping, ms"] / 3.6e6 + of_map_hours,
        "of these refinement and exports": of_map_hours,
        "scans read, TB": 1e-12 * scans * constant["reads of a scan"] * BYTES_OF_A_SCAN,
        "disk of `drives/`, GB": 1e-9 * voxels * layers + 1e-3 * km * of_drives,
        "disk of the joint map and its products, GB": 1e-9 * voxels * (layers + products),
        "memory per worker, GB": 1e-3 * constant["peak memory, drive of 480 s, MB"],
    }


def limits(constant: dict[str, float]) -> dict[str, float]:
    """Where something breaks."""
    per_tile = 1e3 * constant["`refined/map.json`, kB per tile"]
    per_core = (
        1e3 * constant["reads of a scan"] * BYTES_OF_A_SCAN / constant["of it trajectory and mapping, ms"]
    )
    return {
        "km of street until `refined/map.json` is full": LARGEST_JSON
        / per_tile
        / constant["tiles per km of street"],
        "km of one drive until its `run.json` is full": LARGEST_JSON
        / (1e3 * constant["`run.json`, kB per km"]),
        "hours of one drive in 16 GB of memory": 16_000
        / constant["smoothing and binding, MB per hour of a drive"],
        "MB/s that a core reads while it maps": 1e-6 * per_core,
    }


def table(head: Row, rows: Sequence[Row]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ("---",) * len(head), *rows))


def told(value: float) -> str:
    """Three digits that count."""
    if value >= 1e6:
        return f"{float(f'{value / 1e6:.3g}'):,g} million"
    return f"{float(f'{value:.3g}'):,g}"


def main() -> None:
    """Print the tables, and write them into the page."""
    constant = constants(json.loads(RESULTS.read_text()))
    by_km = [costs(constant, km) for km in KILOMETRES]
    tables = {
        "constants": table(("constant", "value"), [(name, told(value)) for name, value in constant.items()]),
        "costs": table(
            ("", *(f"{km:,} km" for km in KILOMETRES)),
            [(name, *(told(cost[name]) for cost in by_km)) for name in by_km[0]],
        ),
        "limits": table(
            ("limit", "value"), [(name, told(value)) for name, value in limits(constant).items()]
        ),
    }
    page = PAGE.read_text()
    for name, made in tables.items():
        print(made, end="\n\n")
        begin, end = f"<!-- {name} -->\n", "<!-- end -->"
        before, found, rest = page.partition(begin)
        if not found or end not in rest:
            raise SystemExit(f"{PAGE}: no place for the table '{name}'; expected {begin!r} and {end!r}")
        page = f"{before}{begin}{made}\n{rest[rest.index(end) :]}"
    PAGE.write_text(page)


if __name__ == "__main__":
    main()

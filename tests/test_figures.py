"""Figures of the README and of the pages are those that the benchmarks have measured: `benchmarks/results/*.json`.

The tables of the demo on three pages are compared with a demo in `test_demo.py`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
TRAJECTORY = "simulated/outages of 30, 60, 30 s"
RAW = "removal, raw drive 0005, excerpt"
PAPER = f"{RAW}/as the pipeline runs, paper's rule"
OURS = f"{RAW}/as the pipeline runs"
DBSCAN = "dbscan/1000491"
LABELS = "semantic_kitti"


@cache
def results(name: str) -> Any:
    return json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text("utf-8"))


def value(name: str, path: str) -> float:
    found = results(name)
    for key in path.split("/"):
        found = found[key]
    return float(found)


def of_drives(pick: Callable[[Any], float]) -> str:
    """From the least to the greatest of the drives of `benchmarks/mapping.py`."""
    found = [pick(drive) for drive in results("mapping")["drives"].values()]
    return f"{min(found):.1f} to {max(found):.1f}"


def percent(name: str, path: str) -> str:
    return f"{100 * value(name, path):.1f} %"


def metres(path: str) -> str:
    return f"{value('trajectory', path):.2f} m"


def of_units(form: str, *paths: str) -> tuple[str, ...]:
    """The cells of a row of the table of sessions: of the navigation unit, and of the consumer's receiver."""
    return tuple(
        form.format(*(value("sessions", f"{unit}/{path}") for path in paths)) for unit in ("unit", "consumer")
    )


IN_BOTH = {
    "outages": (metres(f"{TRAJECTORY}/graph (default)/inside_outages_m"),
                metres(f"{TRAJECTORY}/EKF + RTS/inside_outages_m")),
    "SemanticKITTI 00": tuple(percent("fusion", f"{LABELS}/{way}/pooled/mean_iou")
                           for way in ("default", "single frame", "eq. 6")),
    "DBSCAN": (f"{value('refinement', f'{DBSCAN}/ours_s'):.2f} s",
               f"{value('refinement', f'{DBSCAN}/sklearn_s'):.2f} s"),
    "Open3D": (of_drives(lambda drive: drive["peers"]["ratio"]["kiss-icp"]),
                   of_drives(lambda drive: drive["peers"]["ratio"]["open3d"])),
}  # fmt: skip
"""What a row of a table holds, by a word in it."""
FIELD = {
    f"| {name} |": (f"{of['horizontal_m']:.3f} m", f"{of['heading_deg']:.2f}°", f"{of['deviations']:.2f}",
                    f"{100 * of['covered']:.0f} %")
    for name, of in results("field").items() if name != "made by"
}  # fmt: skip
ROWS = {
    "README.md": IN_BOTH | {
        "vehicles removed": (percent("refinement", f"{OURS}/DA"), percent("refinement", f"{PAPER}/DA")),
        "vehicles kept": (percent("refinement", f"{OURS}/SA_vehicle"),
                          percent("refinement", f"{PAPER}/SA_vehicle")),
    },
    "docs/comparison.md": IN_BOTH | {
        "parked kept": tuple(percent("refinement", f"{rule}/{what}")
                             for rule in (OURS, PAPER) for what in ("DA", "SA_vehicle")),
        "the same in numpy": (of_drives(lambda drive: drive["full chain"]["ratio_labels_decoded"]),),
    },
    "docs/results.md": FIELD | {
        "strict mean IoU": tuple(f"{100 * value('fusion', f'{LABELS}/{way}/pooled/mean_iou'):.1f}"
                                 for way in ("single frame", "eq. 6", "default", "calibrated")),
        "expected calibration error": tuple(percent("fusion", f"{LABELS}/{way}/pooled/ece")
                                            for way in ("default", "eq. 6")),
        "thickness of surfaces": tuple(
            f"{100 * value('sharpness', f'excerpt/sharpness/{poses}/thickness_m'):.1f} cm"
            for poses in ("GNSS + IMU + LiDAR", "GNSS + IMU")),
        "EKF + RTS |": (metres("simulated/clean/EKF + RTS/horizontal_m"),
                        metres(f"{TRAJECTORY}/EKF + RTS/inside_outages_m")),
        "factor graph without vehicle constraint |": (
            metres("simulated/clean/graph, standing/horizontal_m"),
            metres(f"{TRAJECTORY}/graph, standing/inside_outages_m")),
        "factor graph |": (metres("simulated/clean/graph (default)/horizontal_m"),
                           metres(f"{TRAJECTORY}/graph (default)/inside_outages_m")),
    },
    "docs/sessions.md": {
        "apart before, median": tuple(f"{100 * value('sessions', f'{unit}/before_m'):.1f}"
                                      for unit in ("unit", "consumer")),
        "thickness of surfaces": of_units("{:.2f}", "thickness_ratio"),
        "bound over alone": of_units("{:.2f}", "error_bound_over_alone"),
        "planted, and taken": of_units("{:.0f}, **{:.0f}**", "planted", "planted_taken"),
        "precision, recall": of_units("{:.0f}: **{:.2f}, {:.2f}**", "changes_there", "changes_precision",
                                      "changes_recall"),
        "per scan, ms": of_units("{:.1f}", "search_ms_per_scan"),
    },
}  # fmt: skip


@pytest.mark.parametrize(("page", "word"), [(page, word) for page, rows in ROWS.items() for word in rows])
def test_a_row_has_the_figures_that_were_measured(page: str, word: str) -> None:
    text = (ROOT / page).read_text("utf-8")
    rows = [row for row in text.splitlines() if row.startswith("|") and word in row]
    assert rows, f"{page} has no row with {word!r}"
    for row in rows:
        assert [figure for figure in ROWS[page][word] if figure not in row] == [], row


def test_what_the_pages_say_in_words_was_measured() -> None:
    pages = {page.name: " ".join(page.read_text("utf-8").split()) for page in (ROOT / "docs").glob("*.md")}
    surround, rings = results("rigs")["surround"], results("rigs")["rings"]
    shares = [100 * drive["DA"] for seeds in rings.values() for drive in seeds.values()]
    for page, says in (
        ("paper.md", f"eq. 12 and 13 removes {percent('refinement', f'{PAPER}/DA')} of their points and keeps"
                     f" {percent('refinement', f'{PAPER}/SA_vehicle')} of the parked vehicles; ours removes"
                     f" {percent('refinement', f'{OURS}/DA')} and keeps"
                     f" {percent('refinement', f'{OURS}/SA_vehicle')}"),
        ("paper.md", f"error is {percent('fusion', f'{LABELS}/eq. 6/pooled/ece')}, that of the default"
                     f" {percent('fusion', f'{LABELS}/default/pooled/ece')}"),
        ("your_own_log.md", f"The map labels {100 * surround['coverage']:.1f} % of the LiDAR points whose"
                            " true class it has, at"
                            f" {100 * surround['refined']['mean_accuracy']:.1f} % accuracy and"
                            f" {100 * surround['refined']['mean_iou']:.1f} % IoU"),
        ("your_own_log.md", f"128 rings {min(shares):.1f} to {max(shares):.1f} %"),
        ("results.md", f"{value('sharpness', 'outage/rms/with_inside_m'):.2f} m with LiDAR odometry,"
                       f" {value('sharpness', 'outage/rms/without_inside_m'):.1f} m without"),
    ):  # fmt: skip
        assert says in pages[page], f"{page}: {says}"


def test_the_demo_has_one_table_on_all_pages() -> None:
    tables = []
    for page in ("README.md", "docs/results.md"):
        rows = re.findall(
            r"^\| (?:\*\*)?(road|sidewalk|vehicle|building|vegetation|mean)(?:\*\*)? \| ([\d.| *]+) \|$",
            (ROOT / page).read_text("utf-8"),
            re.M,
        )
        tables.append({name: figures.replace("*", "") for name, figures in rows})
    assert tables[0] == tables[1]
    assert list(tables[0]) == ["road", "sidewalk", "vehicle", "building", "vegetation", "mean"]

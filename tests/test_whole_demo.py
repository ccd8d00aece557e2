"""The figures of the demo, and of the paper's rules on its drive, are those on the pages; minutes."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from pages import ROOT, blocks, shell

pytestmark = pytest.mark.demo

CLASSES = ("road", "sidewalk", "vehicle", "building", "vegetation")


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """`metrics.json` of the demo and of the paper's rules, by the commands of `docs/paper.md`."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "examples").symlink_to(ROOT / "examples")
    [commands] = [block.text for block in blocks(ROOT / "docs/paper.md") if block.title == "takes minutes"]
    shell(folder, commands)
    return {
        name: json.loads((folder / name / "metrics.json").read_text("utf-8")) for name in ("demo", "paper")
    }


def rows(page: str, beginning: str) -> list[list[float]]:
    """The numbers of the rows of tables that begin so."""
    text = (ROOT / page).read_text("utf-8")
    found = re.findall(rf"^\| (?:\*\*)?{re.escape(beginning)}(?:\*\*)? \|(.*)\|$", text, re.M)
    return [[float(cell.strip(" *")) for cell in row.split("|")] for row in found]


def shares(scores: dict[str, Any], figure: str) -> list[float]:
    """Of the classes, then their mean, %."""
    each = [scores["classes"][name][figure] for name in CLASSES]
    return [round(100 * share, 1) for share in (*each, scores[f"mean_{figure}"])]


@pytest.mark.parametrize("page", ["README.md", "docs/results.md"])
def test_the_table_of_the_demo_is_what_it_measures(page: str, measured: dict[str, Any]) -> None:
    found = measured["demo"]["semantics"]
    columns = [
        shares(scores, figure)
        for figure in ("accuracy", "iou")
        for scores in (found["raw"], found["refined"]["seen"])
    ]
    for number, name in enumerate((*CLASSES, "mean")):
        [row] = rows(page, name)
        assert row == [column[number] for column in columns]


@pytest.mark.parametrize(
    ("run", "beginning"), [("demo", "default, the same drive"), ("paper", "its rules, our drive")]
)
def test_the_tables_beside_the_paper_are_what_is_measured(
    run: str, beginning: str, measured: dict[str, Any]
) -> None:
    metrics = measured[run]
    accuracy, iou, moving = rows("docs/paper.md", beginning)
    refined = metrics["semantics"]["refined"]
    assert accuracy == [*shares(refined, "accuracy"), round(100 * refined["coverage"], 1)]
    assert iou == shares(refined, "iou")
    found = [100 * metrics["dynamic"][name] for name in ("DA", "SA", "SA_vehicle", "AA")]
    assert moving == pytest.approx(found, abs=0.051)  # as the table rounds


def test_what_the_results_say_of_the_demo_is_what_is_measured(measured: dict[str, Any]) -> None:
    text = " ".join((ROOT / "docs/results.md").read_text("utf-8").split())
    metrics = measured["demo"]
    found = metrics["trajectory"]
    for says in (
        f"**Coverage** is {100 * metrics['semantics']['refined']['coverage']:.1f} %",
        f"the error is {found['ate_m']:.2f} m, which is the error of the simulated GNSS, and"
        f" {1000 * found['ate_aligned_m']:.0f} mm after alignment",
        f"expected calibration error is {100 * metrics['calibration']['ece']:.1f} %",
        f"position has {found['position_nees_per_dof']:.2f} and orientation"
        f" {found['orientation_nees_per_dof']:.2f}",
        f"roll and pitch are wrong by {found['tilt_rms_deg']:.3f}°, heading by {found['heading_rms_deg']:.2f}°",
    ):
        assert says in text, says


def test_what_the_readme_says_of_movers_is_what_is_measured(measured: dict[str, Any]) -> None:
    text = " ".join((ROOT / "README.md").read_text("utf-8").split())
    moving = measured["demo"]["dynamic"]
    assert (
        f"{100 * moving['DA']:.1f} % of the points of moving vehicles are removed,"
        f" and {100 * moving['SA']:.2f} % of the static points are kept" in text
    )

"""Pages of the documentation run from their first command to their last, in a folder of their own.

What a title says is needed, drives of the simulator and of the small street stand for.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import street_drives
from pages import ROOT, blocks, python, shell

pytestmark = pytest.mark.slow

SIMULATED = "try/2026_04_18/2026_04_18_drive_0000_sync"
CHECK = f"gnss-sem-map check {SIMULATED}"
SHORT = {CHECK: f"{CHECK} || test $? = 1"}
"""Five seconds are short: the check may be red, and then says so by its exit code."""


def run_page(page: Path, folder: Path, stands_for: dict[str, str], titles: tuple[str, ...] = ("",)) -> int:
    """Run the blocks of these titles; how many."""
    chosen = [block for block in blocks(page) if block.title in titles]
    for block in chosen:
        if block.language == "python":
            assert python(folder, "-c", block.text)
        elif block.language == "bash":
            shell(folder, block.text, stands_for)
    return len(chosen)


def test_the_tutorial_and_what_is_shown_of_a_map(tmp_path: Path) -> None:
    assert run_page(ROOT / "docs/tutorial.md", tmp_path, SHORT) > 6
    for page in ("formats.md", "method.md"):
        assert run_page(ROOT / "docs" / page, tmp_path, {}, ("needs a map",)) == 1
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    stands_for = {"DRIVE": SIMULATED, "SPEC": "labels:try/probabilities", "-o out": "-o paper --force"}
    assert run_page(ROOT / "docs/paper.md", tmp_path, stands_for, ("needs your drive",)) == 1


def test_from_a_bag_to_a_map(tmp_path: Path) -> None:
    bag = {"BAG": "try/2026_04_18_drive_0000", "-o out": "-o again"}
    page = ROOT / "docs/your_own_log.md"
    run_page(page, tmp_path, {})
    assert run_page(page, tmp_path, bag | {"view out": "view again"}, ("needs your bag",)) == 3


@pytest.fixture
def town(tmp_path: Path) -> Path:
    """Drives by the names that the pages have for them, and their labels."""
    names = ("2011_09_26_drive_0005_sync", "2011_09_26_drive_0009_sync", "third")
    drives = street_drives.write(tmp_path / "drives", names)
    date = drives.by_name["third"].parent
    (tmp_path / "2011_09_26").symlink_to(date)
    (tmp_path / "PROBABILITIES").symlink_to(tmp_path / "drives/labels")
    (tmp_path / "MORE").symlink_to(tmp_path / "drives/labels/third")
    for day, name in (
        ("2011_09_28", "2011_09_28_drive_0001_sync"),
        ("2011_10_03", "2011_10_03_drive_0027_sync"),
    ):
        (tmp_path / day).mkdir()
        (tmp_path / day / name).symlink_to(drives.by_name["third"])
        for calibration in date.glob("calib*.txt"):
            shutil.copyfile(calibration, tmp_path / day / calibration.name)
    return tmp_path


def test_many_drives_of_the_readme(town: Path) -> None:
    assert run_page(ROOT / "README.md", town, {}, ("needs your drives",)) == 1
    assert (town / "town/map.laz").is_file()


def test_the_first_run_of_the_readme(town: Path) -> None:
    # the clone is here, and the demo has a test of its own
    stands_for = {"git clone REPOSITORY gnss-sem-map && cd gnss-sem-map": ":", "make demo": ":"}
    assert run_page(ROOT / "README.md", town, stands_for, ("from a clone",)) == 1
    assert (town / "out/map.laz").is_file()


def test_drives_that_come_again(town: Path) -> None:
    stands_for = {
        "DAY1": "2011_09_26/2011_09_26_drive_0005_sync",
        "DAY2": "2011_09_26/2011_09_26_drive_0009_sync",
        "LOOP": "2011_09_26/2011_09_26_drive_0005_sync",
        "CITY.laz": "city/map.laz",
        "SPEC": "labels:PROBABILITIES/{drive}",
        "-o town --align-to": "-o aligned --align-to",
    }
    shell(town, "gnss-sem-map run DAY1 --segmenter none -o city", stands_for)
    assert run_page(ROOT / "docs/sessions.md", town, stands_for, ("needs your drives",)) == 2

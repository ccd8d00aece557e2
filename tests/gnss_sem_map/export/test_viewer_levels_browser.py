"""Levels of detail in a real browser: what is loaded and drawn from near, from afar, and without its files."""

import base64
import re
import time
import zlib
from pathlib import Path

import pytest
from browsers import Browser
from viewer_pages import look_at, written

from gnss_sem_map.voxels.semantic_map import SemanticMap


def settled(browser: Browser) -> dict[str, int]:
    """Load what the view needs; returns the voxels that are held and drawn of each level."""
    for _ in range(400):
        if not browser.run("draw(); return waiting()"):
            break
        time.sleep(0.02)
    ready = "[...scene.nodes.values()].filter(({ state }) => state === 'ready')"
    return {
        "held": browser.run(
            f"return {ready}.reduce((sum, {{ level, count }}) => sum + (level < meta.level) * count, 0)"
        ),
        "finest": browser.run("return Math.min(...scene.drawn.map(([{ level }]) => level ?? 99))"),
        "coarsest": browser.run("return Math.max(...scene.drawn.map(([{ level }]) => level ?? 0))"),
    }


def test_near_by_a_page_with_levels_shows_what_a_page_with_all_voxels_shows(
    browser: Browser, town: SemanticMap, tmp_path: Path
) -> None:
    pictures = []
    for name, most_voxels in (("whole", 10**6), ("levels", 20_000)):
        (tmp_path / name).mkdir()
        written(tmp_path / name, town, None, most_voxels=most_voxels)
        assert browser.open((tmp_path / name / "viewer.html").as_uri()) == f"ready: {len(town)} voxels"
        look_at(browser, (110, 6, 0), 30)
        browser.run("camera.elevation = 1.2; most = 0")
        settled(browser)
        pictures.append(browser.screenshot())
    whole, coarse = pictures
    assert (coarse != whole).any(axis=2).mean() > 0.05
    browser.run("most = 4e6")
    assert settled(browser)["finest"] == 0
    assert (browser.screenshot() != whole).any(axis=2).mean() < 0.001


def test_from_afar_voxels_are_coarse_and_memory_is_bounded_wherever_the_camera_goes(
    browser: Browser, town: SemanticMap, tmp_path: Path
) -> None:
    written(tmp_path, town, None, most_voxels=20_000)
    browser.open((tmp_path / "viewer.html").as_uri())
    browser.run("most = 150000")
    look_at(browser, (0, 0, 0), 4000)
    far = settled(browser)
    assert far["finest"] == far["coarsest"] > 1
    seen = set()
    for east in (-150, 110, 240):
        for north in (-140, 6):
            look_at(browser, (east, north, 0), 20)
            near = settled(browser)
            assert near["held"] <= 150_000
            seen |= set(browser.run("return scene.drawn.map(([{ name }]) => name)"))
    assert sum(name.startswith("0_") for name in seen) >= 6


@pytest.mark.parametrize("fault", ["lost", "cut", "of another map"])
def test_a_page_without_the_files_of_its_folder_shows_the_coarse_voxels_and_says_so(
    fault: str, browser: Browser, town: SemanticMap, tmp_path: Path
) -> None:
    written(tmp_path, town, None, most_voxels=20_000)
    for file in (tmp_path / "viewer").iterdir():
        if fault == "lost":
            file.unlink()
        elif fault == "cut":
            file.write_bytes(file.read_bytes()[:-1000])
        else:
            other = base64.b64encode(zlib.compress(bytes(900))).decode()
            file.write_text(f'voxels("{file.stem}","{other}");')
    browser.open((tmp_path / "viewer.html").as_uri())
    look_at(browser, (110, 6, 0), 30)
    settled(browser)
    assert browser.run("return waiting()") == 0
    assert browser.run("return scene.drawn.length") > 0
    said = browser.run("return document.getElementById('about').textContent")
    what = {
        "lost": "is not beside this page",
        "cut": "is damaged",
        "of another map": "is damaged, or of another page",
    }
    pattern = rf"joined to [\d.]+ m where finer ones are missing: viewer/\d_\d_\d.js {what[fault]}"
    assert re.search(pattern, said)


def test_a_click_on_a_joined_voxel_says_so(browser: Browser, town: SemanticMap, tmp_path: Path) -> None:
    written(tmp_path, town, None, most_voxels=20_000)
    browser.open((tmp_path / "viewer.html").as_uri())
    look_at(browser, (110, 6, 0), 300)
    browser.run("camera.elevation = 1.5;")
    settled(browser)
    browser.run("pick({ clientX: innerWidth / 2, clientY: innerHeight / 2 });")
    said = browser.run("return document.getElementById('picked').textContent")
    assert "the most hit voxel in 0.8 m" in said
    place = [float(number) for number in re.findall(r"(-?\d+\.\d) m", said.split("\n")[1])]
    assert place[:2] == pytest.approx([110, 6], abs=2.0)

"""The viewer page: its structure always, its behaviour in a real browser where one is installed."""

import base64
import gzip
import json
import re
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from declared import BROWSER, absent

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.viewer import write_viewer
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels.semantic_map import SemanticMap, State


def part(page: str, name: str) -> str:
    (found,) = re.findall(rf'<script type="[a-z/]+" id="{name}">(.*?)</script>', page, flags=re.DOTALL)
    return str(found)


def decoded(page: str) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Meta, indices (v, 3) and label, confidence, state (v, 3), by the description in the page's script."""
    meta = json.loads(part(page, "meta"))
    planes = np.frombuffer(gzip.decompress(base64.b64decode(part(page, "voxels"))), np.uint8).reshape(12, -1)
    assert planes.shape[1] == meta["count"]
    low, middle, high = planes[:9].astype(np.int64).reshape(3, 3, -1).transpose(1, 0, 2)
    zigzag = low | middle << 8 | high << 16
    indices = np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1).T + meta["origin"]
    return meta, indices, planes[9:].T


def written(tmp_path: Path, semantic_map: SemanticMap, *arguments: Any, **settings: Any) -> str:
    write_viewer(semantic_map, *arguments, tmp_path / "viewer.html", **settings)
    return (tmp_path / "viewer.html").read_text("utf-8")


def test_the_page_holds_every_voxel_with_its_class_confidence_and_state(
    street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    meta, indices, about = decoded(written(tmp_path, street, track))
    rows = np.lexsort(indices.T[::-1])
    np.testing.assert_array_equal(indices[rows], street.voxels.indices)
    labels = np.where(street.labels < 0, 5, street.labels)
    np.testing.assert_array_equal(about[rows, 0], labels)
    np.testing.assert_allclose(about[rows, 1] / 255, street.confidence, atol=0.5 / 255 + 1e-6)
    np.testing.assert_array_equal(about[rows, 2], street.states)
    assert [c["count"] for c in meta["classes"]] == [
        int((street.labels[street.shown] == i).sum()) for i in range(5)
    ]
    assert meta["removed"] == (street.states == State.REMOVED).sum()
    path = (np.array(meta["track"]) + meta["origin"]) * meta["voxel_m"]
    np.testing.assert_allclose(path, track.positions, atol=0.002)


def test_the_page_asks_the_network_for_nothing(
    street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    page = written(tmp_path, street, track)
    assert "default-src 'none'" in page
    assert not re.findall(r"(?:src|href)\s*=|https?://|@import|url\(", page)


def hostile(street: SemanticMap) -> SemanticMap:
    old = street.voxels.label_set
    names = (
        "</script><script>document.title='owned'</script>",
        "<img src=x onerror=alert(1)>",
        "a&b",
        '"',
        "$title",
    )
    spiteful = LabelSet("x", names, old.colours, old.semantic_kitti_ids, old.asprs_codes, {})
    return replace(street, voxels=replace(street.voxels, label_set=spiteful))


def test_names_cannot_leave_their_place(street: SemanticMap, track: Trajectory, tmp_path: Path) -> None:
    page = written(tmp_path, hostile(street), track, title="</title><script>alert(1)</script>")
    assert len(re.findall("<script", page)) == len(re.findall("</script", page)) == 3
    meta, _, _ = decoded(page)
    assert tuple(c["name"] for c in meta["classes"]) == hostile(street).voxels.label_set.names


def test_a_map_above_the_budget_is_joined_and_says_so(street: SemanticMap, tmp_path: Path) -> None:
    meta, indices, about = decoded(written(tmp_path, street, None, most_voxels=10_000))
    assert 10_000 / 8 < meta["count"] <= 10_000
    assert meta["voxel_m"] == 0.4
    assert meta["about"].endswith("of 0.4 m, without the unlabelled ones, joined from 0.2 m")
    coarse = {tuple(i): label for i, label in zip(indices.tolist(), about[:, 0].tolist(), strict=True)}
    best: dict[tuple[int, ...], tuple[int, int]] = {}
    for index, hits, label in zip(
        (street.voxels.indices >> 1).tolist(),
        street.voxels.hits.tolist(),
        street.labels.tolist(),
        strict=True,
    ):
        if label >= 0 and hits > best.get(tuple(index), (0, 0))[0]:
            best[tuple(index)] = (hits, label)
    assert coarse.keys() == best.keys()
    assert np.mean([coarse[i] == best[i][1] for i in best]) > 0.999  # equal hits may go either way


def test_an_empty_map_is_refused(street: SemanticMap, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no voxels to draw"):
        written(tmp_path, SemanticMap.of(street.voxels[np.zeros(len(street), bool)]), None)


DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))


class Browser:
    """A headless Chromium, spoken to in the W3C WebDriver protocol."""

    FLAGS = (
        "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
        "--disable-sync", "--window-size=800,600",
    )  # fmt: skip

    def __init__(self, base: str, profile: Path) -> None:
        options = {"args": [*self.FLAGS, f"--user-data-dir={profile}"]}
        self._session = ""
        self._base = f"{base}/session"
        self._session = (
            "/" + self.ask("", capabilities={"alwaysMatch": {"goog:chromeOptions": options}})["sessionId"]
        )

    def ask(self, command: str, **body: Any) -> Any:
        request = urllib.request.Request(
            f"{self._base}{self._session}{command}",
            json.dumps(body).encode(),
            {"Content-Type": "application/json"},
        )
        with DIRECT.open(request, timeout=60) as answer:
            return json.load(answer)["value"]

    def run(self, script: str) -> Any:
        return self.ask("/execute/sync", script=script, args=[])

    def open(self, address: str) -> str:
        """Open the page and return its title once it says that it is ready or failed."""
        self.ask("/url", url="about:blank")
        self.ask("/url", url=address)
        title = ""
        for _ in range(600):
            title = self.run("return document.title")
            if title.startswith(("ready", "failed")):
                break
            time.sleep(0.05)
        return title

    def screenshot(self) -> np.ndarray:
        """RGB (h, w, 3) of what the canvas shows now."""
        self.run("draw()")
        png = self.run("return canvas.toDataURL('image/png')").split(",")[1]
        image = cv2.imdecode(np.frombuffer(base64.b64decode(png), np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return image[..., ::-1]

    def close(self) -> None:
        DIRECT.open(
            urllib.request.Request(f"{self._base}{self._session}", method="DELETE"), timeout=60
        ).close()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    driver = shutil.which("chromedriver")
    if driver is None or not (shutil.which("chromium") or shutil.which("google-chrome")):
        absent(BROWSER, "needs chromium and chromedriver")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [driver, f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        session = started(f"http://127.0.0.1:{port}", tmp_path_factory.mktemp("profile"))
        yield session
        session.close()
    finally:
        process.terminate()
        process.wait()


def started(base: str, profile: Path) -> Browser:
    for _ in range(200):
        try:
            DIRECT.open(f"{base}/status", timeout=5).close()
            break
        except urllib.error.URLError:
            time.sleep(0.05)
    try:
        return Browser(base, profile)
    except urllib.error.URLError as error:
        absent(BROWSER, f"the installed browser does not start: {error}")


def count(image: np.ndarray, colour: np.ndarray) -> int:
    """Pixels of about this hue: a class, lit and shaded."""
    pixels = image.reshape(-1, 3).astype(float)
    cosine = pixels @ colour / (np.linalg.norm(pixels, axis=1) * np.linalg.norm(colour) + 1e-9)
    return int(((cosine > 0.995) & (pixels.max(axis=1) > 70)).sum())


def test_the_browser_shows_every_class_and_hides_what_is_switched_off(
    browser: Browser, street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    written(tmp_path, street, track)
    assert browser.open((tmp_path / "viewer.html").as_uri()) == f"ready: {len(street)} voxels"
    colours = street.voxels.label_set.colours.astype(float)
    before = browser.screenshot()
    assert all(count(before, colour) > 30 for colour in colours)
    boxes = "document.querySelectorAll('#layers input')"
    names = browser.run(
        "return [...document.querySelectorAll('#layers label')].map(l => l.childNodes[2].textContent)"
    )
    assert names == [*street.voxels.label_set.names, "unlabelled", "track", "removed"]
    browser.run(f"{boxes}[3].click()")
    without = browser.screenshot()
    assert count(without, colours[3]) == 0
    assert count(without, colours[0]) > 0.9 * count(before, colours[0])
    browser.run(f"{boxes}[3].click()")
    np.testing.assert_array_equal(browser.screenshot(), before)
    browser.run(f"{boxes}[7].click()")
    assert (browser.screenshot() != before).any()


def test_the_browser_lets_nothing_run_that_a_name_smuggles_in(
    browser: Browser, street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    written(tmp_path, hostile(street), track, title="<script>document.title='owned'</script>")
    assert browser.open((tmp_path / "viewer.html").as_uri()).startswith("ready")
    assert browser.run("return document.querySelectorAll('img, #layers script').length") == 0
    assert browser.run("return document.querySelector('h1').textContent").startswith("<script>")


@pytest.mark.parametrize("mode", ["height", "confidence", "origin"])
def test_every_colour_mode_shows_the_same_voxels_in_other_colours(
    mode: str, browser: Browser, street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    page = tmp_path / "viewer.html"
    written(tmp_path, street, track)
    browser.open(page.as_uri() + "#hide=track")
    by_class = browser.run("draw(); return document.querySelector('select').value"), browser.screenshot()
    browser.open(f"{page.as_uri()}#hide=track&colour={mode}")
    other = browser.run("draw(); return document.querySelector('select').value"), browser.screenshot()
    assert (by_class[0], other[0]) == ("class", mode)
    assert (by_class[1] != other[1]).any(axis=2).mean() > 0.02


def test_a_click_tells_what_the_voxel_is(browser: Browser, street: SemanticMap, tmp_path: Path) -> None:
    written(tmp_path, street, None)
    browser.open((tmp_path / "viewer.html").as_uri())
    browser.run("camera.target = [30, 1, 0].map((metres, k) => metres / meta.voxel_m - meta.origin[k]);")
    browser.run("camera.elevation = 1.5; camera.distance = 100; draw();")
    browser.run("pick({ clientX: innerWidth / 2, clientY: innerHeight / 2 });")
    said = browser.run("return document.getElementById('picked').textContent")
    assert said.startswith("road, seen, probability 0.")
    place = [float(number) for number in re.findall(r"(-?\d+\.\d) m", said)]
    assert place == pytest.approx([30, 1, 0.1], abs=0.3)


def pointer(name: str, kind: str, *points: tuple[int, int]) -> dict[str, Any]:
    """Press at the first point, move to the others, release."""
    moves = [{"type": "pointerMove", "duration": 50, "x": x, "y": y} for x, y in points]
    press, release = {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}
    actions = [moves[0], press, *moves[1:], release]
    return {"type": "pointer", "id": name, "parameters": {"pointerType": kind}, "actions": actions}


def test_mouse_and_fingers_turn_and_zoom(browser: Browser, street: SemanticMap, tmp_path: Path) -> None:
    written(tmp_path, street, None)
    browser.open((tmp_path / "viewer.html").as_uri())
    state = "return [camera.azimuth, camera.elevation, camera.distance]"
    azimuth, elevation, distance = browser.run(state)
    browser.ask("/actions", actions=[pointer("mouse", "mouse", (500, 300), (600, 350))])
    turned = browser.run(state)
    assert turned == pytest.approx([azimuth + 0.6, elevation + 0.3, distance])
    roll = {
        "type": "scroll",
        "x": 500,
        "y": 300,
        "deltaX": 0,
        "deltaY": -200,
        "duration": 0,
        "origin": "viewport",
    }
    browser.ask("/actions", actions=[{"type": "wheel", "id": "wheel", "actions": [roll]}])
    nearer = browser.run(state)
    assert nearer[:2] == turned[:2]
    assert nearer[2] < 0.9 * distance
    fingers = [pointer("a", "touch", (500, 300), (450, 300)), pointer("b", "touch", (600, 300), (650, 300))]
    browser.ask("/actions", actions=fingers)
    assert browser.run(state) == pytest.approx([*turned[:2], nearer[2] / 2], rel=0.05)

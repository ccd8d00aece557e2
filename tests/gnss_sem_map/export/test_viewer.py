"""The viewer page: its structure always, its behaviour in a real browser where one is installed."""

import base64
import json
import re
import shutil
import socket
import subprocess
import time
import tracemalloc
import urllib.error
import urllib.request
import zlib
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
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import in_memory
from gnss_sem_map.voxels.voxel_map import pack


def part(page: str, name: str) -> str:
    (found,) = re.findall(rf'<script type="[a-z/]+" id="{name}">(.*?)</script>', page, flags=re.DOTALL)
    return str(found)


def decoded(page: str) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Meta, indices (v, 3) in voxels of the page's level and label, confidence, state (v, 3), by the description in
    the page's script.
    """
    meta = json.loads(part(page, "meta"))
    listed = [node for node in meta["nodes"] if node[0] == meta["level"]]
    nodes = [unpacked(*each, meta) for each in zip(listed, part(page, "voxels").split("\n"), strict=True)]
    return meta, np.concatenate([cells for cells, _ in nodes]), np.concatenate([about for _, about in nodes])


def unpacked(listed: list[int], text: str, meta: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Indices (v, 3) and label, confidence, state (v, 3) of a node."""
    level, x, y, low, high, *quadrants = listed
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(9, -1)
    assert planes.shape[1] == sum(quadrants)
    lower, upper = planes[:6].astype(np.int64).reshape(3, 2, -1).transpose(1, 0, 2)
    zigzag = lower | upper << 8
    cells = np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1).T + np.array([512 * x, 512 * y, low])
    assert cells[:, 2].max() == high
    return cells + (np.array(meta["origin"]) >> level), planes[6:].T


def written(tmp_path: Path, semantic_map: SemanticMap, track: Trajectory | None, **settings: Any) -> str:
    tracks = [] if track is None else [track]
    write_viewer(in_memory(semantic_map), tracks, tmp_path / "viewer.html", **settings)
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
    (line,) = meta["tracks"]
    path = (np.array(line) + meta["origin"]) * meta["voxel_m"]
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


@pytest.fixture(scope="module")
def town(street: SemanticMap) -> SemanticMap:
    """Twelve copies of the street in eleven tiles, west and east, south and north of the origin."""
    copies = [(dx, dy) for dx in (-900, -300, 400, 1100) for dy in (-700, 30, 600)]
    voxels = street.voxels
    keys = np.concatenate([pack(voxels.indices + np.array([dx, dy, 0])) for dx, dy in copies])
    order = np.argsort(keys)
    many = np.tile(np.arange(len(street)), len(copies))[order]
    return SemanticMap(
        replace(voxels, keys=keys[order], evidence=voxels.evidence[many], hits=voxels.hits[many]),
        street.labels[many],
        street.confidence[many],
        street.states[many],
    )


def levels(tmp_path: Path) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Indices (v, 3) in voxels of the level and label, confidence, state (v, 3) of the page and its folder."""
    page = (tmp_path / "viewer.html").read_text("utf-8")
    meta, indices, about = decoded(page)
    found: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {meta["level"]: [(indices, about)]}
    files = {file.name for file in (tmp_path / "viewer").iterdir()}
    for listed in meta["nodes"]:
        level, x, y = listed[:3]
        if level != meta["level"]:
            name = f"{level}_{x}_{y}"
            files.remove(f"{name}.js")
            script = (tmp_path / "viewer" / f"{name}.js").read_text("ascii")
            text = script.removeprefix(f'voxels("{name}","').removesuffix('");\n')
            found.setdefault(level, []).append(unpacked(listed, text, meta))
    assert not files
    return {
        level: (np.concatenate([i for i, _ in nodes]), np.concatenate([a for _, a in nodes]))
        for level, nodes in found.items()
    }


def test_a_map_above_the_budget_has_levels_of_which_each_shows_the_most_hit_of_the_voxels_it_joins(
    town: SemanticMap, tmp_path: Path
) -> None:
    """Against a dictionary; a labelled voxel that stands goes before the others."""
    written(tmp_path, town, None, most_voxels=20_000)
    found = levels(tmp_path)
    assert len(found) > 2
    labels = np.where(town.labels < 0, 5, town.labels).tolist()
    ranks = list(zip(town.shown.tolist(), town.voxels.hits.tolist(), strict=True))
    for level, (indices, about) in found.items():
        best: dict[tuple[int, ...], tuple[tuple[bool, int], set[tuple[int, int]]]] = {}
        joined = map(tuple, (town.voxels.indices >> level).tolist())
        for index, rank, label, state in zip(joined, ranks, labels, town.states.tolist(), strict=True):
            highest, those = best.get(index, (rank, set()))
            if rank >= highest:
                best[index] = rank, {(label, state)} | (those if rank == highest else set())
        shown = {
            tuple(i): (label, state)
            for i, (label, _, state) in zip(indices.tolist(), about.tolist(), strict=True)
        }
        assert len(shown) == len(indices)
        assert shown.keys() == best.keys()
        assert all(shown[index] in those for index, (_, those) in best.items())
    assert len(found[max(found)][0]) <= 20_000 < len(found[max(found) - 1][0])


def test_a_map_in_tiles_on_disk_gives_the_same_bytes_and_each_tile_is_read_once(
    town: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    tiles.write(town, tmp_path / "map", None)
    opened, read = tiles.open_map(tmp_path / "map"), list[tiles.Tile]()

    def read_tile(tile: tiles.Tile) -> SemanticMap:
        read.append(tile)
        return opened.read_tile(tile)

    for name, tiled_map in (("disk", replace(opened, read_tile=read_tile)), ("memory", in_memory(town))):
        (tmp_path / name).mkdir()
        write_viewer(tiled_map, [track], tmp_path / name / "viewer.html", most_voxels=20_000)
    assert sorted(read) == list(opened.tiles)
    disk, memory = (
        {file.relative_to(tmp_path / name): file.read_bytes() for file in (tmp_path / name).rglob("*.*")}
        for name in ("disk", "memory")
    )
    assert disk == memory
    assert len(disk) > 10


def test_the_files_of_an_earlier_page_are_not_replaced(town: SemanticMap, tmp_path: Path) -> None:
    written(tmp_path, town, None, most_voxels=20_000)
    with pytest.raises(DataError, match=r"viewer: exists; move it away"):
        written(tmp_path, town, None, most_voxels=20_000)


def peak_memory(edge: int, piece: SemanticMap, page: Path) -> int:
    """Bytes that writing a map of edge x edge such tiles takes at most."""
    corners = tuple((x, y) for x in range(edge) for y in range(edge))
    tiled_map = replace(in_memory(piece), tiles=corners, read_tile=lambda _: piece[np.arange(len(piece))])
    tracemalloc.start()
    write_viewer(tiled_map, (), page, most_voxels=20_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_memory_does_not_grow_with_the_map(street: SemanticMap, tmp_path: Path) -> None:
    small, large = (peak_memory(edge, street, tmp_path / f"{edge}.html") for edge in (3, 9))
    assert large < 1.2 * small


def test_tiles_without_voxels_are_passed_over(street: SemanticMap, tmp_path: Path) -> None:
    tiled_map, nothing = in_memory(street), street[np.zeros(len(street), bool)]
    pages = []
    for corners in (tiled_map.tiles, (*tiled_map.tiles, (2, 5))):
        with_empty = replace(
            tiled_map,
            tiles=corners,
            read_tile=lambda tile: nothing if tile == (2, 5) else tiled_map.read_tile(tile),
        )
        write_viewer(with_empty, (), tmp_path / "viewer.html")
        pages.append(decoded((tmp_path / "viewer.html").read_text("utf-8"))[1])
    np.testing.assert_array_equal(*pages)


def test_a_page_needs_a_suffix_since_its_folder_has_none(street: SemanticMap, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"viewer: found no suffix, expected a name such as viewer.html"):
        write_viewer(in_memory(street), (), tmp_path / "viewer")


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


def test_every_state_of_a_voxel_has_a_name_and_a_colour(
    browser: Browser, street: SemanticMap, tmp_path: Path
) -> None:
    written(tmp_path, street, None)
    browser.open((tmp_path / "viewer.html").as_uri())
    assert browser.run("return [ORIGINS.length, ORIGIN_COLOURS.length]") == [len(State)] * 2


def test_a_double_click_goes_to_the_voxel(browser: Browser, street: SemanticMap, tmp_path: Path) -> None:
    written(tmp_path, street, None)
    browser.open((tmp_path / "viewer.html").as_uri())
    look_at(browser, (30, 1, 0), 20)
    browser.run("camera.elevation = 1.5; draw();")
    press = {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}
    move = {"type": "pointerMove", "duration": 0, "x": 450, "y": 200}
    mouse = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}}
    browser.ask("/actions", actions=[mouse | {"actions": [move, *press, *press]}])
    said = browser.run("return document.getElementById('picked').textContent")
    place = [float(number) for number in re.findall(r"(-?\d+\.\d) m", said)]
    target = browser.run("return camera.target.map((v, k) => (v + meta.origin[k]) * meta.voxel_m)")
    assert place == pytest.approx(target, abs=0.06)
    assert np.hypot(target[0] - 30, target[1] - 1) > 1
    assert browser.run("return camera.distance * meta.voxel_m") == pytest.approx(20 / 3)


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


def look_at(browser: Browser, metres: tuple[float, float, float], distance_m: float) -> None:
    browser.run(
        f"camera.target = {list(metres)}.map((m, k) => m / meta.voxel_m - meta.origin[k]);"
        f"camera.distance = {distance_m} / meta.voxel_m;"
    )


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

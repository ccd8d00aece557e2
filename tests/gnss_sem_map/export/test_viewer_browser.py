"""The viewer page in a real browser: what it shows, and what it does when somebody clicks."""

import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsers import Browser
from viewer_pages import hostile, look_at, written

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.export.exported import sure_part
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import in_memory


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
    colours = street.voxels.label_set.legend.colours.astype(float)
    colours[4:] += 0.35 * (255 - colours[4:])  # vegetation and `other` are inferred, so lighter
    before = browser.screenshot()
    assert all(count(before, colour) > 30 for colour in colours)
    boxes = "document.querySelectorAll('#layers input')"
    names = browser.run(
        "return [...document.querySelectorAll('#layers label')].map(l => l.childNodes[2].textContent)"
    )
    assert names == [*street.voxels.label_set.legend.names, "unlabelled", "track", "removed"]
    browser.run(f"{boxes}[3].click()")
    without = browser.screenshot()
    assert count(without, colours[3]) == 0
    assert count(without, colours[0]) > 0.9 * count(before, colours[0])
    browser.run(f"{boxes}[3].click()")
    np.testing.assert_array_equal(browser.screenshot(), before)
    browser.run(f"{boxes}[8].click()")
    assert (browser.screenshot() != before).any()


def changed(change: str, centre_m: tuple[float, float, float]) -> dict[str, Any]:
    return {
        "change": change, "class": "vehicle", "kind": "parked", "before": "monday", "after": "tuesday",
        "centre_m": centre_m, "size_m": [4.0, 2.0, 1.5], "yaw_deg": 90.0,
    }  # fmt: skip


def test_what_changed_is_a_layer_of_boxes_that_say_what_they_are(
    browser: Browser, street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    written(
        tmp_path, street, track, changes=[changed("appeared", (30, 1, 3)), changed("vanished", (20, 1, 3))]
    )
    browser.open((tmp_path / "viewer.html").as_uri() + "#hide=track")
    rows = "return [...document.querySelectorAll('#layers label')].map(l => l.textContent)"
    assert {"appeared1", "vanished1"} <= set(browser.run(rows))
    # from above, a box is its outline: in its middle is the road, and on its edge it says what it is
    look_at(browser, (30, 1, 3), 30)
    browser.run("camera.azimuth = 0; camera.elevation = 1.5707; draw();")
    shown = browser.screenshot()
    assert count(shown, np.array([80.0, 230, 255])) > 100
    pick = "pick({ clientX: innerWidth / 2 + %d, clientY: innerHeight / 2 });"
    pixels = browser.run("return 0.9 * innerHeight") / (30 - 0.75)
    said = []
    for east in (0, 1):
        browser.run(pick % round(east * pixels))
        said.append(browser.run("return document.getElementById('picked').textContent"))
    assert said[0].startswith("road")
    assert said[1].startswith(
        "vehicle appeared (parked), 4.0 x 2.0 x 1.5 m, between monday and tuesday\nmap: east 31.0 m"
    )
    browser.run(
        "[...document.querySelectorAll('#layers label')].find(l => l.textContent === 'appeared1').click()"
    )
    assert count(browser.screenshot(), np.array([80.0, 230, 255])) == 0


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


def said_at_the_middle(browser: Browser) -> str:
    browser.run("draw(); pick({ clientX: innerWidth / 2, clientY: innerHeight / 2 });")
    return str(browser.run("return document.getElementById('picked').textContent"))


def test_a_click_tells_the_place_on_earth_as_pyproj_does(
    browser: Browser, street: SemanticMap, tmp_path: Path
) -> None:
    georeference = Georeference(LocalFrame(49.0, 8.4, 100.0))
    written(tmp_path, street, None, georeference=georeference)
    browser.open((tmp_path / "viewer.html").as_uri())
    look_at(browser, (30, 1, 0), 20)
    browser.run("camera.elevation = 1.5")
    said = said_at_the_middle(browser)
    assert "WGS 84 / UTM zone 32N (EPSG:32632): " in said
    place = [float(number) for number in re.findall(r"(-?\d+\.\d) (?:E|N|m above)", said)]
    p_map = np.array([[float(number) for number in re.findall(r"(?:east|north|up) (-?\d+\.\d) m", said)]])
    assert place == pytest.approx(georeference.from_map(p_map)[0], abs=0.11)
    degrees = [float(number) for number in re.findall(r"(\d+\.\d+)°", said)]
    lat_deg, lon_deg, _ = georeference.frame.to_geodetic(p_map)
    assert degrees == pytest.approx([lat_deg[0], lon_deg[0]], abs=2e-6)


def test_the_distance_of_clicks_is_that_of_their_places(
    browser: Browser, street: SemanticMap, tmp_path: Path
) -> None:
    written(tmp_path, street, None)
    browser.open((tmp_path / "viewer.html").as_uri() + "#hide=unlabelled,other")  # nothing grey but the line
    browser.run("camera.elevation = 1.5; document.getElementById('measure').click()")
    before = count(browser.screenshot(), np.ones(3))
    places = [(30, 1, 0), (20, 1, 0), (20, -3, 0)]
    for place in places:
        look_at(browser, place, 20)
        said = said_at_the_middle(browser)
    found = [float(number) for number in re.findall(r"(\d+\.\d) m", said)]
    assert said.startswith("distance ")
    assert found[:2] == pytest.approx([4, 4], abs=0.41)  # a voxel at each end
    assert "\n2 parts: " in said
    assert found[3] == pytest.approx(14, abs=0.81)
    assert count(browser.screenshot(), np.ones(3)) > before + 50
    assert (
        said_at_the_middle(browser).splitlines()[:2] == said.splitlines()[:2]
    )  # the same place is no corner
    browser.run("document.getElementById('measure').click()")
    assert not said_at_the_middle(browser).startswith("distance")


def test_labels_below_the_least_confidence_are_shown_as_a_map_without_them_is(
    browser: Browser, street: SemanticMap, tmp_path: Path
) -> None:
    pictures = []
    for shown, view in ((street, "&least=0.7"), (sure_part(in_memory(street), 0.7).whole(), "")):
        written(tmp_path, shown, None)
        browser.open(f"{(tmp_path / 'viewer.html').as_uri()}#at=30,0,0,60,10,40&hide={view}")
        pictures.append(browser.screenshot())
    np.testing.assert_array_equal(*pictures)
    written(tmp_path, street, None)
    browser.open((tmp_path / "viewer.html").as_uri() + "#at=30,0,0,60,10,40&hide=")
    assert (browser.screenshot() != pictures[0]).any(axis=2).mean() > 0.02
    browser.run(
        "const slider = document.getElementById('least'); slider.value = 0.7;"
        "slider.dispatchEvent(new Event('input')); draw();"
    )
    np.testing.assert_array_equal(browser.screenshot(), pictures[0])
    assert browser.run("return link()").endswith("&hide=&least=0.7")
    for nonsense in ("2", "-1", "x"):
        browser.run(f"location.hash = '#least={nonsense}'")
        time.sleep(0.2)
        assert browser.run("return leastConfidence") == (1 if nonsense == "2" else 0)


def test_the_page_says_what_lighter_means_where_something_is(
    browser: Browser, street: SemanticMap, tmp_path: Path
) -> None:
    for shown, is_said in ((street, True), (street[~street.inferred], False)):
        written(tmp_path, shown, None)
        browser.open((tmp_path / "viewer.html").as_uri())
        said = "colourBy('%s'); return !document.getElementById('lighter').hidden"
        assert [browser.run(said % mode) for mode in ("class", "height")] == [is_said, False]


def test_the_address_of_a_view_shows_the_same_picture(
    browser: Browser, street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    written(tmp_path, street, track)
    page = (tmp_path / "viewer.html").as_uri()
    browser.open(page)
    first = browser.screenshot()
    browser.run(
        "camera.azimuth = 1; camera.elevation = 0.7; zoom(0.5);"
        "document.querySelectorAll('#layers input')[3].click();"
        "document.querySelectorAll('#layers input')[8].click();"
        "document.querySelector('select').value = 'confidence';"
        "document.querySelector('select').dispatchEvent(new Event('change'));"
    )
    seen = browser.screenshot()
    for _ in range(100):
        if "colour=confidence" in (link := browser.run("return location.href")):
            break
        time.sleep(0.05)
    assert (first != seen).any()
    browser.open(link)
    assert browser.run("return [...document.querySelectorAll('#layers input')].map(b => b.checked)") == [
        True, True, True, False, True, True, False, True, True,
    ]  # fmt: skip
    assert (browser.screenshot() != seen).any(axis=2).mean() < 0.02
    # pasted into the address of an open page
    browser.run("location.hash = '#at=30,1,0,20,0,86&colour=height&hide='")
    time.sleep(0.2)
    assert browser.run("return [mode, camera.distance * meta.voxel_m, visible.every(Boolean)]") == [
        1,
        20,
        True,
    ]
    browser.run("location.hash = '#at=1,2,x,4,5,6&colour=nothing&hide=nobody'")
    time.sleep(0.2)
    assert browser.run("return [mode, camera.distance * meta.voxel_m]") == [0, 20]


def test_every_colour_mode_has_a_legend_of_what_it_shows(
    browser: Browser, street: SemanticMap, track: Trajectory, tmp_path: Path
) -> None:
    written(tmp_path, street, track)
    browser.open((tmp_path / "viewer.html").as_uri())
    shown = {
        mode: browser.run(
            f"colourBy('{mode}'); return ['ramp', 'origins'].map(id => !document.getElementById(id).hidden).concat("
            "[...document.querySelectorAll('#layers i')].map(i => i.style.visibility === 'visible'))"
        )
        for mode in ("class", "height", "confidence", "origin")
    }
    classes, unlabelled, track_and_removed = [True] * 6, [True], [True] * 2
    assert shown == {
        "class": [False, False, *classes, *unlabelled, *track_and_removed],
        "height": [True, False, *[False] * 7, *track_and_removed],
        "confidence": [True, False, *[False] * 6, *unlabelled, *track_and_removed],
        "origin": [False, True, *[False] * 7, *track_and_removed],
    }
    assert browser.run("return document.getElementById('origins').childElementCount") == len(State) - 1


def test_two_fingers_move_the_map_by_as_much_as_they_move(
    browser: Browser, street: SemanticMap, tmp_path: Path
) -> None:
    written(tmp_path, street, None)
    browser.open((tmp_path / "viewer.html").as_uri())
    look_at(browser, (30, 1, 0), 20)
    browser.run("camera.azimuth = 0; camera.elevation = 1.55; draw()")
    steps = range(0, 61, 10)
    fingers = [pointer(str(x), "touch", *((x + step, 300) for step in steps)) for x in (350, 550)]
    browser.ask("/actions", actions=fingers)
    metres = browser.run("return 60 * 20 / (0.9 * innerHeight)")
    east, distance = browser.run(
        "return [(camera.target[0] + meta.origin[0]) * meta.voxel_m, camera.distance * meta.voxel_m]"
    )
    assert 30 - east == pytest.approx(metres, rel=0.05)
    assert distance == pytest.approx(20, rel=0.05)

"""A function of the user's own is as good a segmenter as any."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.sensor_log import Image

URBAN = open_label_set("urban")
PIXELS = np.random.default_rng(5).integers(0, 256, (9, 13, 3), dtype=np.uint8)

MODULE = """
import numpy as np

def by_colour(pixels):
    p = pixels[::2, ::2][:len(pixels) // 2, :pixels.shape[1] // 2].astype(np.float32) + 1
    return p / p.sum(2, keepdims=True)

by_colour.class_names = ("road", "vegetation", "sky")

def unnamed(pixels):
    return by_colour(pixels)

def eleven(pixels):
    return np.full((*pixels.shape[:2], 11), 1 / 11, np.float32)

def logits(pixels):
    return by_colour(pixels) - 2

def wrong_size(pixels):
    return by_colour(pixels)[:-1]

def wrong_count(pixels):
    return by_colour(pixels)[:, :, :2]

for function in (logits, wrong_size, wrong_count):
    function.class_names = by_colour.class_names

number = 3
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    name = f"my_network_{tmp_path.name}".replace("-", "_")
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    return name


def camera() -> Image:
    return Image(4, 0.4, lambda: PIXELS)


@pytest.mark.parametrize(("name", "query"), [("by_colour", ""), ("unnamed", "?classes=road,vegetation,sky")])
def test_a_functions_probabilities_come_through(module: str, name: str, query: str) -> None:
    segment = open_segmenter(f"python:{module}:{name}{query}", URBAN)
    assert segment.class_names == ("road", "vegetation", "sky")
    cut = PIXELS[:8:2, :12:2].astype(np.float32) + 1
    np.testing.assert_allclose(segment(camera()), cut / cut.sum(2, keepdims=True), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "message"),
    [("logits", "negative"), ("wrong_size", "6 x 3 pixels"), ("wrong_count", r"expected \(h, w, 3\)")],
)
def test_what_is_no_probabilities_is_refused_with_the_image(module: str, name: str, message: str) -> None:
    segment = open_segmenter(f"python:{module}:{name}", URBAN)
    with pytest.raises(DataError, match=rf"{name} on image 4: .*{message}"):
        segment(camera())


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("{}:unnamed", "has no class_names"),
        ("{}:nothing", "has no 'nothing'"),
        ("{}:number", "found int, expected a callable"),
        ("{}", "expected python:package.module:callable"),
        ("no_such_module_anywhere:f", "PYTHONPATH"),
        ("{}:by_colour?classes=road,vegetation", "found 3 classes, and 2"),
        ("{}:by_colour?classes=road,vegetation,skye", "did you mean 'sky'"),
    ],
)
def test_a_callable_that_is_not_there_or_not_named_is_refused(module: str, place: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        open_segmenter(f"python:{place.format(module)}", URBAN)


def test_classes_may_be_those_of_a_taxonomy_and_void_is_dropped(module: str) -> None:
    of_camvid = open_segmenter(f"python:{module}:eleven?classes=camvid", URBAN)
    assert len(of_camvid.class_names) == 11
    assert of_camvid(camera()).shape == (9, 13, 11)
    segment = open_segmenter(f"python:{module}:by_colour?classes=road,void,sky", URBAN)
    assert segment.class_names == ("road", "sky")
    whole = open_segmenter(f"python:{module}:by_colour", URBAN)(camera())
    np.testing.assert_array_equal(segment(camera()), whole[:, :, [0, 2]])
    URBAN.table_from(segment.class_names)  # each is known


def test_a_missing_package_is_told_from_a_missing_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "needs_more.py").write_text("import a_package_nobody_has\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        ConfigError, match="No module named 'a_package_nobody_has'; it imports that: install it"
    ):
        open_segmenter("python:needs_more:f", URBAN)


def test_any_error_inside_is_one_line_with_image_and_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "def f(pixels):\n    raise KeyError('a\\nb')\nf.class_names = ('road', 'car')\n"
    (tmp_path / "breaks.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(DataError, match=r"python:breaks:f on image 4 of 13 x 9 pixels: KeyError") as caught:
        open_segmenter("python:breaks:f", URBAN)(camera())
    assert "\n" not in str(caught.value)

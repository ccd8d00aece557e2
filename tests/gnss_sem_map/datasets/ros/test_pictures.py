"""Images of every encoding have the colours that were encoded, and cameras the lens and the region that they say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import ros
from numpy.typing import NDArray
from ros import START_NS

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.datasets.ros.contents import contents_of, suggested_rig
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.structured import parse_yaml

HEIGHT, WIDTH = 4, 6
RED, GREEN, BLUE = 200, 120, 40
COLOUR = np.full((HEIGHT, WIDTH, 3), (RED, GREEN, BLUE), np.uint8)


def mosaic(pattern: str) -> NDArray[np.uint8]:
    """What a sensor with this pattern of filters sees of one colour."""
    values = {"r": RED, "g": GREEN, "b": BLUE}
    return np.tile([[values[c] for c in pattern[:2]], [values[c] for c in pattern[2:]]], (2, 3)).astype(
        np.uint8
    )


def yuv(is_chroma_first: bool) -> NDArray[np.uint8]:
    """BT.601 with 16 to 235, as cameras send it: each two pixels share their chroma."""
    r, g, b = RED / 255, GREEN / 255, BLUE / 255
    luma = 0.299 * r + 0.587 * g + 0.114 * b
    y = round(16 + 219 * luma)
    u, v = (
        round(128 + 224 * 0.5 * (b - luma) / (1 - 0.114)),
        round(128 + 224 * 0.5 * (r - luma) / (1 - 0.299)),
    )
    pair = [u, y, v, y] if is_chroma_first else [y, u, y, v]
    return np.tile(np.array(pair, np.uint8), (HEIGHT, WIDTH // 2)).reshape(HEIGHT, WIDTH, 2)


def wide(pixels: NDArray[np.uint8], is_bigendian: bool = False) -> NDArray[np.uint8]:
    """The same in 16 bits, as bytes."""
    numbers = (pixels.astype(np.uint16) * 257).astype(">u2" if is_bigendian else "<u2")
    return numbers.reshape(HEIGHT, -1).view(np.uint8)


def read(
    path: Path, pixels: NDArray[np.uint8], encoding: str, is_bigendian: bool = False, step: int = 0
) -> Any:
    rig = ros.with_camera()
    rig.image(START_NS, pixels.reshape(HEIGHT, WIDTH, -1), encoding, step or None)
    rig.messages[-1][2].is_bigendian = int(is_bigendian)
    [image] = open_drive(ros.write(path / "drive", rig)).images
    return image.read()


OPAQUE = np.full((HEIGHT, WIDTH, 1), 7, np.uint8)
PATTERNS = ("rggb", "bggr", "gbrg", "grbg")
GREY = np.full((HEIGHT, WIDTH), 90, np.uint8)
WHOLE = {
    "rgb": COLOUR,
    "bgr": COLOUR[..., ::-1],
    "rgba": np.dstack([COLOUR, OPAQUE]),
    "bgra": np.dstack([COLOUR[..., ::-1], OPAQUE]),
    **{f"bayer_{pattern}": mosaic(pattern) for pattern in PATTERNS},
}


@pytest.mark.parametrize("name", WHOLE)
@pytest.mark.parametrize("step", [0, 60])
def test_colours_of_8_bits_arrive(tmp_path: Path, name: str, step: int) -> None:
    np.testing.assert_array_equal(read(tmp_path, WHOLE[name], f"{name}8", step=step), COLOUR)


@pytest.mark.parametrize("name", WHOLE)
@pytest.mark.parametrize("is_bigendian", [False, True])
def test_colours_of_16_bits_arrive(tmp_path: Path, name: str, is_bigendian: bool) -> None:
    pixels = wide(np.ascontiguousarray(WHOLE[name]), is_bigendian)
    np.testing.assert_array_equal(read(tmp_path, pixels, f"{name}16", is_bigendian), COLOUR)


@pytest.mark.parametrize(
    ("encoding", "is_chroma_first"),
    [("yuv422", True), ("uyvy", True), ("yuv422_yuy2", False), ("yuyv", False)],
)
def test_colours_with_half_the_chroma_arrive(tmp_path: Path, encoding: str, is_chroma_first: bool) -> None:
    found = read(tmp_path, yuv(is_chroma_first), encoding)
    np.testing.assert_allclose(found.astype(int), COLOUR.astype(int), atol=3)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_of_8_bits_arrives(tmp_path: Path, encoding: str) -> None:
    np.testing.assert_array_equal(read(tmp_path, GREY, encoding), np.dstack([GREY] * 3))


@pytest.mark.parametrize("factor", [257, 16])
def test_grey_of_16_bits_and_of_12_in_them_arrives(tmp_path: Path, factor: int) -> None:
    pixels = GREY.astype(np.uint16) * factor
    np.testing.assert_array_equal(read(tmp_path, pixels.view(np.uint8), "mono16"), np.dstack([GREY] * 3))


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("said", ["bayer_{}8; png compressed ", "bayer_{}8; png compressed bgr8"])
def test_a_mosaic_that_was_compressed_has_its_colours(tmp_path: Path, pattern: str, said: str) -> None:
    """Drivers compress the mosaic itself, or the colours."""
    rig = ros.with_camera()
    pixels = COLOUR[..., ::-1] if "bgr8" in said else mosaic(pattern)
    rig.compressed(START_NS, cv2.imencode(".png", pixels)[1].tobytes())
    rig.messages[-1][2].format = said.format(pattern)
    [image] = open_drive(ros.write(tmp_path / "drive", rig)).images
    np.testing.assert_array_equal(image.read(), COLOUR)


@pytest.mark.parametrize(
    ("said", "content"),
    [("16UC1; compressedDepth png", b"\0" * 12 + b"\x89PNG\r\n\x1a\n"), ("h264", b"\0\0\0\1gB")],
)
def test_what_is_compressed_otherwise_is_no_camera(tmp_path: Path, said: str, content: bytes) -> None:
    rig = ros.with_camera()
    rig.compressed(START_NS, content)
    rig.messages[-1][2].format = said
    path = ros.write(tmp_path / "drive", rig)
    [topic] = [one for one in contents_of(Bag(path)) if one.name == "/image_rect/compressed"]
    assert topic.taken_for == ""
    assert topic.notes[0].startswith(f"not read: its images have the encoding {said}")
    log = open_drive(path)
    assert log.images == ()
    assert any(skip.what == "image" and said in skip.reason for skip in log.skips)


@pytest.mark.parametrize("encoding", ["nv12", "NV21"])
def test_pictures_with_their_colours_below_are_as_opencv_makes_them(tmp_path: Path, encoding: str) -> None:
    rig = ros.with_camera()
    rows = np.random.default_rng(0).integers(16, 235, (6, 6), np.uint8)
    rig.image(START_NS, rows, encoding, step=8)
    rig.messages[-1][2].height = 4
    [image] = open_drive(ros.write(tmp_path / "drive", rig)).images
    code = getattr(cv2, f"COLOR_YUV2RGB_{encoding.upper()}")
    np.testing.assert_array_equal(image.read(), cv2.cvtColor(rows, code))


@pytest.mark.parametrize("encoding", ["RGB8", "Bgr8"])
def test_encodings_may_have_capital_letters(tmp_path: Path, encoding: str) -> None:
    rig = ros.with_camera()
    rig.image(START_NS, COLOUR if encoding == "RGB8" else COLOUR[..., ::-1], encoding)
    [image] = open_drive(ros.write(tmp_path / "drive", rig)).images
    np.testing.assert_array_equal(image.read(), COLOUR)


@pytest.mark.parametrize("said", ["", "bgr8", "jpeg"])
def test_a_png_is_read_whatever_it_says(tmp_path: Path, said: str) -> None:
    rig = ros.with_camera()
    rig.compressed(START_NS, cv2.imencode(".png", COLOUR[..., ::-1])[1].tobytes())
    rig.messages[-1][2].format = said
    [image] = open_drive(ros.write(tmp_path / "drive", rig)).images
    np.testing.assert_array_equal(image.read(), COLOUR)


def test_depth_beside_colours_is_no_camera(tmp_path: Path) -> None:
    rig = ros.with_camera()
    rig.image(START_NS, COLOUR, "rgb8", topic="/color/image_raw")
    rig.image(START_NS, np.zeros((HEIGHT, WIDTH, 2), np.uint8), "16UC1", topic="/depth/image_rect_raw")
    bag = Bag(ros.write(tmp_path / "drive", rig))
    rig_file = parse_yaml(suggested_rig(bag, contents_of(bag)))
    assert [one["topic"] for one in rig_file["cameras"].values()] == ["/color/image_raw"]


def test_a_mosaic_of_one_pixel_is_an_error_of_ours(tmp_path: Path) -> None:
    rig = ros.with_camera()
    rig.info(START_NS + 1, topic="/one/camera_info")
    rig.messages[-1][2].width = rig.messages[-1][2].height = 1
    rig.image(START_NS, np.zeros((1, 1), np.uint8), "yuv422", 2, topic="/one/image_rect")
    [image] = open_drive(ros.write(tmp_path / "drive", rig)).images
    with pytest.raises(
        DataError, match=r"/one/image_rect: message 0: 1 x 1 pixels are too few or odd for YUV"
    ):
        image.read()


# the camera's CameraInfo


def camera(path: Path, topic: str = "/image_raw", **info: Any) -> Any:
    rig = ros.with_camera(**{key: info.pop(key) for key in ("d", "model") if key in info})
    message = next(one for name, _, one in rig.messages if name == "/camera_info")
    region = info.pop("roi", None)
    for key, value in info.items():
        setattr(message, key, value)
    if region is not None:
        message.roi.x_offset, message.roi.y_offset, message.roi.width, message.roi.height = region
    rig.image(START_NS, np.zeros((4, 6, 3), np.uint8), "rgb8", topic=topic)
    [found] = open_drive(ros.write(path / "drive", rig)).calibration.cameras
    return found


@pytest.mark.parametrize("topic", ["/image_raw", "/image_rect"])
def test_binned_images_of_a_region_have_its_pixels(tmp_path: Path, topic: str) -> None:
    """A point that the whole sensor sees at u, v is at (u - x) / binning of the image."""
    found = camera(
        tmp_path, topic, width=1000, height=800, binning_x=2, binning_y=4, roi=(100, 40, 600, 400),
        d=(0.0,) * 5,
    )  # fmt: skip
    assert found.image_size == (300, 100)
    point = np.array([0.3, -0.1, 2.0])
    u, v = 100 * 0.15 + 3, 100 * -0.05 + 2
    pixel = found.K @ point / point[2]
    np.testing.assert_allclose(pixel[:2], [(u - 100) / 2, (v - 40) / 4])


@pytest.mark.parametrize("binning", [0, 1])
def test_without_binning_and_region_the_images_are_of_the_whole_sensor(tmp_path: Path, binning: int) -> None:
    found = camera(tmp_path, binning_x=binning, binning_y=binning)
    assert found.image_size == (6, 4)
    np.testing.assert_array_equal(found.K, [[100, 0, 3], [0, 100, 2], [0, 0, 1]])


K1 = (0.1, -0.02, 0.001, 0.002)


@pytest.mark.parametrize(
    ("model", "d", "expected"),
    [
        ("kannala_brandt4", K1, ("fisheye", K1)),
        ("equidistant", K1, ("fisheye", K1)),
        ("equidistant", (), ("fisheye", (0.0,) * 4)),
        ("none", (), None),
        ("", (), None),
        ("none", (0.0,) * 5, None),
        ("", (0.0,) * 5, None),
        ("plumb_bob", (*K1, 0.3), ("brown", (*K1, 0.3))),
        ("plumb_bob", K1, ("brown", K1)),
        ("rational_polynomial", (*K1, 0.3, 0.4, 0.5, 0.6), ("brown", (*K1, 0.3, 0.4, 0.5, 0.6))),
        ("rational_polynomial", (*K1, 0.3, 0.4, 0.5, 0.6, *[0.0] * 4), ("brown", (*K1, 0.3, 0.4, 0.5, 0.6))),
        ("rational_polynomial", (*K1, 0.3, 0.4, 0.5, 0.6, *[0.0] * 6), ("brown", (*K1, 0.3, 0.4, 0.5, 0.6))),
        ("thin_prism", (*K1, 0.3, 0.4, 0.5, 0.6, *[0.0] * 4), ("brown", (*K1, 0.3, 0.4, 0.5, 0.6))),
    ],
)
def test_lenses_are_those_of_the_camera_info(tmp_path: Path, model: str, d: Any, expected: Any) -> None:
    found = camera(tmp_path, model=model, d=d).distortion
    assert (None if found is None else (found.model, found.coefficients)) == expected


@pytest.mark.parametrize(
    ("model", "d"), [("rational_polynomial", (*K1, *[0.1] * 8)), ("none", K1), ("omni", K1)]
)
def test_a_lens_that_we_do_not_have_is_named(tmp_path: Path, model: str, d: Any) -> None:
    with pytest.raises(
        DataError, match=rf"/camera_info: found distortion model '{model}' with {len(d)} coeff.*set K"
    ):
        camera(tmp_path, model=model, d=d)

"""Label images of public data sets, written as these write them: the same scene is the same classes in each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Picture

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.labels.label_set import open_label_set, taxonomy
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.sensor_log import Image

URBAN = open_label_set("urban")
NAMES = (*URBAN.names, "other")
SCENE = np.random.default_rng(5).choice(
    ["road", "sidewalk", "building", "vegetation", "car", "sky"],
    size=(24, 40), p=[0.35, 0.1, 0.2, 0.15, 0.1, 0.1],
)  # fmt: skip
TARGET = {"car": "vehicle", "sky": "other"}
TRUTH = np.vectorize(lambda name: NAMES.index(TARGET.get(name, name)))(SCENE)
MAPILLARY = {name: name.capitalize() for name in np.unique(SCENE)}
CAMVID = {"sidewalk": "pavement", "vegetation": "tree"}


def ids(kind: str, source: str = "cityscapes", names: dict[str, str] | None = None) -> np.ndarray:
    table = taxonomy(source).ids[kind]
    return np.vectorize(lambda name: table[(names or {}).get(name, name)])(SCENE)


def rgb(source: str, names: dict[str, str] | None = None) -> np.ndarray:
    packed = ids("colour", source, names)
    return np.dstack([packed >> 16, packed >> 8 & 255, packed & 255]).astype(np.uint8)


def grey_as_colours(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[..., None].astype(np.uint8), 3, axis=2)


def save(path: Path, pixels: np.ndarray, palette: list[int] | None = None, **how: Any) -> None:
    picture = Picture.fromarray(pixels)
    if palette is not None:
        picture.putpalette(palette)
    picture.save(path, **how)


def palette_of(source: str, kind: str) -> list[int]:
    colours = np.random.default_rng(6).integers(0, 256, (256, 3))  # those without a class are anything
    about = taxonomy(source)
    for name, number in about.ids[kind].items():
        packed = about.ids["colour"][name]
        colours[number] = packed >> 16, packed >> 8 & 255, packed & 255
    return [int(v) for v in colours.ravel()]


def classes_seen(folder: Path, number: int = 3, more: str = "") -> np.ndarray:
    segment = open_segmenter(f"labels:{folder}{more}", URBAN, sizes={"": (40, 24)})
    seen = segment(Image(number, 0.0, lambda: np.zeros((1, 1, 3), np.uint8)))
    return np.where(seen.any(2), seen.argmax(2), -1)


def voc_palette() -> list[int]:
    """Of Pascal VOC, with which many tools write ids: its colours mean nothing here."""
    table = np.zeros((256, 3), int)
    for i in range(256):
        for bit in range(8):
            for channel in range(3):
                table[i, channel] |= (i >> (3 * bit + channel) & 1) << (7 - bit)
    return [int(v) for v in table.ravel()]


WRITERS = {
    "Cityscapes trainIds": lambda f: save(f / "3.png", ids("train_id").astype(np.uint8)),
    "Cityscapes labelIds": lambda f: save(f / "3.png", ids("label_id").astype(np.uint8)),
    "Cityscapes colours": lambda f: save(f / "aachen_000003_000019_gtFine_color.png", rgb("cityscapes")),
    "Cityscapes colours, RGBA": lambda f: save(
        f / "000003_color.png", np.dstack([rgb("cityscapes"), np.full((24, 40), 255, np.uint8)])
    ),
    "Cityscapes palette of trainIds": lambda f: save(
        f / "3.png", ids("train_id").astype(np.uint8), palette_of("cityscapes", "train_id")
    ),
    "trainIds by a palette of another data set": lambda f: save(
        f / "3.png", ids("train_id").astype(np.uint8), voc_palette()
    ),
    "labelIds of 16 bits": lambda f: save(f / "3.png", ids("label_id").astype(np.uint16)),
    "trainIds of 16 bits": lambda f: save(f / "3.png", ids("train_id").astype(np.uint16)),
    "Cityscapes instanceIds": lambda f: save(
        f / "aachen_000003_000019_gtFine_instanceIds.png",
        np.where(SCENE == "car", 26_007, ids("label_id")).astype(np.uint16),
    ),
    "KITTI-360 instance": lambda f: save(
        f / "0000000003.png", (ids("label_id") * 1000 + 12).astype(np.uint16)
    ),
    "KITTI instance_segmentation": lambda f: save(
        f / "000003_10.png", (ids("label_id") * 256 + 3).astype(np.uint16)
    ),
    "KITTI-360 semantic_rgb": lambda f: save(f / "0000000003.png", rgb("cityscapes")),
    "Mapillary palette": lambda f: save(
        f / "3.png", ids("id", "mapillary", MAPILLARY).astype(np.uint8), palette_of("mapillary", "id")
    ),
    "Mapillary colours": lambda f: save(f / "3.png", rgb("mapillary", MAPILLARY)),
    "CamVid colours": lambda f: save(f / "0001TP_000003_L.png", rgb("camvid", CAMVID)),
    "CamVid colours by a palette": lambda f: (
        Picture.fromarray(rgb("camvid", CAMVID)).quantize(16).save(f / "3.png")
    ),
    "Cityscapes colours by a palette of few bits": lambda f: (
        Picture.fromarray(rgb("cityscapes")).quantize(6).save(f / "3.png", bits=4)
    ),
    "trainIds in three equal channels": lambda f: save(f / "3.png", grey_as_colours(ids("train_id"))),
    "labelIds in three equal channels, with alpha": lambda f: save(
        f / "3.png", np.dstack([grey_as_colours(ids("label_id")), np.full((24, 40), 255, np.uint8)])
    ),
    "trainIds with void 19": lambda f: (
        save(f / "2.png", np.full((24, 40), 19, np.uint8)),
        save(f / "3.png", ids("train_id").astype(np.uint8)),
    ),
    "grey of 4 bits": lambda f: four_bits(f / "3.png", ids("train_id")),
}


def four_bits(path: Path, values: np.ndarray) -> None:
    """A grey PNG of 4 bits, which Pillow and OpenCV do not write."""
    import struct
    import zlib

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    rows = (values[:, ::2] << 4 | values[:, 1::2]).astype(np.uint8)
    body = b"".join(b"\0" + row.tobytes() for row in rows)
    head = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], 4, 0, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(body))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("name", WRITERS)
def test_label_images_of_any_data_set_are_read_without_a_setting(tmp_path: Path, name: str) -> None:
    WRITERS[name](tmp_path)
    np.testing.assert_array_equal(classes_seen(tmp_path), TRUTH)


@pytest.mark.parametrize(
    ("content", "more"),
    [
        (ids("id", "mapillary", MAPILLARY).astype(np.uint8), "?taxonomy=mapillary"),
        ((ids("id", "mapillary", MAPILLARY) * 256 + 9).astype(np.uint16), "?taxonomy=mapillary"),
        (ids("label_id").astype(np.uint8), "?ids=label_id"),
        (ids("train_id").astype(np.uint16), "?ids=train_id"),
        (ids("id", "camvid", CAMVID).astype(np.uint8), "?taxonomy=camvid"),
        (rgb("camvid", CAMVID), "?taxonomy=camvid&ids=colour"),
    ],
)
def test_what_values_cannot_tell_is_told(tmp_path: Path, content: np.ndarray, more: str) -> None:
    save(tmp_path / "3.png", content)
    np.testing.assert_array_equal(classes_seen(tmp_path, more=more), TRUTH)


def test_ids_of_ade20k_count_from_one_in_its_label_images(tmp_path: Path) -> None:
    names = {"vegetation": "tree"}
    for kind in ("label_id", "train_id"):
        save(tmp_path / "3.png", ids(kind, "ade20k", names).astype(np.uint8))
        seen = classes_seen(tmp_path, more=f"?taxonomy=ade20k&ids={kind}")
        np.testing.assert_array_equal(seen, TRUTH)


def test_ids_of_kitti_360_beyond_those_of_cityscapes_are_known(tmp_path: Path) -> None:
    values = ids("label_id").astype(np.uint8)
    values[0, :4] = 34, 37, 43, 0  # garage, smallpole, unknown vehicle, unlabelled
    save(tmp_path / "0000000250.png", values)
    seen = classes_seen(tmp_path, 250)
    assert [NAMES[k] for k in seen[0, :3]] == ["building", "other", "vehicle"]
    assert seen[0, 3] == -1


def test_of_labelids_no_file_is_taken_for_trainids(tmp_path: Path) -> None:
    """Eight of forty hold small ids only, which would be other classes as trainIds."""
    whole = ids("label_id").astype(np.uint8)
    small = np.where(whole > 18, 7, whole)
    for number in range(40):
        save(tmp_path / f"{number:06d}.png", small if number % 5 == 0 else whole)
    np.testing.assert_array_equal(classes_seen(tmp_path, 4), TRUTH)
    np.testing.assert_array_equal(classes_seen(tmp_path, 5), np.where(whole > 18, 0, TRUTH))


@pytest.mark.parametrize("others", [(8, 8), (11, 13)])
def test_ids_that_fit_both_are_asked_about(tmp_path: Path, others: tuple[int, int]) -> None:
    """As trainIds: vegetation, a person and a car; as labelIds: sidewalk, a building and a fence."""
    values = np.full((24, 40), 8, np.uint8)
    values[:6], values[6:12] = others
    save(tmp_path / "3.png", values)
    with pytest.raises(
        ConfigError, match=r"fit train_id as well as label_id.*\?ids=train_id or \?ids=label_id"
    ) as e:
        classes_seen(tmp_path)
    assert str(tmp_path) in str(e.value)
    for kind, name in (("train_id", "vegetation"), ("label_id", "sidewalk")):
        assert (classes_seen(tmp_path, more=f"?ids={kind}")[12:] == NAMES.index(name)).all()


STREET = np.repeat([["sky"], ["building"], ["vegetation"], ["road"]], 6, axis=0).repeat(40, axis=1)


@pytest.mark.parametrize(
    "values",
    [
        np.vectorize(lambda name: taxonomy("camvid").ids["id"][CAMVID.get(name, name)])(STREET),
        np.where(STREET == "road", 1, 0),
        np.where(STREET == "road", 0, 2) + np.where(STREET == "road", 3, 0),
    ],
)
def test_ids_with_which_roads_are_above_or_nowhere_are_asked_about(
    tmp_path: Path, values: np.ndarray
) -> None:
    """CamVid's, whose 0 is the sky; a mask of roads; fences in place of roads."""
    save(tmp_path / "3.png", values.astype(np.uint8))
    with pytest.raises(
        ConfigError, match=r"train_id of cityscapes, but then .*road.*\?taxonomy=.*\?ids=train_id"
    ):
        classes_seen(tmp_path)
    assert classes_seen(tmp_path, more="?ids=train_id").shape == (24, 40)


def test_a_time_as_a_name_is_no_frame_number(tmp_path: Path) -> None:
    for k in range(3):
        save(tmp_path / f"{1_780_000_000 + k / 10:.6f}.png", ids("train_id").astype(np.uint8))
    with pytest.raises(DataError, match=r"named by times.*frame numbers"):
        classes_seen(tmp_path)


def test_names_of_files_decide_before_ids(tmp_path: Path) -> None:
    for mark, kind in (("labelTrainIds", "train_id"), ("labelIds", "label_id")):
        folder = tmp_path / mark
        folder.mkdir()
        save(folder / f"0000000003_gtFine_{mark}.png", np.full((24, 40), 8, np.uint8))
        name = "vegetation" if kind == "train_id" else "sidewalk"
        assert (classes_seen(folder) == NAMES.index(name)).all()


def test_a_folder_of_cityscapes_has_one_file_of_each_kind_and_the_best_is_taken(tmp_path: Path) -> None:
    for number in (3, 4):
        stem = tmp_path / f"bonn_{number:06d}_000019_gtFine"
        save(Path(f"{stem}_color.png"), rgb("cityscapes"))
        save(Path(f"{stem}_labelIds.png"), ids("label_id").astype(np.uint8))
        save(Path(f"{stem}_instanceIds.png"), ids("label_id").astype(np.uint16))
        Path(f"{stem}_polygons.json").write_text("{}")
    np.testing.assert_array_equal(classes_seen(tmp_path, 4), TRUTH)
    np.testing.assert_array_equal(classes_seen(tmp_path, 4, "?ids=colour"), TRUTH)


@pytest.mark.parametrize(
    ("names", "number"),
    [
        (["0000000003_gtFine_labelTrainIds", "0000000004_gtFine_labelTrainIds"], 3),
        (["000003_10", "000004_10"], 3),
        (["frame_0003", "frame_0010"], 3),
        (["aachen_000000_000003_leftImg8bit", "aachen_000000_000004_leftImg8bit"], 3),
        (["left0003"], 3),
        (["seq1_0003_pred", "seq1_0012_pred"], 3),
        (["3", "3_color", "legend", "overview_2024"], 3),
    ],
)
def test_frame_numbers_are_found_in_names(tmp_path: Path, names: list[str], number: int) -> None:
    for name in names:
        save(tmp_path / f"{name}.png", ids("train_id").astype(np.uint8))
    np.testing.assert_array_equal(classes_seen(tmp_path, number), TRUTH)


def test_several_names_without_a_known_one_are_refused(tmp_path: Path) -> None:
    for name in ("left_3", "right_3"):
        save(tmp_path / f"{name}.png", ids("train_id").astype(np.uint8))
    with pytest.raises(DataError, match=r"found names such as .*left_3\.png"):
        classes_seen(tmp_path)


@pytest.mark.parametrize(
    ("content", "more", "message"),
    [
        (np.full((24, 40, 3), (1, 2, 3), np.uint8), "", r"\['#010203'\], which are no colour of cityscapes"),
        (np.random.default_rng(0).integers(0, 255, (24, 40, 3), np.uint8), "", "which are no colour of"),
        (
            np.full((24, 40), 120, np.uint8),
            "",
            r"ids \[120\], which are no train_id of cityscapes .*\?taxonomy=",
        ),
        (rgb("cityscapes"), "?taxonomy=ade20k", r"found \['#\w+', .*|found colours, expected train_id ids"),
        (rgb("cityscapes"), "?ids=train_id", "found colours, expected train_id ids, not colours"),
        (ids("train_id").astype(np.uint8), "?ids=colour", "found ids, expected colours"),
        (np.full((24, 40), 60_123, np.uint16), "?ids=label_id", r"ids \[60\]"),
    ],
)
def test_values_that_nobody_knows_are_named(
    tmp_path: Path, content: np.ndarray, more: str, message: str
) -> None:
    save(tmp_path / "3.png", content)
    with pytest.raises(DataError, match=message) as caught:
        classes_seen(tmp_path, more=more)
    assert "\n" not in str(caught.value)


def test_the_sixteen_bits_of_minus_one_are_void(tmp_path: Path) -> None:
    values = ids("label_id").astype(np.uint16)
    values[0] = 0xFFFF
    save(tmp_path / "3.png", values)
    seen = classes_seen(tmp_path)
    assert (seen[0] == -1).all()
    np.testing.assert_array_equal(seen[1:], TRUTH[1:])


def test_other_files_and_other_frames_are_named(tmp_path: Path) -> None:
    Picture.fromarray(rgb("cityscapes")).save(tmp_path / "3.jpg")
    with pytest.raises(
        DataError, match=r"found no <frame number>\.npz or \.png in it; found \.jpg there: save them as PNG"
    ):
        classes_seen(tmp_path)
    for number in (1000, 1039):
        save(tmp_path / f"{number}.png", ids("train_id").astype(np.uint8))
    with pytest.raises(DataError, match="no labels of frame 3; 2 frames have some, from 1000 to 1039"):
        classes_seen(tmp_path)

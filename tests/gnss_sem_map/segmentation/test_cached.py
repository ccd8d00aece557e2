"""Labels on disk: what comes back is what was written, and whatever is not right is named."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.files.archives import open_archive
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import MissingLabels, open_segmenter
from gnss_sem_map.segmentation.classes import unknown_classes
from gnss_sem_map.sensor_log import Image

URBAN = open_label_set("urban")
NAMES = (*URBAN.names, "other")


def frame(number: int) -> Image:
    """A camera image that nobody may decode."""

    def refuse() -> np.ndarray:
        raise AssertionError("cached labels must not decode the camera image")

    return Image(number, 0.1 * number, refuse)


def write_png(path: Path, ids: np.ndarray) -> None:
    assert cv2.imwrite(str(path), ids)


def write_npz(path: Path, probabilities: np.ndarray, names: tuple[str, ...] = NAMES) -> None:
    np.savez_compressed(path, probabilities=probabilities, class_names=np.array(names))


def some_probabilities(seed: int = 0, shape: tuple[int, ...] = (4, 6, 6)) -> np.ndarray:
    p = np.random.default_rng(seed).dirichlet(np.ones(shape[-1]), shape[:-1])
    return np.rint(255 * p).astype(np.uint8)


def test_probabilities_come_back_as_they_were_written(tmp_path: Path) -> None:
    written = some_probabilities()
    write_npz(tmp_path / "000007.npz", written)
    segment = open_segmenter(f"labels:{tmp_path}", URBAN, sizes={"": (13, 9)})
    assert segment.class_names == NAMES
    np.testing.assert_array_equal(segment(frame(7)), written)


@pytest.mark.parametrize("batch", [False, True])
def test_classes_may_be_the_first_axis(tmp_path: Path, batch: bool) -> None:
    """As networks have it, also in a batch of one."""
    written = some_probabilities(shape=(4, 7, len(NAMES)))
    first = written.transpose(2, 0, 1)
    write_npz(tmp_path / "0.npz", first[None] if batch else first)
    seen = open_segmenter(f"labels:{tmp_path}", URBAN, sizes={"": (7, 4)})(frame(0))
    np.testing.assert_array_equal(seen, written)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_floating_probabilities_come_as_float32(tmp_path: Path, dtype: type) -> None:
    written = (some_probabilities() / 255).astype(dtype)
    write_npz(tmp_path / "0.npz", written)
    seen = open_segmenter(f"labels:{tmp_path}", URBAN)(frame(0))
    assert seen.dtype == np.float32
    np.testing.assert_array_equal(seen, written.astype(np.float32))


def test_the_frame_number_is_the_key_however_it_is_padded(tmp_path: Path) -> None:
    for name, number in (("0000000003", 3), ("000012", 12), ("5", 5)):
        write_npz(tmp_path / f"{name}.npz", some_probabilities(number))
    segment = open_segmenter(f"labels:{tmp_path}", URBAN)
    for number in (3, 5, 12):
        np.testing.assert_array_equal(segment(frame(number)), some_probabilities(number))


def test_a_frame_without_labels_is_told_apart_from_a_broken_one(tmp_path: Path) -> None:
    write_npz(tmp_path / "1.npz", some_probabilities())
    (tmp_path / "2.npz").write_bytes((tmp_path / "1.npz").read_bytes()[:-40])
    segment = open_segmenter(f"labels:{tmp_path}", URBAN)
    with pytest.raises(MissingLabels, match="frame 9"):
        segment(frame(9))
    with pytest.raises(DataError, match=r"2\.npz: damaged") as caught:
        segment(frame(2))
    assert not isinstance(caught.value, MissingLabels)


@given(st.lists(st.sampled_from([0, 1, 2, 8, 13, 14, 10, 255]), min_size=6, max_size=6))
@settings(max_examples=25, deadline=None)
def test_a_train_id_becomes_soft_evidence_for_its_class_and_void_for_none(
    tmp_path_factory: pytest.TempPathFactory, ids: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("ids")
    write_png(folder / "0.png", np.array(ids, np.uint8).reshape(2, 3))
    seen = open_segmenter(f"labels:{folder}?ids=train_id", URBAN)(frame(0)).reshape(6, 6)
    target = {
        0: "road",
        1: "sidewalk",
        2: "building",
        8: "vegetation",
        13: "vehicle",
        14: "vehicle",
        10: "other",
    }
    for pixel, row in zip(ids, seen, strict=True):
        if pixel == 255:
            assert not row.any()
        else:
            assert NAMES[row.argmax()] == target[pixel]
            assert sorted(set(row.tolist())) == [round(255 * 0.1 / 5), round(255 * 0.9)]


def test_label_ids_are_read_when_the_spec_says_so(tmp_path: Path) -> None:
    write_png(tmp_path / "0.png", np.array([[7, 8, 11, 21, 26, 23, 0]], np.uint8))
    seen = open_segmenter(f"labels:{tmp_path}?ids=label_id", URBAN)(frame(0))
    assert [NAMES[k] for k in seen[0, :6].argmax(1)] == [
        "road",
        "sidewalk",
        "building",
        "vegetation",
        "vehicle",
        "other",
    ]
    assert not seen[0, 6].any()


def test_another_taxonomy_brings_its_own_ids(tmp_path: Path) -> None:
    write_png(tmp_path / "0.png", np.array([[3, 4, 11]], np.uint8))
    seen = open_segmenter(f"labels:{tmp_path}?taxonomy=camvid", URBAN)(frame(0))
    assert [NAMES[k] for k in seen[0, :2].argmax(1)] == ["road", "sidewalk"]
    assert not seen[0, 2].any()


def test_an_id_that_nobody_knows_is_named_with_its_file(tmp_path: Path) -> None:
    write_png(tmp_path / "0.png", np.zeros((2, 2), np.uint8))
    write_png(tmp_path / "4.png", np.array([[0, 77], [200, 1]], np.uint8))
    segment = open_segmenter(f"labels:{tmp_path}", URBAN)
    with pytest.raises(DataError, match=r"4\.png: found ids \[77, 200\]"):
        segment(frame(4))


def npz(**arrays: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: np.savez(folder / "0.npz", **arrays)


@pytest.mark.parametrize(
    ("kind", "shape", "message"),
    [
        ("<f3", (0,), "damaged file, or no .npz of plain arrays"),
        ("|u1", (0, 999_999_999_999_999_999, 99_999_999), "expected as many as that needs and at most"),
        ("|u1", (0, *[1] * 70), "71 dimensions, at most 32"),
    ],
)
def test_an_array_that_numpy_cannot_have_is_refused(
    tmp_path: Path, kind: str, shape: tuple[int, ...], message: str
) -> None:
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with zipfile.ZipFile(tmp_path / "0.npz", "w") as members:
        members.writestr("probabilities.npy", content)
    with (
        open_archive(tmp_path / "0.npz") as archive,
        pytest.raises(DataError, match=rf"0\.npz: .*{message}"),
    ):
        archive.array("probabilities").read()


GOOD = some_probabilities() / np.float32(255)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (npz(probabilities=some_probabilities()), "class_names"),
        (npz(class_names=np.array(NAMES)), "probabilities"),
        (npz(probabilities=some_probabilities(), class_names=np.array(NAMES[:5])), r"expected \(h, w, 5\)"),
        (npz(probabilities=GOOD[0], class_names=np.array(NAMES)), r"expected \(h, w, 6\)"),
        (npz(probabilities=GOOD.astype(np.int32), class_names=np.array(NAMES)), "int32"),
        (npz(probabilities=np.where(GOOD > 0.5, np.nan, GOOD), class_names=np.array(NAMES)), "not finite"),
        (npz(probabilities=-GOOD, class_names=np.array(NAMES)), "negative"),
        (npz(probabilities=9 * GOOD, class_names=np.array(NAMES)), "normalise"),
        (
            npz(probabilities=np.tile(np.eye(6, dtype=np.uint8), (4, 1, 1)), class_names=np.array(NAMES)),
            "expected 255",
        ),
        (npz(probabilities=some_probabilities(), class_names=np.arange(6)), "expected a list of names"),
        (
            npz(probabilities=some_probabilities(), class_names=np.array(NAMES, object)),
            "no .npz of plain arrays",
        ),
        (lambda folder: (folder / "0.npz").write_bytes(b""), "damaged"),
        (lambda folder: (folder / "0.npz").write_bytes(b"PK\x03\x04 nonsense"), "damaged"),
        (lambda folder: (folder / "0.png").write_bytes(b"\x89PNG\r\n"), "damaged"),
        (
            lambda folder: write_png(folder / "0.png", np.full((9, 13, 3), (9, 8, 7), np.uint8)),
            "found .'#070809'., which are no colour",
        ),
        (lambda folder: write_png(folder / "0.png", np.zeros((9, 13, 3), np.uint16)), "uint16"),
        (lambda folder: write_png(folder / "0.png", np.zeros((8, 13), np.uint8)), "13 x 8 pixels"),
        (lambda folder: write_npz(folder / "0.npz", some_probabilities(shape=(5, 6, 6))), "6 x 5 pixels"),
        (lambda folder: None, "no <frame number>"),
    ],
)
def test_what_is_not_right_is_refused_on_opening(
    tmp_path: Path, make: Callable[[Path], None], message: str
) -> None:
    make(tmp_path)
    with pytest.raises(DataError, match=message) as caught:
        open_segmenter(f"labels:{tmp_path}", URBAN, sizes={"": (13, 9)})
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("suffix", [".npz", ".png"])
def test_damaged_files_spoil_their_own_frames_only(tmp_path: Path, suffix: str) -> None:
    """Whichever they are: the first good one says what the others are like."""
    for number in range(50):
        if suffix == ".npz":
            write_npz(tmp_path / f"{number:06d}.npz", some_probabilities(number))
        else:
            write_png(tmp_path / f"{number:06d}.png", np.full((9, 13), number % 19, np.uint8))
    files = sorted(tmp_path.iterdir())
    for path in files[:-4]:
        path.write_bytes(path.read_bytes()[:-30])
    segment = open_segmenter(f"labels:{tmp_path}", URBAN, sizes={"": (13, 9)})
    assert segment.class_names == NAMES
    assert segment(frame(49)).shape[2] == 6
    with pytest.raises(DataError, match=r"000003.*damaged"):
        segment(frame(3))
    for path in files[-4:]:
        path.write_bytes(b"")
    with pytest.raises(
        DataError, match=r"000000.*damaged.*; none of 17 label files that were tried can be used"
    ):
        open_segmenter(f"labels:{tmp_path}", URBAN, sizes={"": (13, 9)})


def test_files_of_one_folder_agree_on_their_classes(tmp_path: Path) -> None:
    write_npz(tmp_path / "0.npz", some_probabilities())
    write_npz(tmp_path / "1.npz", some_probabilities(), NAMES[::-1])
    with pytest.raises(DataError, match=r"1\.npz: found classes"):
        open_segmenter(f"labels:{tmp_path}", URBAN)(frame(1))


def test_two_files_of_one_frame_are_refused(tmp_path: Path) -> None:
    for name in ("01.npz", "1.npz"):
        write_npz(tmp_path / name, some_probabilities())
    with pytest.raises(DataError, match="same frame"):
        open_segmenter(f"labels:{tmp_path}", URBAN)


def test_two_kinds_in_one_folder_are_refused(tmp_path: Path) -> None:
    write_npz(tmp_path / "0.npz", some_probabilities())
    write_png(tmp_path / "0.png", np.zeros((2, 2), np.uint8))
    with pytest.raises(DataError, match="both"):
        open_segmenter(f"labels:{tmp_path}", URBAN)


def test_the_folder_above_is_answered_with_the_folders_in_it(tmp_path: Path) -> None:
    (tmp_path / "probabilities").mkdir()
    with pytest.raises(DataError, match=r"did you mean .*probabilities"):
        open_segmenter(f"labels:{tmp_path}", URBAN)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("labels:", "found nothing after 'labels'"),
        ("labels", "found nothing after 'labels'"),
        ("lables:x", "unknown kind 'lables'"),
        ("labels:{}?idz=label_id", r"unknown options \['idz'\]"),
        ("labels:{}?", "found no options"),
        ("labels:{}?ids=lidar", "no ids 'lidar'"),
        ("labels:{}?taxonomy=mars", "mars"),
    ],
)
def test_a_wrong_description_says_what_was_expected(tmp_path: Path, spec: str, message: str) -> None:
    write_png(tmp_path / "0.png", np.zeros((2, 2), np.uint8))
    with pytest.raises(ConfigError, match=message):
        open_segmenter(spec.format(tmp_path), URBAN)


def test_classes_that_the_map_does_not_know_are_other_but_one_must_be_known(tmp_path: Path) -> None:
    names = ("road", "sidewalk", "vehicle", "building", "vegetatoin", "other")
    write_npz(tmp_path / "0.npz", some_probabilities(), names)
    segment = open_segmenter(f"labels:{tmp_path}", URBAN)
    said = unknown_classes(segment.class_names, URBAN)
    assert said == "1 of 6 class names are unknown and count as other: vegetatoin"
    assert URBAN.table_from(segment.class_names)[4].argmax() == 5
    write_npz(tmp_path / "0.npz", some_probabilities(), ("cat", "dog", "cow", "hen", "vegetatoin", "other"))
    with pytest.raises(ConfigError, match=r"none of its 6 class names is one of the map's: \['cat'"):
        open_segmenter(f"labels:{tmp_path}", URBAN)


def test_real_probabilities_and_real_train_ids_tell_the_same_story(real_data: Path) -> None:
    folder = real_data / "labels" / "kitti_raw_0005"
    soft = open_segmenter(f"labels:{folder / 'probabilities'}", URBAN, sizes={"": (1242, 375)})
    hard = open_segmenter(f"labels:{folder / 'trainids'}", URBAN, sizes={"": (1242, 375)})
    assert soft.class_names == hard.class_names == NAMES
    for number in (114, 153):
        ids = hard(frame(number))[:374:2, ::2].argmax(2)
        agreement = (soft(frame(number)).argmax(2) == ids).mean()
        assert agreement > 0.95  # they differ along borders only, where the half-size pixel holds two classes

"""The file of a classifier: it comes back with the same bits, and nothing else is taken for one."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import damage
import numpy as np
import pytest
from classifiers import SIZE_M, URBAN, random_classifier
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError
from gnss_sem_map.geometric_classifier import features, road_sidewalk
from gnss_sem_map.geometric_classifier.classifier import Classifier, folds_of, is_classifier, read
from gnss_sem_map.geometric_classifier.trees import BoostedTrees
from gnss_sem_map.runs.classifier_fitting import check_replaceable
from gnss_sem_map.voxels.voxel_map import pack

Arrays = dict[str, NDArray[Any]]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "classifier.npz"
    path.write_bytes(random_classifier().to_bytes())
    return path


def same(a: Classifier, b: Classifier) -> bool:
    arrays = ((getattr(x, f.name), getattr(y, f.name)) for x, y in zip(a.folds, b.folds, strict=True)
              for f in fields(BoostedTrees))  # fmt: skip
    return all(x.dtype == y.dtype and np.array_equal(x, y) for x, y in arrays) and (
        replace(a, folds=()).__dict__ == replace(b, folds=()).__dict__
    )


@pytest.mark.parametrize("uses_intensity", [False, True])
def test_a_classifier_comes_back_with_the_same_bits(tmp_path: Path, uses_intensity: bool) -> None:
    first, second = tmp_path / "first.npz", tmp_path / "second.npz"
    written = random_classifier(uses_intensity=uses_intensity)
    first.write_bytes(written.to_bytes(why=np.array([""])))
    found = read(first, URBAN, SIZE_M)
    assert same(found, written)
    second.write_bytes(found.to_bytes(why=np.array([""])))
    assert second.read_bytes() == first.read_bytes()
    assert is_classifier(first)


def rewritten(path: Path, **changes: Any) -> None:
    """The same file with other arrays; without those that are None."""
    with np.load(path) as arrays:
        content = {name: arrays[name] for name in arrays.files} | changes
    np.savez(path, **{name: array for name, array in content.items() if array is not None})


def replaced(name: str, content: bytes) -> Callable[[Path], None]:
    """The same file in which an array has another content."""

    def change(path: Path) -> None:
        old = zipfile.ZipFile(io.BytesIO(path.read_bytes()))
        with zipfile.ZipFile(path, "w") as new:
            for entry in old.namelist():
                new.writestr(entry, content if entry == f"{name}.npy" else old.read(entry))

    return change


def declared(shape: str) -> bytes:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(64)


def of_objects() -> bytes:
    file = io.BytesIO()
    np.save(file, np.array([{}], object), allow_pickle=True)
    return file.getvalue()


DAMAGE: dict[str, tuple[Callable[[Path], None], str]] = {
    "halved": (damage.halved, "damaged file"),
    "other bytes": (lambda p: p.write_bytes(np.random.default_rng(0).bytes(5000)) and None, "damaged file"),
    "empty": (lambda p: p.write_bytes(b"") and None, "damaged file"),
    "a pickle": (lambda p: p.write_bytes(pickle.dumps({"format": [1]})) and None, "damaged file"),
    "gone": (Path.unlink, "cannot be used"),
    "objects": (replaced("classes", of_objects()), "Python objects"),
    "huge leaves": (replaced("leaves_0", declared("(9000000000, 16)")), "at most"),
    "more leaves than there are": (replaced("leaves_1", declared("(1000000, 16)")), "as many as that needs"),
    "another format": (lambda p: rewritten(p, format=np.array([2])), "no classifier of format 1"),
    "no format": (lambda p: rewritten(p, format=None), "no classifier of format 1"),
    "other features": (
        lambda p: rewritten(p, features=np.array([*features.NAMES[:-1], "colour"])),
        "other features, of another version",
    ),
    "fewer features": (lambda p: rewritten(p, features=np.array(features.NAMES[:-1])), "other features"),
    "a model too few": (lambda p: rewritten(p, classes_1=None), "no classes_1"),
    "no trees": (lambda p: rewritten(p, leaves_1=np.zeros(0, np.float32)), "its arrays"),
    "leaves that are no number": (
        lambda p: rewritten(p, leaves_0=np.full((15, 16), np.nan, np.float32)),
        "leaves",
    ),
    "no temperature": (lambda p: rewritten(p, numbers=np.array([0.2, 0.0, 0.0])), "temperature"),
    "a temperature that vanishes": (
        lambda p: rewritten(p, numbers=np.array([0.2, 1e-300, 0.0])),
        "temperature",
    ),
    "a temperature without end": (lambda p: rewritten(p, numbers=np.array([0.2, np.inf, 0])), "temperature"),
    "whole numbers": (lambda p: rewritten(p, numbers=np.array([1, 1, 1])), "temperature"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_what_is_no_classifier_is_refused_in_one_line(file: Path, kind: str) -> None:
    change, why = DAMAGE[kind]
    change(file)
    with pytest.raises(DataError) as refused:
        read(file, URBAN, SIZE_M)
    said = str(refused.value)
    assert said.startswith(f"{file}: cannot be used as geometric classifier (")
    assert said.endswith("expected a file of `gnss-sem-map fit-classifier`")
    assert why in said
    assert "\n" not in said
    assert len(said) < 500 + len(str(file))


@given(st.data())
def test_a_file_with_other_numbers_is_refused_or_answers_with_numbers(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.getbasetemp() / "other_numbers.npz"
    path.write_bytes(CONTENT)
    with np.load(path) as arrays:
        names = [name for name in arrays.files if arrays[name].dtype.kind in "fi"]
        name = data.draw(st.sampled_from(names))
        changed = arrays[name]
    raw = changed.view(np.uint8).reshape(-1)
    for _ in range(data.draw(st.integers(1, 6))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    rewritten(path, **{name: changed})
    try:
        found = read(path, URBAN, SIZE_M)
    except DataError:
        return
    rows = np.zeros((3, len(features.NAMES)), np.float32)
    logs = found.log_probabilities(rows, pack(np.arange(9).reshape(3, 3)), np.ones(3, bool))
    assert np.isfinite(logs).all()


CONTENT = random_classifier().to_bytes()


def test_a_classifier_of_another_map_is_refused_with_what_the_map_has(file: Path) -> None:
    rewritten(file, classes=np.array(["road", "lawn", *URBAN.names[2:]]))
    says = r"classifier\.npz: is of the classes \['road', 'lawn'.*the map's are \['road', 'sidewalk'.*same class set$"
    with pytest.raises(DataError, match=says):
        read(file, URBAN, SIZE_M)
    rewritten(file, classes=np.array(["x" * 100_000] * 20))
    with pytest.raises(DataError, match="xxx") as refused:
        read(file, URBAN, SIZE_M)
    assert len(str(refused.value)) < 1000
    rewritten(file, classes=np.array(URBAN.names))
    says = r"classifier\.npz: is of voxels of 0\.2 m, the map's are 0\.1 m; fit .* the same voxels$"
    with pytest.raises(DataError, match=says):
        read(file, URBAN, 0.1)


def test_only_a_classifier_is_replaced(file: Path, tmp_path: Path) -> None:
    check_replaceable(file)
    check_replaceable(tmp_path / "new.npz")
    rewritten(file, classes=np.array(["of", "another", "map"]), format=np.array([7]))
    check_replaceable(file)
    np.savez(tmp_path / "other.npz", format=np.array([1]), classes=np.array(["road"]))
    (tmp_path / "note.txt").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for name in ("other.npz", "note.txt", "link", "."):
        with pytest.raises(
            DataError, match=r"there already, and is no geometric classifier; choose another -o$"
        ):
            check_replaceable(tmp_path / name)


def test_what_images_show_is_judged_by_the_model_of_the_other_colour_and_all_else_by_both() -> None:
    rng, whole = np.random.default_rng(1), random_classifier()
    rows = rng.normal(0, 2, (400, len(features.NAMES))).astype(np.float32)
    keys = pack(rng.integers(-200, 200, (400, 3)))
    folds, seen = folds_of(keys, SIZE_M), rng.random(400) < 0.5
    logs = whole.log_probabilities(rows, keys, seen)
    assert logs.shape == (400, len(URBAN.names) + 1)
    assert (logs >= -9.0001).all()
    for k in (0, 1):
        of_fold = replace(whole.folds[k], leaves=rng.normal(0, 3, whole.folds[k].leaves.shape).astype("f4"))
        other = replace(whole, folds=(of_fold, whole.folds[1]) if k == 0 else (whole.folds[0], of_fold))
        moved = (other.log_probabilities(rows, keys, seen) != logs).any(axis=1)
        np.testing.assert_array_equal(moved, ~seen | (folds != k))


def test_the_colours_are_those_of_a_checkerboard_of_8_m() -> None:
    x, y = np.meshgrid(np.arange(-90, 90), np.arange(-90, 90))
    indices = np.column_stack([x.ravel(), y.ravel(), np.arange(x.size) % 50])
    colours = folds_of(pack(indices), SIZE_M).reshape(x.shape)
    edges = [np.flatnonzero(np.diff(line)) for line in (colours[0], colours[:, 0])]
    for at in edges:
        assert set(np.diff(at)) == {40}
    np.testing.assert_array_equal(colours ^ colours[:1] ^ colours[:, :1], colours[0, 0])


def test_the_shipped_model_knows_road_and_sidewalk_and_nothing_of_intensity() -> None:
    trees = road_sidewalk.shipped()
    assert trees.classes.tolist() == [0, 1]
    names = [features.NAMES[i] for i in road_sidewalk.COLUMNS]
    assert len(names) == len(features.NAMES) - len(features.OF_INTENSITY)
    assert not [name for name in names if "intensity" in name]

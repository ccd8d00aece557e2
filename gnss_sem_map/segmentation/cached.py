"""Class probabilities that are already on disk: one file per frame, found by the frame number in its name."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.labels import OTHER, UNLABELLED, LabelSet, taxonomy
from gnss_sem_map.segmentation import MissingLabels
from gnss_sem_map.segmentation.probabilities import LabelImage, check_size, checked_probabilities
from gnss_sem_map.sensor_log import Image

HARD_LABEL_PROBABILITY = 0.9
"""What a label image's class gets; the rest is spread evenly over the other classes, for no network is always right."""
MOST_TRIED = 20
"""Files, from all over the folder, that are tried before it is given up."""


class CachedLabels:
    """The segmenter that reads `<number>.npz` (probabilities) or `<number>.png` (class ids) and no camera image.

    An `.npz` holds `probabilities` (h, w, c), uint8 as round(255 p) or floating in 0..1, and `class_names` (c,). A
    PNG holds one 8-bit id per pixel, named by `ids` of `taxonomy`: the class gets HARD_LABEL_PROBABILITY, every other
    class an equal share of the rest, and a void pixel no evidence at all. Frame numbers may be padded with zeros to
    any width. The first good file says what the others must be like. Raises ConfigError or DataError when the folder is
    not like that, or none of some files from all over it.
    """

    def __init__(
        self,
        folder: Path,
        label_set: LabelSet,
        expected_size: tuple[int, int] | None = None,
        ids: str | None = None,
        taxonomy: str = "cityscapes",
    ) -> None:
        self._folder, self._size = folder, expected_size
        self._files, suffix = _label_files(folder)
        self._evidence: NDArray[np.uint8] | None = None
        if suffix == ".png":
            self._ids = ids or _default_ids(taxonomy)
            self._unknown, self._evidence = _evidence_of_ids(label_set, taxonomy, self._ids)
            self.class_names: tuple[str, ...] = (*label_set.names, OTHER)
        elif ids is not None:
            raise ConfigError(
                f"labels {folder}: found .npz probabilities, where ids={ids} means nothing; leave it out"
            )
        else:
            self.class_names = ()
        self._try(label_set)

    def __call__(self, image: Image) -> NDArray[np.uint8] | NDArray[np.float32]:
        """The probabilities of this frame; raises MissingLabels where the folder has none, DataError for a bad file."""
        seen = self.kept(image)
        return seen.probabilities if isinstance(seen, LabelImage) else seen

    def kept(self, image: Image) -> NDArray[np.uint8] | NDArray[np.float32] | LabelImage:
        """What `__call__` gives, but a label image as it is: most of its pixels are never asked for."""
        path = self._files.get(image.number)
        if path is None:
            raise MissingLabels(
                f"{self._folder}: no labels of frame {image.number}; {len(self._files)} frames have some"
            )
        return self._read(path)

    def _try(self, label_set: LabelSet) -> None:
        """Find a good file, and what classes it has; raises DataError when there is none among those tried."""
        files = list(self._files.values())
        tried = files[:: -(-len(files) // MOST_TRIED)]
        refused: list[DataError] = []
        for path in tried:
            try:
                if self._evidence is not None:
                    self._read_ids(path)
                else:
                    self.class_names = read_probabilities(path, self._size)[1]
                    label_set.table_from(self.class_names)  # a name that nobody knows is refused here
                return
            except DataError as error:
                refused.append(error)
        if len(files) > 1:
            raise DataError(f"{refused[0]}; nor can any of {len(tried)} label files be used that were tried")
        raise refused[0]

    def _read(self, path: Path) -> NDArray[np.uint8] | NDArray[np.float32] | LabelImage:
        if self._evidence is not None:
            return LabelImage(self._read_ids(path), self._evidence)
        probabilities, names = read_probabilities(path, self._size)
        if names != self.class_names:
            raise DataError(
                f"{path}: found classes {list(names)}, expected {list(self.class_names)} as in the first file"
            )
        return probabilities

    def _read_ids(self, path: Path) -> NDArray[np.uint8]:
        import cv2

        ids = read_class_ids(path)
        check_size(ids.shape, self._size, str(path))
        if cv2.LUT(ids, self._unknown.view(np.uint8)).any():  # many times faster than indexing
            unknown = np.unique(ids[self._unknown[ids]]).tolist()
            raise DataError(
                f"{path}: found ids {unknown}, which are no {self._ids}; say what they are with ?ids="
            )
        return ids


def read_probabilities(
    path: Path, expected_size: tuple[int, int] | None = None
) -> tuple[NDArray[np.uint8] | NDArray[np.float32], tuple[str, ...]]:
    """The probabilities (h, w, c) and class names (c,) of one `.npz`; raises DataError for anything else in it."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as content:
            probabilities, names = content["probabilities"], content["class_names"]
    except KeyError as error:
        raise DataError(
            f"{path}: {error.args[0]}; expected probabilities (h, w, c) and class_names (c,)"
        ) from None
    except (OSError, ValueError, TypeError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(
            f"{path}: damaged file, or no .npz of plain arrays ({' '.join(str(error).split())})"
        ) from None
    if names.ndim != 1 or names.dtype.kind != "U":
        raise DataError(f"{path}: found class_names of {names.dtype} {names.shape}, expected a list of names")
    checked = checked_probabilities(probabilities, len(names), str(path))
    check_size(checked.shape, expected_size, str(path))
    return checked, tuple(map(str, names))


def read_class_ids(path: Path) -> NDArray[np.uint8]:
    """The ids (h, w) of a label image; raises DataError unless it is an 8-bit image of one channel."""
    import cv2

    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise DataError(f"{path}: cannot read the labels ({error.strerror})") from None
    ids: NDArray[Any] | None = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    if ids is None:
        raise DataError(f"{path}: damaged label image; expected an 8-bit grey PNG of class ids")
    if ids.ndim != 2 or ids.dtype != np.uint8:
        raise DataError(
            f"{path}: found {ids.dtype} {ids.shape}, expected an 8-bit grey PNG of class ids, not colours"
        )
    return ids


def _label_files(folder: Path) -> tuple[dict[int, Path], str]:
    if not folder.is_dir():
        raise DataError(f"labels {folder}: no such folder")
    found = {suffix: _numbered(folder, suffix) for suffix in (".npz", ".png")}
    if all(found.values()):
        raise DataError(
            f"labels {folder}: found both .npz and .png; expected one kind, keep them in two folders"
        )
    for suffix, files in found.items():
        if files:
            return files, suffix
    inside = [d.name for d in sorted(folder.iterdir()) if d.is_dir()]
    hint = f"; did you mean one of its folders {inside[:8]}?" if inside else ""
    raise DataError(f"labels {folder}: found no <frame number>.npz or .png in it{hint}")


def _numbered(folder: Path, suffix: str) -> dict[int, Path]:
    files: dict[int, Path] = {}
    for path in sorted(folder.glob(f"*{suffix}")):
        if path.stem.isdecimal():
            if int(path.stem) in files:
                raise DataError(
                    f"{path}: same frame as {files[int(path.stem)].name}; expected one file per frame"
                )
            files[int(path.stem)] = path
    return files


def _default_ids(name: str) -> str:
    return next(iter(taxonomy(name).ids))


def _evidence_of_ids(label_set: LabelSet, name: str, ids: str) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
    """For every 8-bit id: whether it is unknown (256,), and its evidence (256, c + 1) as round(255 p)."""
    source = taxonomy(name)
    if ids not in source.ids:
        raise ConfigError(f"labels: taxonomy {name!r} has no ids {ids!r}; expected one of {list(source.ids)}")
    classes = source.lookup(label_set, ids)
    count = len(label_set.names) + 1
    rest = (1 - HARD_LABEL_PROBABILITY) / (count - 1)
    softened = np.where(np.eye(count, dtype=bool), HARD_LABEL_PROBABILITY, rest)
    evidence = np.zeros((256, count), np.uint8)
    evidence[classes >= 0] = np.rint(255 * softened[classes[classes >= 0]])
    return classes < UNLABELLED, evidence

"""Segmenter that reads class probabilities from disk: one file per image, found by the frame number in its name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.files.archives import open_archive
from gnss_sem_map.files.pictures import read_ids
from gnss_sem_map.files.untrusted import inside, is_folder, shown
from gnss_sem_map.labels.label_set import OTHER, UNLABELLED, LabelSet, taxonomy
from gnss_sem_map.labels.probabilities import LabelImage, check_shape, checked_probabilities, shrink_of
from gnss_sem_map.segmentation import MissingLabels
from gnss_sem_map.sensor_log import Image

HARD_LABEL_PROBABILITY = 0.9
"""Probability of the class of a label image; the rest is spread evenly over the other classes."""
MOST_TRIED = 20
"""Number of files, spread over the folder, that are tried before it is refused."""

MOST_NAME_BYTES = 1 << 20


class CachedLabels:
    """The segmenter that reads `<number>.npz` (probabilities) or `<number>.png` (class ids) and no camera image.

    An `.npz` holds `probabilities` (h, w, c), uint8 as round(255 p) or floating in 0..1, and `class_names` (c,). A
    PNG holds one 8-bit id per pixel, named by `ids` of `taxonomy`: the class gets HARD_LABEL_PROBABILITY, every other
    class an equal share of the rest, and a void pixel no evidence at all. Frame numbers may be padded with zeros to
    any width. Of several cameras, each has a folder of its name. The classes of the first valid file are expected in
    all others. Raises ConfigError or DataError for another folder, or if none of several files from the whole folder is
    valid.
    """

    def __init__(
        self,
        folder: Path,
        label_set: LabelSet,
        sizes: Mapping[str, tuple[int, int]] | None = None,
        ids: str | None = None,
        taxonomy: str = "cityscapes",
    ) -> None:
        self._folder, self._sizes = folder, sizes or {}
        self._files, suffix = _label_files(folder, list(self._sizes) or [""])
        self._evidence: NDArray[np.uint8] | None = None
        if suffix == ".png":
            self._ids, self._unknown, self._evidence = _evidence_of_ids(label_set, taxonomy, ids)
            self.class_names: tuple[str, ...] = (*label_set.names, OTHER)
        elif ids is not None:
            raise ConfigError(
                f"labels {folder}: found .npz probabilities, where ids={ids} means nothing; leave it out"
            )
        else:
            self.class_names = ()
        self._try(label_set)

    def __call__(self, image: Image) -> NDArray[np.uint8] | NDArray[np.float32]:
        """The probabilities of this frame; raises MissingLabels if there are none, DataError for a bad file."""
        seen = self.kept(image)
        return seen.probabilities if isinstance(seen, LabelImage) else seen

    def kept(self, image: Image) -> NDArray[np.uint8] | NDArray[np.float32] | LabelImage:
        """The result of `__call__`, with a label image not expanded: most of its pixels are never used."""
        path = self._files.get((image.camera, image.number))
        if path is None:
            raise MissingLabels(
                f"{self._folder}: no labels of frame {image.frame}; {len(self._files)} frames have some"
            )
        return self._read(path, self._sizes.get(image.camera))

    def _try(self, label_set: LabelSet) -> None:
        """Find a valid file and its classes; raises DataError if none of the tried files is valid."""
        files = list(self._files.items())
        tried = files[:: -(-len(files) // MOST_TRIED)]
        refused: list[DataError] = []
        for (camera, _), path in tried:
            size = self._sizes.get(camera)
            try:
                if self._evidence is not None:
                    self._read_ids(path, size)
                else:
                    self.class_names = read_probabilities(path, size)[1]
                    label_set.table_from(self.class_names)  # refuses an unknown name
                return
            except DataError as error:
                refused.append(error)
        if len(files) > 1:
            raise DataError(f"{refused[0]}; none of {len(tried)} label files that were tried can be used")
        raise refused[0]

    def _read(
        self, path: Path, size: tuple[int, int] | None
    ) -> NDArray[np.uint8] | NDArray[np.float32] | LabelImage:
        if self._evidence is not None:
            return LabelImage(self._read_ids(path, size), self._evidence)
        probabilities, names = read_probabilities(path, size)
        if names != self.class_names:
            raise DataError(
                f"{path}: found classes {list(names)}, expected {list(self.class_names)} as in the first file"
            )
        return probabilities

    def _read_ids(self, path: Path, size: tuple[int, int] | None) -> NDArray[np.uint8]:
        import cv2

        ids = read_ids(path)
        if size is not None:
            shrink_of(ids.shape, size, str(path))
        if cv2.LUT(ids, self._unknown.view(np.uint8)).any():  # many times faster than indexing
            unknown = np.unique(ids[self._unknown[ids]]).tolist()
            raise DataError(
                f"{path}: found ids {unknown}, which are no {self._ids}; name their kind with ?ids="
            )
        return ids


def read_probabilities(
    path: Path, expected_size: tuple[int, int] | None = None
) -> tuple[NDArray[np.uint8] | NDArray[np.float32], tuple[str, ...]]:
    """The probabilities (h, w, c) and class names (c,) of one `.npz`; raises DataError for anything else in it."""
    with open_archive(path) as archive:
        stored, named = archive.array("probabilities"), archive.array("class_names", MOST_NAME_BYTES)
        if len(named.shape) != 1 or named.dtype.kind != "U":
            raise DataError(
                f"{shown(path)}: found class_names of {named.dtype} {named.shape}, expected a list of names"
            )
        check_shape(stored.shape, stored.dtype, named.shape[0], shown(path))
        if expected_size is not None:
            shrink_of(stored.shape, expected_size, shown(path))
        try:
            names = tuple(map(str, named.read()))
        except ValueError:
            raise DataError(f"{shown(path)}: class_names are no text") from None
        return checked_probabilities(stored.read(), len(names), shown(path)), names


def _label_files(folder: Path, cameras: Sequence[str]) -> tuple[dict[tuple[str, int], Path], str]:
    """The files by camera and frame number, and their ending."""
    if not is_folder(folder):
        raise DataError(f"labels {shown(folder)}: no such folder")
    paths = inside(folder)
    found: dict[str, dict[tuple[str, int], Path]] = {".npz": {}, ".png": {}}
    for camera in cameras:
        of_camera = paths if not camera else inside(folder / camera) if is_folder(folder / camera) else []
        for suffix, files in found.items():
            files |= {(camera, number): path for number, path in _numbered(of_camera, suffix).items()}
    if all(found.values()):
        raise DataError(
            f"labels {shown(folder)}: found both .npz and .png; expected one kind, keep them in two folders"
        )
    for suffix, files in found.items():
        if files:
            return files, suffix
    folders = [shown(path.name) for path in paths if path.is_dir()]
    hint = f"; did you mean one of its folders {folders[:8]}?" if folders else ""
    where = "it" if "" in cameras else f"the folders of the cameras, {', '.join(cameras)}"
    raise DataError(f"labels {shown(folder)}: found no <frame number>.npz or .png in {where}{hint}")


def _numbered(paths: list[Path], suffix: str) -> dict[int, Path]:
    files: dict[int, Path] = {}
    for path in paths:
        if path.suffix == suffix and path.stem.isdecimal():
            if int(path.stem) in files:
                raise DataError(
                    f"{shown(path)}: same frame as {files[int(path.stem)].name}; expected one file per frame"
                )
            files[int(path.stem)] = path
    return files


def _evidence_of_ids(
    label_set: LabelSet, name: str, ids: str | None
) -> tuple[str, NDArray[np.bool_], NDArray[np.uint8]]:
    """The kind of ids, and of every 8-bit id whether it is unknown (256,) and evidence (256, c + 1) as round(255 p)."""
    source = taxonomy(name)
    ids = ids or source.usual_ids
    if ids not in source.ids:
        raise ConfigError(f"labels: taxonomy {name!r} has no ids {ids!r}; expected one of {list(source.ids)}")
    classes = source.lookup(label_set, ids)
    count = len(label_set.names) + 1
    rest = (1 - HARD_LABEL_PROBABILITY) / (count - 1)
    softened = np.where(np.eye(count, dtype=bool), HARD_LABEL_PROBABILITY, rest)
    evidence = np.zeros((256, count), np.uint8)
    evidence[classes >= 0] = np.rint(255 * softened[classes[classes >= 0]])
    return ids, classes < UNLABELLED, evidence

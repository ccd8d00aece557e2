"""Segmenter that reads class probabilities from disk: one file per image, found by the frame number in its name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.files.archives import open_archive
from gnss_sem_map.files.untrusted import inside, is_folder, refused, shown
from gnss_sem_map.labels.label_set import OTHER, LabelSet
from gnss_sem_map.labels.probabilities import (
    LabelImage,
    check_shape,
    checked_probabilities,
    of_hard_labels,
    shrink_of,
)
from gnss_sem_map.segmentation import MissingLabels
from gnss_sem_map.segmentation.classes import check_some_known
from gnss_sem_map.segmentation.label_images import (
    Meaning,
    by_frame,
    meaning_of,
    none_usable,
)
from gnss_sem_map.sensor_log import Image

MOST_TRIED = 20
"""Number of files, spread over the folder, that are tried before it is refused."""

MOST_NAME_BYTES = 1 << 20


class CachedLabels:
    """The segmenter that reads `<number>.npz` (probabilities) or `<number>.png` (classes) and no camera image.

    An `.npz` holds `probabilities` (h, w, c), uint8 as round(255 p) or floating in 0..1, and `class_names` (c,). Pixels
    of a PNG are `ids` or colours of `taxonomy` (found out where they are not given, see `meaning_of`): the class gets
    HARD_LABEL_PROBABILITY, every other class an equal share of the rest, and a void pixel no evidence at all. Frame
    numbers may be padded with zeros to any width, and be part of a name (`by_frame`). Of several cameras, each has a
    folder of its name. The classes of the first valid file are expected in all others. Raises ConfigError or DataError
    for another folder, or if none of several files from the whole folder is valid.
    """

    def __init__(
        self,
        folder: Path,
        label_set: LabelSet,
        sizes: Mapping[str, tuple[int, int]] | None = None,
        ids: str | None = None,
        taxonomy: str | None = None,
    ) -> None:
        self._folder, self._sizes = folder, sizes or {}
        self._files, suffix, told = _label_files(folder, list(self._sizes) or [""], ids)
        self._meaning: Meaning | None = None
        if suffix == ".png":
            where = f"labels {shown(folder)}"
            kind = ids or (told if taxonomy is None else None)
            self._meaning = meaning_of(self._some_files(), label_set, taxonomy, kind, where)
            self.class_names: tuple[str, ...] = (*label_set.names, OTHER)
            count = len(self.class_names)
            self._evidence = np.zeros((256, count), np.uint8)  # void has none
            self._evidence[:count] = np.rint(255 * of_hard_labels(count))
        elif ids is not None:
            raise ConfigError(f"labels {folder}: found .npz probabilities, which have no ids; leave out ids=")
        else:
            self.class_names = ()
        self._try(label_set)

    @property
    def remedy(self) -> str:
        """What to do where they are not what they should be."""
        make = "make the labels again (gnss-sem-map segment)"
        return make if self._meaning is None else f"{make}, or say what the ids are (labels:FOLDER?ids=...)"

    def __call__(self, image: Image) -> NDArray[np.uint8] | NDArray[np.float32]:
        """The probabilities of this frame; raises MissingLabels if there are none, DataError for a bad file."""
        seen = self.kept(image)
        return seen.probabilities if isinstance(seen, LabelImage) else seen

    def kept(self, image: Image) -> NDArray[np.uint8] | NDArray[np.float32] | LabelImage:
        """The result of `__call__`, with a label image not expanded: most of its pixels are never used."""
        path = self._files.get((image.camera, image.number))
        if path is None:
            numbers = [number for _, number in self._files]
            raise MissingLabels(
                f"{self._folder}: no labels of frame {image.frame}; {len(numbers)} frames have some, from"
                f" {min(numbers)} to {max(numbers)}"
            )
        return self._read(path, self._sizes.get(image.camera))

    def _some_files(self) -> list[Path]:
        """At most MOST_TRIED, spread over the folder."""
        files = list(self._files.values())
        return files[:: -(-len(files) // MOST_TRIED)]

    def _try(self, label_set: LabelSet) -> None:
        """Find a valid file and its classes; raises DataError if none of the tried files is valid."""
        camera_of = {path: camera for (camera, _), path in self._files.items()}
        tried = self._some_files()
        refused: list[DataError] = []
        for path in tried:
            size = self._sizes.get(camera_of[path])
            try:
                if self._meaning is not None:
                    self._read_codes(self._meaning, path, size)
                else:
                    self.class_names = read_probabilities(path, size)[1]
                    check_some_known(self.class_names, label_set, shown(path))
                return
            except DataError as error:
                refused.append(error)
        raise none_usable(refused)

    def _read(
        self, path: Path, size: tuple[int, int] | None
    ) -> NDArray[np.uint8] | NDArray[np.float32] | LabelImage:
        if self._meaning is not None:
            return LabelImage(self._read_codes(self._meaning, path, size), self._evidence)
        probabilities, names = read_probabilities(path, size)
        if names != self.class_names:
            raise refused(path, f"found classes {list(names)}, the first file has {list(self.class_names)}")
        return probabilities

    def _read_codes(self, meaning: Meaning, path: Path, size: tuple[int, int] | None) -> NDArray[np.uint8]:
        codes = meaning.read(path)
        if size is not None:
            shrink_of(codes.shape, size, str(path))
        return codes


def read_probabilities(
    path: Path, expected_size: tuple[int, int] | None = None
) -> tuple[NDArray[np.uint8] | NDArray[np.float32], tuple[str, ...]]:
    """The probabilities (h, w, c) and class names (c,) of one `.npz`; raises DataError for anything else in it."""
    with open_archive(path) as archive:
        stored, named = archive.array("probabilities"), archive.array("class_names", MOST_NAME_BYTES)
        if len(named.shape) != 1 or named.dtype.kind not in "US":
            raise refused(path, f"found class_names of {named.dtype} {named.shape}, expected a list of names")
        axes = _axes(stored.shape, named.shape[0])
        shape = tuple(stored.shape[axis] for axis in axes)
        check_shape(shape, stored.dtype, named.shape[0], shown(path))
        if expected_size is not None:
            shrink_of(shape, expected_size, shown(path))
        try:
            names = tuple(map(str, named.read().astype(np.str_)))
        except ValueError:
            raise refused(path, "class_names are no text") from None
        values = stored.read()
        values = values.reshape(values.shape[-3:]).transpose([axis - values.ndim + 3 for axis in axes])
        return checked_probabilities(np.ascontiguousarray(values), len(names), shown(path)), names


def _axes(shape: tuple[int, ...], classes: int) -> list[int]:
    """Which axes are rows, columns and classes: (h, w, c), or as networks have it (c, h, w), of a batch of one."""
    axes = list(range(len(shape)))
    if len(shape) == 4 and shape[0] == 1:
        axes = axes[1:]
    if len(axes) == 3 and shape[axes[0]] == classes != shape[axes[2]]:
        axes = [*axes[1:], axes[0]]
    return axes


def _label_files(
    folder: Path, cameras: Sequence[str], ids: str | None
) -> tuple[dict[tuple[str, int], Path], str, str | None]:
    """The files by camera and frame number, their ending, and the kind of ids that their names tell."""
    if not is_folder(folder):
        raise DataError(f"labels {shown(folder)}: no such folder")
    paths = inside(folder)
    found: dict[str, dict[tuple[str, int], Path]] = {".npz": {}, ".png": {}}
    told: str | None = None
    for camera in cameras:
        of_camera = paths if not camera else inside(folder / camera) if is_folder(folder / camera) else []
        for suffix, files in found.items():
            numbered, kind = by_frame(of_camera, suffix, ids)
            files |= {(camera, number): path for number, path in numbered.items()}
            told = told or kind
    if all(found.values()):
        raise DataError(f"labels {shown(folder)}: found both .npz and .png; keep one kind")
    for suffix, files in found.items():
        if files:
            return files, suffix, told
    folders = [shown(path.name) for path in paths if path.is_dir()]
    hint = f"; did you mean one of its folders {folders[:8]}?" if folders else ""
    others = sorted({path.suffix for path in paths if path.is_file() and path.suffix})
    hint += f"; found {', '.join(map(shown, others[:8]))} there: save them as PNG" if others else ""
    where = "it" if "" in cameras else f"the folders of the cameras, {', '.join(cameras)}"
    raise DataError(f"labels {shown(folder)}: found no <frame number>.npz or .png in {where}{hint}")

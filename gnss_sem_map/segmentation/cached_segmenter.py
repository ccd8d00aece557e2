"""Cache of a network's probabilities: every image is segmented once, though a drive is read more than once."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError
from gnss_sem_map.files import work_folder
from gnss_sem_map.files.atomic import write_whole
from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.labels.label_set import OTHER, LabelSet
from gnss_sem_map.process.thread_pools import unless_left
from gnss_sem_map.scans.projection import class_image
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.segmentation.cache import write_probabilities
from gnss_sem_map.segmentation.cached import read_probabilities
from gnss_sem_map.sensor_log import Image

ABOUT = "about.json"


@dataclass(frozen=True, eq=False)
class CachedSegmenter:
    """A segmenter that saves its probabilities, in the classes of the map, to a folder; the second call reads them."""

    segmenter: Segmenter
    label_set: LabelSet
    image_sizes: Mapping[str, tuple[int, int]]
    """(width, height) by camera, px."""
    folder: Path

    @property
    def class_names(self) -> tuple[str, ...]:
        """The map's classes, and `other`."""
        return (*self.label_set.names, OTHER)

    def __call__(self, image: Image) -> NDArray[np.uint8]:
        """Probabilities (h, w, c + 1), round(255 p), the same at every call; raises what the segmenter raises."""
        file = self.folder / image.camera / f"{image.number}.npz"
        try:
            return np.asarray(read_probabilities(file)[0], np.uint8)
        except DataError:
            pass  # not saved yet, or damaged
        answer = unless_left(self.segmenter, image)
        seen = class_image(
            answer, self.segmenter.class_names, self.label_set, self.image_sizes[image.camera],
            f"labels of image {image.frame}",
        )  # fmt: skip
        write_probabilities(file, seen.probabilities, self.class_names)
        return seen.probabilities


def probabilities_folder(work: Path, fingerprint: str, resume: bool, cameras: Iterable[str]) -> Path:
    """Folder for a network's probabilities; with `resume`, those of an interrupted run with this fingerprint are kept.

    Raises DataError when it cannot be written.
    """
    work_folder.make(work)
    folder = work / work_folder.ANSWERS
    try:
        if not (resume and _fingerprint(folder / ABOUT) == fingerprint):
            work_folder.remove_answers(work)
        for camera in ("", *cameras):
            (folder / camera).mkdir(exist_ok=True)
        write_whole(folder / ABOUT, json.dumps({"fingerprint": fingerprint}).encode())
    except OSError as error:
        raise refused(folder, f"cannot be written ({error.strerror}); choose another place") from None
    return folder


def _fingerprint(about: Path) -> str | None:
    try:
        return str(json.loads(about.read_text("utf-8"))["fingerprint"])
    except (OSError, ValueError, KeyError, TypeError):
        return None

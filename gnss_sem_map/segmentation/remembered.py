"""A network looks at every image once, though the drive is read twice: for what moved, and for the map."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError, WriteError
from gnss_sem_map.files import work_folder
from gnss_sem_map.files.ownership import write_whole
from gnss_sem_map.labels.label_set import OTHER, LabelSet
from gnss_sem_map.scans.projection import class_image
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import Image

ABOUT = "about.json"


@dataclass(frozen=True, eq=False)
class RememberedSegmenter:
    """A segmenter whose answers stay in a folder, in the map's own classes: the second asking costs a file."""

    segmenter: Segmenter
    label_set: LabelSet
    image_size: tuple[int, int]
    """(width, height) of the camera, px."""
    folder: Path

    @property
    def class_names(self) -> tuple[str, ...]:
        """The map's classes, and `other`."""
        return (*self.label_set.names, OTHER)

    def __call__(self, image: Image) -> NDArray[np.uint8]:
        """Probabilities (h, w, c + 1), round(255 p), the same at every asking; raises what the segmenter raises."""
        file = self.folder / f"{image.number}.npz"
        remembered = _read(file)
        if remembered is not None:
            return remembered
        seen = class_image(
            self.segmenter(image), self.segmenter.class_names, self.label_set, self.image_size,
            f"labels of image {image.number}",
        )  # fmt: skip
        content = io.BytesIO()
        np.savez_compressed(content, probabilities=seen.probabilities)
        try:
            write_whole(file, content.getvalue())
        except OSError as error:
            raise WriteError(
                f"{self.folder}: cannot keep what the network said ({error.strerror}); free the disk, then --resume"
            ) from None
        return seen.probabilities


def answers_folder(work: Path, fingerprint: str, resume: bool) -> Path:
    """A folder for a network's answers; those of an interrupted run stay when resuming and both have one fingerprint.

    Raises DataError when it cannot be written.
    """
    work_folder.make(work)
    folder = work / work_folder.ANSWERS
    try:
        if not (resume and _fingerprint(folder / ABOUT) == fingerprint):
            work_folder.forget_answers(work)
        folder.mkdir(exist_ok=True)
        write_whole(folder / ABOUT, json.dumps({"fingerprint": fingerprint}).encode())
    except OSError as error:
        raise DataError(f"{folder}: cannot be written ({error.strerror}); choose another place") from None
    return folder


def _fingerprint(about: Path) -> str | None:
    try:
        return str(json.loads(about.read_text("utf-8"))["fingerprint"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _read(file: Path) -> NDArray[np.uint8] | None:
    """What was answered; None where nothing was, or the file is damaged (its checksum is in it)."""
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as remembered:
            return np.asarray(remembered["probabilities"], np.uint8)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None

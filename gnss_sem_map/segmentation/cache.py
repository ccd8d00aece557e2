"""Class probabilities on disk: one file per image, written once and read by all later runs as `labels:FOLDER`."""

from __future__ import annotations

import io
import json
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, DataError, WriteError
from gnss_sem_map.files.atomic import write_whole
from gnss_sem_map.files.output_folder import locked, real_path
from gnss_sem_map.files.structured import read_json
from gnss_sem_map.labels.label_set import OTHER, LabelSet
from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.process.thread_pools import leaving_all, unless_left
from gnss_sem_map.segmentation import MissingLabels, Segmenter
from gnss_sem_map.sensor_log import Image, Skip

ABOUT = "about.json"
"""File with the segmenter of a cache; frames of two segmenters are not mixed."""


PARTIAL = re.compile(r"\.(\d+\.npz|about\.json)\.\d+\.part")
"""Unfinished files of a process that was killed."""

STEP = 3
"""Probabilities are rounded to 3/255, less than the error of any network: the files are a third smaller."""


SegmentMany = Callable[[Sequence[Image]], list[NDArray[np.float32]]]


@runtime_checkable
class BatchSegmenter(Protocol):
    """A segmenter that processes several images in one batch."""

    def segment_many(self, images: Sequence[Image]) -> list[NDArray[np.float32]]:
        """Class probabilities (h, w, c) of every image."""
        ...


@runtime_checkable
class ThreadedSegmenter(Protocol):
    """A segmenter that is faster when several threads call it, each with its own images."""

    @property
    def threads(self) -> int:
        """Number of threads."""
        ...

    def on_one_core(self, images: Sequence[Image]) -> list[NDArray[np.float32]]:
        """Class probabilities (h, w, c) of every image, computed by the calling thread alone."""
        ...


@dataclass(frozen=True)
class CacheReport:
    """Result of `write_cache`."""

    written: int
    kept: int
    """Frames that an earlier call had already written."""
    skips: tuple[Skip, ...]
    bytes_per_frame: float
    images_per_second: float


def write_cache(
    images: Sequence[Image],
    segmenter: Segmenter,
    label_set: LabelSet,
    folder: Path,
    description: str,
    batch_size: int = 4,
    progress: Progress = silent,
) -> CacheReport:
    """Segment every image that has no file in `folder` yet, and write `<number>.npz`: 8 bits per class and pixel.

    Of several cameras, each has a folder of its name in it.

    Classes are summed by name into those of `label_set` and `other`. A KITTI image at half its size takes 70 to 130 kB.
    Files are written atomically, so an interrupted call can be repeated. `description` (the segmenter's SPEC) must be
    that of the first call for the folder. Frames with a damaged image are skipped and reported.
    Raises ConfigError for a folder of another segmenter, DataError when it cannot be written or nothing was segmented.
    """
    with _for_us_alone(folder):
        about: dict[str, object] = {"segmenter": description, "class_names": [*label_set.names, OTHER]}
        _claim(folder, about, sorted({image.camera for image in images}))
        return _write_all(images, segmenter, label_set, folder, batch_size, progress)


def _write_all(
    images: Sequence[Image],
    segmenter: Segmenter,
    label_set: LabelSet,
    folder: Path,
    batch_size: int,
    progress: Progress,
) -> CacheReport:
    waiting = [image for image in images if not _file(folder, image).exists()]
    kept, skips, sizes, start = len(images) - len(waiting), list[Skip](), list[int](), time.perf_counter()
    progress("segmenting", kept, len(images))
    threads, many = 1, segmenter.segment_many if isinstance(segmenter, BatchSegmenter) else None
    if isinstance(segmenter, ThreadedSegmenter) and segmenter.threads > 1:
        threads, many = segmenter.threads, segmenter.on_one_core

    def make(batch: list[Image]) -> tuple[list[int], list[Skip]]:
        lost: list[Skip] = []
        seen = _segment(batch, segmenter, many, lost)
        small = ((image, quantised(each, segmenter.class_names, label_set)) for image, each in seen)
        names = (*label_set.names, OTHER)
        return [write_probabilities(_file(folder, image), each, names) for image, each in small], lost

    batches = (waiting[i : i + batch_size] for i in range(0, len(waiting), batch_size))
    for _, (written, lost) in prefetch(make, batches, threads, under_way=threads):
        sizes += written
        skips += lost
        progress("segmenting", kept + len(sizes) + len(skips), len(images))
    if images and not (kept or sizes):
        raise DataError(f"none of {len(images)} images could be segmented; first reason: {skips[0].reason}")
    seconds = max(time.perf_counter() - start, 1e-9)
    return CacheReport(
        len(sizes), kept, tuple(skips), float(np.mean(sizes)) if sizes else 0.0, len(sizes) / seconds
    )


def quantised(
    seen: NDArray[np.uint8] | NDArray[np.float32], class_names: Sequence[str], label_set: LabelSet
) -> NDArray[np.uint8]:
    """Probabilities of the map's classes and `other`, as 255 p rounded to whole STEPs: (h, w, c + 1)."""
    levels = np.float32((1 if seen.dtype == np.uint8 else 255) / STEP)
    summed = np.asarray(seen, np.float32) @ label_set.table_from(class_names) * levels
    return np.asarray(np.rint(np.clip(summed, 0, 255 / STEP)) * STEP, np.uint8)


def _segment(
    batch: list[Image], segmenter: Segmenter, many: SegmentMany | None, skips: list[Skip]
) -> Iterator[tuple[Image, NDArray[np.uint8] | NDArray[np.float32]]]:
    """Segment a batch at once if there is a way; one by one if there is none, or if one image is damaged."""
    if many and len(batch) > 1:
        try:
            yield from zip(batch, unless_left(many, batch), strict=True)
            return
        except DataError:
            pass  # some image is damaged: the loop below finds out which
    for image in batch:
        try:
            yield image, unless_left(many, [image])[0] if many else unless_left(segmenter, image)
        except MissingLabels as error:
            skips.append(Skip("labels", f"frame {image.frame}", str(error)))
        except DataError as error:
            skips.append(Skip("image", f"frame {image.frame}", str(error)))


@contextmanager
def _for_us_alone(folder: Path) -> Iterator[None]:
    """Lock the folder: two calls do not write it at the same time."""
    real = real_path(folder)
    try:
        real.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cache {folder}: cannot be written ({error.strerror})") from None
    with locked(real), leaving_all():
        yield


def _claim(folder: Path, about: dict[str, object], cameras: Sequence[str]) -> None:
    file = folder / ABOUT
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not file.exists():
            strange = sorted(path.name for path in folder.iterdir() if not PARTIAL.fullmatch(path.name))
            if strange:
                raise ConfigError(f"cache {folder}: found {strange[0]}, no {ABOUT}; choose an empty folder")
            write_whole(file, (json.dumps(about) + "\n").encode())
        for inside in (folder / camera for camera in {"", *cameras}):
            inside.mkdir(exist_ok=True)
            for path in inside.iterdir():
                if PARTIAL.fullmatch(path.name):
                    path.unlink()  # of a call that was killed
    except OSError as error:
        raise DataError(f"cache {folder}: cannot be written ({error.strerror})") from None
    found = read_json(file)
    if found != about:
        raise ConfigError(f"cache {folder}: was started with {found}, now {about}; choose another folder")


def _file(folder: Path, image: Image) -> Path:
    return folder / image.camera / f"{image.number:010d}.npz"


def write_probabilities(path: Path, probabilities: NDArray[np.uint8], class_names: Sequence[str]) -> int:
    """Write the `.npz` that `cached.read_probabilities` reads, atomically; returns its bytes. Raises WriteError."""
    content = io.BytesIO()
    np.savez_compressed(content, probabilities=probabilities, class_names=np.array(class_names))
    try:
        write_whole(path, content.getvalue())
        return path.stat().st_size
    except OSError as error:
        raise WriteError(
            f"{path}: cannot be written ({error.strerror}); free some space, run again"
        ) from None

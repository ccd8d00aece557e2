"""Training data: images with label images, augmented by cropping, scaling, mirroring and colour changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.files.pictures import read_picture
from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.labels.label_set import OTHER, LabelSet, taxonomy
from gnss_sem_map.segmentation.label_images import VOID, Meaning, reading

IGNORE = VOID
"""Label of pixels that are ignored in training."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

CITYSCAPES_IMAGE = "_leftImg8bit"
CITYSCAPES_LABELS = {"train_id": "_gtFine_labelTrainIds", "label_id": "_gtFine_labelIds"}


@dataclass(frozen=True)
class LabelledFolder:
    """A folder of images, and one of label PNGs with the same names."""

    images: Path
    labels: Path
    every: int = 1
    """Use every n-th image, in the order of names: consecutive images of a drive are very similar."""

    @classmethod
    def parse(cls, text: str) -> LabelledFolder:
        """IMAGES,LABELS or IMAGES,LABELS,EVERY; raises ConfigError for anything else."""
        parts = text.split(",")
        every = parts[2] if len(parts) == 3 else "1"
        if len(parts) not in (2, 3) or not all(parts) or not every.isdecimal() or int(every) < 1:
            raise ConfigError(f"found {text!r}, expected IMAGES,LABELS[,EVERY] with EVERY from 1")
        return cls(Path(parts[0]), Path(parts[1]), int(every))


@dataclass(frozen=True, eq=False)
class LabelledImages:
    """Pairs of image and label files, and what the values of these mean."""

    pairs: tuple[tuple[Path, Path], ...]
    class_names: tuple[str, ...]
    meaning: Meaning

    def read(self, index: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """RGB pixels (h, w, 3) and truth (h, w); raises DataError for damaged files, other sizes and unknown ids."""
        image_file, label_file = self.pairs[index]
        pixels = read_picture(image_file, needs_colour=True)
        classes = self.meaning.read(label_file)
        if pixels.shape[:2] != classes.shape:
            raise refused(
                label_file,
                f"found {classes.shape}, {image_file.name} has {pixels.shape[:2]}",
            )
        return pixels, classes


def labelled_images(
    folders: Sequence[LabelledFolder], label_set: LabelSet, taxonomy_name: str, ids: str | None = None
) -> LabelledImages:
    """Every image of the folders and the folders in them, in order, with the PNG of the same name and place.

    Cityscapes' file names are known: `_leftImg8bit` is paired with the suffix of the chosen ids. Raises DataError
    when there are none or an image has no labels, ConfigError for ids that the taxonomy does not have.
    """
    source = taxonomy(taxonomy_name)
    meaning = reading(source, label_set, ids or source.usual_ids)
    pairs = tuple(pair for folder in folders for pair in _pairs(folder, meaning.kind))
    return LabelledImages(pairs, (*label_set.names, OTHER), meaning)


def _pairs(folder: LabelledFolder, ids: str) -> list[tuple[Path, Path]]:
    images = sorted(path for path in folder.images.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
    pairs = [(image, _label_file(folder, image, ids)) for image in images[:: folder.every]]
    without = [image.name for image, label in pairs if not label.is_file()]
    if not pairs or without:
        raise DataError(
            f"{folder.images}: {len(pairs)} images, {len(without)} without labels in {folder.labels} ({without[:3]})"
        )
    return pairs


def _label_file(folder: LabelledFolder, image: Path, ids: str) -> Path:
    place = folder.labels / image.relative_to(folder.images).parent
    if image.stem.endswith(CITYSCAPES_IMAGE) and ids in CITYSCAPES_LABELS:
        return place / f"{image.stem.removesuffix(CITYSCAPES_IMAGE)}{CITYSCAPES_LABELS[ids]}.png"
    return place / f"{image.stem}.png"


def class_weights(data: LabelledImages, samples: int = 64) -> NDArray[np.float32]:
    """Weight 1 / ln(1.02 + frequency) of every class, mean one, from at most `samples` images (Paszke et al., 2016)."""
    chosen = np.unique(np.linspace(0, len(data.pairs) - 1, samples).astype(int))
    counts = np.zeros(256)
    for index in chosen:
        counts += np.bincount(data.read(int(index))[1].ravel(), minlength=256)
    counts = counts[: len(data.class_names)]
    if not counts.any():
        raise DataError(f"{data.pairs[0][1].parent}: found no pixel of {data.class_names}")
    weights = 1 / np.log(1.02 + counts / counts.sum())
    return np.asarray(weights / weights.mean(), np.float32)


def augmented(
    pixels: NDArray[np.uint8],
    truth: NDArray[np.uint8],
    crop: tuple[int, int],
    scales: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A random crop of (width, height) at a random scale, mirrored with probability 1/2, with changed colours.

    Scales are drawn evenly in their logarithm; what lies outside a small image is black and IGNORE.
    """
    import cv2

    width, height = crop
    scale = float(np.exp(rng.uniform(*np.log(scales))))
    size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
    pixels = np.asarray(
        cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    )
    truth = np.asarray(cv2.resize(truth, size, interpolation=cv2.INTER_NEAREST_EXACT))
    left = int(rng.integers(0, max(1, size[0] - width + 1)))
    top = int(rng.integers(0, max(1, size[1] - height + 1)))
    cut, cut_truth = (
        pixels[top : top + height, left : left + width],
        truth[top : top + height, left : left + width],
    )
    seen, said = np.zeros((height, width, 3), np.uint8), np.full((height, width), IGNORE, np.uint8)
    seen[: cut.shape[0], : cut.shape[1]], said[: cut.shape[0], : cut.shape[1]] = cut, cut_truth
    if rng.random() < 0.5:
        seen, said = seen[:, ::-1], said[:, ::-1]
    return np.ascontiguousarray(_with_changed_colours(seen, rng)), np.ascontiguousarray(said)


def _with_changed_colours(pixels: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Another gamma, gain and tint, by one table per channel."""
    levels = (np.arange(256) / 255.0) ** np.exp(rng.uniform(-0.3, 0.3))
    gains = np.exp(rng.uniform(-0.2, 0.2) + rng.uniform(-0.06, 0.06, 3))
    tables = np.rint(np.clip(255 * levels[:, None] * gains, 0, 255)).astype(np.uint8)
    return np.stack([tables[pixels[:, :, c], c] for c in range(3)], axis=2)

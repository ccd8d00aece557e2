"""A network looks at every image once, though the drive is read twice: for what moved, and for the map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.labelling import class_image
from gnss_sem_map.labels import OTHER, LabelSet
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.sensor_log import Image


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
        if file.exists():
            with np.load(file, allow_pickle=False) as remembered:
                return np.asarray(remembered["probabilities"], np.uint8)
        seen = class_image(
            self.segmenter(image), self.segmenter.class_names, self.label_set, self.image_size,
            f"labels of image {image.number}",
        )  # fmt: skip
        with file.with_suffix(".part").open("wb") as part:
            np.savez_compressed(part, probabilities=seen.probabilities)
        file.with_suffix(".part").rename(file)
        return seen.probabilities

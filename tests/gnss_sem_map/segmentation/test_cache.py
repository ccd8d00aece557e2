"""A cache holds what the segmenter said, survives interruptions, and reads back through `labels:`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import MissingLabels, open_segmenter
from gnss_sem_map.segmentation.cache import STEP, write_cache
from gnss_sem_map.sensor_log import Image

URBAN = open_label_set("urban")
CITYSCAPES = ("road", "sidewalk", "building", "vegetation", "car", "truck", "sky", "pole")


class Dice:
    """Probabilities that depend on the pixels alone; refuses images whose first pixel is black."""

    class_names = CITYSCAPES

    def __init__(self) -> None:
        self.seen: list[int] = []

    def __call__(self, image: Image) -> np.ndarray:
        pixels = image.read()
        if not pixels[0, 0].any():
            raise DataError(f"image {image.number}: black")
        self.seen.append(image.number)
        dice = np.random.default_rng(int(pixels.sum()))
        return dice.dirichlet(np.ones(8) / 4, (10, 15)).astype(np.float32)


def image(number: int, black: bool = False) -> Image:
    pixels = np.random.default_rng(number).integers(1, 256, (20, 30, 3), dtype=np.uint8) * (not black)
    return Image(number, 0.1 * number, lambda: pixels.astype(np.uint8))


IMAGES = [image(number) for number in (3, 4, 7, 11, 12)]


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_what_comes_back_is_what_was_said_to_half_a_step(tmp_path: Path) -> None:
    segmenter = Dice()
    report = write_cache(IMAGES, segmenter, URBAN, tmp_path, "dice")
    assert (report.written, report.kept, report.skips) == (5, 0, ())
    cached = open_segmenter(f"labels:{tmp_path}", URBAN, sizes={"": (30, 20)})
    assert cached.class_names == (*URBAN.names, "other")
    for one in IMAGES:
        said = segmenter(one) @ URBAN.table_from(CITYSCAPES)
        np.testing.assert_allclose(cached(one) / 255, said, atol=STEP / 2 / 255 + 1e-6)


def test_a_second_call_writes_only_what_is_missing(tmp_path: Path) -> None:
    write_cache(IMAGES[:2], Dice(), URBAN, tmp_path, "dice")
    segmenter = Dice()
    report = write_cache(IMAGES, segmenter, URBAN, tmp_path, "dice")
    assert (report.written, report.kept) == (3, 2)
    assert segmenter.seen == [7, 11, 12]


def test_an_interrupted_cache_ends_with_the_bytes_of_an_uninterrupted_one(tmp_path: Path) -> None:
    class Interrupted(Dice):
        def __call__(self, image: Image) -> np.ndarray:
            if image.number == 11:
                raise KeyboardInterrupt
            return super().__call__(image)

    with pytest.raises(KeyboardInterrupt):
        write_cache(IMAGES, Interrupted(), URBAN, tmp_path / "a", "dice", batch_size=1)
    assert len(files(tmp_path / "a")) == 4
    write_cache(IMAGES, Dice(), URBAN, tmp_path / "a", "dice")
    write_cache(IMAGES, Dice(), URBAN, tmp_path / "b", "dice")
    assert files(tmp_path / "a") == files(tmp_path / "b")


# in batches of two the last one holds the damaged image, and both of its images are asked for again
@pytest.mark.parametrize(("batch_size", "calls"), [(1, 6), (2, 5)])
def test_threads_that_each_ask_for_a_batch_change_nothing(
    tmp_path: Path, batch_size: int, calls: int
) -> None:
    class Threaded(Dice):
        threads, asked = 3, 0

        def on_one_core(self, images: Sequence[Image]) -> list[np.ndarray]:
            self.asked += 1
            return [self(one) for one in images]

    segmenter = Threaded()
    images = [*IMAGES, image(20, black=True)]
    report = write_cache(images, segmenter, URBAN, tmp_path / "a", "dice", batch_size=batch_size)
    assert segmenter.asked == calls
    assert report.written == 5
    assert [(skip.what, skip.where) for skip in report.skips] == [("image", "frame 20")]
    write_cache(images, Dice(), URBAN, tmp_path / "b", "dice", batch_size=1)
    assert files(tmp_path / "a") == files(tmp_path / "b")


def test_a_damaged_image_is_skipped_and_reported_and_the_others_are_not(tmp_path: Path) -> None:
    report = write_cache([*IMAGES, image(20, black=True)], Dice(), URBAN, tmp_path, "dice")
    assert report.written == 5
    assert [(skip.what, skip.where) for skip in report.skips] == [("image", "frame 20")]
    with pytest.raises(MissingLabels):
        open_segmenter(f"labels:{tmp_path}", URBAN)(image(20))


def test_a_batch_with_a_damaged_image_loses_only_that_one(tmp_path: Path) -> None:
    class Batches(Dice):
        batches = 0

        def segment_many(self, images: Sequence[Image]) -> list[np.ndarray]:
            self.batches += 1
            return [self(one) for one in images]

    segmenter = Batches()
    report = write_cache([image(1, black=True), *IMAGES], segmenter, URBAN, tmp_path, "dice", batch_size=2)
    # three pairs, then the two images of the damaged one
    assert (report.written, len(report.skips), segmenter.batches) == (5, 1, 5)


def test_nothing_segmented_at_all_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="none of 1 images"):
        write_cache([image(1, black=True)], Dice(), URBAN, tmp_path, "dice")


def test_frames_of_two_segmenters_do_not_mix(tmp_path: Path) -> None:
    write_cache(IMAGES[:1], Dice(), URBAN, tmp_path, "python:dice:six")
    with pytest.raises(ConfigError, match=r"started with .*dice:six.* now .*dice:seven"):
        write_cache(IMAGES, Dice(), URBAN, tmp_path, "python:dice:seven")


def test_somebody_elses_folder_is_left_alone(tmp_path: Path) -> None:
    np.savez(tmp_path / "3.npz", scans=np.zeros(3))
    before = files(tmp_path)
    with pytest.raises(ConfigError, match="choose an empty folder"):
        write_cache(IMAGES, Dice(), URBAN, tmp_path, "dice")
    assert files(tmp_path) == before


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot be written"):
        write_cache(IMAGES, Dice(), URBAN, tmp_path / "file" / "cache", "dice")


def test_progress_runs_from_what_is_there_to_all_there_is(tmp_path: Path) -> None:
    write_cache(IMAGES[:1], Dice(), URBAN, tmp_path, "dice")
    steps: list[tuple[str, int, int]] = []
    write_cache(
        IMAGES, Dice(), URBAN, tmp_path, "dice", batch_size=2, progress=lambda *step: steps.append(step)
    )
    assert steps == [("segmenting", done, 5) for done in (1, 3, 5)]


@pytest.mark.integration
def test_a_network_in_batches_writes_what_it_writes_alone(tmp_path: Path) -> None:
    from gnss_sem_map.segmentation.checkpoints import write_network
    from gnss_sem_map.segmentation.refinenet import LightWeightRefineNet

    names = (*URBAN.names, "other")
    network = LightWeightRefineNet(6, "mobilenet_v2", width=16, depth_head=False)
    write_network(tmp_path / "net.safetensors", network, names, 1.0)
    segmenter = open_segmenter(f"refinenet:{tmp_path / 'net.safetensors'}", URBAN, "cpu")
    write_cache(IMAGES, segmenter, URBAN, tmp_path / "four", "net", batch_size=4)
    write_cache(IMAGES, segmenter, URBAN, tmp_path / "one", "net", batch_size=1)
    four, one = (open_segmenter(f"labels:{tmp_path / name}", URBAN) for name in ("four", "one"))
    for each in IMAGES:
        np.testing.assert_allclose(four(each).astype(int), one(each).astype(int), atol=STEP)

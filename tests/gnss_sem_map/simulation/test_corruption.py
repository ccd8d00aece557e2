"""Class images corrupted as a network would: wrong in patches and at borders, and the same every time."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation.cached import CachedLabels
from gnss_sem_map.simulation import Simulation, corrupt_class_image, write_corrupted_labels
from gnss_sem_map.simulation.corruption import CLASS_NAMES

IDS = [0, 1, 13, 2, 8, 11]  # one trainId for each of CLASS_NAMES


@pytest.fixture(scope="module")
def stripes() -> npt.NDArray[np.uint8]:
    """Six vertical stripes, one per class, 360 by 600."""
    return np.repeat(np.array(IDS, np.uint8), 100)[None].repeat(360, axis=0)


def test_probabilities_are_probabilities_at_half_resolution(stripes: npt.NDArray[np.uint8]) -> None:
    p = corrupt_class_image(stripes[:-1, :-1])
    assert p.shape == (179, 299, 6)
    assert p.dtype == np.uint8
    assert np.abs(p.sum(axis=2, dtype=int) - 255).max() <= 3
    assert p.max() < 253  # never certain


def test_most_is_right_and_errors_come_in_patches(stripes: npt.NDArray[np.uint8]) -> None:
    said = corrupt_class_image(stripes, frame=40).argmax(axis=2)
    truth = np.repeat(np.arange(6), 50)[None].repeat(180, axis=0)
    wrong = said != truth
    assert 0.01 < wrong.mean() < 0.15
    beside = (wrong[:, 1:] & wrong[:, :-1]).sum() / wrong.sum()
    assert beside > 0.7


def test_look_alikes_are_confused_and_vehicles_do_not_become_road(stripes: npt.NDArray[np.uint8]) -> None:
    truth = np.repeat(np.arange(6), 50)[None].repeat(180, axis=0)
    inner = np.zeros_like(truth, bool)
    inner[:, np.arange(300) % 50 // 10 == 2] = True
    said = np.concatenate(
        [corrupt_class_image(stripes, frame=k).argmax(axis=2)[None] for k in range(0, 96, 12)]
    )
    for name, other in (("building", "vegetation"), ("sidewalk", "road")):
        mine = said[:, inner & (truth == CLASS_NAMES.index(name))]
        assert (mine == CLASS_NAMES.index(other)).mean() > 0.01
    assert not (said[:, inner & (truth == 2)] == 0).any()


def test_frames_that_follow_each_other_err_alike(stripes: npt.NDArray[np.uint8]) -> None:
    first, second, later = (corrupt_class_image(stripes, frame=k).astype(int) for k in (20, 21, 80))
    assert np.abs(first - second).mean() < 0.5 * np.abs(first - later).mean()


def test_the_same_frame_gives_the_same_bytes_and_another_seed_others(stripes: npt.NDArray[np.uint8]) -> None:
    once = corrupt_class_image(stripes, 3, 5)
    np.testing.assert_array_equal(once, corrupt_class_image(stripes, 3, 5))
    assert (once != corrupt_class_image(stripes, 4, 5)).mean() > 0.1


def test_the_written_labels_are_a_segmenter_s_cache(
    town_drive: Path, simulation: Simulation, tmp_path: Path
) -> None:
    folder = write_corrupted_labels(town_drive, tmp_path / "labels")
    assert len(list(folder.glob("*.npz"))) == 12
    size = (simulation.camera.width, simulation.camera.height)
    cached = CachedLabels(folder, open_label_set("urban"), {"": size})
    assert set(cached.class_names) == set(CLASS_NAMES)


def test_what_is_no_class_image_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="uint8"):
        corrupt_class_image(np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(DataError, match="simulated drive"):
        write_corrupted_labels(tmp_path, tmp_path / "labels")

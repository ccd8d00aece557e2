"""Range images on disk are those that were put there, and take the place of the ones before."""

import numpy as np
import pytest
from scenes import DENSE

from gnss_sem_map.dynamics.visibility import SCANS_PER_PART, KeyframeScans, RangeImage
from gnss_sem_map.mapping.waiting_images import WaitingImages


def seen(count):
    rng = np.random.default_rng(count)
    images = rng.integers(0, 65536, (count, DENSE.count + 1, 902), dtype=np.uint16)
    return [RangeImage(image, rng.normal(size=(4, 4)), DENSE) for image in images]


@pytest.mark.parametrize("count", [1, SCANS_PER_PART, 2 * SCANS_PER_PART + 5])
def test_images_come_back_part_by_part_as_they_were_written(tmp_path, count):
    WaitingImages.write(seen(7), tmp_path)
    scans = seen(count)
    waiting = WaitingImages.write(scans, tmp_path)
    expected = KeyframeScans.of(scans)
    parts = list(waiting.parts())
    assert len(waiting.T_lidar_map) == count
    assert max(map(len, parts)) <= SCANS_PER_PART
    assert np.array_equal(np.concatenate([part.images for part in parts]), expected.images)
    assert np.array_equal(np.concatenate([part.T_lidar_map for part in parts]), expected.T_lidar_map)
    assert all(part.rows is DENSE for part in parts)
    assert [path.name for path in tmp_path.iterdir()] == ["images.npy"]


def test_no_scans_wait_for_nothing(tmp_path):
    assert WaitingImages.write([], tmp_path) is None
    assert not list(tmp_path.iterdir())

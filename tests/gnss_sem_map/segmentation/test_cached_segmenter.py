"""A network segments every image once, though a run is interrupted and resumed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import street

from gnss_sem_map import pipeline
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.sensor_log import Image


class Counting:
    """A network that sees road everywhere, and counts how often it is asked."""

    class_names = ("road", "other")

    def __init__(self) -> None:
        self.asked: list[int] = []

    def __call__(self, image: Image) -> np.ndarray:
        self.asked.append(image.number)
        return np.tile(np.array([230, 25], np.uint8), (street.HEIGHT, street.WIDTH, 1))


class Interrupted(Exception):
    """The run is interrupted."""


def stop_at_mapping(stage: str, done: int, total: int) -> None:
    if stage == "mapping" and done == 8:
        raise Interrupted


@pytest.mark.integration
def test_resuming_asks_a_network_nothing_again(small_drive: street.Street, tmp_path: Path) -> None:
    log, settings = (
        open_drive(small_drive.drive),
        Settings.model_validate({"mapping": {"scans_per_chunk": 4}}),
    )
    first, second, other = Counting(), Counting(), Counting()
    with pytest.raises(Interrupted):
        pipeline.run(log, first, settings, stop_at_mapping, work=tmp_path / "work", labels_from="net")
    assert sorted(first.asked) == [image.number for image in log.images]
    damaged = tmp_path / "work/answers/7.npz"
    damaged.write_bytes(damaged.read_bytes()[:-40])
    resumed = pipeline.run(log, second, settings, work=tmp_path / "work", resume=True, labels_from="net")
    assert second.asked == [7], "only the damaged image is segmented again"
    whole = pipeline.run(log, other, settings, work=tmp_path / "other", resume=True, labels_from="net")
    for name in ("keys", "evidence", "hits"):
        np.testing.assert_array_equal(getattr(resumed.raw.voxels, name), getattr(whole.raw.voxels, name))
    assert len(other.asked) == len(log.images), "another work folder has no probabilities"

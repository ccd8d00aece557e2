"""A network segments every image once, though a run is interrupted and resumed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import street
from faults.killing import content

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.runs import pipeline
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
        Settings.model_validate({"dynamics": {"window_scans": 2}}),
    )
    first, second, other = Counting(), Counting(), Counting()
    with pytest.raises(Interrupted):
        pipeline.run(
            log, first, settings, tmp_path / "a", tmp_path / "work", stop_at_mapping, labels_from="net"
        )
    assert len(set(first.asked)) == len(first.asked) >= 8
    damaged = tmp_path / "work/answers/7.npz"
    damaged.write_bytes(damaged.read_bytes()[:-40])
    pipeline.run(log, second, settings, tmp_path / "a", tmp_path / "work", resume=True, labels_from="net")
    never_asked = {image.number for image in log.images} - set(first.asked)
    assert sorted(second.asked) == sorted({7} | never_asked), "only the damaged image is segmented again"
    pipeline.run(log, other, settings, tmp_path / "b", tmp_path / "other", resume=True, labels_from="net")
    assert content(tmp_path / "a") == content(tmp_path / "b")
    assert sorted(other.asked) == [image.number for image in log.images], "once each; nothing is there"

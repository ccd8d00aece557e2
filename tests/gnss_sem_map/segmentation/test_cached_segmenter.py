"""A network segments every image once, though a run is interrupted and resumed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import street
from faults.killing import content

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.runs import pipeline
from gnss_sem_map.runs.map_job import MapJob
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

    def made(network: Counting, work: str, progress: Progress = silent) -> Path:
        run = MapJob(settings, log.frame, tmp_path / work, progress=progress, is_one=True)
        return pipeline.map_log(log, network, run, labels_from="net").folder

    with pytest.raises(Interrupted):
        made(first, "work", stop_at_mapping)
    assert len(set(first.asked)) == len(first.asked) >= 8
    (damaged,) = (tmp_path / "work").glob("drives/.*.work/answers/7.npz")
    damaged.write_bytes(damaged.read_bytes()[:-40])
    again = made(second, "work")
    never_asked = {image.number for image in log.images} - set(first.asked)
    assert sorted(second.asked) == sorted({7} | never_asked), "only the damaged image is segmented again"
    at_once = made(other, "other")
    for name in ("map", "attributes", "evidence"):
        assert content(again / name) == content(at_once / name)
    assert sorted(other.asked) == [image.number for image in log.images], "once each; nothing is there"

"""The small street as a drive to map, and its map made at once."""

from __future__ import annotations

import pytest
from chunks import Maps, build_maps
from street import Street

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.segmentation import open_segmenter

NOTHING_MOVES = Settings.model_validate({"dynamics": {"enabled": False}})


@pytest.fixture(scope="module")
def drive(small_drive: Street) -> Drive:
    """Nothing moves in it, and nothing that does is sought."""
    log = open_drive(small_drive.drive)
    segmenter = open_segmenter(
        f"labels:{small_drive.labels}", open_label_set(), sizes=log.calibration.image_sizes
    )
    assert log.reference is not None
    return Drive(log, log.reference, segmenter, NOTHING_MOVES)


@pytest.fixture(scope="module")
def at_once(drive: Drive) -> tuple[Maps, RunStats]:
    stats = RunStats()
    return build_maps(drive, stats), stats

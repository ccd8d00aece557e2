"""The real excerpt of KITTI drive 0005: a van ahead, a car that pulls out, nine parked vehicles."""

import pytest
import tracklets

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.chunks import chunks_of, map_chunks
from gnss_sem_map.mapping.edge_windows import EdgeWindows
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.segmentation import open_segmenter

DRIVE = "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync"


@pytest.mark.slow
def test_the_van_and_the_car_go_and_the_parked_vehicles_stay(real_data, tmp_path):
    log = open_drive(real_data / DRIVE)
    segmenter = open_segmenter(
        f"labels:{real_data / 'labels/kitti_raw_0005/probabilities'}", open_label_set()
    )
    drive = Drive(log, log.reference, segmenter, Settings())
    chunks = map_chunks(drive, range(len(chunks_of(drive))), tmp_path, EdgeWindows(tmp_path, ""))
    moving = {number: points for chunk in chunks for number, points in chunk.moving.items()}
    figures = tracklets.removal(drive, moving, real_data / DRIVE)
    assert figures["moving_points"] > 5000
    assert figures["DA"] >= 0.95
    assert figures["SA_vehicle"] >= 0.999
    assert figures["SA"] >= 0.995

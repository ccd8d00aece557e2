"""The paper's own method is one file of settings, and it runs."""

from pathlib import Path

import numpy as np
from street import Street

from gnss_sem_map import config, pipeline
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import open_segmenter

PAPER = Path(__file__).parents[1] / "examples" / "paper.yaml"


def test_the_paper_s_settings_do_what_the_paper_does_and_no_more(small_drive: Street) -> None:
    settings = config.load(PAPER)
    log = open_drive(small_drive.drive)
    segmenter = open_segmenter(
        f"labels:{small_drive.labels}", open_label_set(), expected_size=log.calibration.image_size
    )
    result = pipeline.run(log, segmenter, settings)
    assert "scans matched" not in result.stats.counts
    assert set(result.sharpness) == {"map"}  # nothing to compare with: GNSS and IMU alone made the map
    assert not result.evidence.moving  # the paper looks for what moved in the map, not beside it
    assert not settings.refinement.potts_mrf.enabled
    known = result.refined.labels[result.refined.labels >= 0]
    assert len(known) > 1000
    assert len(np.unique(known)) > 2

"""The paper's own method is one file of settings, and it runs."""

import json
from pathlib import Path

import numpy as np
from street import Street

from gnss_sem_map import config, run
from gnss_sem_map.mapping import evidence
from gnss_sem_map.mapping.classifying import FILE
from gnss_sem_map.voxels.semantic_map import State

PAPER = Path(__file__).parents[1] / "examples" / "paper.yaml"


def test_the_paper_s_settings_do_what_the_paper_does_and_no_more(small_drive: Street, tmp_path: Path) -> None:
    settings = config.load(PAPER)
    done = run(small_drive.drive, tmp_path / "out", f"labels:{small_drive.labels}", settings)
    assert "scans matched" not in done.about["counts"]
    metrics = json.loads((done.folder / "metrics.json").read_text())
    assert set(metrics["sharpness"]) == {"map"}  # nothing to compare with: GNSS and IMU alone made the map
    beside = evidence.read(done.folder, done.label_set)
    assert not beside.moving()  # the paper looks for what moved in the map, not beside it
    assert not beside.moved.tiles
    assert not settings.refinement.potts_mrf.enabled
    assert not (done.map().states == State.INFERRED).any()
    assert not (done.folder / "evidence" / FILE).exists()
    labels = done.map().labels
    known = labels[labels >= 0]
    assert len(known) > 1000
    assert len(np.unique(known)) > 2

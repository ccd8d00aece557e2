"""Files of what changed between drives, as json reads them."""

import json
from pathlib import Path

import numpy as np

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.evaluation.changes import ChangedObject
from gnss_sem_map.export.changes import Change, write_changes
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.voxels.semantic_map import SemanticMap


def test_a_box_across_the_180_degree_meridian_stays_one_box(street: SemanticMap, tmp_path: Path) -> None:
    fiji = LocalFrame(-17.0, 180.0, 100.0)
    size = np.array([4.0, 2.0, 1.5])
    thing = ChangedObject(True, 0, np.zeros(3), 0.3, size, street.voxels, misses=9.0, hits=4.0)
    write_changes([Change("a", "b", thing)], Georeference(fiji), street.voxels.label_set, tmp_path)
    (feature,) = json.loads((tmp_path / "changes.geojson").read_text())["features"]
    ring = np.array(feature["geometry"]["coordinates"][0])
    p_map = fiji.to_map(ring[:, 1], ring[:, 0], ring[:, 2])
    sides = np.linalg.norm(np.diff(p_map, axis=0), axis=1)
    np.testing.assert_allclose(sides, [4, 2, 4, 2], atol=2e-3)
    assert np.ptp(ring[:, 0]) < 1e-4

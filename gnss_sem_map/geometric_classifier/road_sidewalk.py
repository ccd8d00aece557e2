"""Kerbs: the odds of sidewalk against road by shape alone, learned from simulated towns with exact truth.

Networks call sidewalks road, so labels of images cannot teach the difference. `examples/road_sidewalk_model.py` trained
the model that ships with the package; real data had no part in it. What it may say is limited, and it moves probability
between these two classes only.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.files.archives import open_archive
from gnss_sem_map.geometric_classifier import features
from gnss_sem_map.geometric_classifier.trees import BoostedTrees
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.refinement.road_sidewalk import road_and_sidewalk

FILE = Path(str(resources.files("gnss_sem_map") / "geometric_classifier" / "road_sidewalk.npz"))
COLUMNS = np.array([i for i, name in enumerate(features.NAMES) if name not in features.OF_INTENSITY])
"""Simulated intensities are not those of real streets."""
LEAST_LOG = np.float32(np.log(0.02))
"""Where road and sidewalk together are less probable, the model is not asked."""
LIMITS_NAT = np.float32(-3), np.float32(3)


@dataclass(frozen=True, eq=False)
class RoadSidewalkModel:
    """The model, and how much of its log odds counts, 0 to 1."""

    trees: BoostedTrees
    weight: float

    def log_odds(
        self, rows: NDArray[np.float32], logs: NDArray[np.float32], label_set: LabelSet
    ) -> NDArray[np.float32]:
        """Log odds (v,) of sidewalk against road of voxels with these features (v, f), and log probabilities (v, k).

        Zero where these say neither of the two, and for a class set that lacks one.
        """
        said, classes = np.zeros(len(rows), np.float32), road_and_sidewalk(label_set)
        if classes is None or self.weight == 0:
            return said
        asked = np.flatnonzero(np.logaddexp(*(logs[:, one] for one in classes)) > LEAST_LOG)
        said[asked] = self.trees.scores(np.ascontiguousarray(rows[asked][:, COLUMNS]))[:, 0]
        return np.asarray(np.float32(self.weight) * np.clip(said, *LIMITS_NAT))


@cache
def shipped() -> BoostedTrees:
    """The trees that ship with the package, of the classes 0 road and 1 sidewalk."""
    with open_archive(FILE) as archive:
        trees = BoostedTrees(*(archive.array(field.name).read() for field in fields(BoostedTrees)))
    trees.check(len(COLUMNS), 2)
    return trees

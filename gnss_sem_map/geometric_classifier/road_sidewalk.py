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

FILE = Path(str(resources.files("gnss_sem_map") / "geometric_classifier" / "road_sidewalk.npz"))
ROAD, SIDEWALK = "road", "sidewalk"
COLUMNS = np.array([i for i, name in enumerate(features.NAMES) if name not in features.OF_INTENSITY])
"""Simulated intensities are not those of real streets."""
MOST_NAT = 3.0


@dataclass(frozen=True, eq=False)
class RoadSidewalkModel:
    """The model, and how much of its log odds counts, 0 to 1."""

    trees: BoostedTrees
    weight: float

    def applied(
        self, logs: NDArray[np.float32], rows: NDArray[np.float32], names: tuple[str, ...]
    ) -> NDArray[np.float32]:
        """Log probabilities (v, k) with other odds of road against sidewalk; `rows` (v, f) are the features."""
        if ROAD not in names or SIDEWALK not in names or self.weight == 0:
            return logs
        road, sidewalk = names.index(ROAD), names.index(SIDEWALK)
        said = self.trees.scores(np.ascontiguousarray(rows[:, COLUMNS]))[:, 0]
        odds = logs[:, sidewalk] - logs[:, road]
        odds = odds + np.float32(self.weight) * np.clip(said, np.float32(-MOST_NAT), np.float32(MOST_NAT))
        both, logs = np.logaddexp(logs[:, road], logs[:, sidewalk]), logs.copy()
        logs[:, sidewalk] = both - np.logaddexp(0, -odds)
        logs[:, road] = both - np.logaddexp(0, odds)
        return logs


@cache
def shipped() -> BoostedTrees:
    """The trees that ship with the package, of the classes 0 road and 1 sidewalk."""
    with open_archive(FILE) as archive:
        trees = BoostedTrees(*(archive.array(field.name).read() for field in fields(BoostedTrees)))
    trees.check(len(COLUMNS), 2)
    return trees

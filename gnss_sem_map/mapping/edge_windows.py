"""What the first window of a range of chunks tells of motion, on disk: the chunk before it needs it, too.

Another process maps that chunk. Without the file, or with one that is damaged or of another run, it looks at these
scans itself, with the same result.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.dynamics.clusters import PointSets, Segments
from gnss_sem_map.dynamics.image_rows import Rows
from gnss_sem_map.dynamics.observation import Observation
from gnss_sem_map.dynamics.sweep_delays import SweepDelays
from gnss_sem_map.dynamics.visibility import RangeImage
from gnss_sem_map.files.memo import recall, remember
from gnss_sem_map.files.work_folder import EDGES


@dataclass(frozen=True)
class EdgeWindows:
    """What the run with this fingerprint has saved in its work folder."""

    work: Path
    fingerprint: str

    def save(self, observations: Sequence[Observation], chunk: int) -> None:
        """Save the observations of the first window of a chunk; raises DataError."""
        arrays = {f"{n}.{name}": a for n, one in enumerate(observations) for name, a in _arrays(one).items()}
        remember(self._file(chunk), self.fingerprint, {"count": len(observations)}, arrays)

    def read(self, chunk: int, rows: Rows) -> list[Observation] | None:
        """Those of the first window of a chunk, by a LiDAR with these rows; None where they are not saved."""
        found = recall(self._file(chunk), self.fingerprint)
        if found is None:
            return None
        return [_observation(found.of(str(n)), rows) for n in range(found.about["count"])]

    def _file(self, chunk: int) -> Path:
        return self.work / EDGES / f"{chunk}.npz"


def _arrays(one: Observation) -> dict[str, Any]:
    seen, segments = one.seen, one.segments
    parts = {field.name: getattr(segments.parts, field.name) for field in fields(PointSets)}
    return parts | {
        "frame": np.array(one.number), "stamp": np.array(one.stamp),
        "image": seen.image, "T_lidar_map": seen.T_lidar_map,
        "keys": segments.keys, "number": segments.number, "truncated": segments.truncated,
        "delays": one.delays.seconds,
    }  # fmt: skip


def _observation(arrays: Mapping[str, NDArray[Any]], rows: Rows) -> Observation:
    parts = PointSets(**{field.name: arrays[field.name] for field in fields(PointSets)})
    segments = Segments(arrays["keys"], parts, arrays["number"], arrays["truncated"])
    seen = RangeImage(arrays["image"], arrays["T_lidar_map"], rows)
    delays = SweepDelays(arrays["delays"])
    return Observation(int(arrays["frame"]), float(arrays["stamp"]), seen, segments, delays)

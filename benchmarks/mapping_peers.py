"""Other people's tools doing what the map does, for `mapping.py`: each is imported when it is asked for.

A builder raises ImportError where its package is not installed, and returns what is then timed.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

os.environ.setdefault("POLARS_MAX_THREADS", "1")

import numpy as np
import numpy_chain
from numpy.typing import NDArray

from gnss_sem_map.mapping.fusion import Drive
from gnss_sem_map.mapping.labelled_scans import LabelledScan
from gnss_sem_map.sensor_log import Points


def _pose(job: Drive, seen: LabelledScan) -> NDArray[np.float64]:
    T = np.asarray(job.trajectory.at([seen.scan.stamp], 0.15)[0] @ job.log.calibration.T_imu_lidar)
    left, _, right = np.linalg.svd(T[:3, :3])  # kiss-icp refuses a rotation off by 1e-9, as KITTI's are
    T[:3, :3] = left @ right
    return T


def open3d_hash(job: Drive) -> Callable[[LabelledScan, Points], None]:
    """Open3D's hash of integer voxels, sums and hits in numpy."""
    import open3d as o3d

    core, capacity = o3d.core, 3_000_000
    voxels = core.HashSet(capacity, core.int32, (3,), core.Device("CPU:0"))
    evidence, hits = np.zeros((capacity, 5), np.int32), np.zeros(capacity, np.uint32)
    logs = numpy_chain.log_table(5, 5)

    def add(seen: LabelledScan, points: Points) -> None:
        T = _pose(job, seen)
        p_map = points.xyz[seen.valid].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        indices = core.Tensor.from_numpy(np.floor(p_map / job.settings.mapping.voxel_size_m).astype(np.int32))
        voxels.insert(indices)
        slots = voxels.find(indices)[0].numpy()
        np.add.at(hits, slots, 1)
        looked = seen.pixels >= 0
        looks = numpy_chain.log_likelihoods(seen.classes[seen.pixels[looked]], logs, 5)
        for c in range(5):
            np.add.at(evidence[:, c], slots[looked], looks[:, c])

    return add


def kiss_icp_map(job: Drive) -> Callable[[LabelledScan, Points], None]:
    """KISS-ICP's local map."""
    from kiss_icp.mapping import VoxelHashMap

    voxels = VoxelHashMap(job.settings.mapping.voxel_size_m, 120.0, 20)
    return lambda seen, points: voxels.update(points.xyz[seen.valid].astype(np.float64), _pose(job, seen))


def pandas_groups(columns: dict[str, NDArray[Any]]) -> Callable[[], int]:
    """pandas, in memory."""
    import pandas

    frame = pandas.DataFrame(columns)
    return lambda: len(frame.groupby("key", sort=False).sum())


def duckdb_groups(columns: dict[str, NDArray[Any]]) -> Callable[[], int]:
    """DuckDB on one thread, the table its own."""
    import duckdb
    import pyarrow

    base = duckdb.connect(config={"threads": 1})
    base.register("points", pyarrow.table(columns))
    base.execute("create table t as select * from points")
    sums = ", ".join(f"sum({name})" for name in columns if name != "key")
    return lambda: len(base.execute(f"select key, {sums} from t group by key").fetchnumpy()["key"])


def polars_groups(columns: dict[str, NDArray[Any]]) -> Callable[[], int]:
    """polars on one thread."""
    import polars

    frame = polars.DataFrame(columns)
    return lambda: len(frame.group_by("key").agg(polars.all().sum()))

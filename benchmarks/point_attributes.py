"""What intensity and the last moment would cost on disk, if tiles kept them: bytes per voxel of columns as in a tile.

python benchmarks/point_attributes.py DRIVE
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.mapping.labelled_scans import Drive, map_points
from gnss_sem_map.mapping.trajectory import estimate_trajectory
from gnss_sem_map.run_stats import RunStats
from gnss_sem_map.voxels.tile_files import PACKING
from gnss_sem_map.voxels.voxel_map import keys_of

INTENSITY_BITS = (8, 4, 3)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("drive", type=Path)
    log, settings = open_drive(parser.parse_args().drive), Settings()
    trajectory, _ = estimate_trajectory(log, settings, RunStats())
    drive = Drive(log, trajectory, None, settings)
    keys, scans, sums = [], [], []
    for number, scan in enumerate(log.scans):
        points = scan.read()
        p_map, usable = map_points(points, scan, drive)
        intensity = np.clip(np.rint(255 * points.intensity[usable]), 0, 255).astype(np.int64)
        found, voxel = np.unique(keys_of(p_map, settings.mapping.voxel_size_m), return_inverse=True)
        keys.append(found)
        scans.append(np.full(len(found), number))
        sums.append(
            np.stack([np.bincount(voxel, intensity >> (8 - bits)) for bits in INTENSITY_BITS], axis=1)
        )
    found, voxel = np.unique(np.concatenate(keys), return_inverse=True)
    last = np.zeros(len(found), np.int64)
    np.maximum.at(last, voxel, np.concatenate(scans))
    print(f"{log.name}: {len(found):,} voxels of {len(log.scans)} scans, bytes per voxel:")
    for bits, column in zip(INTENSITY_BITS, np.concatenate(sums).T, strict=True):
        print(f"sum of intensities of {bits} bits  {bytes_each(np.bincount(voxel, column)):.2f}")
    print(f"last scan that saw it        {bytes_each(last):.2f}")


def bytes_each(values: NDArray[np.floating] | NDArray[np.int64]) -> float:
    """Of a column of integers, in the order of the keys, packed as in a tile."""
    sink = pa.BufferOutputStream()
    pq.write_table(
        pa.table({"values": np.asarray(values, np.int32)}), sink, compression="zstd", compression_level=PACKING,
        use_dictionary=False, write_statistics=False, store_schema=False,
        column_encoding={"values": "DELTA_BINARY_PACKED"},
    )  # fmt: skip
    return len(sink.getvalue()) / len(values)


if __name__ == "__main__":
    main()

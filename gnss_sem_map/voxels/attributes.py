"""Attributes of voxels: the last moment and the intensity, in a Parquet file beside the map for each of its tiles.

Neither is a sum, so neither is in the tiles of a map, from which drives and moving objects are subtracted. A row of a
file belongs to the voxel in the same row of the tile.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import read_bytes, shown
from gnss_sem_map.voxels.map_json import name_of
from gnss_sem_map.voxels.tile_files import PACKING, Tile, arrow_column, numbers_of

ATTRIBUTES = "attributes"
"""Folder in a run."""


@dataclass(frozen=True, eq=False)
class Attributes:
    """What the scans say of voxels beside their classes."""

    last_us: NDArray[np.int64]
    """(v,) when the last point of a voxel was measured, Unix time in us; 0 where none is known."""
    intensity: NDArray[np.uint8]
    """(v,) the median of its points, 255 for an intensity of 1; of two in the middle the lower one."""

    def __getitem__(self, chosen: NDArray[np.int64]) -> Attributes:
        return Attributes(self.last_us[chosen], self.intensity[chosen])


def write_tile(attributes: Attributes, folder: Path, tile: Tile) -> None:
    """Write the attributes of a tile; raises OSError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns: dict[str, NDArray[Any]] = {
        "last_us": attributes.last_us,
        "intensity": attributes.intensity.astype(np.int32),
    }
    table = pa.table({name: arrow_column(values) for name, values in columns.items()})
    with (folder / name_of(tile)).open("wb") as file:
        pq.write_table(
            table, file, compression="zstd", compression_level=PACKING, use_dictionary=False,
            write_statistics=False, store_schema=False, write_page_checksum=True,
            column_encoding=dict.fromkeys(columns, "DELTA_BINARY_PACKED"),
        )  # fmt: skip


def read_tile(folder: Path, tile: Tile, voxels: int) -> Attributes:
    """The attributes of a tile with so many voxels; raises DataError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = folder / name_of(tile)
    content = read_bytes(path)
    try:
        table = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True).read()
        if table.num_rows != voxels:
            raise ValueError(f"found {table.num_rows} voxels, expected {voxels}")
        last_us, intensity = numbers_of(table, "last_us"), numbers_of(table, "intensity")
        if not ((intensity >= 0) & (intensity <= 255)).all():
            raise ValueError("it has intensities beyond 0..255")
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DataError(
            f"{shown(path)}: damaged attributes ({reason}); make the run again with --write-labels, or remove the"
            f" folder {shown(folder)} to export without them"
        ) from None
    return Attributes(last_us.astype(np.int64), intensity.astype(np.uint8))

"""The files that a refined map is exported to, for everybody's own tools."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.pictures import write_perspective, write_topview
from gnss_sem_map.export.point_cloud import write_laz, write_ply
from gnss_sem_map.export.raster import write_topview_geotiff
from gnss_sem_map.export.viewer import write_viewer
from gnss_sem_map.memory import release_memory


@dataclass(frozen=True)
class Format:
    """One kind of file."""

    name: str
    file: str
    what: str
    write: Callable[[Exported, Path], None]


SMALL = 1_000_000
"""Voxels of a map."""
FORMATS = (
    Format(
        "viewer", "viewer.html", "the map to turn and to ask, in any browser, offline",
        lambda e, path: write_viewer(e.map, e.tracks, path, e.title or "Semantic map", changes=e.changes),
    ),
    Format(
        "laz", "map.laz",
        "every voxel as LAS 1.4 in UTM, with ASPRS codes, confidence and state, for QGIS and CloudCompare",
        write_laz,
    ),
    Format("ply", "map.ply", "the labelled voxels in map metres, coloured by class", write_ply),
    Format(
        "geotiff", "topview_class.tif", "the classes from above as GeoTIFF in UTM, for QGIS",
        write_topview_geotiff,
    ),
    Format("topview", "topview.png", "the map from above, north up", write_topview),
    Format(
        "perspective", "perspective.png", "the map as a camera behind the vehicle would see it",
        write_perspective,
    ),
)  # fmt: skip


def write_exports(exported: Exported, folder: Path) -> None:
    """All files that can be written of a map: two at a time of a small one, as each takes memory with its size."""

    def write(one: Format) -> None:
        one.write(exported, folder / one.file)
        release_memory()  # 50 MB of each

    possible = [each for each in FORMATS if exported.map.frame is not None or each.name != "geotiff"]
    _ = exported.extent  # once, before both threads ask for it
    with ThreadPoolExecutor(2 if exported.extent.count < SMALL else 1) as pool:
        # the last takes longest, so it begins
        writing = [pool.submit(write, one) for one in reversed(possible)]
    for each in writing:
        each.result()

"""The files that a refined map is exported to, for everybody's own tools."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path

from gnss_sem_map.export.copc import write_copc
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.flight import write_flight
from gnss_sem_map.export.geopackage import write_geopackage
from gnss_sem_map.export.nav2 import write_nav2
from gnss_sem_map.export.pictures import write_perspective, write_topview
from gnss_sem_map.export.point_cloud import write_laz, write_ply, write_removed
from gnss_sem_map.export.raster import write_topview_geotiff
from gnss_sem_map.export.terrain import write_terrain
from gnss_sem_map.export.viewer import write_viewer
from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.process.thread_pools import thread_pool


@dataclass(frozen=True)
class Format:
    """One kind of file."""

    name: str
    file: str
    """Or the folder of several."""
    what: str
    write: Callable[[Exported, Path], None]
    needs_georeference: bool = False
    on_demand: bool = False
    """Written by `gnss-sem-map export` alone."""


LARGE = 3_000_000
"""Voxels of a map. One of 2.8 million, written two files at a time on 2 cores, takes 9 s in place of 13 s, and 70 MB
more; mapping takes more memory than that."""
FORMATS = (
    Format(
        "viewer", "viewer.html", "the map to turn and to ask, in any browser, offline",
        lambda e, path: write_viewer(
            e.map, e.tracks, path, e.title or "Semantic map", changes=e.changes, georeference=e.georeference
        ),
    ),
    Format(
        "laz", "map.laz",
        "the map as LAS 1.4, a point per voxel, with ASPRS codes, confidence and state, for QGIS and CloudCompare",
        write_laz,
    ),
    Format("removed", "removed.laz", "the voxels of moving objects that are not in map.laz", write_removed),
    Format("ply", "map.ply", "the shown voxels in map metres, coloured by class, grey where they have none", write_ply),
    Format(
        "geotiff", "topview_class.tif", "the classes from above as cloud-optimised GeoTIFF, for QGIS",
        write_topview_geotiff, needs_georeference=True,
    ),
    Format(
        "geopackage", "map.gpkg",
        "areas of road and sidewalk, kerb lines, outlines of buildings and vehicles, for QGIS and ArcGIS",
        write_geopackage, needs_georeference=True,
    ),
    Format("topview", "topview.png", "the map from above, north up", write_topview),
    Format(
        "perspective", "perspective.png", "the map as a camera behind the vehicle would see it",
        write_perspective,
    ),
    Format(
        "flight", "flight.webp", "a flight over the map along the longest track, as a moving picture",
        write_flight, on_demand=True,
    ),
    Format(
        "copc", "map.copc.laz", "map.laz as an octree that is read in parts, for streaming and web viewers",
        write_copc, on_demand=True,
    ),
    Format(
        "nav2", "nav2", "occupancy grid and costmap for robots, as Nav2 reads them",
        write_nav2, on_demand=True,
    ),
    Format(
        "terrain", "terrain", "heights of the ground (dtm.tif) and of the surface (dsm.tif), with standard deviations",
        write_terrain, needs_georeference=True, on_demand=True,
    ),
)  # fmt: skip


def write_exports(exported: Exported, folder: Path, progress: Progress = silent) -> None:
    """All files that are made of every map: two at a time, but one of a large map: each takes memory with its size."""

    def write(one: Format) -> None:
        one.write(exported, folder / one.file)
        release_memory()  # 50 MB of each

    is_georeferenced = exported.georeference is not None
    possible = [
        each for each in FORMATS if not each.on_demand and (is_georeferenced or not each.needs_georeference)
    ]
    _ = exported.extent  # once, before both threads ask for it
    with thread_pool(1 if exported.extent.count > LARGE else 2) as pool:
        # the last takes longest, so it begins
        writing = [pool.submit(write, one) for one in reversed(possible)]
        for done, each in enumerate(as_completed(writing), 1):
            each.result()
            progress("export", done, len(writing))

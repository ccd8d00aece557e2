"""The files that a refined map is exported to, for everybody's own tools."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.pictures import write_perspective, write_topview
from gnss_sem_map.export.point_cloud import write_laz, write_ply
from gnss_sem_map.export.raster import write_topview_geotiff
from gnss_sem_map.export.viewer import write_viewer
from gnss_sem_map.voxels.semantic_map import SemanticMap


@dataclass(frozen=True, eq=False)
class Exported:
    """A refined map and what its files say beside it."""

    map: SemanticMap
    frame: LocalFrame | None
    """None for a map without a georeference."""
    driven: Trajectory
    """The track from which pictures show the map."""
    title: str


@dataclass(frozen=True)
class Format:
    """One kind of file."""

    name: str
    file: str
    what: str
    write: Callable[[Exported, Path], None]


FORMATS = (
    Format(
        "viewer", "viewer.html", "the map to turn and to ask, in any browser, offline",
        lambda e, path: write_viewer(e.map, e.driven, path, title=e.title),
    ),
    Format(
        "laz", "map.laz",
        "every voxel as LAS 1.4 in UTM, with ASPRS codes, confidence and state, for QGIS and CloudCompare",
        lambda e, path: write_laz(e.map, e.frame, path),
    ),
    Format(
        "ply", "map.ply", "the labelled voxels in map metres, coloured by class",
        lambda e, path: write_ply(e.map, path, e.frame),
    ),
    Format(
        "geotiff", "topview_class.tif", "the classes from above as GeoTIFF in UTM, for QGIS",
        lambda e, path: write_topview_geotiff(e.map, _frame(e), path),
    ),
    Format(
        "topview", "topview.png", "the map from above, north up",
        lambda e, path: write_topview(e.map, path, e.driven, title=e.title),
    ),
    Format(
        "perspective", "perspective.png", "the map as a camera behind the vehicle would see it",
        lambda e, path: write_perspective(e.map, path, e.driven),
    ),
)  # fmt: skip


def _frame(exported: Exported) -> LocalFrame:
    if exported.frame is None:
        raise DataError(
            f"{exported.title}: a GeoTIFF needs a georeference; this map is in its drive's own poses"
        )
    return exported.frame


def write_exports(exported: Exported, folder: Path) -> None:
    """All files that can be written of a map, two at a time."""
    possible = [each for each in FORMATS if exported.frame is not None or each.name != "geotiff"]
    with ThreadPoolExecutor(2) as pool:
        # the last takes longest, so it begins
        writing = [pool.submit(each.write, exported, folder / each.file) for each in reversed(possible)]
    for each in writing:
        each.result()

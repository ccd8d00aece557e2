"""The map as a point cloud, one point per voxel: PLY for viewing, LAZ with UTM coordinates and class codes."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.utm import to_utm
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels.semantic_map import SemanticMap, State
from gnss_sem_map.voxels.tiles import TiledMap

if TYPE_CHECKING:
    import laspy

PLY_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"),
     ("label", "u1"), ("confidence", "<f4"), ("hits", "<u4"), ("state", "u1")]
)  # fmt: skip
PLY_TYPES = {"<f4": "float", "<u4": "uint", "|u1": "uchar"}
PLY_UNLABELLED = 255
UNLABELLED_COLOUR = (150, 150, 150)
LAZ_SCALE_M = 0.001
LAZ_CHUNK = 250_000
"""Points converted at a time."""
NEVER_CLASSIFIED, UNCLASSIFIED = 0, 1  # ASPRS codes: nobody looked, and looked without a result
EXTRA_BYTES = (
    ("sem_label", "uint16", "SemanticKITTI raw id, 0: none"),
    ("confidence", "float32", "probability of the class"),
    ("hits", "uint32", "LiDAR points in the voxel"),
    ("state", "uint8", "origin of the class, 4: removed"),
)


def colours(labels: NDArray[np.int8], label_set: LabelSet) -> NDArray[np.uint8]:
    """Colours of labels (v,), grey where there is none: (v, 3) RGB."""
    palette = np.vstack([label_set.colours, UNLABELLED_COLOUR]).astype(np.uint8)
    return palette[labels]  # -1 is the last row


def write_ply(exported: Exported, path: Path | str) -> None:
    """Write the visible voxels as a binary PLY: centre, colour, class, confidence, hits and state.

    Coordinates are float32 metres of the map frame (east, north, up), rounded by less than 1 mm within 8 km
    of the origin; the comments say where that origin is on Earth, if known, and which class each `label` is (255:
    none). Raises DataError when the file cannot be written.
    """
    with replacing(path) as file:
        file.write(_ply_header(exported.map, exported.extent.count))
        for piece in exported.map:
            file.write(_ply_vertices(piece[exported.extent.visible(piece)]).data)


def _ply_vertices(piece: SemanticMap) -> NDArray[np.void]:
    voxels, labels = piece.voxels, piece.labels
    vertices = np.empty(len(voxels), PLY_VERTEX)
    vertices["x"], vertices["y"], vertices["z"] = voxels.centres.T
    vertices["red"], vertices["green"], vertices["blue"] = colours(labels, voxels.label_set).T
    vertices["label"] = np.where(labels < 0, PLY_UNLABELLED, labels)
    vertices["confidence"], vertices["hits"], vertices["state"] = piece.confidence, voxels.hits, piece.states
    return vertices


def _ply_header(tiled_map: TiledMap, count: int) -> bytes:
    label_set, frame = tiled_map.label_set, tiled_map.frame
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment gnss-sem-map {version('gnss-sem-map')}",
        f"comment map frame: x east, y north, z up, metres; voxel {tiled_map.voxel_size_m} m",
    ]
    if frame is not None:
        lines.append(
            "comment origin (WGS 84, ellipsoidal height):"
            f" lat_deg {frame.lat_deg:.10f} lon_deg {frame.lon_deg:.10f} alt_m {frame.alt_m:.4f}"
        )
    lines += [f"comment label {i}: {_plain(name)}" for i, name in enumerate(label_set.names)]
    lines += [f"comment label {PLY_UNLABELLED}: unlabelled", f"element vertex {count}"]
    lines += [f"property {PLY_TYPES[PLY_VERTEX[name].str]} {name}" for name in PLY_VERTEX.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def _plain(name: str) -> str:
    """A class name as one line of printable ASCII, for any content of the user's class file."""
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in name)


def write_laz(exported: Exported, path: Path | str) -> None:
    """Write every voxel as LAZ (LAS 1.4, point format 7) in the UTM zone of the map's origin.

    Heights are above the WGS 84 ellipsoid; a map without a frame stays in its own metres, without a CRS.
    `classification` holds the class set's ASPRS codes, 0 where no camera looked and 1 where looking gave no class;
    removed voxels keep their class and are flagged `withheld`. Extra bytes: `sem_label` (SemanticKITTI raw id),
    `confidence`, `hits`, `state`. Raises DataError when the file cannot be written. Source: ASPRS LAS 1.4 R15
    (coordinate system as OGC WKT 1).
    """
    import laspy

    frame = exported.map.frame
    header = las_header(exported.map.label_set, frame)
    with (
        replacing(path) as file,
        laspy.open(file, mode="w", header=header, do_compress=True, closefd=False) as writer,
    ):
        for piece in exported.map:
            for start in range(0, len(piece), LAZ_CHUNK):
                part = piece[np.arange(start, min(start + LAZ_CHUNK, len(piece)))]
                writer.write_points(_las_points(part, frame, header))


def las_header(label_set: LabelSet, frame: LocalFrame | None) -> laspy.LasHeader:
    """The header of a file of voxels: coordinate system, names of the classes, extra bytes."""
    import laspy
    from laspy.vlrs.known import ClassificationLookupVlr, WktCoordinateSystemVlr
    from pyproj import CRS

    header = laspy.LasHeader(point_format=7, version="1.4")
    header.generating_software = f"gnss-sem-map {version('gnss-sem-map')}"
    header.scales = np.full(3, LAZ_SCALE_M)
    header.offsets = np.floor(_placed(np.zeros((1, 3)), frame)[0])
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind, text) for name, kind, text in EXTRA_BYTES])
    header.global_encoding.wkt = True
    if frame is not None:
        # LAS 1.4 asks for WKT 1; laspy's own add_crs writes WKT 2, which older readers refuse
        header.vlrs.append(WktCoordinateSystemVlr(CRS.from_epsg(frame.utm_epsg).to_wkt("WKT1_GDAL")))
    lookup = ClassificationLookupVlr()
    for code, name in zip(label_set.asprs_codes.tolist(), label_set.names, strict=True):
        lookup[code] = _plain(name)[:15]
    header.vlrs.append(lookup)
    return header


def _placed(p_map: NDArray[np.float64], frame: LocalFrame | None) -> NDArray[np.float64]:
    """Map points in the coordinates of the file: UTM, or map frame if the map is not georeferenced."""
    return p_map if frame is None else to_utm(frame, p_map)


def _las_points(
    piece: SemanticMap, frame: LocalFrame | None, header: laspy.LasHeader
) -> laspy.ScaleAwarePointRecord:
    import laspy

    labels, states, label_set = piece.labels, piece.states, piece.voxels.label_set
    points = laspy.ScaleAwarePointRecord.zeros(len(labels), header=header)
    points.x, points.y, points.z = _placed(piece.voxels.centres, frame).T
    points.red, points.green, points.blue = 257 * colours(labels, label_set).T.astype(np.uint16)  # to 16 bit
    points.return_number[:] = 1
    points.number_of_returns[:] = 1
    unlabelled = np.where(states == State.UNOBSERVED, NEVER_CLASSIFIED, UNCLASSIFIED)
    points.classification = np.where(labels < 0, unlabelled, label_set.asprs_codes[labels])
    points.withheld = states == State.REMOVED
    points.sem_label = np.where(labels < 0, 0, label_set.semantic_kitti_ids[labels])
    points.confidence, points.hits, points.state = piece.confidence, piece.voxels.hits, states
    return points

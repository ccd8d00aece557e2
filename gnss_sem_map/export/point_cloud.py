"""The map as a point cloud, one point per voxel: PLY for viewing, LAZ with a CRS and class codes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import date, timedelta
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.gnss_files.time_systems import GPS_EPOCH_NS, gps_of_utc_ns
from gnss_sem_map.export.exported import Exported
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.files.atomic import replacing
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.voxels.attributes import Attributes
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
ADJUSTED_BY_S = 1_000_000_000
UNLABELLED_COLOUR = (150, 150, 150)
LAZ_SCALE_M = 0.001
LAZ_CHUNK = 250_000
"""Points converted at a time."""
NOT_DATED = date(1970, 1, 1)
"""Files are dated by their last measurement: the same run on another day writes the same bytes."""
TEXT_AREA = 3
"""Record of the LAS specification for a text that people read."""
NEVER_CLASSIFIED, UNCLASSIFIED = 0, 1  # ASPRS codes: nobody looked, and looked without a result
EXTRA_BYTES = (
    ("sem_label", "uint16", "SemanticKITTI raw id, 0: none"),
    ("confidence", "float32", "probability of the class"),
    ("hits", "uint32", "LiDAR points in the voxel"),
    ("state", "uint8", "origin of the class, 4: removed"),
)


def colours(labels: NDArray[np.int8], label_set: LabelSet) -> NDArray[np.uint8]:
    """Colours of labels (v,), grey where there is none: (v, 3) RGB."""
    palette = np.vstack([label_set.legend.colours, UNLABELLED_COLOUR]).astype(np.uint8)
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
    vertices["label"] = np.where(labels < 0, PLY_UNLABELLED, labels.astype(np.uint8))
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
    lines += [f"comment label {i}: {_plain(name)}" for i, name in enumerate(label_set.legend.names)]
    lines += [f"comment label {PLY_UNLABELLED}: unlabelled", f"element vertex {count}"]
    lines += [f"property {PLY_TYPES[PLY_VERTEX[name].str]} {name}" for name in PLY_VERTEX.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def _plain(name: str) -> str:
    """A class name as one line of printable ASCII, for any content of the user's class file."""
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in name)


def write_laz(exported: Exported, path: Path | str) -> None:
    """Write the map as LAZ (LAS 1.4, point format 7): every voxel that was not removed.

    Coordinates are those of the delivery (see `Georeference`), and a text in the header says which; a map without a
    frame stays in its own metres, without a CRS. `classification` holds the class set's ASPRS codes, 66 for `other`, 0
    where no camera looked and 1 where looking gave no class; colours are those of the classes. Extra bytes: `sem_label`
    (SemanticKITTI raw id, 99 for `other`), `confidence`, `hits`, `state`. `gps_time` (adjusted standard GPS time, s) is
    when the last point of the voxel was measured, `intensity` the median of its points, 65535 for 1; both are 0 where
    they are not known, see `voxels.attributes`. Raises DataError when the file cannot be written. Source: ASPRS LAS 1.4
    R15 (coordinate system as OGC WKT 1).
    """
    _write_points(exported, path, removed=False)


def write_removed(exported: Exported, path: Path | str) -> None:
    """Write the removed voxels, those of moving objects, as `write_laz` does; they are flagged `withheld` as well.

    `user_data` is the `Reason` of each.
    """
    _write_points(exported, path, removed=True)


def _write_points(exported: Exported, path: Path | str, removed: bool) -> None:
    georeference = exported.georeference
    header = las_header(exported.map.label_set, georeference, has_times=exported.attributes is not None)
    with laz_writer(path, header) as writer:
        last_us = 0
        for piece, attributes in exported.tiles():
            chosen = np.flatnonzero((piece.states == State.REMOVED) == removed)
            for start in range(0, len(chosen), LAZ_CHUNK):
                part = chosen[start : start + LAZ_CHUNK]
                of_part = None if attributes is None else attributes[part]
                writer.write_points(las_points(piece[part], of_part, georeference, header))
                if of_part is not None:
                    last_us = max(last_us, int(of_part.last_us.max()))
        writer.header.creation_date += timedelta(microseconds=last_us)


@contextmanager
def laz_writer(path: Path | str, header: laspy.LasHeader) -> Iterator[laspy.LasWriter]:
    """What writes the points of a LAZ file, which is there when it is complete; raises DataError."""
    import laspy

    with (
        replacing(path) as file,
        laspy.open(file, mode="w", header=header, do_compress=True, closefd=False) as writer,
    ):
        yield writer


def las_header(
    label_set: LabelSet, georeference: Georeference | None, has_times: bool = False
) -> laspy.LasHeader:
    """The header of a file of voxels: coordinate system, what `gps_time` is, names of the classes, extra bytes."""
    import laspy
    from laspy.header import GpsTimeType
    from laspy.vlrs.known import ClassificationLookupVlr, WktCoordinateSystemVlr

    header = laspy.LasHeader(point_format=7, version="1.4")
    header.creation_date = NOT_DATED
    header.generating_software = f"gnss-sem-map {version('gnss-sem-map')}"[:32]  # no longer by the standard
    header.scales = np.full(3, LAZ_SCALE_M)
    header.offsets = np.floor(_placed(np.zeros((1, 3)), georeference)[0])
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind, text) for name, kind, text in EXTRA_BYTES])
    header.global_encoding.wkt = True
    if has_times:
        header.global_encoding.gps_time_type = GpsTimeType.STANDARD
    if georeference is not None:
        # LAS 1.4 asks for WKT 1; laspy's own add_crs writes WKT 2, which older readers refuse
        header.vlrs.append(WktCoordinateSystemVlr(georeference.crs.to_wkt("WKT1_GDAL")))
        header.vlrs.append(
            laspy.VLR("LASF_Spec", TEXT_AREA, "CRS and heights", _plain(georeference.words).encode())
        )
    lookup, legend = ClassificationLookupVlr(), label_set.legend
    for code in np.unique(legend.asprs_codes).tolist():
        named = np.flatnonzero(legend.asprs_codes == code)
        lookup[code] = "/".join(_plain(legend.names[i]) for i in named)[:15]
    header.vlrs.append(lookup)
    return header


def _placed(p_map: NDArray[np.float64], georeference: Georeference | None) -> NDArray[np.float64]:
    """Map points in the coordinates of the file: the map frame if the map is not georeferenced."""
    return p_map if georeference is None else georeference.from_map(p_map)


def las_points(
    piece: SemanticMap,
    attributes: Attributes | None,
    georeference: Georeference | None,
    header: laspy.LasHeader,
) -> laspy.ScaleAwarePointRecord:
    """One point for every voxel."""
    labels, states = piece.labels, piece.states
    points = labelled_points(
        _placed(piece.voxels.centres, georeference), labels, piece.voxels.label_set, header
    )
    points.classification[(labels < 0) & (states == State.UNOBSERVED)] = NEVER_CLASSIFIED
    points.withheld, points.user_data = states == State.REMOVED, piece.told_reasons
    points.confidence, points.hits, points.state = piece.confidence, piece.voxels.hits, states
    if attributes is not None:
        points.gps_time = adjusted_gps_time(attributes.last_us)
        points.intensity = 257 * attributes.intensity.astype(np.uint16)  # to 16 bit
    return points


def labelled_points(
    p: NDArray[np.float64], labels: NDArray[np.int8], label_set: LabelSet, header: laspy.LasHeader
) -> laspy.ScaleAwarePointRecord:
    """Points at (n, 3) m, in the coordinates of the file, with codes and colours of their labels (n,), -1: none."""
    import laspy

    points = laspy.ScaleAwarePointRecord.zeros(len(labels), header=header)
    points.x, points.y, points.z = p.T
    points.red, points.green, points.blue = 257 * colours(labels, label_set).T.astype(np.uint16)  # to 16 bit
    points.return_number[:] = 1
    points.number_of_returns[:] = 1
    points.classification = np.where(labels < 0, UNCLASSIFIED, label_set.legend.asprs_codes[labels])
    points.sem_label = np.where(labels < 0, 0, label_set.legend.semantic_kitti_ids[labels])
    return points


def adjusted_gps_time(unix_us: NDArray[np.int64]) -> NDArray[np.float64]:
    """Moments (n,), Unix time in us, as adjusted standard GPS time: s since the GPS epoch, with leap seconds, less 1e9.

    0 before that epoch, as in drives whose log does not say the date. Source: ASPRS LAS 1.4 R15, table 4.
    """
    gps_ns = gps_of_utc_ns(1000 * unix_us) - GPS_EPOCH_NS
    return np.where(gps_ns < 0, 0.0, (gps_ns - ADJUSTED_BY_S * 1_000_000_000) / 1e9)

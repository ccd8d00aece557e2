"""What changed between sessions, for everybody's own tools: boxes as GeoJSON, voxels as LAZ."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.evaluation.changes import ChangedObject
from gnss_sem_map.export.georeference import Georeference
from gnss_sem_map.export.longitudes import DEGREE_DIGITS, HEIGHT_DIGITS, near
from gnss_sem_map.export.point_cloud import labelled_points, las_header, laz_writer
from gnss_sem_map.files.atomic import link_or_copy, replacing
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.labels.roles import MOVABLE

CHANGES = "changes"
GEOJSON, LAZ = f"{CHANGES}.geojson", f"{CHANGES}.laz"
APPEARED, VANISHED = 1, 2
"""`user_data` of a voxel."""


@dataclass(frozen=True, eq=False)
class Change:
    """A changed object, and the sessions between which it changed."""

    before: str
    after: str
    thing: ChangedObject

    def about(self, label_set: LabelSet) -> dict[str, Any]:
        """In words and numbers, for run.json, the report and the file."""
        thing = self.thing
        name = label_set.legend.names[thing.label] if thing.label >= 0 else "unknown"
        was_parked = thing.label in label_set.having(*MOVABLE)
        return {
            "change": "appeared" if thing.appeared else "vanished",
            "class": name,
            "kind": "parked" if was_parked else "unknown" if thing.label < 0 else "built",
            "before": self.before,
            "after": self.after,
            "centre_m": thing.centre.round(2).tolist(),
            "size_m": thing.size.round(2).tolist(),
            "yaw_deg": round(float(np.degrees(thing.yaw)), 1),
            "voxels": len(thing.voxels),
            "seen_through": thing.misses,
            "hit": thing.hits,
        }


def write_changes(
    changes: Sequence[Change], georeference: Georeference, label_set: LabelSet, folder: Path
) -> None:
    """Write `changes.geojson` (RFC 7946: the footprint of every box) and `changes.laz`; raises DataError."""
    frame = georeference.frame
    with replacing(folder / GEOJSON) as file:
        features = [_feature(change, frame, label_set) for change in changes]
        file.write(json.dumps({"type": "FeatureCollection", "features": features}, indent=1).encode())
    _write_laz(changes, georeference, label_set, folder / LAZ)


def copy_changes(
    run: Path, folder: Path, before: Georeference, after: Georeference, label_set: LabelSet
) -> None:
    """Take over the changes of a run into another folder, in other coordinates where these differ."""
    for name in (GEOJSON, LAZ):
        if not (run / name).is_file():
            continue
        if name == GEOJSON or before == after:
            link_or_copy(run / name, folder / name)
        else:
            _place_again(run / name, folder / name, before, after, label_set)


def _place_again(
    file: Path, target: Path, before: Georeference, after: Georeference, label_set: LabelSet
) -> None:
    """Write a small LAZ in other coordinates."""
    import laspy

    known = laspy.read(file)
    header = las_header(label_set, after)
    points = laspy.ScaleAwarePointRecord.zeros(len(known.points), header=header)
    for name in set(points.point_format.dimension_names) - {"X", "Y", "Z"}:
        points[name] = known[name]
    points.x, points.y, points.z = after.from_map(before.to_map(np.asarray(known.xyz))).T
    with laz_writer(target, header) as writer:
        writer.write_points(points)


def box_corners(centre: ArrayLike, size: ArrayLike, yaw: float) -> NDArray[np.float64]:
    """Corners (8, 3) m of an upright box: the lower four counter-clockwise, then the upper four above them."""
    c, s = np.cos(yaw), np.sin(yaw)
    flat = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    corners = np.column_stack([np.tile(flat, (2, 1)), np.repeat([-1, 1], 4)]) * np.asarray(size) / 2
    turned = corners @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return np.asarray(turned + np.asarray(centre))


def _feature(change: Change, frame: LocalFrame, label_set: LabelSet) -> dict[str, Any]:
    thing = change.thing
    closed = box_corners(thing.centre, thing.size, thing.yaw)[[0, 1, 2, 3, 0]]
    lat_deg, lon_deg, alt_m = frame.to_geodetic(closed)
    # a box across the 180 degree meridian is not cut: a few metres of it lie beyond 180
    ring = np.column_stack([near(lon_deg, lon_deg[0]), lat_deg]).round(DEGREE_DIGITS).tolist()
    return {
        "type": "Feature",
        "geometry": {
            "type": "Polygon",
            "coordinates": [
                [[*place, alt] for place, alt in zip(ring, alt_m.round(HEIGHT_DIGITS).tolist(), strict=True)]
            ],
        },
        "properties": change.about(label_set),
    }


def _write_laz(
    changes: Sequence[Change], georeference: Georeference, label_set: LabelSet, path: Path
) -> None:
    """The voxels of all objects: class and colour of each, `user_data` 1 appeared or 2 vanished, `point_source_id` the
    number of the object in the GeoJSON file.
    """
    header = las_header(label_set, georeference)
    with laz_writer(path, header) as writer:
        for number, change in enumerate(changes):
            thing = change.thing
            labels = np.full(len(thing.voxels), thing.label, np.int8)
            places = georeference.from_map(thing.voxels.centres)
            points = labelled_points(places, labels, label_set, header)
            points.hits = thing.voxels.hits
            points.user_data[:] = APPEARED if thing.appeared else VANISHED
            points.point_source_id[:] = number % (1 << 16)
            writer.write_points(points)

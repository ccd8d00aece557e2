"""Boxes of KITTI raw drives (`tracklet_labels.xml`) as truth for what moved: an independent, small reader."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.evaluation.metrics import Tables, dynamic, dynamic_counts
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.labelled_scans import Drive, labelled_scans
from gnss_sem_map.scans.deskew import EXTRAPOLATE_S
from gnss_sem_map.sensor_log import Calibration

VEHICLES = {"Car", "Van", "Truck", "Tram"}
MOVING, PARKED, STATIC, IGNORED = 252, 10, 50, 0
"""SemanticKITTI raw ids; what stands and is no vehicle counts as building."""
MARGIN_M, FOOT_M, LEAST_WAY_M = 0.2, 0.15, 2.0
"""Boxes are this much too small; they reach this far into the road; what went farther than the last moved."""
NEAREST_M, FARTHEST_M = 3.0, 50.0


@dataclass(frozen=True, eq=False)
class Box:
    """One object over consecutive frames; poses (k, 4) are x y z of the middle of its bottom, and yaw, in the lidar."""

    kind: str
    size: NDArray[np.float64]
    """length, width, height, m."""
    first_frame: int
    poses: NDArray[np.float64]

    def pose(self, frame: int) -> NDArray[np.float64] | None:
        """Its pose in a frame, or None."""
        k = frame - self.first_frame
        return self.poses[k] if 0 <= k < len(self.poses) else None

    def holds(self, p_lidar: NDArray[np.float64], frame: int) -> NDArray[np.bool_]:
        """Which points (n, 3) are in the box, which is a little too small."""
        pose = self.pose(frame)
        if pose is None:
            return np.zeros(len(p_lidar), np.bool_)
        c, s = np.cos(pose[3]), np.sin(pose[3])
        x, y, z = (p_lidar - pose[:3]).T
        length, width, height = self.size
        inside = (abs(c * x + s * y) <= length / 2 + MARGIN_M) & (abs(c * y - s * x) <= width / 2 + MARGIN_M)
        return np.asarray(inside & (z >= FOOT_M) & (z <= height + MARGIN_M))


def read(drive: Path) -> list[Box]:
    """All boxes of a drive."""
    items = ElementTree.parse(drive / "tracklet_labels.xml").getroot().findall("./tracklets/item")
    return [
        Box(
            kind=item.findtext("objectType", ""),
            size=np.array([float(item.findtext(k, "nan")) for k in "lwh"]),
            first_frame=int(item.findtext("first_frame", "0")),
            poses=np.array(
                [
                    [float(p.findtext(k, "nan")) for k in ("tx", "ty", "tz", "rz")]
                    for p in item.findall("./poses/item")
                ]
            ),
        )
        for item in items
    ]


def moved(box: Box, T_map_lidar: dict[int, NDArray[np.float64]]) -> bool:
    """Whether it went somewhere in these frames (number -> pose of the lidar)."""
    centres = [
        T[:3, :3] @ pose[:3] + T[:3, 3]
        for frame, T in T_map_lidar.items()
        if (pose := box.pose(frame)) is not None
    ]
    return len(centres) > 1 and float(np.linalg.norm(centres[-1] - centres[0])) > LEAST_WAY_M


def truth(
    boxes: list[Box],
    p_lidar: NDArray[np.float64],
    frame: int,
    in_image: NDArray[np.bool_],
    T_map_lidar: dict[int, NDArray[np.float64]],
) -> NDArray[np.uint32]:
    """Raw id of every point (n, 3) of a scan: boxes exist only in the image, and persons and cyclists do not count."""
    ids = np.full(len(p_lidar), STATIC, np.uint32)
    for box in boxes:
        inside = box.holds(p_lidar, frame)
        if box.kind not in VEHICLES:
            ids[inside] = IGNORED
        else:
            ids[inside] = MOVING if moved(box, T_map_lidar) else PARKED
    ranges = np.linalg.norm(p_lidar, axis=1)
    ids[~in_image | (ranges < NEAREST_M) | (ranges > FARTHEST_M)] = IGNORED
    return ids


def in_image(p_lidar: NDArray[np.float64], calibration: Calibration) -> NDArray[np.bool_]:
    """Which points (n, 3) the camera could show."""
    camera = calibration.camera()
    uvw = (p_lidar @ camera.T_camera_lidar[:3, :3].T + camera.T_camera_lidar[:3, 3]) @ camera.K.T
    width, height = camera.image_size
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = uvw[:, 0] / uvw[:, 2], uvw[:, 1] / uvw[:, 2]
    return (uvw[:, 2] > 0.5) & (u >= 0) & (u < width) & (v >= 0) & (v < height)


def removal(drive: Drive, moving: Mapping[int, NDArray[np.int64]], folder: Path) -> dict[str, float | None]:
    """How much of what moved was removed and of what stands kept; `moving` as `MappedChunk.moving`."""
    tables, boxes = Tables.of(open_label_set(drive.settings.classes)), read(folder)
    calibration = drive.log.calibration
    stamps = np.array([scan.stamp for scan in drive.log.scans])
    poses = drive.trajectory.at(stamps, EXTRAPOLATE_S) @ calibration.T_imu_lidar
    T_map_lidar = {scan.number: T for scan, T in zip(drive.log.scans, poses, strict=True)}
    counts = np.zeros((3, 2), np.int64)
    for seen in labelled_scans(drive):
        T = T_map_lidar[seen.scan.number]
        p_lidar = (seen.p_map - T[:3, 3]) @ T[:3, :3]
        true = truth(boxes, p_lidar, seen.scan.number, in_image(p_lidar, calibration), T_map_lidar)
        removed = np.zeros(len(true), np.uint32)
        removed[moving.get(seen.scan.number, [])] = 1
        counts += dynamic_counts(removed, true, tables, seen.scan.name)
    return dynamic(counts)

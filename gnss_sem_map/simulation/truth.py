"""Truth of a drive: trajectory, poses of all vehicles, and the labels of each scan by its image."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from factor_graphs.simulation import Motion
from gnss_sem_map.simulation.camera import SimulatedImage
from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.kitti_rig import T_LIDAR_IMU
from gnss_sem_map.simulation.models import Model
from gnss_sem_map.simulation.sessions import Change
from gnss_sem_map.simulation.tracklets import Box, Tracklet
from gnss_sem_map.simulation.world import World

_RANGE_M = 120.0
# Cityscapes trainId -> the five classes of the map as SemanticKITTI ids; everything else stays unlabelled
_SCORED = np.zeros(256, np.uint32)
_SCORED[[0, 1, 2, 8]] = 40, 48, 50, 70
_SCORED[13:18] = 10
_TRACKLET_KINDS = {"van": "Van", "truck": "Truck", "person": "Pedestrian", "cyclist": "Cyclist"}


def write_trajectory(
    path: Path, motion: Motion, stamps: Floats, zero_s: float, to_map: Callable[[Floats], Floats]
) -> None:
    """T_map_imu in TUM format, stamps in seconds since the log's epoch."""
    T = motion.poses(stamps)
    rows = np.column_stack(
        [stamps - zero_s, to_map(T[:, :3, 3]), Rotation.from_matrix(T[:, :3, :3]).as_quat()]
    )
    np.savetxt(path, rows, fmt="%.9f")


def vehicle_poses(world: World, stamp: float) -> tuple[npt.NDArray[np.int32], Floats]:
    """Instance numbers (k,) of all vehicles, and x, y, z, yaw (k, 4) of the centres of their bottoms."""
    rows = world.scene(stamp, stamp).things
    who = np.flatnonzero(world.instances > 0)
    return world.instances[who], rows[who, :4]


def write_vehicles(
    path: Path, world: World, stamps: Floats, zero_s: float, to_map: Callable[[Floats], Floats]
) -> None:
    """Poses of all vehicles within the LiDAR's range at every scan's stamp, moving or not."""
    details = {number: (name, _size(model), moving) for number, name, model, moving in _everybody(world)}
    lines = ["stamp_s,instance,name,moving,x_m,y_m,z_m,yaw_rad,length_m,width_m,height_m\n"]
    for stamp in stamps:
        here = world.ego.poses([stamp])[0, :2, 3]
        numbers, poses = vehicle_poses(world, float(stamp))
        near = np.hypot(*(poses[:, :2] - here).T) < _RANGE_M
        for number, place, yaw in zip(numbers[near], to_map(poses[near, :3]), poses[near, 3], strict=True):
            name, (length, width, height), moving = details[int(number)]
            x, y, z = place
            yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
            lines.append(
                f"{stamp - zero_s:.6f},{number},{name},{int(moving)},{x:.4f},{y:.4f},{z:.4f},{yaw:.6f},"
                f"{length:.3f},{width:.3f},{height:.3f}\n"
            )
    path.write_text("".join(lines))


def write_changes(
    path: Path, session: int, changes: list[Change], to_map: Callable[[Floats], Floats]
) -> None:
    """What came and went since session 0, as boxes."""
    rows = []
    for change in changes:
        (x, y, z), (length, width, height) = to_map(change.centre[None])[0], change.size
        rows.append({
            "change": "appeared" if change.appeared else "vanished", "cause": change.cause, "name": change.name,
            "labels": list(change.labels), "x_m": round(x, 4), "y_m": round(y, 4), "z_m": round(z, 4),
            "yaw_rad": round(change.yaw, 6), "length_m": round(length, 3), "width_m": round(width, 3),
            "height_m": round(height, 3),
        })  # fmt: skip
    path.write_text(json.dumps({"session": session, "since": 0, "changes": rows}, indent=1) + "\n")


def _everybody(world: World) -> list[tuple[int, str, Model, bool]]:
    """Instance number, model's name, model, and whether it moves during the drive."""
    town = world.town
    parked = [
        (int(n), town.models[t.model]) for n, t in zip(world.instances, town.things, strict=False) if n > 0
    ]
    moving = zip(
        world.instances[len(town.things) :], (town.models[m.model] for m in world.movers), strict=True
    )
    return [(n, m.name, m, False) for n, m in parked] + [(int(n), m.name, m, True) for n, m in moving]


def _size(model: Model) -> tuple[float, float, float]:
    b = model.bounds
    return float(b[3] - b[0]), float(b[4] - b[1]), float(b[5])


def seen_boxes(world: World, sweeps: Floats, seen: list[npt.NDArray[np.uint16]]) -> list[Tracklet]:
    """A tracklet for every visible object, from the first to the last frame that shows it."""
    details = {number: (name, model) for number, name, model, _ in _everybody(world)}
    span: dict[int, tuple[int, int]] = {}
    for frame, shown in enumerate(seen):
        for number in shown.tolist():
            span[number] = (span.get(number, (frame, frame))[0], frame)
    boxes: dict[int, list[Box]] = {number: [] for number in span}
    for frame, stamp in enumerate(sweeps.mean(axis=1)):
        numbers, poses = vehicle_poses(world, float(stamp))
        T = T_LIDAR_IMU @ np.linalg.inv(world.ego.poses([stamp])[0])
        p = poses[:, :3] @ T[:3, :3].T + T[:3, 3]
        turn = np.arctan2(T[1, 0], T[0, 0])
        for number, (x, y, z), yaw in zip(numbers.tolist(), p.tolist(), poses[:, 3].tolist(), strict=True):
            if number in span and span[number][0] <= frame <= span[number][1]:
                heading = (yaw + turn + np.pi) % (2 * np.pi) - np.pi
                boxes[number].append(Box(frame, x, y, z, float(heading)))
    tracklets = []
    for number in sorted(span):
        name, model = details[number]
        length, width, height = _size(model)
        tracklets.append(
            Tracklet(_TRACKLET_KINDS.get(name, "Car"), height, width, length, tuple(boxes[number]))
        )
    return tracklets


def seen_alone(
    image: SimulatedImage, u: npt.NDArray[np.int64], v: npt.NDArray[np.int64], z: Floats
) -> npt.NDArray[np.uint32]:
    """Label of every point of a scan by the true class image: 40 48 10 50 70, 0 where it shows another thing.

    `u`, `v`, `z`: the points' pixels and depths. A point counts as seen when the image's true depth there is its own.
    """
    height, width = image.depth.shape
    inside = (z > 0.5) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    labels = np.zeros(len(z), np.uint32)
    rows, columns = v[inside], u[inside]
    depth = image.depth[rows, columns]
    visible = (depth > 0) & (np.abs(z[inside] - depth) < 0.15 + 0.03 * z[inside])
    labels[inside] = np.where(visible, _SCORED[image.train_ids[rows, columns]], 0)
    return labels

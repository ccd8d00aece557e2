"""Static transforms of a bag: the tree of frames that its calibration is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.datasets.ros.decoding import decode
from gnss_sem_map.errors import DataError

Array = NDArray[np.float64]

TOPIC, KIND = "/tf_static", "tf2_msgs/msg/TFMessage"
MOST_OFF_UNIT = 1e-3
"""A quaternion is normalised; one whose length is farther from 1 is none."""


class StaticTransforms:
    """Poses of frames in their parents: `T_parent_child`, by child."""

    def __init__(self, edges: dict[str, tuple[str, Array]]) -> None:
        self._edges = edges

    @property
    def frames(self) -> list[str]:
        """All frames, sorted."""
        return sorted({*self._edges, *(parent for parent, _ in self._edges.values())})

    def between(self, target: str, source: str) -> Array | None:
        """T_target_source (4, 4), None where no chain of transforms joins them; raises DataError for a circle."""
        to_target, to_source = self._ancestors(target), self._ancestors(source)
        common = next((frame for frame in to_target if frame in to_source), None)
        if common is None:
            return None
        up, down = to_target[common], to_source[common]
        if target == common:
            return down
        inverse = np.asarray(np.linalg.inv(up), np.float64)
        return inverse if source == common else inverse @ down

    def _ancestors(self, frame: str) -> dict[str, Array]:
        """T_ancestor_frame of the frame itself and of all above it, from the nearest on."""
        found, T = {frame: np.eye(4)}, None
        at = frame
        while at in self._edges:
            at, edge = self._edges[at]
            if at in found:
                raise DataError(
                    f"{TOPIC}: found a circle of frames, {' > '.join([*found, at])}; expected a tree; give the poses"
                    " (T_imu_lidar, T_camera_lidar) in rig.yaml"
                )
            T = edge if T is None else edge @ T  # no product with the identity: the edge to the bit
            found[at] = T
        return found


def read_static_transforms(bag: Bag) -> StaticTransforms:
    """The static transforms of a bag; none where it has no such topic. Raises DataError for one that is no pose."""
    edges: dict[str, tuple[str, Array]] = {}
    if bag.kinds.get(TOPIC) != KIND:
        return StaticTransforms(edges)
    messages = bag.messages(TOPIC)
    for k in range(len(messages)):
        for one in decode(bag, messages, k).transforms:
            child, parent = one.child_frame_id.strip("/"), one.header.frame_id.strip("/")
            q, t = one.transform.rotation, one.transform.translation
            edges[child] = (parent, _pose(parent, child, [q.x, q.y, q.z, q.w], [t.x, t.y, t.z]))
    return StaticTransforms(edges)


def _pose(parent: str, child: str, quaternion_xyzw: list[float], translation: list[float]) -> Array:
    off = abs(float(np.linalg.norm(quaternion_xyzw)) - 1.0)
    if not (off <= MOST_OFF_UNIT and np.isfinite(translation).all()):
        raise DataError(
            f"{TOPIC}: {parent} to {child}: found quaternion {quaternion_xyzw} and translation {translation}, expected"
            " a unit quaternion x y z w and metres"
        )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion_xyzw).as_matrix(), translation
    return T

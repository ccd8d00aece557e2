"""Fixed transforms of a bag: the tree of frames that its calibration is.

They are in topics named tf_static, under any namespace; in tf, where a transform stays the same; and in
robot_description, as fixed joints of a URDF (http://wiki.ros.org/urdf/XML/joint). Of one that is told twice, tf_static
counts, then the URDF.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.datasets.ros.decoding import decode
from gnss_sem_map.datasets.ros.kinds import STRING, TRANSFORMS
from gnss_sem_map.errors import DataError

Array = NDArray[np.float64]

TOPIC = "/tf_static"
URDF = "robot_description"
Edges = dict[str, tuple[str, Array]]
"""Parents of frames, and T_parent_child (4, 4)."""
LOOKED_AT = 500
"""Messages of a topic of changing transforms that tell which of them stay the same."""
MOST_XML_BYTES = 2 << 20
MOST_OFF_UNIT = 1e-3
"""A quaternion is normalised; one whose length is farther from 1 is none."""


class StaticTransforms:
    """Poses of frames in their parents: `T_parent_child`, by child."""

    def __init__(self, edges: Edges) -> None:
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
                    f"fixed transforms: found a circle of frames, {' > '.join([*found, at])}; expected a tree; give"
                    " the poses (T_imu_lidar, T_camera_lidar) in rig.yaml"
                )
            T = edge if T is None else edge @ T  # no product with the identity: the edge to the bit
            found[at] = T
        return found


def read_static_transforms(bag: Bag) -> StaticTransforms:
    """The fixed transforms of a bag; none where it has no such topic. Raises DataError for one that is no pose."""
    named = {topic: topic.rpartition("/")[2] for topic in sorted(bag.kinds)}
    edges: Edges = {}
    for name, kinds, read in (
        ("tf", TRANSFORMS, _that_stay),
        (URDF, (STRING,), _described),
        ("tf_static", TRANSFORMS, _static),
    ):
        for topic, last in named.items():
            if last == name and bag.kinds[topic] in kinds:
                edges |= read(bag, topic)
    return StaticTransforms(edges)


def _static(bag: Bag, topic: str) -> Edges:
    messages = bag.messages(topic)
    return {
        child: (parent, _pose(topic, parent, child, xyzw, xyz))
        for k in range(len(messages))
        for parent, child, xyzw, xyz in _transforms(decode(bag, messages, k))
    }


def _that_stay(bag: Bag, topic: str) -> Edges:
    """Those that are told several times, and are always the same."""
    messages = bag.messages(topic)
    told: dict[str, set[tuple[Any, ...]]] = {}
    counts: dict[str, int] = {}
    for k in (
        np.unique(np.linspace(0, len(messages) - 1, LOOKED_AT).astype(int)).tolist() if len(messages) else []
    ):
        for parent, child, xyzw, xyz in _transforms(decode(bag, messages, k)):
            told.setdefault(child, set()).add((parent, *xyzw, *xyz))
            counts[child] = counts.get(child, 0) + 1
    edges: Edges = {}
    for child, found in told.items():
        if len(found) == 1 and counts[child] > 1:
            [(parent, *numbers)] = found
            with suppress(DataError):  # of one that is not needed, perhaps
                edges[child] = (parent, _pose(topic, parent, child, numbers[:4], numbers[4:]))
    return edges


def _transforms(message: Any) -> Iterator[tuple[str, str, list[float], list[float]]]:
    for one in message.transforms:
        q, t = one.transform.rotation, one.transform.translation
        parent, child = one.header.frame_id.strip("/"), one.child_frame_id.strip("/")
        yield parent, child, [q.x, q.y, q.z, q.w], [t.x, t.y, t.z]


def _described(bag: Bag, topic: str) -> Edges:
    messages = bag.messages(topic)
    return fixed_joints(str(decode(bag, messages, 0).data), topic) if len(messages) else {}


def fixed_joints(text: str, topic: str) -> Edges:
    """The fixed joints of a URDF; none of what is no URDF, or has a document type."""
    edges = Edges()
    if len(text) > MOST_XML_BYTES or "<!" in text.replace(
        "<!--", ""
    ):  # entities may stand for any amount of text
        return edges
    try:
        joints = ElementTree.fromstring(text).findall("joint[@type='fixed']")
    except (ElementTree.ParseError, ValueError):
        return edges
    for joint in joints:
        parts = {part.tag: part.attrib for part in joint}
        parent, child = (parts.get(name, {}).get("link", "").strip("/") for name in ("parent", "child"))
        origin = parts.get("origin", {})
        with suppress(ValueError, DataError):
            xyz, rpy = ([float(v) for v in origin.get(key, "0 0 0").split()] for key in ("xyz", "rpy"))
            xyzw = Rotation.from_euler("xyz", rpy).as_quat().tolist()
            edges[child] = (parent, _pose(topic, parent, child, xyzw, xyz))
    return edges


def _pose(
    topic: str, parent: str, child: str, quaternion_xyzw: list[float], translation: list[float]
) -> Array:
    off = abs(float(np.linalg.norm(quaternion_xyzw)) - 1.0)
    if not (off <= MOST_OFF_UNIT and len(translation) == 3 and np.isfinite(translation).all()):
        raise DataError(
            f"{topic}: {parent} to {child}: found quaternion {quaternion_xyzw} and translation {translation}, expected"
            " a unit quaternion x y z w and metres"
        )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion_xyzw).as_matrix(), translation
    return T

"""Fixed transforms of a bag: the tree of frames that its calibration is.

They are in topics named tf_static, under any namespace; in tf, where a transform stays the same; and in
robot_description, as fixed joints of a URDF (http://wiki.ros.org/urdf/XML/joint). Of one that is told twice, tf_static
counts, then the URDF; what tf_static alone joins, it tells alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.datasets.ros.kinds import STRING, TRANSFORMS, decode
from gnss_sem_map.errors import DataError

Array = NDArray[np.float64]

STATIC, URDF = "tf_static", "robot_description"
Told = tuple[str, str, tuple[float, ...]]
"""Parent, child, and the child's place and quaternion in its parent."""
Edges = dict[str, tuple[str, Array]]
"""Parents of frames, and T_parent_child (4, 4)."""
LOOKED_AT = 500
"""Messages of a topic of changing transforms that tell which of them stay the same."""
MOST_XML_BYTES = 2 << 20
MOST_OFF_UNIT = 0.02
"""A quaternion is normalised, as it may be written with two digits; one whose length is farther from 1 is none."""


class StaticTransforms:
    """Poses of frames in their parents: `T_parent_child`, by child; `more` count only where `edges` join no frames."""

    def __init__(self, edges: Edges, more: Edges | None = None, wrong: dict[str, str] | None = None) -> None:
        self._edges, self._all, self._wrong = edges, (more or {}) | edges, wrong or {}

    @property
    def frames(self) -> list[str]:
        """All frames, sorted."""
        return sorted({*self._all, *(parent for parent, _ in self._all.values())})

    def between(self, target: str, source: str) -> Array | None:
        """T_target_source (4, 4), None where no chain of transforms joins them; raises DataError for a circle."""
        found = _between(self._edges, target, source)
        found = _between(self._all, target, source) if found is None else found
        if found is None and self._wrong:
            raise DataError(
                f"{'; '.join(self._wrong.values())[:400]}; give T_imu_lidar and the like in rig.yaml"
            )
        return found


def _between(edges: Edges, target: str, source: str) -> Array | None:
    to_target, to_source = _ancestors(edges, target), _ancestors(edges, source)
    common = next((frame for frame in to_target if frame in to_source), None)
    if common is None:
        return None
    up, down = to_target[common], to_source[common]
    if target == common:
        return down
    inverse = np.asarray(np.linalg.inv(up), np.float64)
    return inverse if source == common else inverse @ down


def _ancestors(edges: Edges, frame: str) -> dict[str, Array]:
    """T_ancestor_frame of the frame itself and of all above it, from the nearest on."""
    found, T = {frame: np.eye(4)}, None
    at = frame
    while at in edges:
        at, edge = edges[at]
        if at in found:
            raise DataError(
                f"fixed transforms: a circle of frames, {' > '.join([*found, at])}; give the poses in rig.yaml"
            )
        T = edge if T is None else edge @ T  # no product with the identity: the edge to the bit
        found[at] = T
    return found


def read_static_transforms(bag: Bag) -> StaticTransforms:
    """The fixed transforms of a bag; none where it has none. A static one that is no pose is told where it lacks."""
    static, more, wrong = Edges(), Edges(), dict[str, str]()
    for name, kinds, read in (
        ("tf", TRANSFORMS, _that_stay),
        (URDF, (STRING,), _of_robots),
        (STATIC, TRANSFORMS, _transforms),
    ):
        for topic in sorted(bag.kinds):
            if topic.rpartition("/")[2] != name or bag.kinds[topic] not in kinds:
                continue
            messages = bag.messages(topic)
            some = range(len(messages)) if name == STATIC else messages.some(LOOKED_AT)
            for parent, child, numbers in read([decode(bag, messages, k) for k in some]):
                T = _pose(numbers)
                if T is not None:
                    (static if name == STATIC else more)[child] = (parent, T)
                elif name == STATIC:
                    wrong[child] = (
                        f"{topic}: {parent} to {child}: found {list(numbers)}, expected metres x y z and a unit"
                        " quaternion x y z w"
                    )
    return StaticTransforms(static, more, wrong)


def _transforms(messages: Iterable[Any]) -> Iterator[Told]:
    for one in (one for message in messages for one in message.transforms):
        t, q = one.transform.translation, one.transform.rotation
        names = one.header.frame_id.strip("/"), one.child_frame_id.strip("/")
        yield *names, (t.x, t.y, t.z, q.x, q.y, q.z, q.w)


def _that_stay(messages: Iterable[Any]) -> Iterator[Told]:
    """Those that are told several times, and are always the same."""
    found: dict[str, list[Told]] = {}
    for one in _transforms(messages):
        found.setdefault(one[1], []).append(one)
    return (told[0] for told in found.values() if len(told) > 1 and len(set(told)) == 1)


def _of_robots(messages: Iterable[Any]) -> Iterator[Told]:
    return (joint for message in messages for joint in fixed_joints(str(message.data)))


def fixed_joints(text: str) -> Iterator[Told]:
    """The fixed joints of a URDF; none of what is no URDF, or has a document type: entities may be of any size."""
    if len(text) > MOST_XML_BYTES or "<!" in text.replace("<!--", ""):
        return
    try:
        joints = ElementTree.fromstring(text).findall("joint[@type='fixed']")
    except (ElementTree.ParseError, ValueError):
        return
    for joint in joints:
        parts = {part.tag: part.attrib for part in joint}
        parent, child = (parts.get(name, {}).get("link", "").strip("/") for name in ("parent", "child"))
        origin = parts.get("origin", {})
        with suppress(ValueError):
            xyz, rpy = ([float(v) for v in origin.get(key, "0 0 0").split()] for key in ("xyz", "rpy"))
            yield parent, child, (*xyz, *Rotation.from_euler("xyz", rpy).as_quat().tolist())


def _pose(numbers: tuple[float, ...]) -> Array | None:
    """The transform (4, 4) of x y z and a quaternion x y z w; None where they are none."""
    values = np.array(numbers, np.float64)
    if (
        values.shape != (7,)
        or not np.isfinite(values).all()
        or abs(np.linalg.norm(values[3:]) - 1) > MOST_OFF_UNIT
    ):
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
    return T

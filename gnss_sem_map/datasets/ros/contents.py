"""What is in a bag, and what each topic would be taken for: the rig.yaml that `inspect` suggests."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import yaml

from gnss_sem_map.datasets.ros import clouds, pictures, roles
from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.datasets.ros.imu_topics import part_of
from gnss_sem_map.datasets.ros.kinds import HEADLESS, KINDS, STRING, TAKEN_FOR, decode, unread
from gnss_sem_map.datasets.ros.receiver_topics import covariance_of
from gnss_sem_map.datasets.ros.stamps import header_ns
from gnss_sem_map.datasets.ros.static_tf import URDF, StaticTransforms, read_static_transforms
from gnss_sem_map.errors import DataError

GAP_STEPS = 3.0
"""A step of more than so many usual ones is a gap."""
LOOKED_AT = 50
"""Messages of a topic whose headers are compared with their arrival."""
LATE_S = 1.0
USUAL_WORDS = re.compile("points|image(_raw|_rect|_rect_color)?|raw|rect|color|compressed")
NOT_READ = "not read: its images have the encoding"


@dataclass(frozen=True)
class Topic:
    """A topic of a bag."""

    name: str
    kind: str
    messages: int
    rate_hz: float | None
    """By the usual step between arrivals; None for less than two messages."""
    gaps: int
    longest_gap_s: float
    taken_for: str
    """A sensor; empty: it is not used."""
    frame: str
    notes: tuple[str, ...]
    """What will stop a run, or needs a line in rig.yaml."""

    def as_dict(self) -> dict[str, Any]:
        """The same for JSON."""
        return asdict(self)


def contents_of(bag: Bag) -> tuple[Topic, ...]:
    """All topics, sorted by what they are taken for, then by name; raises DataError for a damaged bag."""
    transforms, found = read_static_transforms(bag), []
    for name, kind in bag.kinds.items():
        taken = TAKEN_FOR.get(kind, "")
        messages = bag.messages(name)
        steps = np.diff(messages.received_ns) * 1e-9
        later = steps[steps > 0]  # of messages that are there twice, one has no step
        usual = float(np.median(later)) if len(later) else 0.0
        gaps = steps[steps > GAP_STEPS * usual] if len(steps) > 2 else steps[:0]
        if taken == "IMU":
            taken = part_of(bag, name)
        is_sensor = taken in KINDS and len(messages) > 0
        frame, notes = _looked_into(bag, messages, taken, transforms) if is_sensor else ("", [])
        if notes and notes[0].startswith(NOT_READ):
            taken, notes = "", notes[:1]
        if kind == STRING and name.endswith(URDF):
            taken = "transforms"
        elif not taken and (note := unread(kind)):
            notes = [note]
        found.append(
            Topic(
                name, kind, len(messages), 1.0 / usual if usual > 0 else None,
                len(gaps), float(gaps.max(initial=0.0)), taken, frame, tuple(notes),
            )
        )  # fmt: skip
    order = [*KINDS, "calibration", "transforms", ""]
    return tuple(sorted(found, key=lambda topic: (order.index(topic.taken_for), topic.name)))


def suggested_rig(bag: Bag, topics: tuple[Topic, ...]) -> str:
    """A rig.yaml with every topic that may be a sensor; of several IMUs or receivers, all but the first as comments."""
    transforms = read_static_transforms(bag)
    of = {sensor: _sensors(topics, sensor) for sensor in KINDS}
    of["receiver"].sort(key=lambda topic: KINDS["receiver"].index(topic.kind))
    of["IMU"] += of["gyroscope"]
    force = {"force_topic": of["accelerometer"][0].name} if of["accelerometer"] else {}
    about: dict[str, Any]
    parts = [
        "# Which topic of the bag is which sensor. All LiDARs and cameras here are used: remove those you do not want.",
        "# Frames are those of the transforms; what is not here is as its default: see docs/your_own_log.md.",
    ]
    for key, sensor in (("imu", "IMU"), ("gnss", "receiver")):
        for k, topic in enumerate(of[sensor]):
            about = {"topic": topic.name} | (force if topic.taken_for == "gyroscope" else {}) | _stamps(topic)
            lines = _yaml({key: about})
            if sensor == "receiver" and not _has_lever_arm(topic, of["IMU"], transforms):
                lines += "  p_imu_antenna: [0.0, 0.0, 0.0]  # antenna ahead, left, above of the IMU, m: measure it\n"
            parts += _noted(topic, lines if k == 0 else _commented(lines))
        if not of[sensor]:
            parts.append(
                f"# {key}: {{topic: ...}}  # found none"
                + ("" if key == "imu" else "; or a file: see the guide")
            )
    parts += [
        f"  # {what}: {{topic: {topic.name}}}  # if it is of this receiver; its axes: see the guide"
        for what in ("velocity", "heading")
        for topic in of[what]
    ]
    parts += [
        f"# wheels: {{topic: {topic.name}}}  # if it is the speed of the vehicle along its x axis"
        for topic in (*of["wheels"], *of["velocity"])
    ]
    for key, sensor in (("lidars", "LiDAR"), ("cameras", "camera")):
        parts.append(f"{key}:" if of[sensor] else f"{key}: {{}}")
        for name, topic in _named(of[sensor]).items():
            about = {"topic": topic.name} | _stamps(topic)
            info = roles.info_beside(bag, topic.name) if sensor == "camera" else None
            if info is not None:
                about["info"] = info
            parts += _noted(topic, _yaml({name: about}), indent="  ")
    return "\n".join(parts) + "\n"


def _looked_into(
    bag: Bag, messages: Messages, taken: str, transforms: StaticTransforms
) -> tuple[str, list[str]]:
    """Frame of a topic's first message, and what is odd about the topic."""
    try:
        first = decode(bag, messages, 0)
        if messages.kind in HEADLESS:
            return "", []
        frame, notes = str(first.header.frame_id).strip("/"), _stamp_notes(bag, messages)
    except DataError as error:
        return "", [str(error)]
    if taken == "LiDAR" and clouds.time_field(clouds.fields_of(first), None) is None:
        notes.append(f"no time per point among {', '.join(clouds.fields_of(first))}: set point_times")
    if taken == "receiver" and hasattr(first, "position_covariance") and (why := covariance_of(first)[0]):
        notes.append(f"{why}: set stddevs_m")
    if taken == "camera" and (encoding := pictures.unread_encoding(first)):
        notes.insert(0, f"{NOT_READ} {encoding}: depth, a video, or an unknown one")
    if taken == "camera" and roles.info_beside(bag, messages.topic) is None:
        notes.append("no CameraInfo topic beside it: set info, or K and image_size")
    if taken in ("LiDAR", "camera") and frame not in transforms.frames:
        notes.append(f"its frame {frame!r} is in no fixed transform: set frame or the pose")
    return frame, notes


def _stamp_notes(bag: Bag, messages: Messages) -> list[str]:
    some = messages.some(LOOKED_AT)
    late = np.array([messages.received_ns[k] - header_ns(bag, messages, k) for k in some]) * 1e-9
    zero = sum(header_ns(bag, messages, k) == 0 for k in some)
    if zero:
        return [f"{zero} of {len(some)} header stamps are zero: set stamps: received"]
    if np.ptp(late) > LATE_S:
        return [f"header stamps jump by {np.ptp(late):.1f} s against the arrivals"]
    if abs(float(np.median(late))) > LATE_S:
        off, side = float(np.median(late)), "before" if np.median(late) > 0 else "after"
        return [
            f"header stamps are {abs(off):.1f} s {side} the arrivals: another clock than that of other topics?"
        ]
    return []


def _stamps(topic: Topic) -> dict[str, str]:
    return {"stamps": "received"} if any("stamps: received" in note for note in topic.notes) else {}


def _has_lever_arm(topic: Topic, imus: list[Topic], transforms: StaticTransforms) -> bool:
    if not imus:
        return False
    return topic.frame == imus[0].frame or transforms.between(imus[0].frame, topic.frame) is not None


def _sensors(topics: tuple[Topic, ...], sensor: str) -> list[Topic]:
    """Those with messages; of an image that is there twice the one with fewer notes, else the raw one."""
    best: dict[str, Topic] = {}
    for topic in topics:
        if topic.taken_for == sensor and topic.messages:
            image = topic.name.removesuffix("/compressed")
            if image not in best or len(topic.notes) < len(best[image].notes):
                best[image] = topic
    return list(best.values())


def _named(topics: list[Topic]) -> dict[str, Topic]:
    """Sensors by name; a name that another one has gets a number."""
    named: dict[str, Topic] = {}
    for topic in topics:
        name = first = _name(topic)
        number = 1
        while name in named:
            number += 1
            name = f"{first}_{number}"
        named[name] = topic
    return named


def _name(topic: Topic) -> str:
    """A name for a sensor: the words of its topic but for those that all have."""
    words = [word for word in topic.name.strip("/").split("/") if not USUAL_WORDS.fullmatch(word)]
    return "_".join(words) or topic.taken_for.lower()


def _noted(topic: Topic, lines: str, indent: str = "") -> list[str]:
    notes = [f"{indent}# {note}" for note in topic.notes]
    return notes + [indent + line for line in lines.rstrip("\n").split("\n")]


def _commented(lines: str) -> str:
    return "\n".join(f"# {line}" for line in lines.rstrip("\n").split("\n"))


def _yaml(content: dict[str, Any]) -> str:
    return str(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))

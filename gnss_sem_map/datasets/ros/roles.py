"""Which topic is which sensor: by the types of the topics, where rig.yaml does not say it."""

from __future__ import annotations

from collections.abc import Iterable

from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.datasets.ros.imu_topics import part_of
from gnss_sem_map.datasets.ros.kinds import INFO, KINDS, NAMED, decode, unread
from gnss_sem_map.datasets.ros.pictures import unread_encoding
from gnss_sem_map.datasets.ros.rig import CameraTopic, GnssTopic, ImuTopic, LidarTopic, Rig
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.untrusted import refused, shown
from gnss_sem_map.sensor_log import SENSOR, Skip


def completed(bag: Bag, rig: Rig) -> Rig:
    """The rig with the sensors that it does not name: a topic is taken where there is one of its type.

    A rig that names LiDARs or cameras names all that are used. Raises DataError for topics that are not there or of
    another type, and for several of one kind where the rig does not say which of them are used.
    """
    update: dict[str, object] = {}
    if rig.imu is None:
        of_heading = rig.gnss.heading.topic if rig.gnss and rig.gnss.heading else None
        update["imu"] = _imu(bag, [topic for topic in of_kind(bag, "IMU") if topic != of_heading])
    if rig.gnss is None or (rig.gnss.topic is None and rig.gnss.file is None):
        topic = _only(bag, "receiver", "gnss: {topic: ...}")
        known = {} if rig.gnss is None else rig.gnss.model_dump()
        update["gnss"] = None if topic is None else GnssTopic(**known | {"topic": topic})
    if "lidars" not in rig.model_fields_set:
        topic = _only(bag, "LiDAR", "lidars: {NAME: {topic: ...}}")
        update["lidars"] = {} if topic is None else {"lidar": LidarTopic(topic=topic)}
    if "cameras" not in rig.model_fields_set:
        readable = [topic for topic in of_kind(bag, "camera") if not unread_images(bag, topic)]
        topic = _only(bag, "camera", "cameras: {NAME: {topic: ...}}", readable)
        update["cameras"] = (
            {} if topic is None else {"camera": CameraTopic(topic=topic, info=info_beside(bag, topic))}
        )
    whole = rig.model_copy(update=update)
    _check(bag, whole)
    return whole


def of_kind(bag: Bag, sensor: str) -> list[str]:
    """The topics whose type is that of a sensor, sorted; of an image that is there twice the raw one."""
    kinds = KINDS[sensor]
    if sensor == "receiver":
        kinds = next(((kind,) for kind in kinds if kind in bag.kinds.values()), kinds)
    found = sorted(topic for topic, kind in bag.kinds.items() if kind in kinds)
    return [
        topic
        for topic in found
        if topic.removesuffix("/compressed") not in found or not topic.endswith("/compressed")
    ]


def unread_images(bag: Bag, topic: str) -> str:
    """The encoding of the images of a topic, where it is not read, by the first; empty where it is."""
    try:
        return unread_encoding(decode(bag, bag.messages(topic), 0))
    except (DataError, IndexError):
        return ""  # told where they are read


def info_beside(bag: Bag, topic: str) -> str | None:
    """The CameraInfo of an image topic: the one in the nearest namespace, or the only one; None if there is none."""
    infos = sorted(name for name, kind in bag.kinds.items() if kind == INFO)
    space = topic
    while "/" in space:
        space = space.rpartition("/")[0]
        beside = [name for name in infos if name == f"{space}/camera_info"]
        if beside:
            return beside[0]
    return infos[0] if len(infos) == 1 else None


def missing(bag: Bag, rig: Rig) -> list[Skip]:
    """That there is no IMU, no receiver or, where packets of one are there, no LiDAR."""
    notes = [] if rig.lidars else [(topic, note) for topic, note in _notes(bag) if "LiDAR" in note]
    skips = [Skip("scan", topic, note) for topic, note in notes]
    if not rig.cameras:
        skips += [
            Skip("image", topic, f"not read: its images have the encoding {encoding}")
            for topic in of_kind(bag, "camera")
            if (encoding := unread_images(bag, topic))
        ]
    if rig.imu is not None and rig.gnss is not None:
        return skips
    what = "an IMU (sensor_msgs/Imu)" if rig.imu is None else "a receiver (sensor_msgs/NavSatFix)"
    found = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(bag.kinds.items()))[:500] or "no topics"
    reason = (
        f"found no topic of {what}; it has {found}; set it, or a file of positions (gnss.file), in rig.yaml"
        + "".join(f"; {topic}: {note}" for topic, note in _notes(bag))[:300]
    )
    return [*skips, Skip(SENSOR, shown(bag.path), reason)]


def _notes(bag: Bag) -> list[tuple[str, str]]:
    """What is to be said of topics that are not read."""
    return [(topic, note) for topic, kind in sorted(bag.kinds.items()) if (note := unread(kind))]


def nothing_read(bag: Bag) -> DataError:
    """The error that no topic of a bag is of a sensor, with what may be done about its types."""
    notes = "; ".join(f"{topic}: {note}" for topic, note in _notes(bag))
    found = ", ".join(sorted(set(bag.kinds.values())))[:300] or "no topics"
    return refused(
        bag.path,
        f"nothing of it is read; found no topic of an IMU, a receiver, a LiDAR or a camera, but"
        f" {found}; {notes[:300] or 'docs/your_own_log.md lists the types that are read'}",
    )


def _imu(bag: Bag, topics: list[str]) -> ImuTopic | None:
    """The only IMU, or the only gyroscope with the only accelerometer."""
    parts = {topic: part_of(bag, topic) for topic in topics} if len(topics) > 1 else {}
    whole, turns, forces = (
        [topic for topic, part in parts.items() if part == name]
        for name in ("IMU", "gyroscope", "accelerometer")
    )
    if not whole and len(turns) == len(forces) == 1:
        return ImuTopic(topic=turns[0], force_topic=forces[0])
    topic = _only(bag, "IMU", "imu: {topic: ...}", whole or topics)
    return None if topic is None else ImuTopic(topic=topic)


def _only(bag: Bag, sensor: str, key: str, among: list[str] | None = None) -> str | None:
    found = of_kind(bag, sensor) if among is None else among
    if len(found) > 1:
        raise refused(
            bag.path,
            f"found {len(found)} topics of a {sensor}: {', '.join(found)[:500]}; say which one in rig.yaml, {key}"
            " (`gnss-sem-map inspect`)",
        )
    return found[0] if found else None


def _check(bag: Bag, rig: Rig) -> None:
    named: list[tuple[str, str, str | None]] = [
        *([("imu", "IMU", rig.imu.topic)] if rig.imu else []),
        *([("imu.force_topic", "IMU", rig.imu.force_topic)] if rig.imu else []),
        *([("wheels", "wheels", rig.wheels.topic)] if rig.wheels else []),
        *([("gnss", "receiver", rig.gnss.topic)] if rig.gnss else []),
        *([("gnss.velocity", "velocity", rig.gnss.velocity.topic)] if rig.gnss and rig.gnss.velocity else []),
        *([("gnss.heading", "heading", rig.gnss.heading.topic)] if rig.gnss and rig.gnss.heading else []),
        *((f"lidars.{name}", "LiDAR", one.topic) for name, one in rig.lidars.items()),
        *((f"cameras.{name}", "camera", one.topic) for name, one in rig.cameras.items()),
    ]
    places: dict[str, str] = {}
    for place, sensor, topic in named:
        if topic is not None:
            _check_kind(bag, place, topic, (*KINDS[sensor], *NAMED.get(sensor, ())))
            if places.setdefault(topic, place) != place:
                raise DataError(
                    f"rig.yaml: {place}: {topic} is {places[topic]} already, and would count twice"
                )
    for name, camera in rig.cameras.items():
        if camera.info is not None:
            _check_kind(bag, f"cameras.{name}.info", camera.info, (INFO,))


def _check_kind(bag: Bag, place: str, topic: str, kinds: Iterable[str]) -> None:
    kind = bag.kinds.get(topic)
    if kind is None:
        fitting = sorted(name for name, one in bag.kinds.items() if one in kinds)
        raise DataError(
            f"rig.yaml: {place}: {shown(bag.path)} has no topic {topic[:100]!r}, expected one of"
            f" {' or '.join(kinds)}: {', '.join(fitting)[:500] or 'there is none'}; correct or remove it in rig.yaml"
        )
    if kind not in kinds:
        raise DataError(
            f"rig.yaml: {place}: {topic} is of {kind}, expected {' or '.join(kinds)};"
            f" {unread(kind) or '`gnss-sem-map inspect` lists the topics'}"
        )

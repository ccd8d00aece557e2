"""A bag: one file, or a folder of the files that it was split into, of ROS 1 or ROS 2 (MCAP or sqlite3)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.ros.mcap_file import McapFile
from gnss_sem_map.datasets.ros.open_file import OpenFile
from gnss_sem_map.datasets.ros.ros1_file import Ros1File
from gnss_sem_map.datasets.ros.sqlite_file import SqliteFile
from gnss_sem_map.errors import DataError, how_to_install
from gnss_sem_map.files.structured import read_yaml
from gnss_sem_map.files.untrusted import inside, is_file, is_folder, refused, shown

Ints = NDArray[np.int64]
BagFile = McapFile | Ros1File | SqliteFile

SUFFIXES = (".bag", ".mcap", ".db3")
METADATA = "metadata.yaml"
ENCODINGS = ("ros1", "cdr")
"""Of messages of ROS 1 and ROS 2; an MCAP file may have others."""
WHOLE_FILE = ".zstd"
"""Ending of the files of a bag that was compressed file by file."""
NOT_CLOSED = ".active"
"""Ending of the file that a recorder of ROS 1 writes to."""
MAGIC = {
    ".bag": b"#ROSBAG", ".mcap": b"\x89MCAP", ".db3": b"SQLite format 3", ".zip": b"PK\3\4", ".gz": b"\x1f\x8b",
    ".bz2": b"BZh", ".zst": b"\x28\xb5\x2f\xfd", ".7z": b"7z\xbc\xaf",
}  # fmt: skip
"""How files begin."""


@dataclass(frozen=True, eq=False)
class Messages:
    """Where the messages of a topic are, in the order of their arrival."""

    topic: str
    kind: str
    """Type of the messages, as ROS 2 writes it: sensor_msgs/msg/Imu."""
    is_ros1: bool
    """Whether they are encoded as ROS 1 does it."""
    received_ns: Ints
    """(n,) Unix time of arrival."""
    places: NDArray[np.int64]
    """(n, 3): number of the file, and the place in it."""

    def __len__(self) -> int:
        return len(self.received_ns)

    def some(self, count: int) -> list[int]:
        """Positions of so many messages over all the time, of all where there are fewer."""
        return np.unique(np.linspace(0, len(self) - 1, count).astype(int)).tolist() if len(self) else []


class Bag:
    """All messages of a bag by topic; they are read when they are asked for, by any thread."""

    def __init__(self, path: Path) -> None:
        self.path = path
        names = bag_files(path)
        if not names and not os.path.lexists(path):
            raise refused(path, "no such file or folder; expected a bag of ROS 1 or ROS 2")
        if not names:
            raise refused(path, f"found no {', '.join(SUFFIXES)} file, expected a bag of ROS 1 or ROS 2")
        suffixes = sorted({name.suffix.lower() for name in names})
        if len(suffixes) > 1:
            raise refused(path, f"found files of {' and '.join(suffixes)} in one folder, expected one bag")
        if find_spec("rosbags") is None or find_spec("mcap") is None:
            raise refused(path, f"ROS bags need rosbags and mcap; {how_to_install('ros')}")
        about = {} if suffixes == [".bag"] else _metadata(path)
        codec = _message_codec(about)
        self.lost = _lost(about, names)
        """Names of the files that the bag's metadata list, and that are not there."""
        self._files: list[BagFile] = [_opened(name, codec) for name in names]
        self._ros1, self.kinds = set[str](), dict[str, str]()
        self._read_kinds()

    def messages(self, topic: str) -> Messages:
        """The messages of a topic in the order of their arrival; raises DataError when there is no such topic."""
        if topic not in self.kinds:
            raise refused(
                self.path, f"no topic {topic[:100]!r}; it has {', '.join(sorted(self.kinds))[:500]}"
            )
        times, places = [], []
        for number, file in enumerate(self._files):
            received, where = file.index(topic)
            times.append(received)
            places.append(np.column_stack([np.full(len(where), number, np.int64), where]))
        joined = np.concatenate(times)
        order = np.argsort(joined, kind="stable")
        return Messages(
            topic, self.kinds[topic], topic in self._ros1, joined[order], np.concatenate(places)[order]
        )

    def read(self, messages: Messages, k: int, most: int | None = None) -> bytes:
        """A message of a topic, by its position in time, or its first `most` bytes; raises DataError."""
        file, *place = messages.places[k].tolist()
        one: BagFile = self._files[file]
        return one.read((place[0], place[1]), most)

    def file_of(self, messages: Messages, k: int) -> Path:
        """The file that holds a message."""
        return self._files[int(messages.places[k, 0])].path

    def _read_kinds(self) -> None:
        others = set[str]()
        for file in self._files:
            for topic, (name, encoding) in file.topics.items():
                kind = name if encoding in ENCODINGS else f"{name or 'messages'} ({encoding})"
                if encoding == "ros1":
                    self._ros1.add(topic)
                elif encoding not in ENCODINGS:
                    others.add(kind)
                if self.kinds.setdefault(topic, kind) != kind:
                    raise refused(file.path, f"{topic} is of {kind}, in another part of {self.kinds[topic]}")
        if others and others == set(self.kinds.values()):
            raise refused(
                self.path,
                f"found no messages of ROS but {', '.join(sorted(others))[:300]}; expected ros1 or"
                " cdr; record or convert it so, or write a CSV log (docs/your_own_log.md)",
            )


def bag_files(path: Path) -> list[Path]:
    """The files of a bag, sorted by name; none for what is no bag."""
    if path.suffix.lower() in SUFFIXES and not path.is_dir():
        return [path] if is_file(path) else []
    if not is_folder(path):
        return []
    found = inside(path)
    packed = [one.name for one in found if one.suffix == WHOLE_FILE and Path(one.stem).suffix in SUFFIXES]
    if packed:
        raise refused(
            path,
            f"is compressed as whole files; expand them: zstd -d --rm {shown(packed[0])}, and remove"
            f" compression_mode from {METADATA}",
        )
    opened = [one.name for one in found if one.suffix == NOT_CLOSED and Path(one.stem).suffix in SUFFIXES]
    if opened:
        name, closed = shown(opened[0]), shown(Path(opened[0]).stem)
        raise refused(
            path,
            f"was not closed ({name}); repair it: rosbag reindex {name}; mv {name} {closed}",
        )
    return [one for one in found if one.suffix.lower() in SUFFIXES and is_file(one)]


def _metadata(path: Path) -> dict[str, Any]:
    """The metadata of a ROS 2 bag; empty where there are none."""
    if not path.is_dir() or not is_file(path / METADATA):
        return {}
    try:
        about: Any = read_yaml(path / METADATA)
    except DataError as error:
        raise DataError(f"{error}; remove it: a bag that is not compressed is read without it") from None
    about = about.get("rosbag2_bagfile_information") if isinstance(about, dict) else None
    return about if isinstance(about, dict) else {}


def _message_codec(about: dict[str, Any]) -> str:
    """How single messages are compressed, by a bag's metadata; empty: not at all."""
    if str(about.get("compression_mode") or "").lower() != "message":
        return ""
    return str(about.get("compression_format") or "")


def _lost(about: dict[str, Any], files: list[Path]) -> list[str]:
    """Names of the parts that a bag's metadata list, but for those that are there, perhaps expanded since."""
    listed, there = about.get("relative_file_paths"), {file.name for file in files}
    if not isinstance(listed, list):
        return []
    names = [Path(str(name)).name.removesuffix(WHOLE_FILE) for name in listed]
    return [shown(name) for name in names if name not in there]


def _opened(path: Path, codec: str) -> BagFile:
    ending = path.suffix.lower()
    _refuse_others(path, ending)
    if ending == ".bag":
        return Ros1File(path)
    return McapFile(path, codec) if ending == ".mcap" else SqliteFile(path, codec)


def _refuse_others(path: Path, ending: str) -> None:
    """Raise DataError for a file that is empty, or of another kind than its ending says: no tool repairs it."""
    head = OpenFile(path).read_up_to(0, max(map(len, MAGIC.values())))
    if not head:
        raise refused(
            path,
            "empty (0 bytes); copy it again, or move it away if the other parts suffice",
        )
    is_of = next((name for name, magic in MAGIC.items() if head.startswith(magic)), ending)
    if is_of != ending:
        way = f"rename it to {shown(path.stem)}{is_of}" if is_of in SUFFIXES else "unpack it"
        raise refused(path, f"found a file of the kind {is_of}, expected {ending}; {way}")

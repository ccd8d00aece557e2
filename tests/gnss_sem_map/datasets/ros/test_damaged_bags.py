"""A bag whose files are damaged, incomplete or of another kind is refused in one line, with its repair."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
import ros
from commands import gnss_sem_map

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import Skip


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ros.write(tmp_path_factory.mktemp("plain") / "drive", ros.drive())


def damaged(bag: Path, change: Callable[[bytearray], bytes | bytearray]) -> None:
    file = bag if bag.is_file() else next(path for path in bag.iterdir() if path.suffix in (".mcap", ".db3"))
    file.write_bytes(change(bytearray(file.read_bytes())))


def chunk_index(content: bytearray, at: int) -> int:
    """Where the first record of a chunk is in the summary of an MCAP file."""
    while content[at] != 0x08:
        at += 9 + int(struct.unpack_from("<Q", content, at + 1)[0])
    return at


def read_all(file: Path) -> None:
    bag = Bag(file)
    for topic in bag.kinds:
        messages = bag.messages(topic)
        for k in range(len(messages)):
            bag.read(messages, k)


@pytest.mark.parametrize("storage", ["mcap", "db3", "bag"])
def test_a_truncated_bag_is_refused_with_its_repair(tmp_path: Path, storage: str) -> None:
    name = "drive.bag" if storage == "bag" else "drive"
    bag = ros.write(tmp_path / name, ros.drive(storage == "bag"), storage)
    damaged(bag, lambda content: content[: len(content) // 3])
    with pytest.raises(DataError, match=r"truncated.*(mcap recover|rosbag reindex|sqlite3)"):
        open_drive(bag).scans[-1].read()


def test_messages_that_are_in_a_log_beside_the_bag_are_not_lost(tmp_path: Path) -> None:
    recorded = next(ros.write(tmp_path / "recorded", ros.drive(), "db3").glob("*.db3"))
    file, log = tmp_path / "killed.db3", tmp_path / "killed.db3-wal"
    with closing(sqlite3.connect(recorded)) as recorder:
        recorder.execute("PRAGMA journal_mode=WAL")
        recorder.execute("INSERT INTO messages (topic_id, timestamp, data) SELECT 1, 0, zeroblob(9)")
        recorder.commit()
        shutil.copy(recorded, file)  # as after a recorder that was killed: one that ends empties the log
        shutil.copy(recorded.with_name(f"{recorded.name}-wal"), log)
    with pytest.raises(DataError, match=r'killed.db3-wal: .*sqlite3 killed.db3 "PRAGMA wal_checkpoint'):
        open_drive(file)
    (tmp_path / "link.db3").symlink_to(file)
    with pytest.raises(DataError, match=r"killed\.db3-wal"):
        open_drive(tmp_path / "link.db3")
    with closing(sqlite3.connect(file)) as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        log.touch()  # an empty one holds nothing
        assert len(Bag(file).messages("/imu")) + len(Bag(file).messages("/fix")) == 207


def test_an_unindexed_ros1_bag_is_refused(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive.bag", ros.drive(is_ros1=True), "bag")

    def not_closed(content: bytearray) -> bytearray:
        at = content.index(b"index_pos=") + len(b"index_pos=")
        content[at : at + 8] = bytes(8)  # what a recorder leaves that was killed
        return content

    damaged(bag, not_closed)
    with pytest.raises(DataError, match=r"not indexed.*rosbag reindex drive.bag"):
        open_drive(bag)


def test_an_mcap_that_was_not_closed_is_refused(plain: Path, tmp_path: Path) -> None:
    content = next(plain.glob("*.mcap")).read_bytes()
    (tmp_path / "open.mcap").write_bytes(content[:-40])
    with pytest.raises(DataError, match=r"not closed.*mcap recover open.mcap"):
        open_drive(tmp_path / "open.mcap")


@pytest.mark.parametrize(
    ("record", "at", "number"),
    [
        pytest.param(0x08, 9 + 16, 2**64 - 1, id="a place that 64 bits with a sign do not hold"),
        pytest.param(0x08, 1, 2**62, id="a record that no memory holds"),
        pytest.param(0x07, 9 + 6 + 8, 2**63 - 1, id="a message beyond the largest place of a file"),
    ],
)
def test_a_wild_number_in_an_mcap_is_refused(
    plain: Path, tmp_path: Path, record: int, at: int, number: int
) -> None:
    content = bytearray(next(plain.glob("*.mcap")).read_bytes())
    [summary] = struct.unpack_from("<Q", content, len(content) - 37 + 9)
    start = chunk_index(content, summary)
    if record == 0x07:  # the index of messages is behind its chunk
        start = sum(struct.unpack_from("<QQ", content, start + 9 + 16))
    assert content[start] == record
    struct.pack_into("<Q", content, start + at, number)
    (tmp_path / "wild.mcap").write_bytes(content)
    with pytest.raises(DataError, match=r"wild\.mcap: .*damaged.*mcap recover"):
        read_all(tmp_path / "wild.mcap")


@pytest.mark.parametrize(("command", "storage"), [("inspect", "mcap"), ("inspect", "bag"), ("check", "db3")])
def test_a_command_says_in_one_line_that_a_bag_is_truncated(
    tmp_path: Path, command: str, storage: str
) -> None:
    name = "drive.bag" if storage == "bag" else "drive"
    bag = ros.write(tmp_path / name, ros.drive(storage == "bag"), storage)
    damaged(bag, lambda content: content[: len(content) // 3])
    done = gnss_sem_map(command, bag)
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert "truncated" in done.stderr
    assert not (tmp_path / "rig.yaml").exists()


def test_an_unknown_codec_is_named(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive", ros.drive(), compression="storage")
    damaged(bag, lambda content: content.replace(b"\x04\x00\x00\x00zstd", b"\x04\x00\x00\x00abcd"))
    with pytest.raises(DataError, match=r"compressed with 'abcd'; convert it to none, lz4, zstd or bz2"):
        open_drive(bag)


def test_files_that_are_compressed_as_a_whole_are_refused(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive", ros.drive(), "db3", "file")
    with pytest.raises(DataError, match=r"compressed as whole files.*zstd -d"):
        open_drive(bag)


@pytest.mark.parametrize("storage", ["mcap", "db3", "bag"])
def test_every_flipped_byte_is_an_error_or_a_value(tmp_path: Path, storage: str) -> None:
    """Nothing but our own errors, whatever the bytes of a message or of the index are."""
    written = ros.write(
        tmp_path / ("bag.bag" if storage == "bag" else "bag"), ros.drive(storage == "bag"), storage
    )
    content = (written if written.is_file() else next(written.glob(f"*.{storage}"))).read_bytes()
    rng = np.random.default_rng(1)
    file = tmp_path / f"drive.{storage}"
    for _ in range(60):
        changed = bytearray(content)
        for at in rng.integers(0, len(content), 20):
            changed[at] = rng.integers(256)
        file.write_bytes(changed)
        with suppress(DataError):
            for scan in open_drive(file).scans:
                scan.read()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", r"empty \(0 bytes\); copy it again"),
        (b"PK\3\4" + bytes(99), "of the kind .zip.*unpack it"),
        (b"\x89MCAP0\r\n" + bytes(99), r"rename it to drive\.mcap"),
    ],
)
def test_a_file_of_another_kind_is_not_called_damaged(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "drive.bag").write_bytes(content)
    with pytest.raises(DataError, match=said):
        open_drive(tmp_path / "drive.bag")


@pytest.mark.parametrize("is_ros1", [True, False])
def test_endings_may_have_capital_letters(tmp_path: Path, is_ros1: bool) -> None:
    bag = tmp_path / ("drive.BAG" if is_ros1 else "drive.MCAP")
    if is_ros1:
        ros.write(tmp_path / "drive.bag", ros.drive(is_ros1), "bag").rename(bag)
    else:
        ros.write_mcap(bag, ros.drive(), "ros2")
    assert len(open_drive(bag).scans) == 10


def test_files_beside_a_bag_that_cannot_be_read_are_named_with_what_to_do(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive", ros.drive())
    (bag / "rig.yml").write_text("gnss: {topic: /other}\n")
    with pytest.raises(DataError, match=r"rig\.yml: .*rename it to rig\.yaml"):
        open_drive(bag)
    (bag / "rig.yml").unlink()
    (bag / "metadata.yaml").write_text("files: [a\n")
    with pytest.raises(DataError, match=r"metadata\.yaml: .*remove it"):
        open_drive(bag)


def test_a_part_that_the_recorder_did_not_close_is_not_passed_over(plain: Path, tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    ros.write(folder / "drive_0.bag", ros.drive(is_ros1=True), "bag")
    assert open_drive(folder).skips == ()
    (folder / "drive_1.bag.active").write_bytes(b"")
    with pytest.raises(
        DataError, match=r"rosbag reindex drive_1.bag.active; mv drive_1.bag.active drive_1.bag"
    ):
        open_drive(folder)
    with pytest.raises(DataError, match=r"found a file, expected .* one ending in .bag, .mcap, .db3"):
        open_drive(folder / "drive_1.bag.active")


def test_a_part_that_the_metadata_list_and_that_is_not_there_is_told(plain: Path, tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    shutil.copytree(plain, bag)
    assert open_drive(bag).skips == ()
    about = (bag / "metadata.yaml").read_text()
    assert about.count("- drive.mcap") == 1
    (bag / "metadata.yaml").write_text(about.replace("- drive.mcap", "- drive.mcap\n  - parts/drive_1.mcap"))
    assert open_drive(bag).skips == (
        Skip("part of the bag", "drive_1.mcap", "metadata.yaml lists it, and it is not there"),
    )


def test_a_bag_that_was_repaired_by_its_advice_is_a_drive(plain: Path, tmp_path: Path) -> None:
    """A repair leaves two files: the advice says what becomes of the damaged one."""
    bag, whole = tmp_path / "drive", next(plain.glob("*.mcap")).read_bytes()
    bag.mkdir()
    (bag / "drive.mcap").write_bytes(whole[:-40])
    (bag / "repaired.mcap").write_bytes(whole)
    with pytest.raises(DataError, match=r"-o repaired.mcap, and move drive.mcap to another folder"):
        open_drive(bag)
    (bag / "drive.mcap").rename(tmp_path / "drive.mcap")
    assert len(open_drive(bag).scans) == 10

"""However a drive is mapped, at once, in chunks, in processes or after being killed, the map has the same bytes."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chunks import Maps, assert_same, by_chunks
from damage import flipped, halved
from street import Street

from factor_graphs.measurements import AntennaHeadings, GnssVelocities
from factor_graphs.surveyed_points import SurveyedPoints
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.ownership import MARKER
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import fingerprints
from gnss_sem_map.mapping.checkpoints import MOVING_POINTS, REMOVED, STATIC, ChunkStore
from gnss_sem_map.mapping.fusion import map_range, map_scans
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.semantic_map import SemanticMap

URBAN = open_label_set()


def assert_same_as(at_once: tuple[Maps, RunStats], store: ChunkStore, stats: RunStats) -> None:
    """Fail where chunks say something else than the maps and counts of a drive mapped at once."""
    assert_same(store.whole(STATIC), at_once[0].static)
    assert_same(store.whole(REMOVED), at_once[0].removed)
    assert stats.counts == at_once[1].counts
    assert stats.skips == at_once[1].skips


@pytest.mark.parametrize("window", [1, 2, 100])
def test_chunks_give_the_same_map_and_stats(
    drive: Drive, at_once: tuple[Maps, RunStats], tmp_path: Path, window: int
) -> None:
    stats = RunStats()
    store = map_scans(by_chunks(drive, window), tmp_path / "work", stats)
    assert store.count == {1: 6, 2: 3, 100: 1}[window]
    assert_same_as(at_once, store, stats)


def test_tiles_come_from_the_chunks_one_by_one(
    drive: Drive, at_once: tuple[Maps, RunStats], tmp_path: Path
) -> None:
    """The folder written tile by tile, never holding the map, has the bytes of the one written at once."""
    store = map_scans(by_chunks(drive, 2), tmp_path / "work", RunStats())
    pieces = ((tile, SemanticMap.of(store.tile(STATIC, tile))) for tile in store.tiles())
    tiles.write_tiles(pieces, tmp_path / "a", drive.log.frame, store.voxel_size_m, URBAN)
    tiles.write(SemanticMap.of(at_once[0].static), tmp_path / "b", drive.log.frame)
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "b").iterdir())
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


MAP = """
import sys
from pathlib import Path
from gnss_sem_map.mapping import fusion
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.segmentation import open_segmenter

if __name__ == "__main__":
    drive, probabilities, work = map(Path, sys.argv[1:])
    log = open_drive(drive)
    segmenter = open_segmenter(f"labels:{probabilities}", open_label_set(), sizes=log.calibration.image_sizes)
    job = Drive(log, log.reference, segmenter, Settings(dynamics={"enabled": False, "window_scans": 1}))
    # compiled code is loaded first: the kills fall into the mapping
    fusion.map_scans(job, work.with_suffix(".first"), RunStats())
    print("ready", flush=True)
    fusion.map_scans(job, work, RunStats(), resume=True)
    print("done", flush=True)
"""


def start(small_drive: Street, work: Path) -> subprocess.Popen[bytes]:
    """Map into a folder in a process of its own, which is about to begin."""
    script = work.with_suffix(".py")
    script.write_text(MAP)
    command = [sys.executable, str(script), str(small_drive.drive), str(small_drive.labels), str(work)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    return process


def seconds_of_mapping(small_drive: Street, work: Path) -> float:
    """How long a process maps when nothing kills it."""
    with start(small_drive, work) as process:
        begun = time.monotonic()
        assert process.stdout is not None
        assert process.stdout.readline() == b"done\n"
        return time.monotonic() - begun


def kill_at_random(small_drive: Street, work: Path, times: int, within_s: float, seed: int) -> list[int]:
    """Start mapping, kill -9 at a random moment, start again ...; how many chunks were there after each kill."""
    chance, done = random.Random(seed), []
    for _ in range(times):
        with start(small_drive, work) as process:
            time.sleep(chance.uniform(0.0, within_s))
            process.send_signal(signal.SIGKILL)
        done.append(sum(path.name.isdecimal() for path in work.iterdir()) if work.is_dir() else 0)
    return done


def assert_resumed(drive: Drive, at_once: tuple[Maps, RunStats], work: Path) -> None:
    """Fail where what killed processes left does not become the map of a drive mapped at once."""
    stats = RunStats()
    store = map_scans(by_chunks(drive, 1), work, stats, resume=True)
    assert_same_as(at_once, store, stats)
    assert [path.name for path in work.glob(".*.*.*")] == [], "what the killed processes left stays"


@pytest.mark.slow
@pytest.mark.integration
def test_a_killed_run_goes_on_to_the_same_map(
    drive: Drive, small_drive: Street, at_once: tuple[Maps, RunStats], tmp_path: Path
) -> None:
    whole_s = seconds_of_mapping(small_drive, tmp_path / "whole")
    kill_at_random(small_drive, tmp_path / "work", 2, whole_s, 1)
    assert_resumed(drive, at_once, tmp_path / "work")


@pytest.mark.slow
def test_a_run_killed_many_times_goes_on_to_the_same_map(
    drive: Drive, small_drive: Street, at_once: tuple[Maps, RunStats], tmp_path: Path
) -> None:
    partly, whole_s = 0, seconds_of_mapping(small_drive, tmp_path / "whole")
    for seed in range(5):
        work = tmp_path / f"work{seed}"
        done = kill_at_random(small_drive, work, 4, whole_s, seed)
        assert_resumed(drive, at_once, work)
        partly += sum(0 < n < len(drive.log.scans) // 2 for n in done)
    assert partly > 0, "no kill fell into the mapping: this test showed nothing"


def test_resuming_something_else_is_refused(drive: Drive, tmp_path: Path) -> None:
    work, drive = tmp_path / "work", by_chunks(drive, 2)
    map_scans(drive, work, RunStats())
    other = Settings.model_validate({"mapping": {"voxel_size_m": 0.3}})
    for changed in (
        replace(drive, settings=other),
        replace(drive, log=replace(drive.log, scans=drive.log.scans[2:])),
        by_chunks(drive, 1),
    ):
        with pytest.raises(DataError, match="another drive, trajectory, labels, settings or version"):
            map_scans(changed, work, RunStats(), resume=True)
    with pytest.raises(DataError, match="another drive"):
        map_scans(drive, work, RunStats(), resume=True, labels_from="labels:elsewhere")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("important")
    with pytest.raises(DataError, match="holds no interrupted run"):
        map_scans(drive, tmp_path / "mine", RunStats())
    assert (tmp_path / "mine/thesis.txt").exists()


def doubled(path: Path) -> None:
    tile = next(path.parent.rglob("*.parquet"))
    tile.with_name("77_77.parquet").write_bytes(tile.read_bytes())


@pytest.mark.parametrize(
    "damage",
    [flipped, *(pytest.param(one, marks=pytest.mark.slow) for one in (halved, doubled, Path.unlink))],
)
@pytest.mark.parametrize("what", ["static/*.parquet", MOVING_POINTS, "record.json"])
def test_a_damaged_chunk_is_mapped_again(
    drive: Drive, at_once: tuple[Maps, RunStats], tmp_path: Path, damage: Callable[[Path], None], what: str
) -> None:
    drive = by_chunks(drive, 2)
    map_scans(drive, tmp_path / "work", RunStats())
    others = {n: (tmp_path / f"work/{n}/record.json").stat().st_ino for n in (0, 2)}
    damage(sorted((tmp_path / "work/1").glob(what))[0])
    stats = RunStats()
    store = map_scans(drive, tmp_path / "work", stats, resume=True)
    assert_same_as(at_once, store, stats)
    assert others == {n: (tmp_path / f"work/{n}/record.json").stat().st_ino for n in (0, 2)}


def test_a_chunk_that_is_there_already_is_left_as_it_is(drive: Drive, tmp_path: Path) -> None:
    """A worker that was taken for lost may have saved it."""
    drive = by_chunks(drive, 2)
    store = map_scans(drive, tmp_path / "work", RunStats())
    before = (tmp_path / "work/0/record.json").stat()
    map_range(drive, store, range(1))
    assert os.path.samestat((tmp_path / "work/0/record.json").stat(), before)
    assert {path.name for path in (tmp_path / "work").iterdir() if path.name.endswith(".part")} == set()


def test_a_chunk_of_another_run_that_came_late_is_replaced(
    drive: Drive, at_once: tuple[Maps, RunStats], tmp_path: Path
) -> None:
    """A cluster goes on with what it has under way when a command is killed."""
    drive = by_chunks(drive, 2)
    other = map_scans(drive, tmp_path / "other", RunStats(), labels_from="elsewhere")
    store = map_scans(drive, tmp_path / "work", RunStats())
    shutil.rmtree(tmp_path / "work/1")
    shutil.copytree(other.folder / "1", tmp_path / "work/1")
    with pytest.raises(DataError, match="damaged chunk"):
        replace(store).records()
    map_range(drive, store, range(1, 2))
    assert store.is_whole(1)
    late = replace(store, fingerprint=other.fingerprint)
    with pytest.raises(DataError, match="cannot save voxels"):
        map_range(drive, late, range(1, 2))
    assert store.is_whole(1)
    assert [path.name for path in (tmp_path / "work").iterdir() if path.name.endswith(".part")] == []


def test_a_chunk_that_is_damaged_under_way_is_named_and_never_used(drive: Drive, tmp_path: Path) -> None:
    store = map_scans(by_chunks(drive, 2), tmp_path / "work", RunStats())
    tile = sorted((tmp_path / "work/1").glob("static/*.parquet"))[0]
    for file, use in (
        (tile, lambda: store.whole(STATIC)),
        (tmp_path / "work/1" / MOVING_POINTS, lambda: list(store.contents(MOVING_POINTS))),
    ):
        flipped(file)
        with pytest.raises(DataError, match=rf"1/.*{file.name}: damaged .*run it again"):
            use()
    shutil.rmtree(tmp_path / "work/2")
    with pytest.raises(DataError, match="damaged chunk"):
        replace(store).records()


def test_an_input_that_was_changed_since_is_noticed(
    small_drive: Street, drive: Drive, tmp_path: Path
) -> None:
    """Every file that a reader gives a scan or an image, and every label file, counts with its size and time."""
    street_copy = tmp_path / "street"
    shutil.copytree(small_drive.drive.parents[1], street_copy)
    opened = open_drive(next(street_copy.glob("*/*_sync")))
    labels_from = f"labels:{street_copy / 'probabilities'}"
    copied = by_chunks(replace(drive, log=opened), 2)
    before = fingerprints.of_map(copied, labels_from)
    assert fingerprints.of_map(copied, labels_from) == before
    for changed in (
        "*/*_sync/velodyne_points/data/*4.bin",
        "*/*_sync/image_02/data/*5.png",
        "probabilities/*6.npz",
    ):
        (path,) = (p for p in street_copy.glob(changed) if "1" not in p.stem)
        halved(path)
        assert fingerprints.of_map(copied, labels_from) != before, changed
        before = fingerprints.of_map(copied, labels_from)


def test_code_of_a_segmenter_that_was_edited_is_noticed(
    drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In its module, or in another one of its package; a copy of it elsewhere is the same code."""
    monkeypatch.syspath_prepend(tmp_path)
    package = tmp_path / "looks_package"
    package.mkdir()
    for file in (
        tmp_path / "looks_alone.py",
        package / "__init__.py",
        package / "network.py",
        package / "layers.py",
    ):
        file.write_text("factor = 1\n")
    for spec, file in (
        ("looks_alone:see", "looks_alone.py"),
        ("looks_package.network:see", "looks_package/layers.py"),
    ):
        before = fingerprints.of_map(drive, f"python:{spec}?classes=road")
        (tmp_path / file).touch()
        assert fingerprints.of_map(drive, f"python:{spec}?classes=road") == before
        (tmp_path / file).write_text("factor = 2\n")
        assert fingerprints.of_map(drive, f"python:{spec}?classes=road") != before


def test_the_last_digits_of_a_pose_are_no_other_drive(drive: Drive) -> None:
    """They depend on the processor that multiplied the matrices of the calibration."""
    calibration, before = drive.log.calibration, fingerprints.of_map(drive, "")
    for off, is_same in ((1e-15, True), (1e-6, False)):
        T_imu_lidar = calibration.T_imu_lidar.copy()
        T_imu_lidar[:3, 3] += off
        log = replace(drive.log, calibration=replace(calibration, T_imu_lidar=T_imu_lidar))
        assert (fingerprints.of_map(replace(drive, log=log), "") == before) == is_same


def test_classes_that_were_changed_in_their_file_are_noticed(drive: Drive, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    shutil.copyfile(Path(fingerprints.__file__).parents[1] / "labels/urban.yaml", file)
    settings = drive.settings.model_copy(update={"classes": str(file)})

    def digests() -> set[str]:
        opened = replace(drive, settings=settings)
        of_log = fingerprints.of_log(drive.log, "", open_label_set(file))
        return {fingerprints.of_map(opened, ""), fingerprints.of_probabilities(opened, ""), of_log}

    before = digests()
    file.write_text(file.read_text("utf-8").replace("sidewalk: sidewalk", "sidewalk: road"), "utf-8")
    assert digests().isdisjoint(before)


def test_what_a_receiver_and_a_survey_say_beside_positions_changes_the_digest(drive: Drive) -> None:
    log, at = drive.log, np.array([1.0, 2.0])
    one, names = np.ones((2, 3)), ("A", "B")
    control = np.ones(2, np.bool_)
    logs = [
        log,
        *(replace(log, velocities=GnssVelocities(at, speed * one, one)) for speed in (1, 2)),
        *(replace(log, headings=AntennaHeadings(at, angle * at, at, one[0])) for angle in (1, 2)),
        *(replace(log, points=SurveyedPoints(names, place * one, one, at, control)) for place in (1, 2)),
        replace(log, points=SurveyedPoints(names[::-1], one, one, at, control)),
        replace(log, points=SurveyedPoints(names, one, one, at, ~control)),
    ]
    assert len({fingerprints.of_log(one) for one in logs}) == len(logs)


FILL = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from gnss_sem_map.errors import DataError
from test_tiles import random_map, FRAME
from gnss_sem_map.mapping import checkpoints
from gnss_sem_map.mapping.chunks import MappedChunk
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.attributes import NOTHING
from gnss_sem_map.labels.label_set import open_label_set

folder, written = Path(sys.argv[2]), random_map(count=200_000)
store = checkpoints.ChunkStore(folder / "work", "x", 1, 0.2, open_label_set()).begun(resume=False)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
for attempt in (
    lambda: tiles.write(written, folder / "map", FRAME),
    lambda: store.write(MappedChunk(
        0, "", written.voxels, written.voxels - written.voxels, NOTHING, NOTHING, {}, (), None, RunStats()
    )),
):
    try:
        attempt()
    except DataError as error:
        print(error)
"""


@pytest.mark.integration
def test_a_full_disk_is_an_error_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    """No file may grow beyond 20 kB, as if the disk were full there."""
    done = subprocess.run(
        [sys.executable, "-c", FILL, str(Path(__file__).parents[1] / "voxels"), str(tmp_path)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    first, second = done.stdout.splitlines()
    assert "cannot write the map" in first
    assert "cannot save voxels" in second
    assert [path.name for path in tmp_path.iterdir()] == ["work"]
    assert {path.name for path in (tmp_path / "work").iterdir()} == {"chunks.json", MARKER}

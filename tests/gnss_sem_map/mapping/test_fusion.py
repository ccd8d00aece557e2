"""However a drive is mapped, at once, in chunks, in processes or after being killed, the map has the same bytes."""

from __future__ import annotations

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
import numpy_chain
import pytest
import street
from damage import flipped, halved
from numpy.typing import NDArray
from street import Street

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import ConfigError, DataError, WriteError
from gnss_sem_map.files.ownership import MARKER
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.fusion import STATIC, Drive, Maps, build_maps, fingerprint, map_chunks
from gnss_sem_map.mapping.labelled_scans import labelled_scans
from gnss_sem_map.run_stats import RunStats
from gnss_sem_map.scans.projection import class_image
from gnss_sem_map.segmentation import Segmenter, open_segmenter
from gnss_sem_map.segmentation.cached_segmenter import CachedSegmenter
from gnss_sem_map.sensor_log import Image, Skip, file_of
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.semantic_map import SemanticMap
from gnss_sem_map.voxels.voxel_map import VoxelMap

URBAN = open_label_set()


@pytest.fixture(scope="module")
def drive(small_drive: Street) -> Drive:
    log = open_drive(small_drive.drive)
    segmenter = open_segmenter(
        f"labels:{small_drive.labels}", URBAN, expected_size=log.calibration.image_size
    )
    assert log.reference is not None
    return Drive(log, log.reference, segmenter, Settings())


@pytest.fixture(scope="module")
def at_once(drive: Drive) -> tuple[Maps, RunStats]:
    stats = RunStats()
    return build_maps(drive, stats), stats


def by_chunks(drive: Drive, scans: int) -> Drive:
    """The drive, with so many scans in a chunk."""
    mapping = drive.settings.mapping.model_copy(update={"scans_per_chunk": scans})
    return replace(drive, settings=drive.settings.model_copy(update={"mapping": mapping}))


def assert_same(a: VoxelMap, b: VoxelMap) -> None:
    for name in ("keys", "evidence", "hits"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_a_scan_without_an_image_adds_hits_and_no_evidence_and_is_counted(
    drive: Drive, at_once: tuple[Maps, RunStats]
) -> None:
    """All images but two: the map is that of the others' labels, with every point in it."""
    kept, stats = drive.log.images[3:5], RunStats()
    found = build_maps(replace(drive, log=replace(drive.log, images=kept)), stats).static
    np.testing.assert_array_equal(found.keys, at_once[0].static.keys)
    np.testing.assert_array_equal(found.hits, at_once[0].static.hits)
    shown = [scan for scan in drive.log.scans if scan.number in [image.number for image in kept]]
    few = build_maps(replace(drive, log=replace(drive.log, scans=tuple(shown))), RunStats()).static
    places = found.indices_of(few.keys)
    np.testing.assert_array_equal(found.evidence[places], few.evidence)
    assert found.observed.sum() == few.observed.sum() > 0
    reasons = [(skip.what, skip.reason) for skip in stats.skips]
    assert reasons == [("labels", "no image near its stamp")] * (len(drive.log.scans) - 2)


def test_points_that_are_kept_on_the_way_are_those_that_are_found_later(drive: Drive) -> None:
    on_the_way = list(labelled_scans(drive, keep_points=True))
    assert len(on_the_way) == len(drive.log.scans)
    for seen, asked in zip(on_the_way, labelled_scans(drive), strict=True):
        assert asked.kept is None
        np.testing.assert_array_equal(seen.p_map, asked.p_map)
        np.testing.assert_array_equal(seen.keys, asked.keys)
        np.testing.assert_array_equal(seen.pixels, asked.pixels)


def test_images_exposed_outside_the_trajectory_cost_the_labels_and_never_the_scans(
    drive: Drive, at_once: tuple[Maps, RunStats]
) -> None:
    settings, stats = drive.settings, RunStats()
    late = settings.labelling.model_copy(update={"camera_time_offset_s": 3600.0})
    found = build_maps(replace(drive, settings=settings.model_copy(update={"labelling": late})), stats).static
    np.testing.assert_array_equal(found.keys, at_once[0].static.keys)
    np.testing.assert_array_equal(found.hits, at_once[0].static.hits)
    assert not found.observed.any()
    assert [skip.what for skip in stats.skips] == ["labels"] * len(drive.log.scans)
    assert all("trajectory" in skip.reason for skip in stats.skips)


class Refusing:
    """A segmenter that cannot do one image."""

    def __init__(self, segmenter: Segmenter, refused: int) -> None:
        self._segmenter, self._refused = segmenter, refused
        self.class_names = segmenter.class_names

    def __call__(self, image: Image) -> NDArray[np.uint8] | NDArray[np.float32]:
        if image.number == self._refused:
            raise DataError("this image is damaged")
        return self._segmenter(image)


def test_an_image_that_cannot_be_segmented_costs_its_own_labels_only(
    drive: Drive, at_once: tuple[Maps, RunStats], tmp_path: Path
) -> None:
    """A live network's answers are remembered between the two passes; so is nothing that it refused."""
    assert drive.segmenter is not None
    size = drive.log.calibration.image_size
    assert size is not None
    refusing = CachedSegmenter(Refusing(drive.segmenter, 5), URBAN, size, tmp_path)
    for _ in range(2):
        stats = RunStats()
        found = build_maps(replace(drive, segmenter=refusing), stats)
        assert stats.skips == [Skip("labels", "frame 5", "this image is damaged")]
        np.testing.assert_array_equal(found.static.hits, at_once[0].static.hits)
        counts = stats.counts
        parts = ("points left out", "points unlabelled", "points labelled")
        assert counts["points"] == sum(counts[part] for part in parts)
        assert 0 < counts["points labelled"] < at_once[1].counts["points labelled"]


def test_a_network_that_can_do_nothing_is_named_and_the_map_is_made(drive: Drive) -> None:
    class Hopeless:
        class_names = ("road", "other")

        def __call__(self, image: Image) -> NDArray[np.uint8]:
            raise DataError("this network is broken")

    stats = RunStats()
    assert len(build_maps(replace(drive, segmenter=Hopeless()), stats).static) > 1000
    assert stats.counts["points labelled"] == 0
    first = drive.log.scans[0].number
    assert stats.warnings == [
        "no point got a label, and the map shows geometry only; first reason:"
        f" frame {first}: this network is broken"
    ]


def test_a_full_disk_is_no_fault_of_an_image_and_ends_the_run(drive: Drive, tmp_path: Path) -> None:
    assert drive.segmenter is not None
    size = drive.log.calibration.image_size
    assert size is not None
    nowhere = CachedSegmenter(drive.segmenter, URBAN, size, tmp_path / "removed")
    with pytest.raises(WriteError, match="cannot be written"):
        build_maps(replace(drive, segmenter=nowhere), RunStats())


@pytest.mark.parametrize(
    ("chunk", "workers"), [(1, 1), (5, 1), (100, 1), pytest.param(5, 2, marks=pytest.mark.integration)]
)
def test_chunks_and_processes_give_the_same_map_and_stats(
    drive: Drive, at_once: tuple[Maps, RunStats], tmp_path: Path, chunk: int, workers: int
) -> None:
    stats = RunStats()
    maps = build_maps(by_chunks(drive, chunk), stats, work=tmp_path / "work", workers=workers)
    assert_same(maps.static, at_once[0].static)
    assert len(maps.removed) == 0
    assert stats.counts == at_once[1].counts
    assert stats.skips == at_once[1].skips


def test_tiles_come_from_the_chunks_one_by_one(
    drive: Drive, at_once: tuple[Maps, RunStats], tmp_path: Path
) -> None:
    """The folder written tile by tile, never holding the map, has the bytes of the one written at once."""
    store = map_chunks(by_chunks(drive, 3), tmp_path / "work", RunStats())
    pieces = ((tile, SemanticMap.of(part)) for tile, part in store.tiles(STATIC))
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
from gnss_sem_map.run_stats import RunStats
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.segmentation import open_segmenter

if __name__ == "__main__":
    drive, probabilities, work = map(Path, sys.argv[1:])
    log = open_drive(drive)
    segmenter = open_segmenter(f"labels:{probabilities}", open_label_set(), expected_size=log.calibration.image_size)
    job = Drive(log, log.reference, segmenter, Settings(mapping={"scans_per_chunk": 1}))
    fusion.fuse_scans(job, log.scans[:1], RunStats())  # compiled code is loaded: the kills fall into the mapping
    print("ready", flush=True)
    fusion.map_chunks(job, work, RunStats(), resume=True)
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


def kill_at_random(small_drive: Street, work: Path, times: int, seed: int) -> list[int]:
    """Start mapping, kill -9 at a random moment, start again ...; how many chunks were there after each kill."""
    chance, done = random.Random(seed), []
    with start(small_drive, work.with_name(f"whole{seed}")) as process:
        begun = time.monotonic()
        assert process.stdout is not None
        assert process.stdout.readline() == b"done\n"
        whole_s = time.monotonic() - begun
    for _ in range(times):
        with start(small_drive, work) as process:
            time.sleep(chance.uniform(0.0, whole_s))
            process.send_signal(signal.SIGKILL)
        done.append(sum(path.name.isdecimal() for path in work.iterdir()) if work.is_dir() else 0)
    return done


def resumed_after_kills(
    drive: Drive, small_drive: Street, at_once: tuple[Maps, RunStats], work: Path, times: int, seed: int
) -> list[int]:
    done = kill_at_random(small_drive, work, times, seed)
    stats = RunStats()
    maps = build_maps(by_chunks(drive, 1), stats, work=work, resume=True)
    assert_same(maps.static, at_once[0].static)
    assert stats.counts == at_once[1].counts
    assert not list(work.glob(".*.part"))
    return done


@pytest.mark.integration
def test_a_killed_run_goes_on_to_the_same_map(
    drive: Drive, small_drive: Street, at_once: tuple[Maps, RunStats], tmp_path: Path
) -> None:
    resumed_after_kills(drive, small_drive, at_once, tmp_path / "work", 2, 1)


@pytest.mark.slow
def test_a_run_killed_many_times_goes_on_to_the_same_map(
    drive: Drive, small_drive: Street, at_once: tuple[Maps, RunStats], tmp_path: Path
) -> None:
    partly = 0
    for seed in range(8):
        done = resumed_after_kills(drive, small_drive, at_once, tmp_path / f"work{seed}", 4, seed)
        partly += sum(0 < n < len(drive.log.scans) for n in done)
    assert partly > 0, "no kill fell into the mapping: this test showed nothing"


def test_resuming_something_else_is_refused(drive: Drive, tmp_path: Path) -> None:
    work, drive = tmp_path / "work", by_chunks(drive, 4)
    build_maps(drive, RunStats(), work=work)
    other = Settings.model_validate({"mapping": {"voxel_size_m": 0.3}})
    for changed in (
        replace(drive, settings=other),
        replace(drive, log=replace(drive.log, scans=drive.log.scans[2:])),
        replace(drive, moving={3: np.array([5])}),
    ):
        with pytest.raises(DataError, match="another drive, trajectory, labels or settings"):
            build_maps(changed, RunStats(), work=work, resume=True)
    with pytest.raises(DataError, match="another drive"):
        build_maps(drive, RunStats(), work=work, resume=True, labels_from="labels:elsewhere")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("important")
    with pytest.raises(DataError, match="holds no interrupted run"):
        build_maps(drive, RunStats(), work=tmp_path / "mine")
    assert (tmp_path / "mine/thesis.txt").exists()


def doubled(path: Path) -> None:
    tile = next(path.parent.rglob("*.npy"))
    tile.with_name("77_77.npy").write_bytes(tile.read_bytes())


@pytest.mark.parametrize("damage", [flipped, halved, doubled, Path.unlink])
@pytest.mark.parametrize("what", ["static/*.npy", "record.json"])
def test_a_damaged_chunk_is_mapped_again(
    drive: Drive, at_once: tuple[Maps, RunStats], tmp_path: Path, damage: Callable[[Path], None], what: str
) -> None:
    drive = by_chunks(drive, 4)
    build_maps(drive, RunStats(), work=tmp_path / "work")
    others = {n: (tmp_path / f"work/{n}/record.json").stat().st_ino for n in (0, 2)}
    damage(sorted((tmp_path / "work/1").glob(what))[0])
    stats = RunStats()
    maps = build_maps(drive, stats, work=tmp_path / "work", resume=True)
    assert_same(maps.static, at_once[0].static)
    assert stats.counts == at_once[1].counts
    assert others == {n: (tmp_path / f"work/{n}/record.json").stat().st_ino for n in (0, 2)}


def test_a_chunk_that_is_damaged_under_way_is_named_and_never_used(drive: Drive, tmp_path: Path) -> None:
    store = map_chunks(by_chunks(drive, 4), tmp_path / "work", RunStats())
    part = sorted((tmp_path / "work/1").glob("static/*.npy"))[0]
    flipped(part)
    with pytest.raises(DataError, match=rf"{part.name}: damaged voxels .*--resume maps them again"):
        store.whole(STATIC)
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
    copied = by_chunks(replace(drive, log=opened), 4)
    before = fingerprint(copied, labels_from)
    assert fingerprint(copied, labels_from) == before
    for changed in (
        "*/*_sync/velodyne_points/data/*4.bin",
        "*/*_sync/image_02/data/*5.png",
        "probabilities/*6.npz",
    ):
        (path,) = (p for p in street_copy.glob(changed) if "1" not in p.stem)
        halved(path)
        assert fingerprint(copied, labels_from) != before, changed
        before = fingerprint(copied, labels_from)


@pytest.mark.parametrize("layout", ["raw", "odometry", "table"])
def test_every_reader_says_which_files_it_reads(small_drive: Street, tmp_path: Path, layout: str) -> None:
    write = {"raw": None, "odometry": street.write_odometry, "table": street.write_table_log}[layout]
    log = open_drive(small_drive.drive if write is None else write(tmp_path, small_drive))
    for item in (*log.scans, *log.images):
        file = file_of(item)
        assert file is not None
        assert int(file.stem) == item.number


def test_what_moved_goes_into_a_map_of_its_own_and_nothing_is_lost(
    drive: Drive, at_once: tuple[Maps, RunStats], tmp_path: Path
) -> None:
    """Everything that its image calls a vehicle is taken out: by chunks and at once alike."""
    vehicle = URBAN.index("vehicle")
    moving = {seen.scan.number: np.flatnonzero(seen.labels == vehicle) for seen in labelled_scans(drive)}
    taken = replace(drive, moving=moving)
    maps = build_maps(taken, RunStats())
    assert maps.removed.hits.sum() == sum(map(len, moving.values())) > 100
    assert set(maps.removed.labels) == {vehicle}
    assert not (maps.static.labels == vehicle).any()
    assert_same(maps.static + maps.removed, at_once[0].static)
    chunked = build_maps(by_chunks(taken, 5), RunStats(), work=tmp_path / "work")
    assert_same(chunked.static, maps.static)
    assert_same(chunked.removed, maps.removed)


class Unsendable:
    """A segmenter that holds something that no other process can have."""

    class_names = ("road", "other")
    lock = property(lambda self: None)

    def __init__(self) -> None:
        self.here = lambda: None

    def __call__(self, image: object) -> np.ndarray:
        return np.zeros((48, 150, 2), np.uint8)


def test_a_segmenter_that_cannot_be_shared_is_refused_before_any_work(drive: Drive, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot work in several processes"):
        build_maps(
            by_chunks(replace(drive, segmenter=Unsendable()), 2), RunStats(), work=tmp_path / "w", workers=2
        )


FILL = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from gnss_sem_map.errors import DataError
from test_tiles import random_map, FRAME
from gnss_sem_map.mapping import checkpoints
from gnss_sem_map.voxels import tiles
from gnss_sem_map.labels.label_set import open_label_set

folder, written = Path(sys.argv[2]), random_map(count=200_000)
store = checkpoints.open_store(folder / "work", "x", 1, False, 0.2, open_label_set())
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
for attempt in (
    lambda: tiles.write(written, folder / "map", FRAME),
    lambda: store.write(0, {"static": written.voxels}, {}),
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


def test_the_whole_chain_equals_plain_numpy_bit_for_bit(drive: Drive, at_once: tuple[Maps, RunStats]) -> None:
    """Deskewing, keys, projection, occlusion and fusion, scan by scan and as a map."""
    settings, log = drive.settings, drive.log
    plain = numpy_chain.NumpyMap(settings.mapping.voxel_size_m, URBAN)
    for seen in labelled_scans(drive):
        points = seen.scan.read()
        p_map = numpy_chain.points_in_map(
            points, seen.scan.stamp, drive.trajectory, log.calibration.T_imu_lidar, settings.mapping
        )
        np.testing.assert_array_equal(seen.p_map, p_map)
        image = log.image_at(seen.scan.stamp, settings.labelling.image_within_s)
        assert image is not None
        assert drive.segmenter is not None
        classes = class_image(
            drive.segmenter(image), drive.segmenter.class_names, URBAN, log.calibration.image_size, ""
        )
        pixels = numpy_chain.pixels_seen(
            p_map, image, drive.trajectory, log.calibration, classes, settings.labelling
        )
        np.testing.assert_array_equal(seen.pixels >= 0, pixels >= 0)
        np.testing.assert_array_equal(seen.classes, classes.rows[pixels[pixels >= 0]])
        plain.add(numpy_chain.keys_of(p_map, settings.mapping.voxel_size_m), pixels, classes.rows)
    assert_same(plain.to_map(), at_once[0].static)


def test_the_car_itself_is_not_mapped(real_data: Path) -> None:
    """A real car shows itself in every sweep, at the corners of its roof: a ghost beside the whole track, if kept."""
    log = open_drive(real_data / "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync")
    assert log.reference is not None
    there, kept = 0, 0
    for seen in labelled_scans(Drive(log, log.reference, None, Settings())):
        x, y, z = seen.points.xyz.T
        of_the_car = (np.abs(x) < 2) & (np.abs(y) < 1.5) & (z > -1.2)
        there, kept = there + int(of_the_car.sum()), kept + int(of_the_car[seen.valid].sum())
    assert there > 1000
    assert kept == 0

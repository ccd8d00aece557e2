"""What a chunk says depends on its own scans and a window on either side: on no other chunk, and on no process."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from chunks import assert_same, build_maps, by_chunks
from counted_reads import counted

from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.chunks import MappedChunk, chunks_of, map_chunks
from gnss_sem_map.mapping.edge_windows import EdgeWindows
from gnss_sem_map.mapping.evidence import read_moving_points
from gnss_sem_map.mapping.fusion import map_scans
from gnss_sem_map.mapping.labelled_scans import Drive, labelled_scans
from gnss_sem_map.mapping.raw_map import open_raw, write_raw
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.sensor_log import Points
from gnss_sem_map.voxels.voxel_map import VoxelMap

SWEEPS, WINDOW = 20, 3
DAMAGED = 6
"""The first scan of the second chunk: it is in the window of the first."""
CARS = [  # one ahead, one that comes towards us, and one that overtakes
    ((16.0, -1.2, 0.0), (20.0, 0.6, 1.5), (6.0, 0.0, 0.0)),
    ((45.0, 1.6, 0.0), (49.0, 3.4, 1.5), (-9.0, 0.0, 0.0)),
    ((-8.0, -4.0, 0.0), (-4.0, -2.4, 1.5), (12.0, 0.0, 0.0)),
]


@pytest.fixture(scope="module")
def moving() -> Drive:
    """A street in which three cars drive, in chunks of six, six and eight scans, one of which is damaged."""
    motion = scenes.drive(SWEEPS * scenes.SWEEP_S)
    points = {k: scenes.sweep(motion, scenes.street(CARS), k) for k in range(SWEEPS)}
    log = scenes.log_of(points, scenes.trajectory_of(motion, SWEEPS))

    def damaged() -> Points:
        raise DataError("this scan is damaged")

    scans = [replace(scan, read=damaged) if scan.number == DAMAGED else scan for scan in log.scans]
    assert log.given is not None
    drive = Drive(replace(log, scans=tuple(scans)), log.given, None, Settings())
    return by_chunks(drive, WINDOW)


@pytest.fixture(scope="module")
def together(moving: Drive, tmp_path_factory: pytest.TempPathFactory) -> list[MappedChunk]:
    """All chunks, mapped in one go."""
    return list(
        map_chunks(
            moving,
            range(3),
            tmp_path_factory.mktemp("waiting"),
            EdgeWindows(tmp_path_factory.mktemp("work"), ""),
        )
    )


def told(chunk: MappedChunk) -> Iterator[tuple[str, object]]:
    """What must not differ: arrays, and plain values."""
    for layer in ("static", "removed"):
        for name in ("keys", "evidence", "hits", "heights", "of_images"):
            yield f"{layer}.{name}", getattr(getattr(chunk, layer), name)
    for number, indices in chunk.moving.items():
        yield f"moving {number}", indices
    for number, one in enumerate(chunk.objects):
        yield f"object {number}", (one.motion, one.probability, one.reason, one.points, one.path.tolist())
    assert chunk.keyframes is not None
    yield "images", chunk.keyframes.images
    yield "poses", chunk.keyframes.T_lidar_map
    yield "counts", chunk.stats.counts
    yield "skips", chunk.stats.skips


def test_every_chunk_but_the_last_has_two_windows_of_scans_and_one_after_it(moving: Drive) -> None:
    for count in range(1, SWEEPS + 1):
        scans = moving.log.scans[:count]
        chunks = chunks_of(replace(moving, log=replace(moving.log, scans=scans)))
        assert [scan.number for chunk in chunks for scan in chunk] == [scan.number for scan in scans]
        assert all(len(chunk) == 2 * WINDOW for chunk in chunks[:-1])
        assert len(chunks) == 1 or WINDOW <= len(chunks[-1]) < 3 * WINDOW


DIVISIONS = [
    [range(1), range(1, 2), range(2, 3)],
    [range(2, 3), range(1, 2), range(1)],  # what the later ones have saved is read
    [range(2), range(2, 3)],
    [range(2, 3), range(2)],
]


@pytest.mark.parametrize("ranges", DIVISIONS)
def test_the_chunks_say_the_same_for_any_division_among_processes(
    moving: Drive, together: list[MappedChunk], ranges: list[range], tmp_path: Path
) -> None:
    waiting = tmp_path / "waiting"
    waiting.mkdir()
    apart = [
        chunk
        for numbers in ranges
        for chunk in map_chunks(moving, numbers, waiting, EdgeWindows(tmp_path, ""))
    ]
    apart.sort(key=lambda chunk: chunk.number)
    assert [chunk.number for chunk in apart] == [0, 1, 2]
    assert sum(len(chunk.removed) for chunk in together) > 100
    assert_same_chunks(apart, together)


def assert_same_chunks(apart: list[MappedChunk], together: list[MappedChunk]) -> None:
    for one, other in zip(together, apart, strict=True):
        for (name, a), (same_name, b) in zip(told(one), told(other), strict=True):
            assert name == same_name
            same_value = np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b
            assert same_value, f"chunk {one.number}: {name}"


@pytest.mark.parametrize(
    ("run", "damage"), [("this", None), ("another", None), ("this", b""), ("this", b"PK\x03\x04 cut off")]
)
def test_a_window_that_another_process_of_this_run_has_looked_at_is_not_read_again_unless_it_is_damaged(
    moving: Drive, together: list[MappedChunk], run: str, damage: bytes | None, tmp_path: Path
) -> None:
    (waiting := tmp_path / "waiting").mkdir()
    for _ in map_chunks(moving, range(1, 3), waiting, EdgeWindows(tmp_path, run)):
        pass
    assert [path.name for path in (tmp_path / "edges").iterdir()] == ["1.npz"]
    if damage is not None:
        (tmp_path / "edges/1.npz").write_bytes(damage)
    drive, reads = counting(moving)
    first = list(map_chunks(drive, range(1), waiting, EdgeWindows(tmp_path, "this")))
    assert_same_chunks(first, together[:1])
    is_read = run == "another" or damage is not None
    assert (7 in reads) == is_read, "an odd one, which does not tell the rows"


def counting(drive: Drive) -> tuple[Drive, Counter[int]]:
    """The drive, and how often each of its scans is read."""
    log, reads = counted(drive.log)
    return replace(drive, log=log), reads


@pytest.mark.parametrize(
    ("numbers", "first", "last"),
    [(range(3), 0, 20), (range(1), 0, 9), (range(1, 2), 3, 15), (range(2, 3), 9, 20)],
)
def test_a_range_of_chunks_reads_its_scans_and_a_window_on_either_side_once(
    moving: Drive, numbers: range, first: int, last: int, tmp_path: Path
) -> None:
    (waiting := tmp_path / "waiting").mkdir()
    drive, reads = counting(replace(moving, saved=tmp_path))
    _ = drive.image_rows  # their scans are saved, as when odometry has read them
    reads.clear()
    for _ in map_chunks(drive, numbers, waiting, EdgeWindows(tmp_path, "")):
        pass
    assert reads.keys() == set(range(first, last))
    again = {number for number, times in reads.items() if times > 1}
    assert again <= {DAMAGED}
    assert [path.name for path in waiting.iterdir()] == ["images.npy"], "points wait no longer"


def test_every_point_is_static_or_removed_and_the_indices_say_which(
    moving: Drive, together: list[MappedChunk]
) -> None:
    """Both maps together are the map of a drive in which nothing is sought."""
    settings = moving.settings.model_copy(
        update={"dynamics": moving.settings.dynamics.model_copy(update={"enabled": False})}
    )
    everything = build_maps(replace(moving, settings=settings), RunStats())
    assert len(everything.removed) == 0
    maps = build_maps(moving, RunStats())
    assert_same(maps.static + maps.removed, everything.static)
    gone = {number: indices for chunk in together for number, indices in chunk.moving.items()}
    seen_of = {seen.scan.number: seen for seen in labelled_scans(moving)}
    assert gone.keys() == seen_of.keys() == set(range(SWEEPS)) - {DAMAGED}
    keys = np.concatenate([seen_of[number].keys[indices] for number, indices in gone.items()])
    heights = np.concatenate([seen_of[number].heights[indices] for number, indices in gone.items()])
    found, places = np.unique(keys, return_inverse=True)
    np.testing.assert_array_equal(maps.removed.keys, found)
    np.testing.assert_array_equal(maps.removed.hits, np.bincount(places))
    np.testing.assert_array_equal(maps.removed.heights, np.bincount(places, heights))
    assert_same(sum_of([chunk.static for chunk in together]), maps.static)


def sum_of(parts: list[VoxelMap]) -> VoxelMap:
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def test_a_run_folder_holds_what_the_chunks_say(
    moving: Drive, together: list[MappedChunk], tmp_path: Path
) -> None:
    store = map_scans(moving, tmp_path / "work", RunStats())
    (tmp_path / "run").mkdir()
    write_raw(store, tmp_path / "run", moving.log.frame)
    raw = open_raw(tmp_path / "run", moving.label_set)
    static, removed = (
        sum_of([getattr(chunk, layer) for chunk in together]) for layer in ("static", "removed")
    )
    assert_same(raw.fused.whole().voxels, static + removed)
    assert_same(raw.evidence.moved.whole().voxels, removed)
    assert_same(sum_of([raw.around((tile,), 0.0) for tile in raw.fused.tiles]), static)
    for chunk, path in zip(together, raw.evidence.moving_points, strict=True):
        for number, indices in read_moving_points(path).items():
            np.testing.assert_array_equal(indices, chunk.moving[number])
    assert [path.name for path in (tmp_path / "work").glob(".*.*.*")] == [], "points wait no longer"
    assert len(store.objects()) + store.untracked() == sum(len(chunk.objects) for chunk in together)


def test_points_that_cannot_wait_are_an_error_in_one_line(moving: Drive, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere: cannot be written .*run it again"):
        list(map_chunks(moving, range(3), tmp_path / "nowhere", EdgeWindows(tmp_path, "")))

"""Tasks of a drive, here and in other processes: what they find is the same to the bit, and is not made twice."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from counted_reads import counted
from street import Street

from factor_graphs.relative_poses import RelativePoses
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.mapping.checkpoints import ChunkStore
from gnss_sem_map.mapping.fusion import map_scans, store_of
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.process.dask_cluster import Cluster
from gnss_sem_map.process.execution import Executor, InProcess
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.process.worker_processes import Processes
from gnss_sem_map.runs import binding, drive_tasks, pipeline
from gnss_sem_map.runs.binding import LocatedJob, bind
from gnss_sem_map.runs.drive_job import DriveJob, closing_drives, give, job_for
from gnss_sem_map.runs.map_job import MapJob
from gnss_sem_map.runs.source import Source, source_of
from gnss_sem_map.scans.lidar_odometry import ScanMatches, match_scans, sections_of
from gnss_sem_map.scans.revisits import Found, Pair, Pass, pass_of, register_pair

SETTINGS = Settings.model_validate(
    {
        "trajectory": {"scan_matching": {"section_scans": 3, "min_points": 20}},
        "dynamics": {"window_scans": 1},
    }
)
"""Several sections, and six chunks."""
MATCHING = SETTINGS.trajectory.scan_matching
PAIRS: list[Pair] = [(0, 0, 0, 1), (0, 0, 0, 2), (0, 1, 0, 2), (0, 0, 0, 3), (0, 2, 0, 1)]


@dataclass(frozen=True)
class Divided(InProcess):
    """Tasks in this process, divided as for two workers."""

    workers: int = 2


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    with closing_drives():
        yield


@pytest.fixture(scope="module")
def source(small_drive: Street) -> Source:
    return source_of(small_drive.drive, f"labels:{small_drive.labels}")


def run_in(work: Path, executor: Executor | None = None) -> MapJob:
    return MapJob(SETTINGS, None, work, executor or InProcess(), is_one=True)


def located(source: Source, run: MapJob) -> LocatedJob:
    [one] = pipeline.locate_drives([job_for(source, run, force=True)], run)[0].values()
    return one


def matches_in(one: LocatedJob) -> ScanMatches:
    log = open_drive(one.job.source.drive)
    assert one.matches is not None
    return drive_tasks._all_matches(one.job, one.matches, len(log.scans))[0]


@pytest.fixture(scope="module")
def expected(source: Source, tmp_path_factory: pytest.TempPathFactory) -> ScanMatches:
    log = open_drive(source.drive)
    one = located(source, run_in(tmp_path_factory.mktemp("expected")))
    found = match_scans(log, Trajectory(**one.job.needed("checked").of("first")), MATCHING)
    assert found.counts["scans matched"] > 3
    assert len(sections_of(len(log.scans), MATCHING)) > 1
    return found


def assert_same(found: ScanMatches, expected: ScanMatches) -> None:
    for field in fields(RelativePoses):
        one, other = (getattr(some.relative_poses, field.name) for some in (found, expected))
        np.testing.assert_array_equal(one, other, err_msg=field.name)
    assert (found.skips, found.counts) == (expected.skips, expected.counts)


@pytest.mark.parametrize("executor", [InProcess(), pytest.param(Processes(2), marks=pytest.mark.integration)])
def test_sections_are_matched_as_the_whole_drive_is(
    executor: Executor, source: Source, expected: ScanMatches, tmp_path: Path
) -> None:
    assert_same(matches_in(located(source, run_in(tmp_path, executor))), expected)


@pytest.mark.parametrize("damage", [b"", b"no archive"])
def test_only_what_is_missing_or_damaged_is_found_again(
    damage: bytes, source: Source, expected: ScanMatches, tmp_path: Path
) -> None:
    one = located(source, run_in(tmp_path))
    files = sorted(one.job.folder.glob("**/*.npz"))
    before = {file: file.stat().st_ino for file in files}
    (one.job.folder / "matches/1.npz").write_bytes(damage)
    assert_same(matches_in(located(source, run_in(tmp_path))), expected)
    again = {file.name for file in files if file.exists() and file.stat().st_ino != before[file]}
    assert again == {"1.npz"}


def test_a_sweep_is_read_once_before_it_is_mapped(source: Source, tmp_path: Path) -> None:
    log, reads = counted(open_drive(source.drive))
    run = run_in(tmp_path)
    job = job_for(source, run, force=True)
    give(job, log)
    [one] = pipeline.locate_drives([job], run)[0].values()
    bound = bind({job.name: one}, {}, run)
    drive_tasks.place(*job.key, one.located, bound.keys[job.name])
    assert reads == dict.fromkeys((scan.number for scan in log.scans), 1), "though its sections overlap"


def test_a_worker_that_finds_another_drive_says_so(source: Source, tmp_path: Path) -> None:
    log = open_drive(source.drive)
    run = run_in(tmp_path, Divided())
    job = job_for(source, run, force=True)
    give(job, replace(log, scans=log.scans[:-1]))
    found = drive_tasks.check(*job.begin().key)
    with closing_drives():
        pass
    with pytest.raises(DataError, match=r"a worker finds another drive .*; take one worker, or") as raised:
        drive_tasks.match(*job.key, found["matches"], 0)
    assert "\n" not in str(raised.value)


@pytest.fixture
def places(source: Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[LocatedJob, Pass]:
    """A drive, and some places of it, each of which is an anchor."""
    monkeypatch.setattr(binding, "PAIRS_PER_TASK", 2)
    one = located(source, run_in(tmp_path))
    drive = one.to_bind(True)
    assert drive is not None
    settings = SETTINGS.trajectory.revisits.model_copy(update={"every_m": 0.1})
    found = pass_of(drive.sweeps, drive.trajectory, drive.condensed, settings)
    monkeypatch.setattr(binding, "pass_of", lambda *_: found)
    assert len(found.anchors) > 3
    return one, found


def test_pairs_of_places_are_registered_alike_everywhere_and_once(
    places: tuple[LocatedJob, Pass], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, there = places
    expected = [register_pair([there], pair, SETTINGS.trajectory.revisits) for pair in PAIRS]
    assert any(found is not None for found in expected)

    def found() -> list[Found | None]:
        binding._opened.cache_clear()
        return list(
            binding._registered([one], True, "made from", run_in(tmp_path, Divided()), [there], PAIRS)
        )

    assert_found(found(), expected)
    registered: list[Any] = []

    def noted(passes: Sequence[Pass], pair: Pair, *others: Any) -> Found | None:
        registered.append(pair)
        return register_pair(passes, pair, *others)

    monkeypatch.setattr(binding, "register_pair", noted)
    (one.job.folder / "revisits/1.npz").write_bytes(b"[]")
    assert_found(found(), expected)
    assert registered == PAIRS[2:4]


def assert_found(found: Sequence[Found | None], expected: Sequence[Found | None]) -> None:
    assert [one is None for one in found] == [one is None for one in expected]
    for one, other in zip(found, expected, strict=True):
        if one is not None and other is not None:
            for a, b in zip(
                (one.T, one.covariance, *one.sample), (other.T, other.covariance, *other.sample), strict=True
            ):
                np.testing.assert_array_equal(a, b)


@dataclass(frozen=True)
class Placed:
    """A drive that is located, in a work folder."""

    job: DriveJob
    fingerprint: str
    chunks: list[int]

    def mapped(self, executor: Executor) -> ChunkStore:
        """Its chunks, mapped by tasks."""
        run = run_in(self.job.folder.parents[1], executor)
        length = pipeline._chunks_per_task(len(self.chunks), executor)
        store = store_of(self.job.folder, self.fingerprint, len(self.chunks), SETTINGS).begun(resume=True)
        tasks = [
            pipeline.task_of(
                f"chunks {start} to {min(start + length, len(self.chunks)) - 1}", drive_tasks.map_range,
                *self.job.key, self.fingerprint, start, min(start + length, len(self.chunks)),
            )
            for start in range(0, len(self.chunks), length)
        ]  # fmt: skip
        run.call("mapping", {self.job.name: tasks})
        return store


def placed(source: Source, work: Path) -> Placed:
    run = run_in(work)
    one = located(source, run)
    found = drive_tasks.place(*one.job.key, one.located, bind({source.name: one}, {}, run).keys[source.name])
    return Placed(one.job, found["map"], found["chunks"])


@pytest.fixture(scope="module")
def chunks(source: Source, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of all chunks, mapped at once."""
    made = placed(source, tmp_path_factory.mktemp("here"))
    log = open_drive(source.drive)
    track = Trajectory(**made.job.needed("placed").of("track"))
    drive = Drive(log, track, source.open_network(SETTINGS, log), SETTINGS)
    folder = tmp_path_factory.mktemp("at_once")
    return files_of(map_scans(drive, folder, RunStats(), labels_from=source.labels_from))


def files_of(store: ChunkStore) -> dict[str, bytes]:
    """All that is saved of the chunks."""
    paths = [path for path in store.folder.glob("[0-9]*/**/*") if path.is_file()]
    return {path.relative_to(store.folder).as_posix(): path.read_bytes() for path in paths}


@pytest.mark.parametrize("executor", [Divided(), pytest.param(Processes(2), marks=pytest.mark.integration)])
def test_chunks_are_mapped_alike_by_any_workers(
    executor: Executor, source: Source, chunks: dict[str, bytes], tmp_path: Path
) -> None:
    made = placed(source, tmp_path)
    assert files_of(made.mapped(executor)) == chunks
    first = (made.job.folder / "0/record.json").stat()
    for name in ("1", "2"):
        (made.job.folder / name).rename(tmp_path / name)
    drive_tasks.map_range(*made.job.key, made.fingerprint, 0, 3)
    assert files_of(store_of(made.job.folder, made.fingerprint, 6, SETTINGS)) == chunks
    assert (made.job.folder / "0/record.json").stat() == first, "a chunk that is there is mapped again"


@pytest.mark.integration
def test_dask_maps_the_bytes_of_this_process(
    source: Source, chunks: dict[str, bytes], tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra [cluster] is not installed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50
    ) as cluster:
        assert (
            files_of(placed(source, tmp_path).mapped(Cluster(cluster.scheduler_address, tmp_path))) == chunks
        )

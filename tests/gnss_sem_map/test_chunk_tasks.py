"""Chunks of a drive that other processes map are those of this process, to the byte."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from street import Street

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.checkpoints import ChunkStore
from gnss_sem_map.mapping.fusion import map_scans
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.process.dask_cluster import Cluster
from gnss_sem_map.process.execution import InProcess
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.process.worker_processes import Processes
from gnss_sem_map.runs.chunk_tasks import ChunkTasks, map_range
from gnss_sem_map.runs.source import Source, source_of
from gnss_sem_map.segmentation.cached_segmenter import CachedSegmenter

NETWORK = """
import numpy as np

def look(pixels):
    with open({asked!r}, "a") as file:
        print("an image", file=file)
    return np.full((*pixels.shape[:2], 2), 0.5, np.float32)

look.class_names = ["road", "other"]
"""


@dataclass(frozen=True)
class Here(InProcess):
    """Tasks in this process, divided as for two workers."""

    workers: int = 2


@pytest.fixture(scope="module")
def source(small_drive: Street) -> Source:
    return source_of(small_drive.drive, f"labels:{small_drive.labels}")


@pytest.fixture(scope="module")
def drive(source: Source) -> Drive:
    """In six chunks, with poses that quaternions would round."""
    log, settings = open_drive(source.drive), Settings.model_validate({"dynamics": {"window_scans": 1}})
    assert log.reference is not None
    return Drive(log, log.reference, source.open_network(settings, log), settings)


@pytest.fixture(scope="module")
def expected(drive: Drive, source: Source, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return files_of(
        map_scans(drive, tmp_path_factory.mktemp("here"), RunStats(), labels_from=source.labels_from)
    )


def files_of(store: ChunkStore) -> dict[str, bytes]:
    """All that is saved of the chunks."""
    paths = [path for path in store.folder.glob("[0-9]*/**/*") if path.is_file()]
    return {path.relative_to(store.folder).as_posix(): path.read_bytes() for path in paths}


def shared(drive: Drive, source: Source, work: Path, executor: Any, **more: Any) -> ChunkStore:
    elsewhere = ChunkTasks(source, executor)
    return map_scans(drive, work, RunStats(), elsewhere=elsewhere, labels_from=source.labels_from, **more)


def test_a_task_maps_the_bytes_of_this_process(
    drive: Drive, source: Source, expected: dict[str, bytes], tmp_path: Path
) -> None:
    assert files_of(shared(drive, source, tmp_path / "work", Here())) == expected
    with (tmp_path / "work/trajectory.npz").open("rb") as file:
        assert b"pickle" not in file.read()


@pytest.mark.integration
@pytest.mark.parametrize("workers", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_processes_map_the_bytes_of_this_process(
    drive: Drive, source: Source, expected: dict[str, bytes], tmp_path: Path, workers: int
) -> None:
    assert files_of(shared(drive, source, tmp_path / "work", Processes(workers))) == expected


@pytest.mark.slow
@pytest.mark.integration
def test_dask_maps_the_bytes_of_this_process(
    drive: Drive, source: Source, expected: dict[str, bytes], tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra [cluster] is not installed")
    (tmp_path / "work").mkdir()
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50
    ) as cluster:
        executor = Cluster(cluster.scheduler_address, tmp_path / "work")
        assert files_of(shared(drive, source, tmp_path / "work", executor)) == expected


def test_a_task_that_is_called_again_goes_on_where_it_stopped(
    drive: Drive, source: Source, expected: dict[str, bytes], tmp_path: Path
) -> None:
    work = tmp_path / "work"
    store = shared(drive, source, work, Here())
    first, last = (work / "0/record.json").stat(), work / "2/record.json"
    for name in ("1", "2"):
        (work / name).rename(tmp_path / name)
    map_range(str(work), store.fingerprint, 0, 3)
    assert files_of(store) == expected
    assert (work / "0/record.json").stat() == first
    before = last.stat()
    map_range(str(work), store.fingerprint, 0, 3)
    assert last.stat() == before


def test_a_log_that_a_script_changed_is_not_mapped_as_another(
    drive: Drive, source: Source, tmp_path: Path
) -> None:
    changed = replace(drive, log=replace(drive.log, images=drive.log.images[2:]))
    with pytest.raises(DataError, match=r"a worker finds another drive .*; take one worker, or") as raised:
        shared(changed, source, tmp_path / "work", Here())
    assert "\n" not in str(raised.value)


def test_workers_use_and_fill_the_cache_of_a_network(
    drive: Drive, source: Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "network_of_this_test.py").write_text(NETWORK.format(asked=str(tmp_path / "asked")))
    monkeypatch.syspath_prepend(tmp_path)
    live = replace(source, segmenter="python:network_of_this_test:look")
    network, size = live.open_network(drive.settings, drive.log), drive.log.calibration.image_sizes
    assert network is not None
    assert size is not None
    (tmp_path / "cache").mkdir()
    cached = CachedSegmenter(network, open_label_set(), size, tmp_path / "cache")
    store = shared(replace(drive, segmenter=cached), live, tmp_path / "work", Here())
    assert len((tmp_path / "asked").read_text().splitlines()) == len(drive.log.images)
    here = map_scans(
        replace(drive, segmenter=cached), tmp_path / "here", RunStats(), labels_from=live.labels_from
    )
    assert files_of(store) == files_of(here)


def test_poses_arrive_to_the_last_bit(drive: Drive, source: Source, tmp_path: Path) -> None:
    """Those of a file of ours, which holds quaternions, do not."""
    trajectory = drive.trajectory
    trajectory.save(tmp_path / "trajectory.parquet")
    rounded = Trajectory.load(tmp_path / "trajectory.parquet")
    assert (rounded.T_map_imu != trajectory.T_map_imu).any(), "nothing is shown with these poses"
    shared(drive, source, tmp_path / "work", Here())
    other = replace(drive, trajectory=rounded)
    with pytest.raises(DataError, match="another drive, trajectory"):
        map_scans(other, tmp_path / "work", RunStats(), resume=True, labels_from=source.labels_from)

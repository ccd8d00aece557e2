"""Tasks on Dask: the results of this process, whatever dies on the way; what a cluster lacks is told before work."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import small_tasks
from dask_clusters import IN_TIME_S, started, two_workers
from processes import wait_until

from gnss_sem_map.errors import ConfigError, DataError, WriteError
from gnss_sem_map.process import dask_cluster
from gnss_sem_map.process.dask_cluster import Cluster
from gnss_sem_map.process.execution import Executor, InProcess, Task, run_tasks

distributed = pytest.importorskip("distributed", reason="the extra [cluster] is not installed")
pytestmark = pytest.mark.integration

ALLOWED = "small_tasks."
OTHER_VERSION = "import importlib.metadata as m; m.version = lambda name: '0.0.1'"
NO_PACKAGE = """
import importlib.metadata as m
def version(name): raise m.PackageNotFoundError(name)
m.version = version
"""
NO_INPUT = """
from gnss_sem_map.process import dask_cluster
dask_cluster._missing = lambda paths: paths
"""
OWN_FOLDER = """
from pathlib import Path
from gnss_sem_map.process import dask_cluster
dask_cluster._token_file = lambda *words: Path("/nowhere/file")
"""


def local_cluster(workers: int, **more: Any) -> Any:
    return distributed.LocalCluster(
        n_workers=workers, threads_per_worker=1, dashboard_address=":0", silence_logs=50, **more
    )


@pytest.fixture(autouse=True)
def any_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy one a worker is not there in a minute."""
    monkeypatch.setattr(dask_cluster, "FIRST_WORKER_S", IN_TIME_S)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a cluster of two workers in processes of its own, as users have it."""
    with two_workers(tmp_path_factory.mktemp("dask")) as address:
        yield address


def task(function: str, *arguments: object) -> Task:
    return Task(f"{function} {arguments}", f"small_tasks:{function}", arguments)


def products(count: int) -> list[Task]:
    return [task("times", number, 0.1) for number in range(count)]


def results(tasks: Sequence[Task], executor: Executor) -> dict[str, Any]:
    return {task.name: result for task, result in run_tasks(tasks, executor)}


def test_dask_gives_the_results_of_this_process(scheduler: str, tmp_path: Path) -> None:
    tasks = [*products(40), task("echo", (1, 2), {"a": None}, "Straße", float("inf"))]
    assert results(tasks, Cluster(scheduler, tmp_path, allowed=ALLOWED)) == results(tasks, InProcess(ALLOWED))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_cluster_of_this_machine_gives_them_too(tmp_path: Path) -> None:
    with local_cluster(2) as cluster:
        executor = Cluster(cluster.scheduler_address, tmp_path, allowed=ALLOWED)
        assert results(products(20), executor) == results(products(20), InProcess(ALLOWED))


def test_a_dask_worker_that_is_killed_loses_nothing(scheduler: str, tmp_path: Path) -> None:
    (tmp_path / "begun").mkdir()
    tasks = [task("process_and_threads", str(tmp_path / "begun")) for _ in range(30)]
    running = run_tasks(tasks, Cluster(scheduler, tmp_path, allowed=ALLOWED))
    _, (worker, *_) = next(running)
    os.kill(worker, signal.SIGKILL)
    later = [pid for _, (pid, *_) in running]
    assert len(later) == len(tasks) - 1
    assert len({worker, *later}) > 1


@pytest.mark.slow
def test_a_task_that_kills_its_dask_worker_is_called_again(scheduler: str, tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("work", "twice", "ever")]
    for folder in folders:
        folder.mkdir()
    work, twice, ever = folders
    cluster = Cluster(scheduler, work, allowed=ALLOWED)
    tasks = [task("dies", str(twice), int(signal.SIGKILL), 2), *products(4)]
    assert "survived" in results(tasks, cluster).values()
    with pytest.raises(DataError, match=r"^dies .* 4 x a Dask worker died .*run it again"):
        results([task("dies", str(ever), int(signal.SIGKILL), 99)], cluster)


@pytest.mark.slow
def test_a_task_that_takes_too_long_on_dask_is_called_again(scheduler: str, tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("work", "once", "ever")]
    for folder in folders:
        folder.mkdir()
    work, once, ever = folders
    cluster = Cluster(scheduler, work, timeout_s=2.0, allowed=ALLOWED)
    assert "ended" in results([task("hangs", str(once), 1), *products(4)], cluster).values()
    with pytest.raises(DataError, match=r"^hangs .* 3 x it was not done after 2 s"):
        results([task("hangs", str(ever), 9)], cluster)


def test_errors_of_ours_name_the_dask_worker(scheduler: str, tmp_path: Path) -> None:
    cluster = Cluster(scheduler, tmp_path, allowed=ALLOWED)
    with pytest.raises(WriteError, match=r"write: wrong; change it \(on Dask worker tcp://"):
        results([task("is_wrong", "write"), *products(3)], cluster)
    with pytest.raises(DataError, match=r"^/full/disk: .* \(on Dask worker tcp://"):
        results([task("is_wrong", "os")], cluster)
    with pytest.raises(RuntimeError, match=r"(?s)Traceback.*KeyError: 'no such thing'"):
        results([task("is_wrong", "defect")], cluster)
    for how, said in (("os", "/full/disk: "), ("write", "write: wrong; change it ")):
        (reason,) = results([task("fails", how)], cluster).values()
        assert re.match(rf"{said}.*\(on Dask worker tcp://\S+\)$", reason)
        assert "worker" not in small_tasks.fails(how), "here there is none"
    with pytest.raises(ConfigError, match="may not be called"):
        results(products(1), Cluster(scheduler, tmp_path))


def test_tls_without_certificates_is_told(tmp_path: Path) -> None:
    address = "tls://127.0.0.1:8786"
    with pytest.raises(ConfigError, match=f"scheduler {address}: the certificates .* \\(none is named\\)"):
        results(products(1), Cluster(address, tmp_path))


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:1", "nonsense", "tcp://no.such.host.example:1", "foo://x:1"]
)
def test_a_scheduler_that_is_not_there_is_told(
    address: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(dask_cluster, "CONNECT_S", 1.0)
    with pytest.raises(ConfigError, match=f"scheduler {address}: no Dask scheduler answers there"):
        results(products(1), Cluster(address, tmp_path))


def test_dask_that_is_not_installed_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"distributed is not installed; .*\[cluster\]"):
        results(products(1), Cluster("tcp://127.0.0.1:1", tmp_path))


@pytest.mark.parametrize(
    ("preload", "message"),
    [
        (OTHER_VERSION, r"Dask worker tcp://\S+: has gnss-sem-map 0\.0\.1; expected \d"),
        pytest.param(NO_PACKAGE, r"has no gnss-sem-map \(.*\); install version \d", marks=pytest.mark.slow),
        pytest.param(OWN_FOLDER, "does not share the folder /", marks=pytest.mark.slow),
        pytest.param(NO_INPUT, r"does not see \S+ and 1 more, which is to be read", marks=pytest.mark.slow),
    ],
)
def test_a_dask_worker_that_is_not_fit_is_refused_by_name(preload: str, message: str, tmp_path: Path) -> None:
    reads = (tmp_path, tmp_path.parent)
    with local_cluster(1, preload=[preload]) as cluster, pytest.raises(DataError, match=message):
        results(products(1), Cluster(cluster.scheduler_address, tmp_path, reads, allowed=ALLOWED))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_dask_worker_with_several_threads_is_refused(tmp_path: Path) -> None:
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, dashboard_address=":0", silence_logs=50
        ) as cluster,
        pytest.raises(DataError, match=r"Dask worker tcp://\S+: has 2 threads, .*--nthreads 1"),
    ):
        results(products(1), Cluster(cluster.scheduler_address, tmp_path, allowed=ALLOWED))


@pytest.mark.slow
def test_a_dask_worker_that_comes_later_is_looked_at_before_it_is_counted(tmp_path: Path) -> None:
    file = tmp_path / "scheduler.json"
    (work := tmp_path / "work").mkdir()
    with started("scheduler", file, "--port", "0", "--dashboard-address", ":0"):
        assert wait_until(file.exists)
        with started("worker", file, "--nthreads", "1", "--no-dashboard"):
            cluster = Cluster(json.loads(file.read_text())["address"], work, allowed=ALLOWED)
            (begun := tmp_path / "begun").mkdir()
            running = run_tasks([task("process_and_threads", str(begun))] * 2000, cluster)
            next(running)
            with (
                started("worker", file, "--nthreads", "1", "--no-dashboard", "--preload", NO_PACKAGE),
                pytest.raises(DataError, match=r"Dask worker tcp://\S+: has no gnss-sem-map"),
            ):
                list(running)


def test_a_dask_worker_that_comes_later_is_checked_too(
    scheduler: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(dask_cluster, "_refuse_other_versions", lambda client: None)
    monkeypatch.setattr(dask_cluster, "_version", lambda: "99.0")
    with pytest.raises(
        DataError, match=r"gnss-sem-map \S+ is installed; expected 99\.0 \(on Dask worker tcp"
    ):
        results(products(1), Cluster(scheduler, tmp_path, allowed=ALLOWED))


def test_a_cluster_without_workers_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(dask_cluster, "FIRST_WORKER_S", 0.5)
    with (
        local_cluster(0) as cluster,
        pytest.raises(DataError, match=r"has no worker after 0\.5 s; start some"),
    ):
        results(products(1), Cluster(cluster.scheduler_address, tmp_path))


def test_a_folder_that_is_not_there_is_told(scheduler: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere: cannot be written \(No such file"):
        results(products(1), Cluster(scheduler, tmp_path / "nowhere"))


@pytest.mark.slow
def test_workers_within_this_process_are_refused(tmp_path: Path) -> None:
    with local_cluster(1, processes=False) as cluster, pytest.raises(DataError, match="has no nanny"):
        results(products(1), Cluster(cluster.scheduler_address, tmp_path))


@pytest.mark.slow
def test_a_scheduler_that_dies_on_the_way_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(dask_cluster, "CONNECT_S", 3.0)
    file, begun = tmp_path / "scheduler.json", tmp_path / "begun"
    begun.mkdir()
    with started("scheduler", file, "--port", "0", "--dashboard-address", ":0") as dying:
        assert wait_until(file.exists)
        with started("worker", file, "--nthreads", "1", "--no-dashboard"):
            address = json.loads(file.read_text())["address"]
            killer = threading.Thread(
                target=lambda: wait_until(lambda: any(begun.iterdir())) and dying.kill()
            )
            killer.start()
            with pytest.raises(DataError, match=r"scheduler.* lost; see that it runs, and --resume"):
                results(
                    [task("begins_and_waits", str(begun))] * 3, Cluster(address, tmp_path, allowed=ALLOWED)
                )
            killer.join()


@pytest.mark.slow
def test_a_scheduler_that_dies_while_workers_are_asked_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "scheduler.json"
    with started("scheduler", file, "--port", "0", "--dashboard-address", ":0") as dying:
        assert wait_until(file.exists)
        with started("worker", file, "--nthreads", "1", "--no-dashboard"):
            asked = dask_cluster._refuse_without_nanny

            def ask(*words: Any) -> None:
                dying.kill()
                os.waitid(os.P_PID, dying.pid, os.WEXITED | os.WNOWAIT)
                asked(*words)

            monkeypatch.setattr(dask_cluster, "_refuse_without_nanny", ask)
            address = json.loads(file.read_text())["address"]
            with pytest.raises(DataError, match=r"scheduler.* lost; see that it runs, and --resume"):
                results(products(1), Cluster(address, tmp_path, allowed=ALLOWED))
    assert [record for record in caplog.records if record.name == "distributed.client"] == []


def test_a_dask_worker_that_dies_while_it_is_asked_is_left_out(
    scheduler: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    dead, work = tmp_path / "dead", tmp_path / "work"
    work.mkdir()
    monkeypatch.setattr(dask_cluster, "_has_nanny", partial(small_tasks.dies_once, str(dead)))
    assert len(results(products(4), Cluster(scheduler, work, allowed=ALLOWED))) == 4
    assert dead.is_dir()

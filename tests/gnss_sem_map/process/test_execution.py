"""Tasks give the same results in this process, in others, and on Dask, whatever dies on the way."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import small_tasks
from processes import is_alive, wait_until
from threadpoolctl import threadpool_limits

from gnss_sem_map.errors import ConfigError, DataError, WriteError
from gnss_sem_map.process.execution import Executor, InProcess, Task, run_tasks
from gnss_sem_map.process.worker_processes import Processes

ALLOWED = "small_tasks."
HERE = InProcess(ALLOWED)
TESTS = Path(__file__).parents[2]
integration = pytest.mark.integration


def task(function: str, *arguments: object) -> Task:
    return Task(f"{function} {arguments}", f"small_tasks:{function}", arguments)


def processes(workers: int = 2, **limits: Any) -> Processes:
    return Processes(workers, allowed=ALLOWED, **limits)


def results(tasks: Sequence[Task], executor: Executor) -> dict[str, Any]:
    return {task.name: result for task, result in run_tasks(tasks, executor)}


def products(count: int = 12) -> list[Task]:
    return [task("times", number, 0.1) for number in range(count)]


def test_tasks_in_this_process_are_calls_in_order() -> None:
    found = [(done.arguments[0], result) for done, result in run_tasks(products(), HERE)]
    assert found == [(number, number * 0.1) for number in range(12)]


def test_progress_counts_from_none_to_all() -> None:
    told: list[tuple[int, int]] = []
    list(run_tasks(products(3), HERE, lambda *counts: told.append(counts)))
    assert told == [(0, 3), (1, 3), (2, 3), (3, 3)]


def test_values_arrive_as_json_in_this_process_too() -> None:
    ((_, result),) = run_tasks([task("echo", (1, 2), {"a": None}, "Straße", 0.1)], HERE)
    assert result == [[1, 2], {"a": None}, "Straße", 0.1]


def test_only_functions_of_this_package_are_called() -> None:
    with pytest.raises(ConfigError, match=r"os:system: may not be called"):
        list(run_tasks([Task("bad", "os:system", ("true",))], InProcess()))
    with pytest.raises(ConfigError, match=r"gnss_sem_map_evil\.a:b: may not be called"):
        list(run_tasks([Task("bad", "gnss_sem_map_evil.a:b")], InProcess()))
    with pytest.raises(ConfigError, match=r"no such function .*nothing"):
        list(run_tasks([Task("bad", "gnss_sem_map.errors:nothing")], InProcess()))
    with pytest.raises(ConfigError, match=r"no such function .*nowhere"):
        list(run_tasks([Task("bad", "gnss_sem_map.nowhere:nothing")], InProcess()))


@pytest.mark.parametrize(
    "name", ["times", "small_tasks.times", "a:b:c", "a:b.c", "a-b:c", ":c", "a:", "a..b:c"]
)
def test_a_name_that_is_no_function_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"expected 'package\.module:function'"):
        Task("bad", name)


@pytest.mark.parametrize("argument", [Path("a"), object(), {1, 2}, b"x"])
def test_an_argument_that_is_no_json_is_refused(argument: object) -> None:
    with pytest.raises(ConfigError, match="its arguments are not JSON"):
        task("echo", argument)


@pytest.mark.slow
@integration
def test_workers_that_are_kept_do_the_next_tasks_too(tmp_path: Path) -> None:
    with closing(processes(2, keep=True)) as kept:
        asked = [task("process_and_threads", str(tmp_path)) for _ in range(4)]
        first, second = ({pid for pid, *_ in run_and_list(asked, kept)} for _ in range(2))
        assert second <= first
        os.kill(min(first), signal.SIGKILL)
        assert not {pid for pid, *_ in run_and_list(asked, kept)} & {min(first)}  # nothing was lost with it
        last = {worker._process.pid for worker in kept._idle}
        assert last
    assert not any(map(is_alive, last))


def run_and_list(tasks: Sequence[Task], executor: Executor) -> list[Any]:
    return [result for _, result in run_tasks(tasks, executor)]


@integration
def test_processes_give_the_results_of_this_process() -> None:
    tasks = [*products(), task("echo", (1, 2), {"a": None}, "Straße", float("inf")), *products(1)]
    assert results(tasks, processes()) == results(tasks, HERE)


@integration
def test_arguments_and_results_may_be_larger_than_a_pipe() -> None:
    ((_, result),) = run_tasks([task("echo", "x" * 3_000_000)], processes(1))
    assert result == ["x" * 3_000_000]


@integration
def test_no_task_is_no_work() -> None:
    assert results([], processes()) == {}


@pytest.mark.slow
@integration
def test_workers_share_the_cores_and_are_recycled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GNSS_SEM_MAP_THREADS", "6")
    tasks = [task("process_and_threads", str(tmp_path)) for _ in range(9)]
    found = [result for _, result in run_tasks(tasks, processes(2, tasks_per_worker=3))]
    workers = [pid for pid, _, _ in found]
    assert {threads for _, *both in found for threads in both} == {3}
    assert max(map(workers.count, workers)) <= 3
    assert os.environ["GNSS_SEM_MAP_THREADS"] == "6"
    assert not any(is_alive(pid) for pid in workers)


@integration
@pytest.mark.parametrize("executor", [HERE, processes(1)], ids=["here", "elsewhere"])
def test_a_task_has_one_thread_of_blas_whatever_the_cores(
    executor: Executor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GNSS_SEM_MAP_THREADS", "6")
    with threadpool_limits(2, "blas"):
        assert set(small_tasks.blas_threads()) == {2}
        ((_, found),) = run_tasks([task("blas_threads")], executor)
        assert set(found) == {1}
        assert set(small_tasks.blas_threads()) == {2}


@pytest.mark.slow
@integration
def test_fewer_tasks_than_workers_share_all_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GNSS_SEM_MAP_THREADS", "6")
    tasks = [task("process_and_threads", str(tmp_path)) for _ in range(2)]
    found = [result for _, result in run_tasks(tasks, processes(5))]
    assert {threads for _, *both in found for threads in both} == {3}
    assert len({pid for pid, *_ in found}) == 2


@integration
@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGSEGV, marks=pytest.mark.slow)])
def test_a_task_whose_worker_dies_is_called_again(number: signal.Signals, tmp_path: Path) -> None:
    tasks = [*products(4), task("dies", str(tmp_path), int(number), 2), *products(4)]
    found = [result for _, result in run_tasks(tasks, processes())]
    assert sorted(map(str, found)) == sorted(map(str, ["survived", *(2 * [0.0, 0.1, 0.2, 3 * 0.1])]))
    assert len(list(tmp_path.iterdir())) == 3


@integration
def test_a_task_that_is_lost_three_times_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"^dies .*3 x a worker .*SIGKILL.*fewer workers") as raised:
        results([task("dies", str(tmp_path), int(signal.SIGKILL), 9), *products()], processes())
    assert "\n" not in str(raised.value)
    assert len(list(tmp_path.iterdir())) == 3


@integration
def test_the_other_tasks_are_done_when_the_caller_accepts_the_loss(tmp_path: Path) -> None:
    tasks, told = [task("dies", str(tmp_path), int(signal.SIGKILL), 9), *products()], []
    found = dict(run_tasks(tasks, processes(), lambda *counts: told.append(counts), lost=str))
    assert "3 x a worker process died (SIGKILL" in found.pop(tasks[0])
    assert sorted(found.values()) == sorted(number * 0.1 for number in range(12))
    assert told[-1] == (13, 13)


@pytest.mark.slow
@integration
def test_a_worker_that_exits_is_told_with_its_code() -> None:
    with pytest.raises(DataError, match=r" 3 x .*exit code 7; .*__main__"):
        results([task("exits", 7)], processes(1))


@pytest.mark.slow
@integration
def test_a_worker_that_takes_too_much_memory_is_killed(tmp_path: Path) -> None:
    (tmp_path / "once").mkdir()
    (tmp_path / "ever").mkdir()
    limit = 400_000_000
    tasks = [task("grows", str(tmp_path / "once"), 1, 20_000_000), *products(2)]
    assert "modest" in results(tasks, processes(memory_bytes=limit)).values()
    with pytest.raises(DataError, match=r"^grows.* 3 x it held more than 0\.40 GB"):
        results([task("grows", str(tmp_path / "ever"), 9, 20_000_000)], processes(memory_bytes=limit))


@pytest.mark.slow
@integration
def test_a_task_that_is_refused_memory_is_called_again(tmp_path: Path) -> None:
    assert results([task("has_no_memory", str(tmp_path), 2)], processes()) != {}
    with pytest.raises(DataError, match=r" 3 x it ran out of memory"):
        results([task("has_no_memory", str(tmp_path), 9)], processes())


@pytest.mark.slow
@integration
def test_a_task_that_takes_too_long_is_called_again(tmp_path: Path) -> None:
    (tmp_path / "once").mkdir()
    (tmp_path / "ever").mkdir()
    found = results([task("hangs", str(tmp_path / "once"), 1), *products()], processes(timeout_s=4.0))
    assert "ended" in found.values()
    with pytest.raises(DataError, match=r"^hangs.* 3 x it was not done after 4 s"):
        results([task("hangs", str(tmp_path / "ever"), 9)], processes(1, timeout_s=4.0))


@integration
def test_errors_of_ours_are_raised_here_and_not_tried_again() -> None:
    with pytest.raises(WriteError, match="write: wrong; change it"):
        results([task("is_wrong", "write"), *products()], processes())
    with pytest.raises(DataError, match="data: wrong; change it"):
        results([task("is_wrong", "data")], processes())
    with pytest.raises(DataError, match=f"^/full/disk: {os.strerror(errno.ENOSPC)}"):
        results([task("is_wrong", "os")], processes())
    with pytest.raises(ConfigError, match="may not be called"):
        results(products(1), Processes(1))


@integration
def test_a_defect_shows_its_traceback() -> None:
    with pytest.raises(RuntimeError, match=r"(?s)is_wrong.*Traceback.*KeyError: 'no such thing'"):
        results([task("is_wrong", "defect")], processes())


@integration
def test_a_script_without_a_guard_gets_an_error_and_does_not_hang(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(PARENT.replace('if __name__ == "__main__":', "if True:"))
    words = [sys.executable, str(script), str(TESTS), str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600)
    assert "if __name__ == '__main__'" in done.stderr.splitlines()[-1]


@integration
def test_workers_end_when_nobody_wants_more_results(tmp_path: Path) -> None:
    tasks = [task("process_and_threads", str(tmp_path)), *[task("begins_and_waits", str(tmp_path))] * 3]
    running = run_tasks(tasks, processes())
    next(running)
    running.close()
    assert not any(is_alive(int(path.name)) for path in tmp_path.iterdir())


PARENT = """
import signal
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from gnss_sem_map.process.execution import Task, run_tasks
from gnss_sem_map.process.worker_processes import Processes

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts background jobs without it
    tasks = [Task("wait", "small_tasks:begins_and_waits", (sys.argv[2],))] * 2
    list(run_tasks(tasks, Processes(2, allowed="small_tasks.")))
"""


@integration
@pytest.mark.parametrize(
    "number",
    [signal.SIGKILL, *(pytest.param(s, marks=pytest.mark.slow) for s in (signal.SIGTERM, signal.SIGINT))],
)
def test_workers_end_when_their_parent_does(number: signal.Signals, tmp_path: Path) -> None:
    script, begun = tmp_path / "script.py", tmp_path / "begun"
    script.write_text(PARENT)
    begun.mkdir()
    words = [sys.executable, str(script), str(TESTS), str(begun)]
    with subprocess.Popen(words, stderr=subprocess.DEVNULL, start_new_session=True) as process:
        try:
            assert wait_until(lambda: len(list(begun.iterdir())) == 2)
            process.send_signal(number)
            process.wait(600)
        finally:
            process.kill()
    workers = [int(path.name) for path in begun.iterdir()]
    assert wait_until(lambda: not any(map(is_alive, workers)))


@integration
def test_no_worker_is_ended_by_ctrl_c_which_its_parent_handles(tmp_path: Path) -> None:
    script, begun = tmp_path / "script.py", tmp_path / "begun"
    script.write_text(PARENT.replace("begins_and_waits", "waits_for_go"))
    begun.mkdir()
    words = [sys.executable, str(script), str(TESTS), str(begun)]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            assert wait_until(lambda: len(list(begun.iterdir())) == 2)
            workers = {path.name for path in begun.iterdir()}
            for worker in workers:
                os.kill(int(worker), signal.SIGINT)
            (begun / "go").touch()
            assert process.communicate(timeout=600)[1] == ""
        finally:
            process.kill()
    assert {path.stem for path in begun.glob("*.ended")} == workers

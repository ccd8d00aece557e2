"""Processes of our own: they end with the main process, and one that dies, grows or hangs is replaced.

A worker receives its work through a pipe, and answers when it is done. Its end of the pipe closes when it dies, and
ours when the main process dies.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess, parent_process
from typing import Any

from gnss_sem_map.process.execution import ALLOWED, Losses, Lost, Task, answer, result_of
from gnss_sem_map.process.machine import (
    BLAS_THREADS_VARIABLE,
    THREADS_VARIABLE,
    held_bytes,
    memory_bytes,
    threads,
)
from gnss_sem_map.process.memory import collect_seldom

WATCH_S = 0.1
"""Memory and time of the workers are looked at this often, whenever the next result is waited for."""
THREADS_VARIABLES = (THREADS_VARIABLE, "NUMBA_NUM_THREADS", "OMP_NUM_THREADS")


@dataclass(frozen=True)
class Processes:
    """Calls tasks in worker processes of this machine; cores and memory are shared out evenly.

    With fewer tasks than `workers`, there is one for each. A worker ends after `tasks_per_worker` tasks, which frees
    whatever they left behind. One that holds more than `memory_bytes` (None: the memory of the machine divided by their
    number + 1, as the main process has a share too), or works on one task for more than `timeout_s`, is killed; what a
    dead worker had under way is called again in a new one. With `keep`, workers wait for the tasks of the next call
    until `close`: a new one takes seconds to start.
    """

    workers: int
    memory_bytes: int | None = None
    timeout_s: float = 3600.0
    tasks_per_worker: int = 10
    keep: bool = False
    allowed: str = ALLOWED
    _idle: list[_Worker] = field(default_factory=list, init=False, repr=False, compare=False)

    def close(self) -> None:
        """End the workers that were kept."""
        while self._idle:
            self._idle.pop().end()

    def run(self, tasks: Sequence[Task]) -> Generator[tuple[Task, Any]]:
        """Call all tasks; yields each with its result when it is done."""
        count = min(self.workers, len(tasks))
        most_bytes = self.memory_bytes or memory_bytes() // (count + 1)
        waiting, losses = deque(tasks), Losses()
        own_threads = max(threads() // max(count, 1), 1)
        team = self._kept(count, own_threads)
        try:
            while waiting or any(worker.task for worker in team):
                self._give(waiting, team, count, own_threads)
                wait([worker.connection for worker in team], WATCH_S)
                for worker in list(team):
                    task = worker.task
                    try:
                        answered = worker.answered(most_bytes, self.timeout_s)
                        if task is not None and answered is not None:
                            yield task, result_of(task, answered)
                    except Lost as lost:
                        worker.end()
                        team.remove(worker)
                        if task is not None:
                            yield from losses.add(task, lost, waiting)
        finally:
            for worker in team:
                if self.keep and worker.task is None:
                    self._idle.append(worker)
                else:
                    worker.end()

    def _kept(self, count: int, own_threads: int) -> list[_Worker]:
        """At most `count` workers of an earlier call, alive and with as many threads; the others end."""
        fit = [worker for worker in self._idle if worker.is_alive and worker.threads == own_threads][:count]
        self._idle[:] = [worker for worker in self._idle if worker not in fit]
        self.close()
        return fit

    def _give(self, waiting: deque[Task], team: list[_Worker], count: int, own_threads: int) -> None:
        """Give every idle one of `count` workers a task; workers that have done their share are replaced."""
        for worker in [worker for worker in team if worker.task is None]:
            if worker.tasks_done >= self.tasks_per_worker:
                worker.end()
                team.remove(worker)
            elif waiting:
                worker.give(waiting.popleft(), self.allowed)
        while waiting and len(team) < count:
            team.append(_Worker(own_threads))
            team[-1].give(waiting.popleft(), self.allowed)


class _Worker:
    """One process, our end of its pipe, and the task that it has under way."""

    def __init__(self, own_threads: int) -> None:
        with _environment(dict.fromkeys(THREADS_VARIABLES, str(own_threads)) | {BLAS_THREADS_VARIABLE: "1"}):
            self.connection, self._process = _start()
        self.threads = own_threads
        self.task: Task | None = None
        self.tasks_done = 0

    @property
    def is_alive(self) -> bool:
        return self._process.is_alive()

    def give(self, task: Task, allowed: str) -> None:
        self.task, self._since = task, time.monotonic()
        with suppress(ConnectionError):  # it died; that is seen when its answer is waited for
            self.connection.send_bytes(
                json.dumps([task.function, json.dumps(task.arguments), allowed]).encode()
            )

    def answered(self, most_bytes: int, timeout_s: float) -> str | None:
        """Its answer, None as long as there is none; raises Lost when there will be none."""
        if self.connection.poll():
            try:
                answered = self.connection.recv_bytes().decode()
            except (EOFError, ConnectionError):
                raise Lost(self._death()) from None
            self.task = None
            self.tasks_done += 1
            return answered
        if self.task is not None and held_bytes(self._process.pid) > most_bytes:
            raise Lost(f"it held more than {most_bytes / 1e9:.2f} GB of memory")
        if self.task is not None and time.monotonic() - self._since > timeout_s:
            raise Lost(f"it was not done after {timeout_s:g} s")
        return None

    def _death(self) -> str:
        self._process.join(1.0)
        code = self._process.exitcode
        if code is not None and code < 0:
            return f"a worker process died ({signal.Signals(-code).name}; lack of memory ends processes with SIGKILL)"
        hint = "a script may call this only below `if __name__ == '__main__':`"
        return f"a worker process died (exit code {code}; {hint})"

    def end(self) -> None:
        """End the process, whatever it does, and wait until it is gone."""
        self.connection.close()
        self._process.kill()
        self._process.join()
        self._process.close()


def _start() -> tuple[Connection, BaseProcess]:
    context = multiprocessing.get_context("spawn")  # a fork of a process with threads may hang
    resource_tracker.ensure_running()  # it unblocks signals, so a worker that starts it would not ignore them
    ours, theirs = context.Pipe()
    # the main process never waits at exit for a daemon
    process = context.Process(target=_serve, args=(theirs,), daemon=True)
    with theirs, _signals_blocked():
        process.start()
    return ours, process


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Processes that start here have these environment variables; libraries read them when they are imported."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """Processes that start here ignore Ctrl-C and the closing of the terminal; the main process handles both."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(parent: Connection) -> None:
    """Answer tasks until the parent closes its end."""
    collect_seldom()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        while True:
            parent.send_bytes(answer(*json.loads(parent.recv_bytes())).encode())
    except (EOFError, ConnectionError):  # the parent has finished, or died
        return


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)

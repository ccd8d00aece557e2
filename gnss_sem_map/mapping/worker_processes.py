"""Work in several processes that end with the main process: when one is killed, no other waits or stays.

A worker receives its items through a pipe, and answers when each is done. Its end of the pipe closes when it dies, and
ours when the main process dies. Large data are sent only after a worker has started: it may die before it reads them.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess, parent_process
from typing import Any

from factor_graphs.errors import FactorGraphError
from gnss_sem_map.errors import DataError, SemMapError


def in_processes(
    function: Callable[..., None], shared: tuple[Any, ...], items: Sequence[int], workers: int
) -> Iterator[int]:
    """Call `function(*shared, item)` for every item in one of several processes; yields each item when it is done.

    Raises what the function raises of our own errors, and DataError when a process dies.
    """
    waiting = deque(items)
    team: dict[Connection, BaseProcess] = {}
    try:
        for _ in range(min(workers, len(items))):
            ours, process = _start()
            team[ours] = process
        for ours in team:
            ours.send((function, shared))
            ours.send(waiting.popleft())
        busy = list(team)
        while busy:
            ours = _first_of(busy)
            answer = ours.recv()
            if isinstance(answer, Exception):
                raise answer
            if waiting:
                ours.send(waiting.popleft())
            else:
                busy.remove(ours)
            yield answer
    except (EOFError, ConnectionError):
        raise DataError(
            "a worker process died: for lack of memory (take fewer --workers, and --resume), or because a script calls"
            " this outside `if __name__ == '__main__':`"
        ) from None
    finally:
        for ours, process in team.items():
            ours.close()
            process.terminate()
        for process in team.values():
            process.join()


def _first_of(connections: list[Connection]) -> Connection:
    ready = wait(connections)[0]
    assert isinstance(ready, Connection)
    return ready


def _start() -> tuple[Connection, BaseProcess]:
    context = multiprocessing.get_context("spawn")  # a fork of a process with threads may hang
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs,))
    with theirs, _signals_blocked():
        process.start()
    return ours, process


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """Processes that start here ignore Ctrl-C and the closing of the terminal; the main process handles both."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(parent: Connection) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        function, shared = parent.recv()
        while True:
            item = parent.recv()
            try:
                function(*shared, item)
            except (SemMapError, FactorGraphError, OSError) as error:
                parent.send(error)
                return
            parent.send(item)
    except (EOFError, ConnectionError):  # the parent has finished, or died
        return


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)

"""Prefetching: items are computed in advance by threads, and returned in order.

Threads cannot be stopped from outside. When nobody waits for them any longer, because something failed or Ctrl-C was
pressed, they end after the item that they have under way; a call that may take longer than that is made `unless_left`.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import islice
from typing import ParamSpec, TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")
Given = ParamSpec("Given")

PER_THREAD = 2
"""Items in progress per thread: enough to keep every thread busy, with little memory."""
THREADS_VARIABLE = "GNSS_SEM_MAP_THREADS"
"""Environment variable: threads of one process. Several processes of one machine share its cores by it."""
LOOK_S = 0.05
"""So often a thread looks whether it was left."""


class _OfThread(threading.local):
    """What one thread has: the pools that it opened, each with an event that is set when it is left; the event of the
    pool that it works for; and a thread for calls that may be left."""

    def __init__(self) -> None:
        self.pools: dict[ThreadPoolExecutor, threading.Event] = {}
        self.left: threading.Event | None = None
        self.helper: ThreadPoolExecutor | None = None


_of_thread = _OfThread()


def threads() -> int:
    """Threads that this process should use at a time: what the variable says, else one per core that it may use."""
    said = os.environ.get(THREADS_VARIABLE, "")
    return int(said) if said.isdecimal() and int(said) else len(os.sched_getaffinity(0))


@contextmanager
def thread_pool(threads: int) -> Iterator[ThreadPoolExecutor]:
    """Threads that are waited for at the end; after an exception, for what they have under way only."""
    left, opened = threading.Event(), _of_thread.pools
    pool = ThreadPoolExecutor(threads, initializer=setattr, initargs=(_of_thread, "left", left))
    opened[pool] = left
    try:
        yield pool
    except BaseException:
        left.set()
        raise
    finally:
        pool.shutdown(cancel_futures=left.is_set())
        opened.pop(pool, None)  # a generator may be closed by another thread


@contextmanager
def leaving_all() -> Iterator[None]:
    """After an exception, wait for what the threads of all pools of this thread have under way, and no more.

    A generator that prefetches may be closed late, but no thread may write into a folder that is being removed.
    """
    try:
        yield
    except BaseException:
        for pool, left in list(_of_thread.pools.items()):
            left.set()
            pool.shutdown(cancel_futures=True)
        raise


def unless_left(call: Callable[Given, Made], *args: Given.args, **kwargs: Given.kwargs) -> Made:
    """The result of a call; raises CancelledError as soon as the pool of the calling thread is left.

    The call itself goes on in another thread, and its result is dropped: it should write nothing.
    """
    _of_thread.helper = _of_thread.helper or ThreadPoolExecutor(1)
    left, answer = _of_thread.left, _of_thread.helper.submit(call, *args, **kwargs)
    while not answer.done():
        if left is not None and left.is_set():
            raise CancelledError
        with suppress(TimeoutError):
            answer.exception(LOOK_S)
    return answer.result()


def prefetch(
    make: Callable[[Item], Made], items: Iterable[Item], threads: int = 1, under_way: int | None = None
) -> Iterator[tuple[Item, Made]]:
    """Pairs (item, make(item)) in order; at most `under_way` items (default: 2 per thread) are computed in advance.

    An exception of `make` is raised at the position of its item.
    """
    waiting = iter(items)
    with thread_pool(threads) as pool:
        started: deque[tuple[Item, Future[Made]]] = deque(
            (item, pool.submit(make, item)) for item in islice(waiting, under_way or PER_THREAD * threads)
        )
        while started:
            item, making = started.popleft()
            made = making.result()
            started.extend((later, pool.submit(make, later)) for later in islice(waiting, 1))
            yield item, made

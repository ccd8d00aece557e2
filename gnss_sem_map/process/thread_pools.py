"""Pools of threads that nobody has to wait for: when something fails or Ctrl-C is pressed, they are left.

Threads cannot be stopped from outside. Those of a pool that is left end after the item that they have under way; a call
that may take longer than that is made `unless_left`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import ParamSpec, TypeVar

Made = TypeVar("Made")
Given = ParamSpec("Given")

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

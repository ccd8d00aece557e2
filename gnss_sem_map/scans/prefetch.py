"""Prefetching: items are computed in advance by threads, and returned in order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from itertools import islice
from typing import TypeVar

from gnss_sem_map.thread_pools import cores, thread_pool

Item = TypeVar("Item")
Made = TypeVar("Made")

PER_THREAD = 2
"""Items in progress per thread: enough to keep every thread busy, with little memory."""
THREADS_VARIABLE = "GNSS_SEM_MAP_THREADS"
"""Environment variable: threads of one process. Several processes of one machine share its cores by it."""


def threads() -> int:
    """Threads that this process should use at a time: what the variable says, else one per core that it may use."""
    said = os.environ.get(THREADS_VARIABLE, "")
    return int(said) if said.isdecimal() and int(said) else cores()


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

"""Prefetching: items are computed in advance by threads, and returned in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from itertools import islice
from typing import TypeVar

from gnss_sem_map.process.thread_pools import thread_pool

Item = TypeVar("Item")
Made = TypeVar("Made")

PER_THREAD = 2
"""Items in progress per thread: enough to keep every thread busy, with little memory."""


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

"""Work done a few items ahead, in threads, with the results in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")

PER_THREAD = 2
"""Items under way per thread: enough that none waits, few enough that little is held."""


def ahead(
    make: Callable[[Item], Made], items: Iterable[Item], threads: int = 1, under_way: int | None = None
) -> Iterator[tuple[Item, Made]]:
    """Every item with what `make` makes of it, in order; at most `under_way` (2 per thread) are made in advance.

    An error of `make` is raised where its item comes up.
    """
    waiting = iter(items)
    with ThreadPoolExecutor(threads) as pool:
        started: deque[tuple[Item, Future[Made]]] = deque(
            (item, pool.submit(make, item)) for item in islice(waiting, under_way or PER_THREAD * threads)
        )
        while started:
            item, making = started.popleft()
            made = making.result()
            started.extend((later, pool.submit(make, later)) for later in islice(waiting, 1))
            yield item, made

"""Prefetched items come in order, and only a few are held at a time."""

import threading
import time

import pytest

from gnss_sem_map.process.prefetch import prefetch


@pytest.mark.parametrize(("threads", "under_way"), [(1, None), (1, 4), (3, None)])
def test_results_come_in_the_order_of_the_items_whichever_is_made_first(
    threads: int, under_way: int | None
) -> None:
    def make(item: int) -> int:
        time.sleep(0.002 * (item % 3 == 0))
        return item * item

    assert list(prefetch(make, range(20), threads, under_way)) == [(i, i * i) for i in range(20)]


def test_no_more_than_asked_for_is_made_before_it_is_taken() -> None:
    made, lock = [0], threading.Lock()

    def make(item: int) -> int:
        with lock:
            made[0] += 1
        return item

    for taken, _ in prefetch(make, range(50), threads=2, under_way=3):
        assert made[0] <= taken + 4  # it, those under way, and the one that took its place


def test_an_error_is_raised_where_its_item_comes_up() -> None:
    def make(item: int) -> int:
        if item == 2:
            raise ValueError("the third")
        return item

    taken = []
    with pytest.raises(ValueError, match="the third"):
        taken.extend(item for item, _ in prefetch(make, range(5)))
    results = prefetch(make, range(5))
    assert [next(results)[0], next(results)[0]] == [0, 1]
    with pytest.raises(ValueError, match="the third"):
        next(results)


def test_nothing_to_do_is_nothing() -> None:
    assert list(prefetch(str, [])) == []

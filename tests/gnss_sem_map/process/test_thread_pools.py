"""Nobody waits for threads whose results nobody wants, and what is left does nothing more."""

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor

import pytest

from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.process.thread_pools import leaving_all, thread_pool, unless_left


def test_what_has_not_begun_when_its_pool_is_left_never_begins() -> None:
    begun, goes_on = list[int](), threading.Event()

    def make(item: int) -> None:
        begun.append(item)
        goes_on.wait()

    futures = list[Future[None]]()

    def interrupted() -> None:
        with thread_pool(1) as pool:
            futures.extend(pool.submit(make, item) for item in range(5))
            while not begun:
                time.sleep(0.001)
            threading.Timer(0.1, goes_on.set).start()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert begun == [0]
    assert futures[0].done()
    assert all(future.cancelled() for future in futures[1:])


def test_a_call_that_never_ends_is_left_and_what_would_follow_is_not_done() -> None:
    followed, goes_on = list[int](), threading.Event()

    def make(item: int) -> int:
        if item > 0:
            unless_left(goes_on.wait)
            followed.append(item)
        return item

    def interrupted() -> None:
        with leaving_all():
            for _ in prefetch(make, range(9), threads=2):
                raise KeyboardInterrupt  # the generator is still there: the traceback holds it

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert followed == []
    goes_on.set()


def test_what_fails_in_one_thread_leaves_nothing_of_another() -> None:
    def fail() -> None:
        with leaving_all():
            raise KeyError

    with ThreadPoolExecutor(1) as other, thread_pool(1) as mine:
        assert isinstance(other.submit(fail).exception(), KeyError)
        assert mine.submit(unless_left, int, "5").result() == 5


@pytest.mark.parametrize("inside", [False, True])
def test_a_call_that_nobody_leaves_is_that_call(inside: bool) -> None:
    def answer(number: int) -> int:
        if number == 2:
            raise TimeoutError("of its own")
        return number + 1

    def ask(number: int) -> int:
        if not inside:
            return unless_left(answer, number)
        return next(iter(prefetch(lambda n: unless_left(answer, n), [number])))[1]

    assert ask(1) == 2
    with pytest.raises(TimeoutError, match="of its own"):
        ask(2)

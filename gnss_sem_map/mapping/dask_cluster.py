"""Tasks on a Dask cluster: for users who outgrow one machine. The cluster and its limits are theirs: docs/cluster.md.

Only names and paths are sent: a Dask worker that is sent large data runs out of memory faster than it spills
(distributed#6110), and what numba has compiled is slow to send, or cannot be sent (numba#7289, distributed#4597).
"""

from __future__ import annotations

import json
import logging
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from gnss_sem_map.errors import ConfigError, DataError, how_to_install
from gnss_sem_map.mapping.execution import ALLOWED, Losses, Lost, Task, answer, result_of

if TYPE_CHECKING:
    from distributed import Client, Future, Worker

PACKAGE = "gnss-sem-map"
IN_FLIGHT = 4
"""Tasks that Dask holds at a time, per thread of the cluster: a scheduler with 100,000 of them is slow."""
CONNECT_S = 10.0
FIRST_WORKER_S = 60.0
"""A cluster may have no worker for so long at the beginning,"""
NO_WORKER_S = 300.0
"""and for so long later on."""
WATCH_S = 1.0


@dataclass(frozen=True)
class Cluster:
    """Calls tasks on the Dask cluster whose scheduler is at `address`, e.g. tcp://10.0.0.1:8786.

    `work` is a folder that this machine and all workers share. A worker that works on one task for more than
    `timeout_s` is restarted; what a dead or restarted worker had under way is called again.
    """

    address: str
    work: Path
    timeout_s: float = 3600.0
    allowed: str = ALLOWED

    def run(self, tasks: Sequence[Task]) -> Generator[tuple[Task, Any]]:
        """Call all tasks; yields each with its result when it is done.

        Raises what `check` raises, and DataError when all workers are gone for long.
        """
        with self._checked() as client:
            waiting, losses = deque(tasks), Losses()
            under_way: dict[Future[Any], Task] = {}
            finished: SimpleQueue[Future[Any]] = SimpleQueue()
            threads = _Threads(client, self.address)
            try:
                while waiting or under_way:
                    for _ in range(min(len(waiting), IN_FLIGHT * threads.count() - len(under_way))):
                        task = waiting.popleft()
                        future = self._submit(client, task)
                        under_way[future] = task
                        future.add_done_callback(finished.put)
                    for future in _taken(finished):
                        task = under_way.pop(future)
                        try:
                            yield task, _result(client, task, future)
                        except Lost as lost:
                            yield from losses.add(task, lost, waiting)
            finally:
                if client.status == "running":
                    client.cancel(list(under_way))

    def check(self) -> None:
        """Raise ConfigError without Dask or a scheduler, and DataError when workers are missing or not fit."""
        with self._checked():
            pass

    @contextmanager
    def _checked(self) -> Iterator[Client]:
        with _quiet_client(), _connected(self.address) as client:
            ask = partial(_asked, client, self.address)
            _wait_for_worker(client, self.address)
            _refuse_other_versions(ask)
            _refuse_without_nanny(ask)
            _refuse_own_folders(ask, self.work.resolve())
            yield client

    def _submit(self, client: Client, task: Task) -> Future[Any]:
        words = (task.function, json.dumps(task.arguments), self.allowed, self.timeout_s, _version())
        return client.submit(_answer_in_time, *words, pure=False)


def _answer_in_time(
    function: str, arguments: str, allowed: str, timeout_s: float, version: str
) -> tuple[str, str]:
    """On a worker: its address, and its answer. The call goes on after the time-out, until the worker is restarted."""
    from distributed import get_worker

    address = get_worker().address
    place = f" (on Dask worker {address})"
    if version != _version():  # a worker that came later
        message = f"{PACKAGE} {_version()} is installed; expected {version}{place}"
        return address, json.dumps({"error": "DataError", "message": message})
    answers: list[str] = []
    calling = threading.Thread(
        target=lambda: answers.append(answer(function, arguments, allowed, place)), daemon=True
    )
    calling.start()
    calling.join(timeout_s)
    return address, answers[0] if answers else json.dumps({"lost": f"it was not done after {timeout_s:g} s"})


def _result(client: Client, task: Task, future: Future[Any]) -> Any:
    """The result of a finished task; raises Lost when a second attempt may succeed."""
    from distributed import KilledWorker

    if future.status == "error":
        error = future.exception()
        if isinstance(error, KilledWorker):  # Dask itself has made several attempts
            reason = "a Dask worker died (its log says why; lack of memory is likely)"
            raise Lost(reason, times=error.allowed_failures + 1)
        raise DataError(
            f"{task.name}: Dask could not call it ({error!r}); install the same {PACKAGE} on all workers"
        )
    try:
        address, answered = future.result()
    except (CancelledError, OSError) as error:
        if client.status != "running":
            raise DataError(
                "the connection to the Dask scheduler was lost; see that it runs, and --resume"
            ) from None
        raise Lost(f"Dask lost it ({error!r})") from None
    try:
        return result_of(task, answered)
    except Lost:
        client.restart_workers([address], timeout=CONNECT_S, raise_for_error=False)
        raise


def _taken(finished: SimpleQueue[Future[Any]]) -> list[Future[Any]]:
    """What has finished; waits for the first for a while."""
    try:
        taken = [finished.get(timeout=WATCH_S)]
    except Empty:
        return []
    while not finished.empty():
        taken.append(finished.get())
    return taken


class _Threads:
    """Threads of the cluster, which may grow and shrink; raises DataError when all have been gone for long."""

    def __init__(self, client: Client, address: str) -> None:
        self._client, self._address = client, address
        self._count, self._looked, self._seen = 0, float("-inf"), time.monotonic()

    def count(self) -> int:
        now = time.monotonic()
        if now - self._looked >= WATCH_S:
            self._count, self._looked = sum(_nthreads(self._client, self._address).values()), now
        if self._count:
            self._seen = now
        elif now - self._seen > NO_WORKER_S:
            raise DataError(
                f"scheduler {self._address}: has had no worker for {NO_WORKER_S:g} s; start workers, and --resume"
            )
        return self._count


def _nthreads(client: Client, address: str) -> dict[str, int]:
    with _scheduler_there(address):
        return dict(client.nthreads())


@contextmanager
def _scheduler_there(address: str) -> Iterator[None]:
    """Raise DataError when the scheduler is lost while it is asked."""
    try:
        yield
    # CommClosedError is an OSError; a client that was closed has no scheduler
    except (OSError, AttributeError, CancelledError):
        raise DataError(f"scheduler {address}: was lost; see that it runs, and --resume") from None


@contextmanager
def _quiet_client() -> Iterator[None]:
    """Dask's client does not log: it tells of a lost scheduler with a traceback, and we in one line."""
    log = logging.getLogger("distributed.client")
    before = log.disabled
    log.disabled = True
    try:
        yield
    finally:
        log.disabled = before


@contextmanager
def _connected(address: str) -> Iterator[Client]:
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"scheduler {address}: {error.name} is not installed; {how_to_install('cluster')}"
        ) from None
    try:
        place = urlsplit(address)
        if place.scheme != "inproc":
            # a Client that fails may block later ones for ever, when it is collected at the wrong moment
            socket.create_connection((place.hostname or "", place.port or 0), CONNECT_S).close()
        client = Client(address, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"scheduler {address}: no Dask scheduler answers there ({error}); expected e.g. tcp://10.0.0.1:8786,"
            " as `dask scheduler` prints it"
        ) from None
    with client:
        yield client


def _wait_for_worker(client: Client, address: str) -> None:
    with _scheduler_there(address):
        try:
            client.wait_for_workers(1, timeout=FIRST_WORKER_S)
        except TimeoutError:
            raise DataError(
                f"scheduler {address}: has no worker after {FIRST_WORKER_S:g} s; start some: dask worker {address}"
            ) from None


def _asked(client: Client, address: str, function: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
    """What a function returns on every worker; one that dies meanwhile is left out, as Dask starts it again.

    Raises DataError for a worker that cannot call it, and for a scheduler that is lost.
    """
    with _scheduler_there(address):
        said = client.run(function, *arguments, on_error="return")
    for worker, one in said.items():
        if isinstance(one, Exception) and not isinstance(one, OSError):
            raise DataError(
                f"Dask worker {worker}: has no {PACKAGE} ({one}); install version {_version()} in its Python"
            )
    return {worker: one for worker, one in said.items() if not isinstance(one, OSError)}


def _refuse_other_versions(ask: Callable[..., dict[str, Any]]) -> None:
    """Every worker must have our package, of our version; asked with a function that every Python has."""
    ours = _version()
    for worker, found in ask(metadata.version, PACKAGE).items():
        if found != ours:
            raise DataError(
                f"Dask worker {worker}: has {PACKAGE} {found}; expected {ours}, as here; install that"
            )


def _refuse_without_nanny(ask: Callable[..., dict[str, Any]]) -> None:
    for worker, has_nanny in ask(_has_nanny).items():
        if not has_nanny:
            raise DataError(
                f"Dask worker {worker}: has no nanny, which restarts it when it hangs or needs too much memory; start"
                " it without --no-nanny, a LocalCluster with processes=True"
            )


def _refuse_own_folders(ask: Callable[..., dict[str, Any]], work: Path) -> None:
    """Every worker must read what is written here, and the other way round."""
    token = secrets.token_hex(8)
    files = [_token_file(work, token, 0)]
    try:
        try:
            files[0].write_text(token)
        except OSError as error:
            raise DataError(f"{work}: cannot be written ({error.strerror}); choose another folder") from None
        for worker, number in ask(_read_and_write, str(work), token).items():
            files.append(_token_file(work, token, number))
            if not number or not files[-1].is_file():
                raise DataError(
                    f"Dask worker {worker}: does not share the folder {work}: what one writes there the other does not"
                    " see; choose an output folder that all machines share, and may write to, under the same path"
                )
    finally:
        for path in files:
            path.unlink(missing_ok=True)


def _read_and_write(work: str, token: str) -> int:
    """On a worker: the number of the file that it wrote, 0 if it did not see ours or could not write."""
    number = 1 + secrets.randbelow(1 << 60)
    try:
        if _token_file(Path(work), token, 0).read_text() != token:
            return 0
        _token_file(Path(work), token, number).write_text(token)
    except OSError:
        return 0
    return number


def _token_file(work: Path, token: str, number: int) -> Path:
    # the name of an unfinished file: one that stays behind is cleared away
    return work / f".{token}.{number}.part"


def _has_nanny(dask_worker: Worker) -> bool:
    return dask_worker.nanny is not None


def _version() -> str:
    return metadata.version(PACKAGE)

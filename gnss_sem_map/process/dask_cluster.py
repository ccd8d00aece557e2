"""Tasks on a Dask cluster: for users who outgrow one machine. The cluster and its limits are theirs: docs/cluster.md.

Only names and paths are sent: a Dask worker that is sent large data runs out of memory faster than it spills
(distributed#6110), and what numba has compiled is slow to send, or cannot be sent (numba#7289, distributed#4597).
"""

from __future__ import annotations

import json
import logging
import os
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence, Set
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from gnss_sem_map.errors import ConfigError, DataError, how_to_install
from gnss_sem_map.process.execution import ALLOWED, Losses, Lost, Task, answer, result_of

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

    `work` is a folder that this machine and all workers share, and they must see all of `reads`. A worker that works on
    one task for more than `timeout_s` is restarted; what a dead or restarted worker had under way is called again.
    """

    address: str
    work: Path
    reads: tuple[Path, ...] = ()
    timeout_s: float = 3600.0
    allowed: str = ALLOWED

    def run(self, tasks: Sequence[Task]) -> Generator[tuple[Task, Any]]:
        """Call all tasks; yields each with its result when it is done.

        Raises what `check` raises, and DataError when all workers are gone for long.
        """
        with self._workers() as workers:
            client, waiting, losses = workers.client, deque(tasks), Losses()
            under_way: dict[Future[Any], Task] = {}
            finished: SimpleQueue[Future[Any]] = SimpleQueue()
            try:
                while waiting or under_way:
                    for _ in range(min(len(waiting), IN_FLIGHT * workers.threads() - len(under_way))):
                        task = waiting.popleft()
                        future = self._submit(client, task)
                        under_way[future] = task
                        future.add_done_callback(finished.put)
                    for future in _taken(finished):
                        task = under_way.pop(future)
                        try:
                            yield task, _result(workers, task, future)
                        except Lost as lost:
                            yield from losses.add(task, lost, waiting)
            finally:
                if client.status == "running":
                    client.cancel(list(under_way))

    def check(self) -> None:
        """Raise ConfigError without Dask or a scheduler, and DataError when workers are missing or not fit."""
        with self._workers():
            pass

    @contextmanager
    def _workers(self) -> Iterator[_Workers]:
        with _quiet_client(), _connected(self.address) as client:
            _wait_for_worker(client, self.address)
            workers = _Workers(client, self)
            workers.threads()  # looks at them for the first time
            yield workers

    def refuse_unfit(self, client: Client, workers: Iterable[str]) -> set[str]:
        """Those of the workers that answer all questions; raises DataError when one cannot do our tasks."""
        fit = set(workers)

        def ask(function: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
            answers = _asked(client, self.address, fit, function, *arguments)
            fit.intersection_update(answers)
            return answers

        _refuse_other_versions(ask)
        _refuse_without_nanny(ask)
        _refuse_more_threads(ask)
        _refuse_own_folders(ask, self.work.resolve())
        _refuse_without_inputs(ask, self.reads)
        return fit

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


def _result(workers: _Workers, task: Task, future: Future[Any]) -> Any:
    """The result of a finished task; raises Lost when a second attempt may succeed."""
    from distributed import KilledWorker

    if future.status == "error":
        error = future.exception()
        if isinstance(error, KilledWorker):  # Dask itself has made several attempts
            reason = "a Dask worker died (its log says why; lack of memory is likely)"
            raise Lost(reason, times=error.allowed_failures + 1)
        workers.look()  # one that came just now may have no package
        raise DataError(
            f"{task.name}: Dask could not call it ({error!r}); install the same {PACKAGE} on all workers"
        )
    try:
        address, answered = future.result()
    except (CancelledError, OSError) as error:
        if workers.client.status != "running":
            raise DataError(
                "the connection to the Dask scheduler was lost; see that it runs, and --resume"
            ) from None
        raise Lost(f"Dask lost it ({error!r})") from None
    try:
        return result_of(task, answered)
    except Lost:
        workers.client.restart_workers([address], timeout=CONNECT_S, raise_for_error=False)
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


class _Workers:
    """The workers of a cluster, which come and go."""

    def __init__(self, client: Client, cluster: Cluster) -> None:
        self.client, self._cluster = client, cluster
        self._known: set[str] = set()
        self._threads, self._looked, self._seen = 0, float("-inf"), time.monotonic()

    def threads(self) -> int:
        """How many threads they have; raises DataError for one that is not fit, and when all are gone for long."""
        now = time.monotonic()
        if now - self._looked >= WATCH_S:
            self.look()
        if self._threads:
            self._seen = now
        elif now - self._seen > NO_WORKER_S:
            raise DataError(
                f"scheduler {self._cluster.address}: has had no worker for {NO_WORKER_S:g} s; start workers, and"
                " --resume"
            )
        return self._threads

    def look(self) -> None:
        """See who is there; raises DataError for a new one that is not fit."""
        there = _nthreads(self.client, self._cluster.address)
        self._known &= there.keys()
        if new := there.keys() - self._known:
            self._known |= self._cluster.refuse_unfit(self.client, new)
        self._threads, self._looked = sum(there.values()), time.monotonic()


def _nthreads(client: Client, address: str) -> dict[str, int]:
    with _scheduler_there(client, address):
        return dict(client.nthreads())


@contextmanager
def _scheduler_there(client: Client, address: str) -> Iterator[None]:
    """Raise DataError when the scheduler is lost while it is asked."""
    try:
        yield
    except (OSError, AttributeError, RuntimeError, CancelledError) as error:  # CommClosedError is an OSError
        # a client that is closed has no scheduler; one that connects again raises what its time-outs raise
        if isinstance(error, AttributeError | RuntimeError) and client.status == "running":
            raise
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
    if address.startswith("tls:"):
        _refuse_without_certificates(address)
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


def _refuse_without_certificates(address: str) -> None:
    from distributed import Security

    reason = "none is named"
    try:
        context = Security().get_connection_args("client").get("ssl_context")
    except OSError as error:
        context, reason = None, str(error)
    if context is None:
        raise ConfigError(
            f"scheduler {address}: the certificates of the client cannot be used ({reason}); set distributed.comm.tls"
            " in Dask's configuration"
        )


def _wait_for_worker(client: Client, address: str) -> None:
    with _scheduler_there(client, address):
        try:
            client.wait_for_workers(1, timeout=FIRST_WORKER_S)
        except TimeoutError:
            raise DataError(
                f"scheduler {address}: has no worker after {FIRST_WORKER_S:g} s; start some: dask worker {address}"
            ) from None


def _asked(
    client: Client, address: str, workers: Set[str], function: Callable[..., Any], *arguments: Any
) -> dict[str, Any]:
    """What a function returns on some workers; one that dies meanwhile is left out, as Dask starts it again.

    Raises DataError for a worker that cannot call it, and for a scheduler that is lost.
    """
    there = sorted(_nthreads(client, address).keys() & workers)
    if not there:
        return {}
    with _scheduler_there(client, address):
        said = client.run(function, *arguments, workers=there, on_error="return")
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


def _refuse_more_threads(ask: Callable[..., dict[str, Any]]) -> None:
    for worker, threads in ask(_threads_of).items():
        if threads != 1:
            raise DataError(
                f"Dask worker {worker}: has {threads} threads, which would share its memory, its BLAS and its time-out;"
                " start it with --nthreads 1, and --nworkers for its cores"
            )


def _refuse_without_inputs(ask: Callable[..., dict[str, Any]], reads: Sequence[Path]) -> None:
    for worker, missing in ask(_missing, [str(path) for path in reads]).items():
        if missing:
            more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            raise DataError(
                f"Dask worker {worker}: does not see {missing[0]}{more}, which is to be read; make it visible there"
                " under the same path"
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


def _threads_of(dask_worker: Worker) -> int:
    return dask_worker.state.nthreads


def _missing(paths: list[str]) -> list[str]:
    return [path for path in paths if not os.path.exists(path)]


def _version() -> str:
    return metadata.version(PACKAGE)

"""Tasks: calls that any process can make, here or on another machine. A task is the name of a function, and JSON.

What is large lies in files: a task names their paths. So no object is pickled, nothing compiled is sent, and a lost
task is simply called again. Three executors give the same results: `InProcess`, `worker_processes.Processes` and
`dask_cluster.Cluster`.
"""

from __future__ import annotations

import json
import re
import threading
import traceback
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

from factor_graphs.errors import EstimationError, FactorGraphError, MeasurementError
from gnss_sem_map.errors import ConfigError, DataError, SemMapError, WriteError
from gnss_sem_map.process.machine import one_blas_thread

ALLOWED = "gnss_sem_map."
"""Modules whose functions may be tasks begin with this."""
ATTEMPTS = 3
"""A task that is lost as often as this is given up."""
_REMADE: dict[str, type[Exception]] = {
    kind.__name__: kind for kind in (WriteError, DataError, ConfigError, EstimationError, MeasurementError)
}
"""Errors that are raised again in the main process: a second attempt would not avoid them."""

_of_thread = threading.local()


@dataclass(frozen=True, eq=False)
class Task:
    """A call of a module-level function; `name` is for reports, `function` is "package.module:function".

    Arguments are JSON: strings, numbers, booleans, None, lists, and dicts with strings as keys. `size` is how much work
    it is, for the progress. Raises ConfigError.
    """

    name: str
    function: str
    arguments: tuple[Any, ...] = ()
    size: int = 1

    def __post_init__(self) -> None:
        if not re.fullmatch(r"\w+(\.\w+)*:\w+", self.function):
            raise ConfigError(
                f"{self.name}: its function is {self.function!r}; expected 'package.module:function'"
            )
        try:
            json.dumps(self.arguments)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"{self.name}: its arguments are not JSON ({error}); pass paths as strings"
            ) from None


def path_of(function: Callable[..., Any]) -> str:
    """How a task names a module-level function."""
    return f"{function.__module__}:{function.__name__}"


def report(done: int) -> None:
    """Tell, within a task, how much of its size is done; who called it in the same process hears it."""
    getattr(_of_thread, "report", lambda done: None)(done)


def attempt(function: str, arguments: list[Any], allowed: str = ALLOWED) -> dict[str, Any]:
    """Call another task: its `result`, or why it `failed`, by an error of ours or of the system. A task."""
    try:
        return {"result": _function(function, allowed)(*arguments)}
    except (SemMapError, FactorGraphError, OSError) as error:
        return {"failed": _told(error)}


def attempted(task: Task) -> Task:
    """The task that attempts this one."""
    return Task(task.name, path_of(attempt), (task.function, list(task.arguments)), task.size)


def _told(error: SemMapError | FactorGraphError | OSError) -> str:
    """The message of an error, and on which worker it is one: there a disk may be full, or a file missing."""
    said = str(error) or "failed"
    if isinstance(error, OSError):
        said = f"{error.filename or 'a file'}: {error.strerror or error}"
    return said + getattr(_of_thread, "place", "")


class Executor(Protocol):
    """Something that calls tasks and yields each with its result, in the order in which they finish."""

    def run(self, tasks: Sequence[Task]) -> Generator[tuple[Task, Any]]:
        """Call all tasks; the result of one that is lost too often is GivenUp. Raises our errors as functions do."""


class GivenUp(DataError):
    """A task was lost too often."""


def given_up(error: GivenUp) -> Any:
    """Raise the error: what `run_tasks` does with a lost task by default."""
    raise error


def run_tasks(
    tasks: Iterable[Task],
    executor: Executor,
    progress: Callable[[int, int], None] = lambda done, total: None,
    lost: Callable[[GivenUp], Any] = given_up,
) -> Generator[tuple[Task, Any]]:
    """Call all tasks, and yield each with its result (JSON) when it is done.

    `progress(done, total)`, in sizes of tasks, is called before the first and after every one. `lost` makes the result
    of a task that is lost three times; by default it raises GivenUp. Raises what the functions raise of our errors,
    DataError for an OSError, and RuntimeError for a defect.
    """
    tasks, done = list(tasks), 0
    total = sum(task.size for task in tasks)
    progress(0, total)
    with closing(executor.run(tasks)) as running, _heard(lambda more: progress(done + more, total)):
        for task, result in running:
            done += task.size
            progress(done, total)
            yield task, lost(result) if isinstance(result, GivenUp) else result


@contextmanager
def _heard(report: Callable[[int], None]) -> Iterator[None]:
    """What tasks of this process `report` is heard."""
    before = getattr(_of_thread, "report", None)
    _of_thread.report = report
    try:
        yield
    finally:
        _of_thread.report = before or (lambda done: None)


@dataclass(frozen=True)
class InProcess:
    """Calls in this process, one after another: an exception of a function is raised here, with its traceback."""

    allowed: str = ALLOWED

    def run(self, tasks: Sequence[Task]) -> Generator[tuple[Task, Any]]:
        """Call all tasks in order."""
        for task in tasks:
            yield task, json.loads(call(task.function, json.dumps(task.arguments), self.allowed))


def call(function: str, arguments: str, allowed: str = ALLOWED) -> str:
    """Call the function of this name with arguments in JSON; its result in JSON.

    Raises ConfigError for a function outside the modules that are allowed.
    """
    called = _function(function, allowed)
    with one_blas_thread():
        return json.dumps(called(*json.loads(arguments)))


def _function(path: str, allowed: str) -> Callable[..., Any]:
    module, _, name = path.partition(":")
    if not f"{module}.".startswith(allowed):
        raise ConfigError(f"{path}: may not be called as a task; expected a function of {allowed}*")
    try:
        found: Callable[..., Any] = getattr(import_module(module), name)
    except (ModuleNotFoundError, AttributeError) as error:
        raise ConfigError(f"{path}: no such function ({error}); is another version installed here?") from None
    return found


def answer(function: str, arguments: str, allowed: str = ALLOWED, place: str = "") -> str:
    """As `call`, on behalf of another process: every outcome is an answer in JSON, for `result_of` there.

    `place`, where it is called, ends the message of an error.
    """
    _of_thread.place = place
    try:
        return json.dumps({"result": call(function, arguments, allowed)})
    except MemoryError:
        return json.dumps({"lost": "it ran out of memory"})
    except (SemMapError, FactorGraphError) as error:
        kind = next((kind.__name__ for kind in type(error).__mro__ if kind.__name__ in _REMADE), "DataError")
        return json.dumps({"error": kind, "message": _told(error)})
    except OSError as error:
        return json.dumps({"error": "DataError", "message": _told(error)})
    except Exception:  # noqa: BLE001 (a defect: it is raised where somebody sees it)
        return json.dumps({"defect": traceback.format_exc()})


def result_of(task: Task, answered: str) -> Any:
    """The result in an answer; raises what it reports, and Lost when a second attempt may succeed."""
    found = json.loads(answered)
    if "lost" in found:
        raise Lost(found["lost"])
    if "error" in found:
        raise _REMADE[found["error"]](found["message"])
    if "defect" in found:
        raise RuntimeError(f"{task.name} failed in its process:\n{found['defect']}")
    return json.loads(found["result"])


class Lost(Exception):
    """A task ended without an answer, through no fault of its data; `times` is the number of attempts that this was."""

    def __init__(self, reason: str, times: int = 1) -> None:
        super().__init__(reason)
        self.times = times


class Losses:
    """How often each task was lost, and why."""

    def __init__(self) -> None:
        self._reasons: defaultdict[Task, list[str]] = defaultdict(list)

    def add(self, task: Task, lost: Lost, waiting: deque[Task]) -> Iterator[tuple[Task, GivenUp]]:
        """Let a lost task wait for its next attempt; yields it, with the error, when there will be none."""
        reasons = self._reasons[task]
        reasons += [str(lost)] * lost.times
        if len(reasons) < ATTEMPTS:
            waiting.append(task)
            return
        told = ", ".join(f"{count} x {reason}" for reason, count in Counter(reasons).items())
        yield (
            task,
            GivenUp(
                f"{task.name}: given up after {len(reasons)} attempts: {told}; if memory was short, take"
                " fewer workers, or more memory for each; run it again"
            ),
        )

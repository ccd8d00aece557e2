"""A reader and many damaged inputs, in a process of its own that is measured: what came out, how long, how much."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import resource
import signal
import time
import traceback
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from faults.harness import PRELOAD

LONGEST_S, MOST_MB = 1.0, 500.0
ROOM_MB = 3000
"""Of addresses, beyond what the process has: who asks for more than that gets a MemoryError, which is a fault."""


@dataclass(frozen=True)
class Reader:
    """A reader, a file that it takes, and how such a file is damaged."""

    file: Path
    """Replaced by each input."""
    read: Callable[[], object]
    mutate: Callable[[bytes, np.random.Generator], bytes]


@dataclass(frozen=True)
class Report:
    """What came of some inputs."""

    inputs: int
    refused: int
    slowest_s: float
    peak_mb: float
    faults: list[str]


def fuzz(make: Callable[[Path], Reader], name: str, first: int, count: int, folder: Path) -> Report:
    """Inputs `first` to `first + count - 1` of a reader that `make` makes in a new folder."""
    folder.mkdir(parents=True, exist_ok=True)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*PRELOAD, "faults.readers"])
    process = context.Process(target=_child, args=(make, name, first, count, folder))
    process.start()
    process.join(600 + count)
    if process.exitcode is None:
        process.kill()
        process.join()
    result = folder / "report.json"
    if process.exitcode != 0 or not result.is_file():
        begun = (folder / "begun").read_text() if (folder / "begun").exists() else "the first"
        return Report(count, 0, 0.0, 0.0, [f"{name}: input {begun} ended the process ({process.exitcode})"])
    return Report(**json.loads(result.read_text()))


def _child(make: Callable[[Path], Reader], name: str, first: int, count: int, folder: Path) -> None:
    from factor_graphs.errors import FactorGraphError
    from gnss_sem_map.errors import SemMapError

    os.environ["OMP_NUM_THREADS"] = "1"
    printed = os.open(folder / "printed", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    reader = make(folder / "seed")
    seed = reader.file.read_bytes()
    reader.read()  # the seed is right, and what is imported is imported now
    os.dup2(printed, 2)
    signal.signal(signal.SIGALRM, _too_long)
    _limit_addresses()
    refused, slowest, peak, faults = 0, 0.0, 0.0, []
    for number in range(first, first + count):
        (folder / "begun").write_text(str(number))
        content = reader.mutate(seed, np.random.default_rng([zlib.crc32(name.encode()), number]))
        reader.file.write_bytes(content)
        before, start = _reset_peak(), time.process_time()
        signal.alarm(120)
        try:
            reader.read()
        except (SemMapError, FactorGraphError) as error:
            refused += 1
            if "\n" in " ".join(str(error).split()) or len(str(error)) > 2000:
                faults.append(f"{name} {number}: a message of {len(str(error))} characters")
        except BaseException as error:  # noqa: BLE001 (whatever escapes is what is looked for)
            where = traceback.extract_tb(error.__traceback__)[-3:]
            places = " ".join(f"{Path(f.filename).name}:{f.lineno}" for f in where)
            faults.append(f"{name} {number}: {type(error).__name__} {str(error)[:150]} at {places}")
        finally:
            signal.alarm(0)
        seconds, megabytes = time.process_time() - start, (_status_kb("VmHWM") - before) / 1024
        slowest, peak = max(slowest, seconds), max(peak, megabytes)
        if seconds > LONGEST_S:
            faults.append(f"{name} {number}: {seconds:.1f} s")
        if megabytes > MOST_MB:
            faults.append(f"{name} {number}: {megabytes:.0f} MB")
        if size := os.fstat(printed).st_size:
            faults.append(f"{name} {number}: printed {os.pread(printed, min(size, 200), 0)!r}")
            os.ftruncate(printed, 0)
            os.lseek(printed, 0, os.SEEK_SET)
    report = Report(count, refused, round(slowest, 3), round(peak, 1), faults)
    (folder / "report.json").write_text(json.dumps(report.__dict__))
    os._exit(0)


def _too_long(*_: object) -> None:
    raise TimeoutError("120 s")


def _limit_addresses() -> None:
    size = (_status_kb("VmSize") << 10) + (ROOM_MB << 20)
    resource.setrlimit(resource.RLIMIT_AS, (size, size))


def _reset_peak() -> int:
    """What is in memory now, kB; from here on the peak is counted anew, where the system lets us."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _status_kb("VmRSS")


def _status_kb(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1])
    return 0

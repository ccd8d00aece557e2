"""Statistics of a run: counts, skips, warnings, and time and memory of every stage."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

from gnss_sem_map.process.machine import most_held_bytes
from gnss_sem_map.process.memory import release_memory
from gnss_sem_map.sensor_log import Skip

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, the number of finished steps, and their total."""


def silent(stage: str, done: int, total: int) -> None:
    """Progress that is not shown."""


def shifted(progress: Progress, done: int, total: int) -> Progress:
    """The progress of a part, told as that of a whole of which so many steps were done before."""
    return lambda stage, more, _: progress(stage, done + more, total)


@dataclass
class RunStats:
    """Statistics of a run: counts, skips, warnings, and time and memory of every stage."""

    counts: Counter[str] = field(default_factory=Counter)
    skips: list[Skip] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory_mb: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> RunStats:
        """Those that `as_dict` made."""
        return cls(**{
            **content, "counts": Counter(content["counts"]), "skips": [Skip(**skip) for skip in content["skips"]]
        })  # fmt: skip

    def as_dict(self) -> dict[str, Any]:
        """As JSON has them."""
        return asdict(self) | {"counts": dict(self.counts)}

    def __iadd__(self, later: RunStats) -> RunStats:
        """With those of a later part of the run."""
        self.counts.update(later.counts)
        self.skips += later.skips
        self.warnings += later.warnings
        for name, seconds in later.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
        for name, peak in later.peak_memory_mb.items():
            self.peak_memory_mb[name] = max(self.peak_memory_mb.get(name, 0.0), peak)
        return self

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure time and peak memory of the block as one stage."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        release_memory()
        self.peak_memory_mb[name] = most_held_bytes() / (1 << 20)

"""Memory that was freed: other threads use it, or it goes back to the system, so the peak of a run is what it needs."""

from __future__ import annotations

import atexit
import ctypes
import gc
import os
from contextlib import suppress

from gnss_sem_map.process.machine import held_bytes

M_ARENA_MAX, M_MMAP_MAX, M_MMAP_THRESHOLD, M_TRIM_THRESHOLD = -8, -4, -3, -1
"""Of glibc's `mallopt`: the number of heaps, how many arrays may have memory that is not of a heap, the size from which
they have it, and how much may be free at the end of a heap."""
LARGE_BYTES, FREE_BYTES = 4 << 20, 64 << 20
"""Arrays of the first size, those of a tile, a chunk or a large scan, go back to the system when they are freed, and
leave no holes: 30 MB less at the peak, at no cost in time. With 1 MB it costs 5 ms per scan. By default glibc raises
that size to 32 MB."""
GROWN_BYTES = 64 << 20
"""Memory is released when the process holds so much more than the least since the last time. With the peak as the
measure in its place, holes fill up to the peak, and then it rises from chunk to chunk though no more is in use."""
NEW_OBJECTS = 20_000
"""So many more objects than before let Python look for reference cycles; its own default is 700."""


def share_one_heap() -> None:
    """Let all threads of this process, and of those that it starts, use one heap; call it before pyarrow is imported.

    By default each thread has a heap of its own and Arrow another one: memory that a scan or a tile has used in one is
    not used for the next in another. On a drive of 60 s, one heap lowers the peak from 1,010 to 880 MB, at no cost in
    time.
    """
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    for name, option, value in (
        ("MALLOC_ARENA_MAX", M_ARENA_MAX, 1),
        ("MALLOC_MMAP_THRESHOLD_", M_MMAP_THRESHOLD, LARGE_BYTES),
        ("MALLOC_TRIM_THRESHOLD_", M_TRIM_THRESHOLD, FREE_BYTES),
    ):
        if name in os.environ:
            continue  # the user's choice
        os.environ[name] = f"{value}"
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).mallopt(option, value)


def use_huge_pages() -> None:
    """Let torch take its arrays in pages of 2 MB; call it before torch is imported.

    Every layer of a network writes new arrays of several MB, and the system hands out each page of 4 kB by itself. The
    demo's network takes a fifth less time per image on a CPU, with the same result.
    """
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")


def reuse_memory() -> None:
    """From now on, keep what large arrays have freed for others, until `release_memory`: for a network on a CPU.

    The arrays of a layer would each get new pages from the system, which fills them with zeros first. A run of the demo
    drive with its network takes 98 s in place of 120 s, and 1,060 to 1,100 MB in place of 994 MB. Only where they go
    back by `share_one_heap`: other programs, and what a user has chosen, stay as they are.
    """
    if os.environ.get("MALLOC_MMAP_THRESHOLD_") != f"{LARGE_BYTES}":
        return
    with suppress(OSError, AttributeError):
        for option, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 1 << 30)):
            ctypes.CDLL(None).mallopt(option, value)


def collect_seldom() -> None:
    """Look for reference cycles less often: there are hardly any, among the 400,000 objects of imported modules.

    A run of the demo drive spends 0.3 s on it in place of 0.8 s; at its end it looks at none of them, which takes
    another 0.3 s.
    """
    gc.set_threshold(NEW_OBJECTS)
    atexit.register(gc.freeze)


_least_held = 0
"""The fewest bytes that were held since memory was last released."""


def release_memory(always: bool = False) -> None:
    """Return freed memory to the system: glibc keeps what many small objects, such as those of a graph, have used.

    Unless `always`, only where the process holds much more than the least since the last time: what is returned and
    used again takes 1.5 us per page.
    """
    global _least_held
    with suppress(OSError, AttributeError):
        held = held_bytes()
        if always or held > _least_held + GROWN_BYTES:
            ctypes.CDLL(None).malloc_trim(0)
            _least_held = held_bytes()
        else:
            _least_held = min(_least_held, held)

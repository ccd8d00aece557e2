"""When messages were measured: the stamps in their headers, tested against the times of their arrival."""

from __future__ import annotations

import struct
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.datasets.ros.kinds import HEADLESS
from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.sensor_log import Skip

Ints = NDArray[np.int64]
Clock = Literal["header", "received"]

HEAD_BYTES = 16
"""From the start of a message to the end of its header's stamp."""
JUMP_NS = 1_000_000_000
"""From one message to the next, stamps and arrivals differ by less, in a bag that is played slowly as well."""
MOST_WRONG = 0.1
"""Largest share of a topic's messages whose stamps may be wrong."""


def stamps_of(bag: Bag, messages: Messages, clock: Clock) -> tuple[Ints, NDArray[np.bool_], list[Skip]]:
    """Stamps (n,), Unix ns, which of them are believed (n,), and the skipped ones.

    Raises DataError where too many headers are zero or jump, and names the times of arrival as the way out.
    """
    if clock == "received" or len(messages) == 0:
        return messages.received_ns, np.ones(len(messages), np.bool_), []
    said = np.fromiter((header_ns(bag, messages, k) for k in range(len(messages))), np.int64, len(messages))
    is_zero = said <= 0
    believed = ~is_zero
    believed[believed] = _of_the_longest_run(said[believed], messages.received_ns[believed])
    jumped = int((~is_zero & ~believed).sum())
    wrong = [(int(is_zero.sum()), "zero"), (jumped, "jump against the times of arrival")]
    told = " and ".join(f"{count} of {len(said)} header stamps {why}" for count, why in wrong if count)
    told = told.replace("stamps zero", "stamps are zero")
    if int((~believed).sum()) > MOST_WRONG * len(said):
        raise refused(
            messages.topic,
            f"{told}; set `stamps: received` for this topic in rig.yaml",
        )
    return said, believed, [Skip("stamp", messages.topic, told, int((~believed).sum()))] if told else []


def _of_the_longest_run(said: Ints, received: Ints) -> NDArray[np.bool_]:
    """The stamps that go with the arrivals: between two jumps all are off by the same, and most are not off."""
    if len(said) == 0:
        return np.zeros(0, np.bool_)
    off = said - received
    steps = np.diff(off)
    is_jump = np.concatenate([[False], np.abs(steps) > JUMP_NS])
    run = np.cumsum(is_jump)
    # a run that lands where an earlier one was is the same one again: what was between has jumped
    first = off[np.searchsorted(run, np.arange(run[-1] + 1))]
    last = off[np.searchsorted(run, np.arange(run[-1] + 1), side="right") - 1]
    sizes = np.bincount(run)
    largest = int(sizes.argmax())
    belongs = np.zeros(len(sizes), np.bool_)
    belongs[largest] = True
    for numbers, here, there in (
        (range(largest + 1, len(sizes)), last, first),
        (range(largest - 1, -1, -1), first, last),
    ):
        edge = here[largest]
        for number in numbers:
            if abs(int(there[number]) - int(edge)) <= JUMP_NS:
                belongs[number], edge = True, here[number]
    return np.asarray(belongs[run])


def header_ns(bag: Bag, messages: Messages, k: int) -> int:
    """The stamp in the header of a message, Unix ns, or its arrival where the type has none; raises DataError."""
    if messages.kind in HEADLESS:
        return int(messages.received_ns[k])
    head = bag.read(messages, k, HEAD_BYTES)
    try:
        if messages.is_ros1:
            _, seconds, nanoseconds = struct.unpack_from("<III", head)
        else:
            order = "<" if head[1] & 1 else ">"
            seconds, nanoseconds = struct.unpack_from(f"{order}iI", head, 4)
    except (struct.error, IndexError):
        raise refused(messages.topic, f"message {k} has {len(head)} bytes, no header") from None
    return int(seconds) * 1_000_000_000 + int(nanoseconds)

"""What the messages say: decoded by `rosbags` with the types of ROS and of `kinds`, never with those of the bag."""

from __future__ import annotations

from functools import cache
from typing import Any

from gnss_sem_map.datasets.ros.bag import Bag, Messages
from gnss_sem_map.datasets.ros.kinds import DEFINITIONS
from gnss_sem_map.errors import one_line
from gnss_sem_map.files.untrusted import refused


@cache
def typestore(is_ros1: bool) -> Any:
    """The message types of ROS; those that we read are the same in every release of it."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text.replace(";", "\n"), name))
    return store


def decode(bag: Bag, messages: Messages, k: int) -> Any:
    """A message, as an object with the fields of its type; raises DataError for one that is damaged."""
    data, store = memoryview(bag.read(messages, k)), typestore(messages.is_ros1)  # whose parts are no copies
    try:
        if messages.is_ros1:
            return store.deserialize_ros1(data, messages.kind)
        return store.deserialize_cdr(data, messages.kind)
    except Exception as error:
        # generated code reads bytes that may be anything: it fails in as many ways as there are bytes
        if isinstance(error, MemoryError):
            raise
        raise refused(messages.topic, f"message {k} is no {messages.kind} ({one_line(error, 80)})") from None

"""A mistake that a user makes with a log, and the words that must name it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Mistake:
    """A wrong log, exit code 0 without a pre-flight, and a wrong map."""

    name: str
    layout: str
    """What is changed: a drive in "kitti-raw", "table" or "odometry" layout, or a folder of "labels"."""
    inject: Callable[[Path], None]
    """Changes a copy of a drive in place."""
    says: tuple[str, ...]
    """Words, lower case, of which mistake or remedy of a red or amber finding must contain one."""

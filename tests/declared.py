"""What not every machine has: a test without it is skipped, but fails where a variable declares that it is there."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest

DATA, BROWSER, ROOT = "GNSS_SEM_MAP_DATA", "GNSS_SEM_MAP_BROWSER", "GNSS_SEM_MAP_ROOT"
"""The folder of the real KITTI excerpts; anything but nothing where chromium and chromedriver must work; likewise where
tests have the rights of root: to mount a disk, and to hold a file (`chattr +i`)."""


def absent(variable: str, reason: str) -> NoReturn:
    """End a test for lack of something: skip it, or fail it where the variable declares it present."""
    if os.environ.get(variable):
        pytest.fail(f"{reason}; but {variable}={os.environ[variable]} declares it present")
    pytest.skip(reason)

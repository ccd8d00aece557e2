"""What tests of several readers share."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from street import Street


@pytest.fixture
def copy(small_drive: Street, tmp_path: Path) -> Path:
    """A copy of the KITTI raw drive that a test may damage."""
    shutil.copytree(small_drive.drive.parent, tmp_path / "2011_09_26")
    return tmp_path / "2011_09_26" / small_drive.drive.name

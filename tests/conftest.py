"""What several tests share: the small street, and where the real data are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import street


@pytest.fixture(scope="session")
def small_drive(tmp_path_factory: pytest.TempPathFactory) -> street.Street:
    """A dozen scans of the analytic street, written as a KITTI raw drive; read only."""
    return street.write(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The real KITTI excerpts; their licence keeps them out of this repository."""
    folder = Path(os.environ.get("GNSS_SEM_MAP_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not (folder / "kitti_raw").is_dir():
        pytest.skip(f"no real data at {folder}; set GNSS_SEM_MAP_DATA")
    return folder

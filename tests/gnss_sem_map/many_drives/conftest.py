"""Three drives and their maps, which all tests here read."""

from __future__ import annotations

from pathlib import Path

import pytest
import street_drives
from made_once import made_once
from maps_of_drives import SETTINGS, mapped
from street_drives import Drives

from gnss_sem_map.runs import finished_run
from gnss_sem_map.runs.many_drives import HowMapped


@pytest.fixture(scope="session")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Drives:
    """Three drives, a to c; read only."""
    return made_once(tmp_path_factory, "drives", street_drives.write)


@pytest.fixture(scope="session")
def how(drives: Drives) -> HowMapped:
    """So short a drive looks wrong before the work, hence `force`."""
    return HowMapped(drives.labels, force=True)


@pytest.fixture(scope="session")
def made(drives: Drives, how: HowMapped, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Maps of the first drive alone, of two and of three, each made at once; read only."""

    def make(folder: Path) -> dict[str, Path]:
        finished_run.run(drives.by_name["a"], folder / "a", drives.labels, SETTINGS, force=True)
        for names in ("ab", "abc"):
            mapped(names, drives, folder / names, how)
        return {path.name: path for path in folder.iterdir()}

    return made_once(tmp_path_factory, "made", make)

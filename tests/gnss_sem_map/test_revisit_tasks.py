"""Places that a drive passes again, registered in other processes: the same results, to the bit."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.work_folder import clear
from gnss_sem_map.process.execution import Executor, InProcess
from gnss_sem_map.process.worker_processes import Processes
from gnss_sem_map.runs import revisit_tasks
from gnss_sem_map.runs.revisit_tasks import RevisitTasks
from gnss_sem_map.runs.source import Source
from gnss_sem_map.scans.local_maps import LocalMaps, sweeps_along
from gnss_sem_map.scans.revisits import Found, Pair, Pass, register_pair
from gnss_sem_map.sensor_log import SensorLog

SETTINGS = Settings()
PAIRS: list[Pair] = [(0, 0, 0, 1), (0, 0, 0, 2), (0, 1, 0, 2), (0, 0, 0, 3), (0, 2, 0, 1)]


@pytest.fixture(scope="module")
def places(small_log: SensorLog, small_track: Trajectory) -> Pass:
    stamps = np.array([scan.stamp for scan in small_log.scans])[[1, 4, 7, 9]]
    return Pass(
        np.arange(len(stamps)),
        stamps,
        small_track.at(stamps),
        LocalMaps(sweeps_along(small_log, small_track), small_track, stamps),
    )


@pytest.fixture(scope="module")
def expected(places: Pass) -> list[Found | None]:
    found = [register_pair([places], pair, SETTINGS.trajectory.revisits) for pair in PAIRS]
    assert any(one is not None for one in found)
    return found


@pytest.fixture(autouse=True)
def small_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(revisit_tasks, "PAIRS_PER_TASK", 2)


def assert_same(found: Sequence[Found | None], expected: Sequence[Found | None]) -> None:
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            for a, b in zip(
                (one.T, one.covariance, *one.sample), (other.T, other.covariance, *other.sample), strict=True
            ):
                np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("executor", [InProcess(), pytest.param(Processes(2), marks=pytest.mark.slow)])
def test_other_processes_find_the_same(
    small_log: SensorLog, small_track: Trajectory, small_source: Source, places: Pass, expected: list[Found | None],
    tmp_path: Path, executor: Executor,
) -> None:  # fmt: skip
    registrar = RevisitTasks(small_source, tmp_path / "w", executor)(small_log, small_track, SETTINGS)
    assert_same(list(registrar([places], PAIRS)), expected)
    clear(tmp_path / "w")
    assert not (tmp_path / "w").exists()


@pytest.mark.parametrize(
    "damage", [b"{", *(pytest.param(one, marks=pytest.mark.slow) for one in (b"", b"[]", b"{}"))]
)
def test_only_what_is_missing_or_damaged_is_registered_again(
    small_log: SensorLog, small_track: Trajectory, small_source: Source, places: Pass, expected: list[Found | None],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: bytes,
) -> None:  # fmt: skip
    registrar = RevisitTasks(small_source, tmp_path, InProcess())(small_log, small_track, SETTINGS)
    list(registrar([places], PAIRS))
    (tmp_path / "revisits" / "1.json").write_bytes(damage)
    registered: list[Any] = []

    def noted(passes: Sequence[Pass], pair: Pair, *others: Any) -> Found | None:
        registered.append(pair)
        return register_pair(passes, pair, *others)

    monkeypatch.setattr(revisit_tasks, "register_pair", noted)
    assert_same(list(registrar([places], PAIRS)), expected)
    assert registered == PAIRS[2:4]


def test_a_worker_that_finds_another_trajectory_registers_again(
    small_log: SensorLog,
    small_track: Trajectory,
    small_source: Source,
    places: Pass,
    expected: list[Found | None],
    tmp_path: Path,
) -> None:
    list(RevisitTasks(small_source, tmp_path, InProcess())(small_log, small_track, SETTINGS)([places], PAIRS))
    T = small_track.T_map_imu.copy()
    T[:, 0, 3] += 0.01 * (small_track.stamps - small_track.start)
    moved = Trajectory(small_track.stamps, T)
    there = Pass(
        places.anchors,
        places.stamps,
        moved.at(places.stamps),
        LocalMaps(sweeps_along(small_log, moved), moved, places.stamps),
    )
    found = list(
        RevisitTasks(small_source, tmp_path, InProcess())(small_log, moved, SETTINGS)([there], PAIRS)
    )
    assert_same(found, [register_pair([there], pair, SETTINGS.trajectory.revisits) for pair in PAIRS])


def test_a_worker_that_outlives_a_run_takes_the_places_and_settings_of_the_next_one(
    small_log: SensorLog, small_track: Trajectory, small_source: Source, places: Pass, tmp_path: Path
) -> None:
    """In the same folder, with the same sweeps and the same pairs of numbers, as of a cluster."""
    looser = Settings.model_validate({"trajectory": {"revisits": {"min_inlier_share": 0.05}}})
    later = places.stamps + 0.1
    there = Pass(
        places.anchors, later, small_track.at(later), LocalMaps(places.maps.sweeps, small_track, later)
    )
    for settings, at in ((SETTINGS, places), (looser, places), (looser, there)):
        registrar = RevisitTasks(small_source, tmp_path, InProcess())(small_log, small_track, settings)
        expected = [register_pair([at], pair, settings.trajectory.revisits) for pair in PAIRS]
        assert_same(list(registrar([at], PAIRS)), expected)
        assert revisit_tasks._opened.cache_info().currsize == 1
        _, opened = revisit_tasks._opened(*_last_job(tmp_path))
        assert opened == settings.trajectory.revisits


def _last_job(work: Path) -> tuple[str, str]:
    folder = work / "revisits"
    return str(folder.resolve()), json.loads((folder / "job.json").read_text())["fingerprint"]


def test_a_worker_that_finds_another_drive_says_so(
    small_log: SensorLog, small_track: Trajectory, small_source: Source, places: Pass, tmp_path: Path
) -> None:
    shorter = replace(small_log, scans=small_log.scans[:-1])
    with pytest.raises(DataError, match="a worker finds another drive"):
        list(
            RevisitTasks(small_source, tmp_path, InProcess())(shorter, small_track, SETTINGS)([places], PAIRS)
        )

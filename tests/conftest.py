"""What several tests share: the small street, where the real data are, and which tests make the unit tier."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NoReturn

import hypothesis
import matplotlib.font_manager  # noqa: F401 (the first import on a machine starts a process, which no unit test may)
import pytest
import street
from declared import DATA, absent
from made_once import made_once

from factor_graphs.trajectory import Trajectory
from gnss_sem_map import Run, Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.runs import finished_run
from gnss_sem_map.runs.source import Source, source_of
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.simulation import Simulation

hypothesis.settings.register_profile("untimed", deadline=None)  # a busy machine is no fault of a law
hypothesis.settings.load_profile("untimed")

TESTS = Path(__file__).parent
NOT_UNIT = ("integration", "slow", "faults")
INTEGRATION_FILES = tuple(
    TESTS / name
    for name in (
        "factor_graphs/test_calibration.py",
        "factor_graphs/test_constraints.py",
        "factor_graphs/test_kalman.py",
        "factor_graphs/test_real_logs.py",
        "factor_graphs/test_relative_poses.py",
        "factor_graphs/test_smoothing.py",
        "faults",
        "gnss_sem_map/datasets/test_kitti_360.py",
        "gnss_sem_map/dynamics/test_moving_objects.py",
        "gnss_sem_map/preflight",
        "gnss_sem_map/export/test_every_writer.py",
        "gnss_sem_map/export/test_pictures.py",
        "gnss_sem_map/many_drives",
        "gnss_sem_map/scans/test_lidar_odometry.py",
        "gnss_sem_map/scans/test_sweeps_left_out.py",
        "gnss_sem_map/segmentation/test_checkpoints.py",
        "gnss_sem_map/segmentation/test_demo_network.py",
        "gnss_sem_map/segmentation/test_huggingface.py",
        "gnss_sem_map/segmentation/test_networks.py",
        "gnss_sem_map/segmentation/test_onnx_file.py",
        "gnss_sem_map/segmentation/test_refinenet.py",
        "gnss_sem_map/segmentation/test_training.py",
        "gnss_sem_map/simulation/test_rigs.py",
        "gnss_sem_map/simulation/test_sessions.py",
        "gnss_sem_map/simulation/test_town.py",
        "gnss_sem_map/test_attributes.py",
        "gnss_sem_map/test_class_roles.py",
        "gnss_sem_map/test_finished_run.py",
        "gnss_sem_map/test_run_again.py",
    )
)
"""Tests of several stages, whole drives, whole pictures or networks; those in `TESTS` itself run commands."""
INTEGRATION_FIXTURES = {"real_data", "browser", "simulation", "town_drive", "whole_drive"}


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """The unit tier does not import what it does not run: networks and their packages take long."""
    is_unit_tier = "not integration" in config.getoption("-m")
    return True if is_unit_tier and collection_path in INTEGRATION_FILES else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is no unit test by where it stands and what it uses; single tests carry the mark themselves.

    Files with such tests run first, and of these the ones that run commands: they take longest, and one that began last
    would keep one core waiting.
    """
    lost = [str(path) for path in INTEGRATION_FILES if not path.exists()]
    if lost:
        raise pytest.UsageError(f"tests/conftest.py: found no {', '.join(lost)}; change INTEGRATION_FILES")
    for item in items:
        is_listed = item.path.parent == TESTS or any(map(item.path.is_relative_to, INTEGRATION_FILES))
        if is_listed or INTEGRATION_FIXTURES.intersection(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.integration)
    long = {item.path for item in items if item.get_closest_marker("integration")}
    items.sort(key=lambda item: (item.path not in long, item.path.parent != TESTS))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """A unit test, and what is set up for it, fails when it starts a process or simulates a drive."""
    if any(map(item.get_closest_marker, NOT_UNIT)):
        return (yield)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(subprocess.Popen, "__init__", _refused("starts a process"))
        patch.setattr(BaseProcess, "start", _refused("starts a process"))
        patch.setattr(os, "fork", _refused("starts a process"))
        patch.setattr(Simulation, "__init__", _refused("simulates a drive"))
        return (yield)


def _refused(what: str) -> Callable[..., NoReturn]:
    def refuse(*_: object, **__: object) -> NoReturn:
        pytest.fail(f"a unit test {what}; mark it as `integration`")

    return refuse


@pytest.fixture(scope="session")
def small_drive(tmp_path_factory: pytest.TempPathFactory) -> street.Street:
    """A dozen scans of the analytic street, written as a KITTI raw drive; read only."""
    return made_once(tmp_path_factory, "street", street.write)


@pytest.fixture(scope="session")
def small_source(small_drive: street.Street) -> Source:
    """The small drive as workers open it."""
    return source_of(small_drive.drive)


@pytest.fixture(scope="session")
def small_log(small_source: Source) -> SensorLog:
    """The log of the small drive."""
    return open_drive(small_source.drive)


@pytest.fixture(scope="session")
def small_track(small_log: SensorLog) -> Trajectory:
    """The poses of its navigation unit."""
    assert small_log.reference is not None
    return small_log.reference


@pytest.fixture(scope="session")
def finished(small_drive: street.Street, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of the small drive with labels; read only. Its classifier is soon trained."""
    settings, labels = (
        Settings().changed("geometric_classifier.rows_per_fold=1000"),
        f"labels:{small_drive.labels}",
    )

    def make(folder: Path) -> Path:
        out = folder / "out"
        return finished_run.run(
            small_drive.drive, out, labels, settings, write_labels=True, force=True
        ).folder

    return Run.open(made_once(tmp_path_factory, "finished", make))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The real KITTI excerpts; their licence keeps them out of this repository."""
    folder = Path(os.environ.get(DATA) or TESTS.parents[1] / "shared" / "data")
    if not (folder / "kitti_raw").is_dir():
        absent(DATA, f"no real data at {folder}; set {DATA}")
    return folder

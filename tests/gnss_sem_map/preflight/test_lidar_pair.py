"""Two LiDARs that are calibrated onto each other wrongly are found, with the error; good ones are green."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.preflight import lidar_pair
from gnss_sem_map.preflight.findings import Finding, Level
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.simulation import prepare
from gnss_sem_map.simulation.rigs import Rig, surround
from gnss_sem_map.simulation.table_drive import write_table


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> SensorLog:
    """Four seconds of town by the LiDARs of the surround rig, with half their columns."""
    lidars = tuple(replace(lidar, sensor=replace(lidar.sensor, columns=900)) for lidar in surround().lidars)
    simulation = prepare(4.0, 3, rig=Rig(lidars, ()))
    return open_drive(write_table(simulation, tmp_path_factory.mktemp("pair"), workers=2))


def found(log: SensorLog) -> Finding:
    (finding,) = lidar_pair.check(Sample(log, Settings(), None))
    return finding


def misplaced(
    log: SensorLog, turn_deg: tuple[float, float, float], shift_m: tuple[float, float, float]
) -> SensorLog:
    """The second LiDAR is said to be turned and moved from where it is, in the imu frame."""
    error: NDArray[np.float64] = np.eye(4)
    error[:3, :3], error[:3, 3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix(), shift_m
    (other,) = log.others
    return replace(log, others=(replace(other, T_imu_lidar=error @ other.T_imu_lidar),))


def told(finding: Finding) -> tuple[list[float], list[float]]:
    """The turn in degrees and the shift in metres of the evidence."""
    turn = finding.evidence.split("turned by ")[1].split(" deg")[0]
    shift = finding.evidence.split("moved by ")[1].split(" m")[0]
    return [float(word) for word in turn.split()], [float(word) for word in shift.split()]


def test_lidars_that_are_where_they_are_said_to_be_are_green(pair: SensorLog) -> None:
    finding = found(pair)
    assert (finding.check, finding.level) == ("right against left", Level.GREEN), finding
    assert float(finding.evidence.split(" lie ")[1].split(" m ")[0]) < 0.04


@pytest.mark.parametrize(
    ("turn_deg", "shift_m"),
    [
        ((1.5, 0, 0), (0, 0, 0)),
        ((0, 0, 0), (0, 0.3, 0)),
        pytest.param((0, 0, 2), (0, 0, 0), marks=pytest.mark.slow),
        pytest.param((0, 0, 0), (0, 0, 0.25), marks=pytest.mark.slow),
    ],
)
def test_a_wrong_pose_is_red_with_its_error(
    pair: SensorLog, turn_deg: tuple[float, float, float], shift_m: tuple[float, float, float]
) -> None:
    finding = found(misplaced(pair, turn_deg, shift_m))
    assert finding.level is Level.RED, finding
    assert "calibrated onto each other wrongly" in finding.mistake
    turn, shift = told(finding)
    np.testing.assert_allclose(turn, -np.array(turn_deg, float), atol=0.2)
    np.testing.assert_allclose(shift, -np.array(shift_m, float), atol=0.08)


@pytest.mark.slow
@pytest.mark.parametrize("turn_deg", [(30, 20, -40), (0, 0, 20), (25, 0, 0), (0, -30, 0), (0, 0, 180)])
def test_a_turn_that_is_far_off_is_red_with_its_error(
    pair: SensorLog, turn_deg: tuple[float, float, float]
) -> None:
    finding = found(misplaced(pair, turn_deg, (0, 0, 0)))
    assert finding.level is Level.RED, finding
    turn = Rotation.from_rotvec(told(finding)[0], degrees=True)
    rest = turn * Rotation.from_rotvec(turn_deg, degrees=True)
    assert np.degrees(rest.magnitude()) < 0.3


def test_one_lidar_has_nothing_to_be_compared_with(pair: SensorLog) -> None:
    assert list(lidar_pair.check(Sample(pair.by_lidar[1], Settings(), None))) == []

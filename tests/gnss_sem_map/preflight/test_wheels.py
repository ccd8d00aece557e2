"""Wheel speeds of another unit or clock are named before any work, with the setting that mends them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sensor_drives import SETTINGS, drive

from factor_graphs.measurements import ImuNoise, WheelSpeeds
from factor_graphs.simulation import random_drive, simulate_wheels
from gnss_sem_map.mapping.trajectory import smooth_log
from gnss_sem_map.preflight import wheels
from gnss_sem_map.preflight.findings import Finding, Level
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.sensor_log.conventions import SPEED_UNITS, SensorConventions

SECONDS = 120.0


@pytest.fixture(scope="module")
def right() -> SensorLog:
    motion = random_drive(SECONDS, np.random.default_rng(3))
    speeds = simulate_wheels(
        motion, np.arange(0.0, SECONDS, 0.05), scale=1.03, quantum_mps=0.05, signed=False
    )
    return replace(drive(3, SECONDS, ImuNoise()), wheels=speeds)


def findings(log: SensorLog, conventions: SensorConventions | None = None) -> list[Finding]:
    ours = log.in_our_conventions(conventions or SensorConventions())
    return list(wheels.check(Sample(ours, SETTINGS, None)))


def with_wheels(log: SensorLog, later_s: float = 0.0, factor: float = 1.0) -> SensorLog:
    assert log.wheels is not None
    return replace(log, wheels=WheelSpeeds(log.wheels.stamps + later_s, log.wheels.speeds * factor))


def test_right_wheels_are_green_and_none_are_not_spoken_of(right: SensorLog) -> None:
    assert [finding.level for finding in findings(right)] == [Level.GREEN] * 2
    assert findings(replace(right, wheels=None)) == []


@pytest.mark.parametrize("unit", ["km/h", "mph"])
def test_another_unit_is_named_and_its_setting_mends_it(right: SensorLog, unit: str) -> None:
    broken = with_wheels(right, factor=1 / SPEED_UNITS[unit])
    (found,) = (finding for finding in findings(broken) if finding.level is not Level.GREEN)
    assert found.level is Level.AMBER
    assert f"set speed_unit: {unit}" in str(found)
    mended = broken.in_our_conventions(SensorConventions(speed_unit=unit))
    assert mended.wheels is not None
    assert right.wheels is not None
    np.testing.assert_allclose(mended.wheels.speeds, right.wheels.speeds, atol=1e-12)
    assert [finding.level for finding in findings(mended)] == [Level.GREEN] * 2


@pytest.mark.parametrize(("later_s", "says"), [(30.0, "another clock or drive"), (1e4, "another clock")])
def test_another_clock_is_told(right: SensorLog, later_s: float, says: str) -> None:
    amber = [
        str(finding) for finding in findings(with_wheels(right, later_s)) if finding.level is Level.AMBER
    ]
    assert len(amber) == 1
    assert says in amber[0]


@pytest.mark.integration
def test_the_trajectory_stage_takes_them(right: SensorLog) -> None:
    solution = smooth_log(right.in_our_conventions(SensorConventions()), SETTINGS.trajectory)
    assert solution.wheels is not None
    assert solution.wheels.held
    assert abs(solution.wheels.scale - 1.03) < 3 * solution.wheels.stddevs[0]

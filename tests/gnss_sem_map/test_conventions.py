"""Axes, units and clocks that a drive says it has become ours, exactly, and once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import street
from scipy.spatial.transform import Rotation

from factor_graphs.measurements import GnssFixes, ImuSamples
from gnss_sem_map import config
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import ConfigError
from gnss_sem_map.sensor_log import Points, Scan, SensorLog
from gnss_sem_map.sensor_log.conventions import NAMED_AXES, SensorConventions, matrix_of

RNG = np.random.default_rng(0)
STAMPS = np.arange(20) * 0.1
IMU = ImuSamples(STAMPS, RNG.normal(size=(20, 3)), RNG.normal(size=(20, 3)))
FIXES = GnssFixes(STAMPS, RNG.normal(size=(20, 3)), np.ones((20, 3)))

AXES = [*NAMED_AXES, "-x -y z", "y -x z", "z x y", "-x y z", "x, -z, y"]


@pytest.mark.parametrize("axes", AXES)
def test_axes_take_every_vector_of_the_sensor_to_ours(axes: str) -> None:
    matrix = matrix_of(axes)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3))
    theirs = ImuSamples(STAMPS, IMU.specific_force @ matrix, IMU.angular_rate @ matrix)
    ours = SensorConventions(imu_axes=axes).imu_in_ours(theirs)
    np.testing.assert_array_equal(ours.specific_force, IMU.specific_force)
    np.testing.assert_array_equal(ours.angular_rate, IMU.angular_rate)


def test_frd_is_forward_right_down() -> None:
    np.testing.assert_array_equal(matrix_of("frd") @ [1.0, 2.0, 3.0], [1.0, -2.0, -3.0])


def test_rfu_is_right_forward_up() -> None:
    np.testing.assert_array_equal(matrix_of("rfu") @ [1.0, 2.0, 3.0], [2.0, -1.0, 3.0])


@pytest.mark.parametrize("axes", ["", "flo", "x y", "x x z", "x y z z", "x y -", "--x y z", "x y zz"])
def test_what_names_no_axes_is_refused_in_one_line(axes: str) -> None:
    with pytest.raises(ConfigError, match=r"sensors\.imu_axes") as caught:
        config.load(overrides=[f'sensors.imu_axes="{axes}"'])
    assert "\n" not in str(caught.value)


def test_units_become_ours() -> None:
    theirs = ImuSamples(STAMPS, IMU.specific_force / 9.80665, np.degrees(IMU.angular_rate))
    ours = SensorConventions(force_unit="g", rate_unit="deg/s").imu_in_ours(theirs)
    np.testing.assert_allclose(ours.specific_force, IMU.specific_force, rtol=1e-14)
    np.testing.assert_allclose(ours.angular_rate, IMU.angular_rate, rtol=1e-14)


def test_a_unit_that_is_mounted_askew_is_turned_by_its_attitude() -> None:
    R_ours_sensor = Rotation.from_euler("ZYX", [40.0, -10.0, 5.0], degrees=True)
    R = R_ours_sensor.as_matrix()
    theirs = ImuSamples(STAMPS, IMU.specific_force @ R, IMU.angular_rate @ R)
    ours = SensorConventions(imu_rotation_deg=(5.0, -10.0, 40.0)).imu_in_ours(theirs)
    np.testing.assert_allclose(ours.specific_force, IMU.specific_force, atol=1e-14)


def test_the_accelerometer_may_have_axes_of_its_own() -> None:
    theirs = ImuSamples(STAMPS, -IMU.specific_force, IMU.angular_rate)
    ours = SensorConventions(force_axes="-x -y -z").imu_in_ours(theirs)
    np.testing.assert_array_equal(ours.specific_force, IMU.specific_force)
    np.testing.assert_array_equal(ours.angular_rate, IMU.angular_rate)


def test_where_nothing_is_said_nothing_is_touched() -> None:
    assert SensorConventions().imu_in_ours(IMU) is IMU
    assert SensorConventions().on_our_clock(FIXES) is FIXES


def test_settings_win_over_the_drive_and_leave_the_rest_to_it() -> None:
    drive = SensorConventions(imu_axes="frd", force_unit="g")
    both = SensorConventions(imu_axes="flu").over(drive)
    assert (both.imu_axes, both.force_unit) == ("flu", "g")


def test_printed_settings_leave_everything_to_the_drive(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(config.load().to_yaml())
    drive = SensorConventions(imu_axes="frd", gnss_time_offset_s=-1.0)
    assert config.load(tmp_path / "config.yaml").sensors.over(drive) == drive


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> SensorLog:
    return open_drive(street.write(tmp_path_factory.mktemp("street"), frames=(0, 1, 2)).drive)


def test_a_log_is_converted_once(log: SensorLog) -> None:
    frd = SensorConventions(imu_axes="frd")
    once = log.in_our_conventions(frd)
    assert once.in_our_conventions(frd) is once
    assert log.imu is not None
    assert once.imu is not None
    np.testing.assert_array_equal(once.imu.specific_force, log.imu.specific_force * [1, -1, -1])


def test_clocks_are_shifted_with_everything_that_they_stamp(log: SensorLog) -> None:
    shifted = log.in_our_conventions(SensorConventions(gnss_time_offset_s=-1.0, lidar_time_offset_s=0.25))
    assert log.gnss is not None
    assert shifted.gnss is not None
    np.testing.assert_allclose(shifted.gnss.stamps, log.gnss.stamps - 1.0)
    for before, after in zip(log.scans, shifted.scans, strict=True):
        assert after.stamp == before.stamp + 0.25
        assert before.sweep is not None
        assert after.sweep == (before.sweep[0] + 0.25, before.sweep[1] + 0.25)
        was, now = before.read().stamps, after.read().stamps
        assert was is not None
        assert now is not None
        np.testing.assert_array_equal(now, was + 0.25)


def test_a_compensated_scan_stays_so(log: SensorLog) -> None:
    points = Points(np.zeros((1, 3), np.float32), np.zeros(1, np.float32), None)
    compensated = replace(log, scans=(Scan("0", 0, 1.0, lambda: points),))
    shifted = compensated.in_our_conventions(SensorConventions(lidar_time_offset_s=0.5))
    assert shifted.scans[0].stamp == 1.5
    assert shifted.scans[0].read().stamps is None


def test_log_yaml_says_the_same_in_flat_keys(tmp_path: Path) -> None:
    rows = "".join(f"{0.1 * k:.1f},0,0,-1,1,2,3\n" for k in range(3))
    (tmp_path / "imu.csv").write_text("stamp_s,ax,ay,az,wx,wy,wz\n" + rows)
    rows = "".join(f"{k},49,8.{k},100,1,1,1\n" for k in range(3))
    (tmp_path / "gnss.csv").write_text("stamp_s,lat_deg,lon_deg,alt_m,std_e_m,std_n_m,std_u_m\n" + rows)
    (tmp_path / "log.yaml").write_text("imu_axes: frd\nforce_unit: g\nrate_unit: deg/s\n")
    ours = open_drive(tmp_path).in_our_conventions(config.load().sensors)
    assert ours.imu is not None
    np.testing.assert_allclose(ours.imu.specific_force, [[0, 0, 9.80665]] * 3)
    np.testing.assert_allclose(ours.imu.angular_rate, np.radians([[1, -2, -3]] * 3))
    upside_down = config.load(overrides=["sensors.imu_axes=flu"]).sensors
    kept = open_drive(tmp_path).in_our_conventions(upside_down)
    assert kept.imu is not None
    np.testing.assert_allclose(kept.imu.specific_force, [[0, 0, -9.80665]] * 3)

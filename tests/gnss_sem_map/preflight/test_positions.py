"""What is wrong with fixes and given poses is named; what is only rare is left alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_drives import FRAME, LEVER, SETTINGS, drive, findings, wrong

from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import GnssFixes, ImuNoise, ImuSamples, clean_gnss, clean_imu
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.gnss_files import GnssFile, read_gnss_file
from gnss_sem_map.preflight import check
from gnss_sem_map.preflight.diagnosis import diagnose
from gnss_sem_map.preflight.findings import Level
from gnss_sem_map.preflight.fixes import examine
from gnss_sem_map.sensor_log import Calibration, SensorLog, Skip
from gnss_sem_map.sensor_log.conventions import SensorConventions
from gnss_sem_map.simulation import Camera, Lidar, prepare
from gnss_sem_map.simulation.table_drive import write_table

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def right() -> SensorLog:
    return drive(4, 120.0, ImuNoise())


def fixes_of(log: SensorLog) -> GnssFixes:
    assert log.gnss is not None
    return log.gnss


def moved(log: SensorLog, positions: Array) -> SensorLog:
    fixes = fixes_of(log)
    return replace(log, gnss=GnssFixes(fixes.stamps, positions, fixes.stddevs))


def written(log: SensorLog, lat: Array, lon: Array, alt: Array) -> SensorLog:
    """The drive as a reader finds it whose columns hold these numbers."""
    fixes, frame = fixes_of(log), LocalFrame(float(lat[0]), float(lon[0]), float(alt[0]))
    return replace(log, frame=frame, gnss=GnssFixes(fixes.stamps, frame.to_map(lat, lon, alt), fixes.stddevs))


def test_swapped_columns_mirror_the_track(right: SensorLog) -> None:
    lat, lon, alt = FRAME.to_geodetic(fixes_of(right).positions)
    assert any("swapped" in said for said in wrong(findings(written(right, lon, lat, alt))))


def test_radians_lie_at_sea(right: SensorLog) -> None:
    lat, lon, alt = FRAME.to_geodetic(fixes_of(right).positions)
    said = wrong(findings(written(right, np.radians(lat), np.radians(lon), alt)))
    assert len(said) == 1
    assert "radians" in said[0]


def test_heights_that_wander_farther_than_streets_climb_are_told(right: SensorLog) -> None:
    """A street of 12 % is none of that, nor are fixes that claim to be so poor."""
    fixes = fixes_of(right)
    climb = 0.4 * float(np.linalg.norm(np.ptp(fixes.positions[:, :2], axis=0)))

    def said(share: float, stddev: float) -> str:
        up = np.linspace(0.0, share * climb, len(fixes))
        positions = np.column_stack([fixes.positions[:, :2], up])
        stddevs = np.tile([1.0, 1.0, stddev], (len(fixes), 1))
        log = replace(right, gnss=GnssFixes(fixes.stamps, positions, stddevs))
        return next(str(found) for found in findings(log) if found.check == "GNSS height")

    assert "the heights wander" in said(1.0, 2.0)
    assert "wander" not in said(0.3, 2.0)
    assert "wander" not in said(1.0, climb)


@pytest.mark.parametrize("height", [3.0, *(pytest.param(m, marks=pytest.mark.slow) for m in (115.0, -20.0))])
def test_heights_in_millimetres_are_no_road(right: SensorLog, height: float) -> None:
    lat, lon, alt = FRAME.to_geodetic(fixes_of(right).positions)
    said = wrong(findings(written(right, lat, lon, 1000.0 * (alt - FRAME.alt_m + height))))
    assert any("altitude is in mm" in line for line in said)


@pytest.mark.parametrize("late_s", [-1.0, *(pytest.param(s, marks=pytest.mark.slow) for s in (0.5, 2.0))])
def test_a_late_clock_is_found_and_its_setting_mends_it(right: SensorLog, late_s: float) -> None:
    fixes = fixes_of(right)
    late = replace(right, gnss=GnssFixes(fixes.stamps + late_s, fixes.positions, fixes.stddevs))
    said = [line for line in wrong(findings(late)) if "gnss_time_offset_s" in line]
    assert len(said) == 1
    offset = float(said[0].split("gnss_time_offset_s: ")[1])
    assert offset == pytest.approx(-late_s, abs=0.2)
    assert wrong(findings(late, SensorConventions(gnss_time_offset_s=offset))) == []


def test_a_remedy_says_on_top_of_what_it_comes(right: SensorLog) -> None:
    """The checks look at what the settings have made: set as it stands, the remedy would undo them."""
    settings = SETTINGS.changed("sensors.gnss_time_offset_s=1.0", "sensors.imu_axes=frd")
    said = [finding.remedy for finding in check(right, settings).findings]
    assert "set imu_axes: frd; this is on top of imu_axes: frd, which is set now" in said
    [clock] = [remedy for remedy in said if "gnss_time_offset_s" in remedy]
    found, _, told = clock.partition("; this is on top of ")
    assert float(found.split("gnss_time_offset_s: ")[1]) == pytest.approx(-1.0, abs=0.2)
    assert told == "gnss_time_offset_s: 1.0, which is set now"
    assert not any("on top of" in finding.remedy for finding in check(right, SETTINGS).findings)


@pytest.mark.parametrize("stamps", [lambda t: 1000 * t + 200, lambda t: t + 86400])
def test_fixes_of_another_time_than_the_imu_are_red(
    right: SensorLog, stamps: Callable[[Array], Array]
) -> None:
    """As `run` refuses them, which finds none to smooth with: stamps in milliseconds, and those of another day."""
    fixes = fixes_of(right)
    apart = replace(right, gnss=GnssFixes(stamps(fixes.stamps), fixes.positions, fixes.stddevs))
    [said] = [each for each in findings(apart) if each.check == "GNSS with IMU"]
    assert said.level is Level.RED
    assert "0 usable GNSS fixes" in said.evidence
    assert not [each for each in findings(apart) if each.check == "break"], "another clock is no other drive"
    assert not [each for each in findings(right) if each.check == "GNSS with IMU"]


@pytest.mark.parametrize(("pause_s", "says"), [(500.0, 0), (700.0, 1)])
def test_two_drives_in_one_log_are_told(right: SensorLog, pause_s: float, says: int) -> None:
    """Bags of two drives in one folder: smoothed as one, they take all memory, or the optimiser fails."""
    assert right.imu is not None
    fixes, imu = fixes_of(right), right.imu

    def later(stamps: Array) -> Array:
        return stamps + pause_s * (stamps >= 60.0)

    paused = replace(
        right,
        gnss=GnssFixes(later(fixes.stamps), fixes.positions, fixes.stddevs),
        imu=ImuSamples(later(imu.stamps), imu.specific_force, imu.angular_rate),
    )
    found = [each for each in findings(paused) if each.check == "break"]
    assert [each.level for each in found] == [Level.RED] * says
    assert all("several drives" in each.mistake and "run DRIVE DRIVE" in each.remedy for each in found)


@pytest.mark.parametrize(("start", "seconds"), [(20.0, 10.0), (30.0, 30.0), (80.0, 60.0), (0.0, 200.0)])
def test_a_frozen_receiver_is_told_from_a_standing_vehicle(
    right: SensorLog, start: float, seconds: float
) -> None:
    fixes = fixes_of(right)
    inside = (fixes.stamps >= start) & (fixes.stamps <= start + seconds)
    positions = fixes.positions.copy()
    positions[inside] = positions[inside][0]
    said = wrong(findings(moved(right, positions)))
    assert any("frozen" in line for line in said)


@pytest.mark.parametrize(
    ("per_degree", "is_coarse"),
    [
        (1e5, True),
        (6e5, False),
        pytest.param(6e4, True, marks=pytest.mark.slow),
        pytest.param(1e8, False, marks=pytest.mark.slow),
    ],
)
def test_rounded_degrees_are_not_called_frozen(right: SensorLog, per_degree: float, is_coarse: bool) -> None:
    """Five fixes a second, of which several have the same place at 10 km/h; four or five decimals are told."""
    seen = fixes_of(right)
    stamps = np.arange(seen.stamps[0], seen.stamps[-1], 0.2)
    positions = np.column_stack([np.interp(stamps, seen.stamps, axis) for axis in seen.positions.T])
    lat, lon, alt = FRAME.to_geodetic(positions)
    rounded = FRAME.to_map(
        np.round(lat * per_degree) / per_degree, np.round(lon * per_degree) / per_degree, alt
    )
    log = replace(right, gnss=GnssFixes(stamps, rounded, np.full((len(stamps), 3), 2.0)))
    found = [each for each in findings(log) if each.check == "GNSS frozen"]
    assert [each.level for each in found] == [Level.AMBER if is_coarse else Level.GREEN]
    assert not any("repeats its last position" in str(each) for each in found)


def test_a_receiver_that_holds_its_place_while_the_vehicle_stands_is_not_frozen() -> None:
    standing = drive(4, 120.0, ImuNoise())
    fixes = fixes_of(standing)
    assert standing.imu is not None
    rest = standing.imu.specific_force[:1].repeat(len(standing.imu), axis=0)
    still = replace(standing.imu, specific_force=rest, angular_rate=np.zeros_like(rest))
    held = moved(standing, fixes.positions[:1].repeat(len(fixes), axis=0))
    assert not any("frozen" in line for line in wrong(findings(replace(held, imu=still))))


@pytest.mark.parametrize("factor", [0.01, pytest.param(0.001, marks=pytest.mark.slow)])
def test_standard_deviations_that_nobody_reaches_are_told_of(right: SensorLog, factor: float) -> None:
    fixes = fixes_of(right)
    sure = replace(right, gnss=GnssFixes(fixes.stamps, fixes.positions, fixes.stddevs * factor))
    assert any("standard deviations are too small" in line for line in wrong(findings(sure)))


def test_rows_without_an_accuracy_are_told_of(right: SensorLog) -> None:
    skips = (Skip("gnss", "gnss.csv", "7 rows with a standard deviation that is not above 0"),)
    assert any("negative" in line for line in wrong(findings(replace(right, skips=skips))))


def test_a_lever_arm_in_millimetres_is_longer_than_any_vehicle(right: SensorLog) -> None:
    calibration = Calibration(np.eye(4), p_imu_antenna=np.array(LEVER) * 1000.0)
    assert any(
        "lever arm is in mm" in line for line in wrong(findings(replace(right, calibration=calibration)))
    )


@pytest.mark.parametrize("off", [(2.0, 0.0, 0.0), (0.0, -2.0, 0.0)])
def test_an_antenna_elsewhere_is_found_in_the_turns(off: tuple[float, float, float]) -> None:
    good = drive(4, 120.0, ImuNoise(), stddev_m=0.02, every_s=0.2)
    assert wrong(findings(good)) == []
    calibration = Calibration(np.eye(4), p_imu_antenna=np.array(LEVER) + off)
    assert any("antenna" in line for line in wrong(findings(replace(good, calibration=calibration))))


@pytest.mark.parametrize("seconds", [10.0, 100.0])
def test_stamps_may_be_unix_time(seconds: float) -> None:
    """There, a float is no finer than 0.2 us."""
    log, unix_s = drive(4, seconds, ImuNoise()), 1_700_000_000.0
    assert log.imu is not None
    fixes, imu = fixes_of(log), log.imu
    dated = replace(
        log,
        imu=ImuSamples(imu.stamps + unix_s, imu.specific_force, imu.angular_rate),
        gnss=GnssFixes(fixes.stamps + unix_s, fixes.positions, fixes.stddevs),
    )
    assert [(one.check, one.level) for one in findings(dated)] == [
        (one.check, one.level) for one in findings(log)
    ]


def test_single_outliers_are_left_to_the_smoother(right: SensorLog) -> None:
    positions = fixes_of(right).positions.copy()
    positions[[20, 55], 0] += 1000.0
    assert wrong(findings(moved(right, positions))) == []


def poses(seconds: float = 20.0) -> Trajectory:
    """A vehicle on a circle at 8 m/s, ten poses a second, looking ahead."""
    stamps = np.arange(0.0, seconds, 0.1)
    heading = 0.2 * stamps
    T = np.tile(np.eye(4), (len(stamps), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("z", heading[:, None]).as_matrix()
    T[:, :2, 3] = 40.0 * np.column_stack([np.sin(heading), 1 - np.cos(heading)])
    return Trajectory(stamps, T)


def given(T: Array) -> SensorLog:
    return SensorLog("x", 0, Calibration(np.eye(4)), (), (), given=Trajectory(poses().stamps, T))


def test_poses_of_a_vehicle_are_green() -> None:
    assert wrong(findings(given(poses().T_map_imu))) == []


@pytest.mark.parametrize("jump_m", [5.0, 1000.0])
@pytest.mark.parametrize("rows", [slice(100, None), slice(100, 101), slice(0, 1)])
def test_poses_that_jump_are_named(jump_m: float, rows: slice) -> None:
    T = poses().T_map_imu.copy()
    T[rows, 0, 3] += jump_m
    assert any("jump" in line for line in wrong(findings(given(T))))


def test_a_pose_that_is_turned_is_named() -> None:
    T = poses().T_map_imu.copy()
    T[100, :3, :3] = T[100, :3, :3] @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
    assert any("rotations jump" in line for line in wrong(findings(given(T))))


def test_poses_in_millimetres_are_named() -> None:
    T = poses().T_map_imu.copy()
    T[:, :3, 3] *= 1000.0
    assert any("unit" in line for line in wrong(findings(given(T))))


def test_poses_of_a_camera_look_aside() -> None:
    T = poses().T_map_imu.copy()
    T[:, :3, :3] = T[:, :3, :3] @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    assert any("other axes" in line for line in wrong(findings(given(T))))


@pytest.mark.slow
@pytest.mark.parametrize("shift_s", [18.0, -18.0])
@pytest.mark.parametrize("seed", [0, 6])
def test_gps_time_in_place_of_utc_is_found(seed: int, shift_s: float) -> None:
    log = drive(seed, 120.0, ImuNoise())
    fixes = GnssFixes(fixes_of(log).stamps + shift_s, fixes_of(log).positions, fixes_of(log).stddevs)
    [told] = [text for text in wrong(findings(replace(log, gnss=fixes))) if text.startswith("GNSS clock")]
    assert ("they are GPS time where UTC" if shift_s > 0 else "they are UTC where GPS time") in told
    offset = float(told.rpartition("gnss_time_offset_s: ")[2])
    assert abs(offset + shift_s) < 0.25
    assert not [text for text in wrong(findings(log)) if text.startswith("GNSS clock")]


def test_a_log_of_three_seconds_tells_nothing_of_the_clock(tmp_path: Path) -> None:
    """By chance the fixes of this one agree best with the IMU 0.68 s after their stamps."""
    small = Lidar(np.radians([-5.0, -10.0]), columns=60, range_m=50.0, blind_m=1.0)
    short = prepare(1.5, 3, small, Camera(width=64, height=32))
    log = open_drive(write_table(short, tmp_path))
    [clock] = [one for one in findings(log) if one.check == "GNSS clock"]
    assert clock.evidence.startswith("not observable")


def test_the_clock_of_one_who_walks_cannot_be_told_by_his_turns(real_data: Path) -> None:
    """His course turns half a second before the IMU in his hand; graph and fixed ambiguities say 0.02 s."""
    folder = real_data / "gnss_imu_walk"
    rows = np.loadtxt(folder / "imu_1730_sf.csv", delimiter=",", usecols=range(7))
    epoch_ns = round(rows[0, 0] * 1e9)
    about = GnssFile(path="gnss_1730_sf.pos", time="utc")
    found = read_gnss_file(about, folder, epoch_ns, (epoch_ns, round(rows[-1, 0] * 1e9))).rows
    frame = LocalFrame(*found[0, 1:4].tolist())
    imu, _ = clean_imu(rows[:, 0] - rows[0, 0], rows[:, 1:4] * 9.80665, rows[:, 4:7])
    fixes, _ = clean_gnss(found[:, 0], frame.to_map(*found[:, 1:4].T), found[:, 4:7])
    lag = diagnose(imu, examine(fixes, frame, imu, 70.0).usable, frame, None).lag
    assert not lag.is_certain
    assert not lag.observable

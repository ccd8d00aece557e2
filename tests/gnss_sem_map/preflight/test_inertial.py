"""Every wrong convention of the IMU is named, with the setting that gives the original samples back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_drives import FRAME, SETTINGS, drive, findings, wrong

from factor_graphs.measurements import ImuNoise, ImuSamples
from factor_graphs.simulation import follow, simulate_gnss, simulate_imu
from gnss_sem_map.mapping.trajectory import smooth_log
from gnss_sem_map.preflight.findings import Level
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.sensor_log import Calibration, SensorLog
from gnss_sem_map.sensor_log.conventions import SensorConventions, matrix_of

Array = NDArray[np.float64]


def reporting(log: SensorLog, force: Array, rate: Array) -> SensorLog:
    """The same drive with an IMU whose columns are these combinations of the right ones."""
    assert log.imu is not None
    imu = log.imu
    return replace(log, imu=ImuSamples(imu.stamps, imu.specific_force @ force.T, imu.angular_rate @ rate.T))


@pytest.fixture(scope="module")
def right() -> SensorLog:
    return drive(3, 120.0, ImuNoise())


@pytest.mark.parametrize(
    ("seed", "seconds"),
    [
        (0, 3.0),
        (1, 20.0),
        (2, 60.0),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in ((3, 20.0), (1, 150.0), (3, 150.0))),
    ],
)
def test_a_good_drive_is_green(seed: int, seconds: float) -> None:
    outages = [(seconds * 0.5, seconds * 0.7)] if seed % 2 else []
    noise = ImuNoise() if seed < 3 else ImuNoise().scaled(5.0)
    assert wrong(findings(drive(seed, seconds, noise, outages=outages))) == []


@pytest.mark.parametrize("speeds", [(0.0, 0.0, 0.0), (20.0, 20.0, 20.0), (0.0, 25.0, 0.0)])
def test_standing_and_driving_straight_are_green(speeds: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    way = np.column_stack([np.linspace(0, 2000, 40), np.linspace(0, 900, 40), np.zeros(40)])
    motion = follow(way, [0.0, 30.0, 60.0], speeds, 0.3)
    imu = simulate_imu(motion, np.arange(0.0, 60.0, 0.01), FRAME, ImuNoise(), rng)
    fixes = simulate_gnss(motion, np.arange(0.3, 59.5, 1.0), (1.0, 1.0, 2.0), rng=rng)
    assert wrong(findings(SensorLog("x", 0, Calibration(np.eye(4)), (), (), FRAME, imu, fixes))) == []


def test_of_a_unit_on_its_side_that_stands_only_the_axis_that_points_up_is_named() -> None:
    log = drive(0, 20.0, ImuNoise())
    assert log.imu is not None
    still = ImuSamples(log.imu.stamps, np.tile([0.0, 9.81, 0.0], (len(log.imu), 1)), 0 * log.imu.angular_rate)
    fixes = replace(log.gnss, positions=np.zeros_like(log.gnss.positions)) if log.gnss is not None else None
    (found,) = (f for f in findings(replace(log, imu=still, gnss=fixes)) if f.check == "IMU axes")
    assert (found.level, "y axis points up" in found.mistake) == (Level.RED, True)
    ways = [matrix_of(axes) for axes in found.remedy.split('"')[1::2]]
    assert len(ways) == 4
    assert all(
        np.array_equal(way @ [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]) and np.linalg.det(way) > 0 for way in ways
    )


def test_the_heading_of_a_slow_unit_is_compared_with_its_course() -> None:
    """It speeds up less than fixes of a metre show, so only the smoothed heading tells that x points right."""
    rng = np.random.default_rng(1)
    way = np.arange(0.0, 400.0)
    points = np.column_stack([way, 8 * np.sin(way / 8), np.zeros(len(way))])
    motion = follow(points, [0.0, 5.0, 240.0], [0.0, 1.0, 1.0], 0.2)
    imu = simulate_imu(motion, np.arange(0.0, 240.0, 0.04), FRAME, ImuNoise(), rng)
    fixes = simulate_gnss(motion, np.arange(0.3, 239.5, 1.0), (1.0, 1.0, 2.0), rng=rng)
    right = SensorLog("x", 0, Calibration(np.eye(4)), (), (), FRAME, imu, fixes)
    aside = matrix_of("-y x z")  # x points to the right
    for log, expected in ((right, []), (reporting(right, aside, aside), ["IMU mounting"])):
        found = [f for f in findings(log) if f.level is not Level.GREEN]
        assert [f.check for f in found] == expected
        if found:
            yaw = float(found[0].remedy.split(",")[-1].strip(" ]"))
            assert abs(yaw + 90) < 10


ONE = np.eye(3)
BY_AXES = ["frd", "-x -y z", "y -x z", "-y x z", "-x y -z", "x -z y", "-z y x"]
CASES: dict[str, tuple[Array, Array, str, SensorConventions]] = {
    "gravity flipped": (-ONE, ONE, "gravity", SensorConventions(force_axes="-x -y -z")),
    "gyroscope reversed": (ONE, -ONE, "wrong way", SensorConventions(rate_axes="-x -y -z")),
    "x reversed": (np.diag([-1.0, 1, 1]), ONE, "x points backwards", SensorConventions(force_axes="-x y z")),
    "g": (ONE / 9.80665, ONE, "in g", SensorConventions(force_unit="g")),
    "mg": (ONE / 9.80665e-3, ONE, "in mg", SensorConventions(force_unit="mg")),
    "deg/s": (ONE, np.degrees(ONE), "deg/s", SensorConventions(rate_unit="deg/s")),
} | {
    axes: (matrix_of(axes).T, matrix_of(axes).T, f"imu_axes: {axes}", SensorConventions(imu_axes=axes))
    for axes in BY_AXES
}


@pytest.mark.parametrize(
    "scale", [1.0, pytest.param(4.0, marks=pytest.mark.slow), pytest.param(0.3, marks=pytest.mark.slow)]
)
def test_a_force_without_gravity_is_not_called_g(right: SensorLog, scale: float) -> None:
    """Whatever its size: of a hard drive its median is near 1, as of a force in g."""
    assert right.imu is not None
    imu = right.imu
    linear = scale * (imu.specific_force - [0.0, 0.0, 9.81])
    said = [str(f) for f in findings(replace(right, imu=ImuSamples(imu.stamps, linear, imu.angular_rate)))]
    assert any("gravity was taken out of the force" in line for line in said)
    assert not any("force_unit" in line for line in said)


def test_a_drive_that_is_all_in_reverse_is_one_of_the_reasons(right: SensorLog) -> None:
    turned = np.diag([-1.0, -1.0, 1.0])
    said = [str(f) for f in findings(reporting(right, turned, turned)) if f.level is Level.RED]
    assert any("or all of the drive is in reverse" in line for line in said)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in BY_AXES[3:])) for name in CASES]
)
def test_a_wrong_convention_is_named_and_its_setting_mends_it(name: str, right: SensorLog) -> None:
    force, rate, says, correction = CASES[name]
    broken = reporting(right, force, rate)
    found = findings(broken)
    assert any(says in str(f).replace('"', "") for f in found if f.level is Level.RED), found
    assert wrong(findings(broken, correction)) == []
    corrected = broken.in_our_conventions(correction).imu
    assert corrected is not None
    assert right.imu is not None
    np.testing.assert_allclose(corrected.specific_force, right.imu.specific_force, atol=1e-12)
    np.testing.assert_allclose(corrected.angular_rate, right.imu.angular_rate, atol=1e-12)


@pytest.mark.parametrize(
    "angles",
    [
        (-12.0, 8.0, -35.0),
        *(
            pytest.param(one, marks=pytest.mark.slow)
            for one in ((0.0, 0.0, 40.0), (0.0, 15.0, 0.0), (30.0, 0.0, 0.0))
        ),
    ],
)
def test_a_unit_that_is_mounted_askew_is_found_with_its_angles(
    angles: tuple[float, float, float], right: SensorLog
) -> None:
    roll, pitch, yaw = angles
    R_ours_sensor = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
    askew = reporting(right, R_ours_sensor.T, R_ours_sensor.T)
    said = [f for f in findings(askew) if f.check == "IMU mounting" and f.level is not Level.GREEN]
    assert len(said) == 1
    told = [float(word) for word in said[0].remedy.split("[")[1].rstrip("]").split(",")]
    np.testing.assert_allclose(told, angles, atol=4.0)
    corrected = SensorConventions(imu_rotation_deg=(told[0], told[1], told[2]))
    assert wrong(findings(askew, corrected)) == []


def test_two_mistakes_are_named_together(right: SensorLog) -> None:
    frd = matrix_of("frd")
    broken = reporting(right, frd / 9.80665, np.degrees(frd))
    said = " ".join(wrong(findings(broken)))
    assert all(words in said for words in ("force_unit: g", "rate_unit: deg/s", "imu_axes: frd"))
    correction = SensorConventions(imu_axes="frd", force_unit="g", rate_unit="deg/s")
    assert wrong(findings(broken, correction)) == []


def test_ten_samples_a_second_are_told_of_and_no_fault(right: SensorLog) -> None:
    assert right.imu is not None
    every = slice(None, None, 10)
    imu = ImuSamples(right.imu.stamps[every], right.imu.specific_force[every], right.imu.angular_rate[every])
    found = findings(replace(right, imu=imu))
    assert any("10 Hz: noise is read off the samples" in f.evidence for f in found)
    assert wrong(found) == []


@pytest.mark.parametrize("seconds", [20.0, 120.0])
def test_other_checks_see_the_trajectory_of_the_mended_unit(seconds: float) -> None:
    right, frd = drive(3, seconds, ImuNoise()), matrix_of("frd")
    good, bad = (Sample(log, SETTINGS, None) for log in (right, reporting(right, frd, frd)))
    assert good.trajectory is not None
    assert bad.trajectory is not None
    np.testing.assert_array_equal(bad.trajectory.T_map_imu, good.trajectory.T_map_imu)
    assert bad.whole_solution is None


def test_a_run_takes_over_the_trajectory_of_a_short_drive_that_is_right() -> None:
    short, long = (Sample(drive(3, seconds, ImuNoise()), SETTINGS, None) for seconds in (20.0, 120.0))
    assert short.whole_solution is not None
    assert long.whole_solution is None
    alone = smooth_log(short.log, SETTINGS.trajectory).trajectory
    np.testing.assert_array_equal(short.whole_solution.trajectory.T_map_imu, alone.T_map_imu)

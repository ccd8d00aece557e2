"""A trajectory in a file, with a log: what it must be the same as, and what is refused or said."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sensor_drives import FRAME, LEVER, drive, findings, wrong

from factor_graphs.errors import MeasurementError
from factor_graphs.geodesy import LocalFrame
from factor_graphs.simulation import random_drive
from factor_graphs.trajectory import Trajectory
from factor_graphs.tum import write_tum
from gnss_sem_map.datasets.given_trajectory import along
from gnss_sem_map.errors import DataError
from gnss_sem_map.export.navigation import write_sbet
from gnss_sem_map.sensor_log import Points, Scan, SensorLog

EPOCH_NS = 1_776_504_600_110_073_513
SEED, SECONDS = 5, 60.0
STAMPS = np.arange(0.0, SECONDS, 0.02)


def truth(seed: int = SEED) -> Trajectory:
    return Trajectory(STAMPS, random_drive(SECONDS, np.random.default_rng(seed)).poses(STAMPS))


TRUTH = truth()


def never_read() -> Points:
    raise AssertionError


def log(**changes: object) -> SensorLog:
    """The drive with 600 scans that nobody reads."""
    scans = tuple(Scan(f"{k:010d}", k, 0.05 + 0.1 * k, never_read) for k in range(599))
    return replace(drive(SEED), epoch_ns=EPOCH_NS, scans=scans, **changes)


def without_imu() -> SensorLog:
    return log(imu=None, gnss=None, frame=None)


def tum(folder: Path, trajectory: Trajectory, shift_s: float = 0.0, name: str = "poses.tum") -> Path:
    write_tum(replace(trajectory, stamps=trajectory.stamps + shift_s), folder / name)
    return folder / name


def rows_changed(file: Path, change: Callable[[np.ndarray], object]) -> Path:
    rows = np.loadtxt(file)
    changed = change(rows)
    np.savetxt(file, rows if changed is None else changed, fmt="%.9f")
    return file


def given(log: SensorLog, file: Path) -> Trajectory:
    found = along(log, file).given
    assert found is not None
    return found


@pytest.mark.parametrize(("shift_s", "said"), [(0.0, "seconds of the log"), (EPOCH_NS * 1e-9, "Unix time")])
def test_stamps_are_of_the_log_or_unix_time(tmp_path: Path, shift_s: float, said: str) -> None:
    found = along(log(), tum(tmp_path, TRUTH, shift_s))
    assert said in found.given_how
    assert "in the frame of the fixes" in found.given_how
    assert found.given is not None
    np.testing.assert_allclose(found.given.stamps, STAMPS, atol=5e-7)
    np.testing.assert_allclose(found.given.T_map_imu, TRUTH.T_map_imu, atol=1e-6)
    assert not wrong(findings(found))


def test_an_sbet_comes_back(tmp_path: Path) -> None:
    write_sbet(TRUTH, FRAME, EPOCH_NS, tmp_path / "t.sbet")
    found = given(log(), tmp_path / "t.sbet")
    np.testing.assert_allclose(found.stamps, STAMPS, atol=1e-6)
    np.testing.assert_allclose(found.T_map_imu, TRUTH.T_map_imu, atol=1e-6)


def test_an_sbet_gives_a_log_without_a_receiver_its_origin(tmp_path: Path) -> None:
    write_sbet(TRUTH, FRAME, EPOCH_NS, tmp_path / "t.out")
    found = along(without_imu(), tmp_path / "t.out")
    assert found.frame is not None
    assert found.given is not None
    np.testing.assert_allclose(
        found.frame.to_geodetic(found.given.positions), FRAME.to_geodetic(TRUTH.positions), atol=1e-8
    )


def test_a_wander_angle_is_taken_from_the_platforms_heading(tmp_path: Path) -> None:
    write_sbet(TRUTH, FRAME, EPOCH_NS, tmp_path / "t.sbet")
    rows = np.fromfile(tmp_path / "t.sbet", "<f8").reshape(-1, 17)
    rows[:, 9:11] += 0.3
    rows.tofile(tmp_path / "t.sbet")
    np.testing.assert_allclose(given(log(), tmp_path / "t.sbet").T_map_imu, TRUTH.T_map_imu, atol=1e-6)


def test_a_table_of_a_run_has_the_clock_and_the_origin_of_its_run_json(tmp_path: Path) -> None:
    other = LocalFrame(FRAME.lat_deg + 0.01, FRAME.lon_deg - 0.02, 90.0)
    covariances = np.tile(np.eye(6), (len(TRUTH), 1, 1))
    moved = replace(TRUTH.moved(other.pose_of(FRAME)), stamps=STAMPS - 7.0, covariances=covariances)
    moved.save(tmp_path / "trajectory.parquet")
    about = {"epoch_ns": EPOCH_NS + 7_000_000_000, "local_frame": vars(other)}
    (tmp_path / "run.json").write_text(json.dumps(about))
    found = given(log(), tmp_path / "trajectory.parquet")
    np.testing.assert_allclose(found.stamps, STAMPS, atol=1e-9)
    np.testing.assert_allclose(found.T_map_imu, TRUTH.T_map_imu, atol=1e-6)
    np.testing.assert_array_equal(found.covariances, covariances)


@pytest.mark.parametrize("roll_deg", [0.0, 8.0])
def test_a_frame_of_its_own_is_fitted_to_the_fixes(tmp_path: Path, roll_deg: float) -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [77.0, 0.0, roll_deg], degrees=True).as_matrix()
    T[:3, 3] = 1000.0, -300.0, 55.0
    found = along(log(), tum(tmp_path, TRUTH.moved(T)))
    assert "fitted to" in found.given_how
    assert found.given is not None
    assert np.linalg.norm(found.given.positions - TRUTH.positions, axis=1).max() < 2.0  # fixes of 1 m
    assert not wrong(findings(found))


def test_without_a_receiver_the_map_is_local(tmp_path: Path) -> None:
    found = along(without_imu(), tum(tmp_path, TRUTH))
    assert found.frame is None
    assert "without a georeference" in found.given_how
    found.check_located()


def test_scans_without_a_pose_are_left_out_and_counted(tmp_path: Path) -> None:
    some = TRUTH[(STAMPS > 10.0) & ((STAMPS < 20.0) | (STAMPS > 22.0)) & (STAMPS < 50.0)]
    found = along(log(), tum(tmp_path, some))
    stamps = np.array([scan.stamp for scan in found.scans])
    assert ((stamps > 10.0) & ((stamps < 20.0) | (stamps > 22.0)) & (stamps < 50.0)).all()
    assert [(skip.what, skip.frames) for skip in found.skips] == [("scan", 199), ("scan", 20)]
    assert len(found.scans) + sum(skip.frames for skip in found.skips) == 599


FAULTS: dict[str, tuple[Callable[[np.ndarray], object], str]] = {
    "a number that is none": (
        lambda rows: rows.__setitem__((7, 2), np.nan),
        "line 8: found .*expected 8 finite",
    ),
    "not sorted": (lambda rows: rows[::-1], "pose 2.*not later than the one before.*2999 of 3000 poses"),
    "repeated": (lambda rows: np.vstack([rows[:5], rows[4:]]), "pose 6, at 0.08 s.*not later.*1 of 3001"),
    "not of length one": (lambda rows: rows.__setitem__((9, 6), 3.0), "pose 10.*quaternion.*1 of 3000"),
    "one pose": (lambda rows: rows[10:11], "found one pose"),
    "of another day": (
        lambda rows: rows.__setitem__((slice(None), 0), rows[:, 0] + 86_400.0),
        "no time in common",
    ),
    "far away": (lambda rows: rows.__setitem__((3, 1), 1e13), "pose 4.*beyond"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_file_with_a_fault_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    change, message = FAULTS[name]
    file = rows_changed(tum(tmp_path, TRUTH), change)
    with pytest.raises(DataError, match=message) as error:
        along(log(), file)
    assert "\n" not in str(error.value)
    assert str(file) in str(error.value)


CONTENTS: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "empty; expected one line of 8 numbers"),
    "comments": (b"# stamp tx ty tz qx qy qz qw\n\n", "empty; expected one line of 8 numbers"),
    "binary": (bytes(range(256)) * 40, "line 1: found .*expected 8 finite numbers"),
    "seven numbers": (b"1 2 3 4 0 0 1\n", "line 1.*expected 8 finite numbers"),
}


@pytest.mark.parametrize("name", CONTENTS)
def test_what_is_no_trajectory_is_refused(tmp_path: Path, name: str) -> None:
    content, message = CONTENTS[name]
    (tmp_path / "poses.tum").write_bytes(content)
    with pytest.raises(DataError, match=message):
        along(log(), tmp_path / "poses.tum")


@pytest.mark.parametrize("name", ["poses.tum", "poses.sbet", "poses.parquet"])
def test_a_huge_file_is_not_read(tmp_path: Path, name: str) -> None:
    with (tmp_path / name).open("wb") as file:
        file.truncate((1 << 30) + 17 * 8)
    with pytest.raises((DataError, MeasurementError), match="expected at most"):
        along(log(), tmp_path / name)


def test_a_missing_file_and_a_truncated_sbet_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        along(log(), tmp_path / "poses.tum")
    (tmp_path / "poses.sbet").write_bytes(b"\0" * 1000)
    with pytest.raises(DataError, match="truncated"):
        along(log(), tmp_path / "poses.sbet")
    (tmp_path / "poses.parquet").write_bytes(b"PAR1")
    with pytest.raises(MeasurementError, match="not a Parquet file"):
        along(log(), tmp_path / "poses.parquet")


@pytest.mark.parametrize("one", [log, without_imu])
@pytest.mark.parametrize("seed", [SEED, 6, 7])
def test_a_file_with_qw_first_is_named(tmp_path: Path, one: Callable[[], SensorLog], seed: int) -> None:
    file = tum(tmp_path, truth(seed))
    this = one() if one is without_imu else replace(one(), imu=drive(seed).imu, gnss=drive(seed).gnss)
    along(this, file)  # as it should be
    rows_changed(file, lambda rows: rows[:, [0, 1, 2, 3, 7, 4, 5, 6]])
    with pytest.raises(DataError, match="looks like qw first"):
        along(this, file)


def of(log: SensorLog, file: Path) -> str:
    return " | ".join(wrong(findings(along(log, file))))


def test_a_trajectory_of_another_drive_is_red(tmp_path: Path) -> None:
    found = of(log(), tum(tmp_path, truth(SEED + 1)))
    assert "Poses with IMU" in found
    assert "another drive" in found
    assert "Poses with GNSS" in found


@pytest.mark.parametrize(
    ("late_s", "said"), [(0.4, "0.40 s late"), (-18.0, "18.00 s early: GPS time and UTC")]
)
def test_stamps_of_another_clock_are_named(tmp_path: Path, late_s: float, said: str) -> None:
    assert said in of(log(), tum(tmp_path, TRUTH, late_s))


def test_jumps_are_counted_and_named(tmp_path: Path) -> None:
    T = TRUTH.T_map_imu.copy()
    T[1000:1001, 0, 3] += 30.0
    found = of(log(), tum(tmp_path, replace(TRUTH, T_map_imu=T)))
    assert "2 jumps" in found
    assert "at 20.0" in found


def test_poses_of_a_body_with_other_axes_are_red(tmp_path: Path) -> None:
    T = TRUTH.T_map_imu @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert "other axes than the IMU" in of(log(), tum(tmp_path, replace(TRUTH, T_map_imu=T)))


def test_the_lever_arm_counts(tmp_path: Path) -> None:
    """Where the fixes are exact, the usual one is at its antenna."""
    exact = replace(log(), gnss=drive(SEED, stddev_m=1e-3).gnss)
    assert "0.00 m from the usual one" in along(exact, tum(tmp_path, TRUTH)).given_how
    assert np.linalg.norm(LEVER) > 1.0


def test_poses_too_far_apart_for_their_motion_are_amber(tmp_path: Path) -> None:
    assert not of(log(), tum(tmp_path, TRUTH[:: round(0.1 / 0.02)]))
    found = along(log(), tum(tmp_path, TRUTH[:: round(1.0 / 0.02)]))
    assert len(found.scans) + sum(skip.frames for skip in found.skips) == 599
    assert len(found.scans) > 580  # a second is not too long
    assert "Pose rate" in " ".join(wrong(findings(found)))

"""One drive in three formats: every reader gives the same points at the same places, and pairs nothing by position."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import street
from scipy.spatial.transform import Rotation
from street import Street

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.datasets import detect_format, open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.scans.deskew import points_in_map
from gnss_sem_map.sensor_log import SensorLog


def true_trajectory(log: SensorLog, driven: Street) -> Trajectory:
    """The exact motion in the log's own time."""
    shift = (log.epoch_ns - int(street.EPOCH.astype(np.int64))) * 1e-9
    stamps = np.arange(driven.motion.start, driven.motion.end, 0.01)
    return Trajectory(stamps - shift, driven.motion.poses(stamps), driven.motion.velocities(stamps))


def test_headings_and_velocities_of_a_csv_log(tmp_path: Path) -> None:
    """Against the map's north; the second antenna is where log.yaml says; one that is the first is refused."""
    (tmp_path / "imu.csv").write_text(
        "stamp_s,ax,ay,az,wx,wy,wz\n" + "".join(f"{k / 10},0,0,9.81,0,0,0\n" for k in range(30))
    )
    (tmp_path / "gnss.csv").write_text(
        "stamp_s,lat_deg,lon_deg,alt_m,std_e_m,std_n_m,std_u_m,ve_mps,vn_mps,std_ve_mps,std_vn_mps,heading_deg\n"
        "0,49,8,100,1,1,2,1.5,-2,0.1,0.1,90\n1,49,8,100,1,1,2,,,,,\n2,49,8,100,1,1,2,1,0,0.1,0.1,350\n"
    )
    (tmp_path / "log.yaml").write_text("p_imu_antenna: [0.5, 0, 1]\np_imu_antenna2: [1.5, 0, 1]\n")
    log = open_drive(tmp_path)
    assert log.velocities is not None
    assert log.headings is not None
    np.testing.assert_allclose(log.velocities.velocities, [[1.5, -2, 0], [1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(np.degrees(log.headings.azimuths), [90, 350])
    np.testing.assert_allclose(log.headings.stddevs, 0.007)
    assert log.headings.baseline.tolist() == [1.0, 0.0, 0.0]
    (tmp_path / "log.yaml").write_text("p_imu_antenna: [0.5, 0, 1]\np_imu_antenna2: [0.5, 0, 1]\n")
    with pytest.raises(DataError, match=r"two antennas are 0\.000 m apart"):
        open_drive(tmp_path)


def test_a_raw_sweep_lands_on_the_street_when_every_point_moves_at_its_own_stamp(small_drive: Street) -> None:
    log = open_drive(small_drive.drive)
    trajectory = true_trajectory(log, small_drive)
    assert detect_format(small_drive.drive) == "kitti-raw"
    for scan in log.scans:
        p_map = points_in_map(scan.read(), scan.stamp, trajectory, log.calibration.T_imu_lidar)
        np.testing.assert_allclose(p_map, small_drive.p_map[scan.number], atol=2e-4)


def test_a_table_log_gives_the_same_points(small_drive: Street, tmp_path: Path) -> None:
    log = open_drive(street.write_table_log(tmp_path, small_drive))
    trajectory = true_trajectory(log, small_drive)
    for scan in log.scans:
        p_map = points_in_map(scan.read(), scan.stamp, trajectory, log.calibration.T_imu_lidar)
        np.testing.assert_allclose(p_map, small_drive.p_map[scan.number], atol=2e-4)
    assert log.imu is not None
    assert log.gnss is not None
    np.testing.assert_allclose(
        log.gnss.positions - log.gnss.positions[0],
        small_drive.motion.poses(log.gnss.stamps)[:, :3, 3]
        - small_drive.motion.poses(log.gnss.stamps[:1])[:, :3, 3],
        atol=1e-3,
    )


def test_intensities_of_a_table_log_have_the_scale_that_it_says(small_drive: Street, tmp_path: Path) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    before = open_drive(drive).scans[0].read()
    for path in (drive / "lidar").glob("*.bin"):
        rows = np.fromfile(path, "<f4").reshape(-1, 5)
        rows[:, 3] *= 255
        rows.tofile(path)
    about = json.loads((drive / "log.yaml").read_text())
    (drive / "log.yaml").write_text(json.dumps(about | {"intensity_max": 255}))
    after = open_drive(drive).scans[0].read()
    np.testing.assert_allclose(after.intensity, before.intensity, rtol=1e-6)
    np.testing.assert_array_equal(after.xyz, before.xyz)
    (drive / "log.yaml").write_text("intensity_max: -1\n")
    with pytest.raises(DataError, match=r"log\.yaml: intensity_max: Input should be greater than 0"):
        open_drive(drive)


@pytest.mark.parametrize(("columns", "is_compensated"), [(3, False), (4, False), (3, True), (5, True)])
def test_scans_of_another_count_of_columns_are_not_read_as_points(
    small_drive: Street, tmp_path: Path, columns: int, is_compensated: bool
) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    for path in (drive / "lidar").glob("*.bin"):
        rows = np.fromfile(path, "<f4").reshape(-1, 5)[:, :columns]
        rows[: len(rows) // 20 * 20].tofile(path)  # a whole number of rows of 3, 4 and 5 columns
    about = json.loads((drive / "log.yaml").read_text())
    (drive / "log.yaml").write_text(json.dumps(about | {"lidar_is_compensated": is_compensated}))
    for scan in open_drive(drive).scans:
        with pytest.raises(DataError, match="another count of columns"):
            scan.read()


def test_an_odometry_sequence_gives_the_same_points_in_its_first_lidar_frame(
    small_drive: Street, tmp_path: Path
) -> None:
    log = open_drive(street.write_odometry(tmp_path, small_drive))
    T_map_first = small_drive.motion.poses(np.array([street.SWEEP_S / 2]))[0] @ street.T_IMU_LIDAR
    assert log.given is not None
    for scan in log.scans:
        points = scan.read()
        assert points.stamps is None, "odometry scans are compensated: they must not be deskewed again"
        p_first = points_in_map(points, scan.stamp, log.given, log.calibration.T_imu_lidar)
        p_map = p_first @ T_map_first[:3, :3].T + T_map_first[:3, 3]
        np.testing.assert_allclose(p_map, small_drive.p_map[scan.number], atol=5e-4)


def test_calibration_is_the_drive_s(small_drive: Street) -> None:
    calibration = open_drive(small_drive.drive).calibration
    np.testing.assert_allclose(calibration.T_imu_lidar, street.T_IMU_LIDAR, atol=1e-8)
    camera = calibration.camera()
    np.testing.assert_allclose(camera.T_camera_lidar, street.T_CAMERA_LIDAR, atol=1e-8)
    np.testing.assert_allclose(camera.K, street.K, atol=1e-6)
    assert camera.image_size == (street.WIDTH, street.HEIGHT)
    assert camera.time_offset_s == -0.0085


def test_specific_force_and_angular_rate_come_from_the_body_columns(small_drive: Street) -> None:
    log = open_drive(small_drive.drive)
    stamps = np.arange(len(log.imu.stamps)) * street.SWEEP_S - 0.02
    np.testing.assert_allclose(
        log.imu.specific_force, small_drive.motion.specific_force(stamps, street.FRAME), atol=1e-9
    )
    np.testing.assert_allclose(
        log.imu.angular_rate, small_drive.motion.angular_rate(stamps, street.FRAME), atol=1e-9
    )


def test_the_reference_is_what_the_navigation_unit_says(small_drive: Street) -> None:
    log = open_drive(small_drive.drive)
    assert log.reference is not None
    exact = small_drive.motion.poses(log.reference.stamps - 0.02)
    np.testing.assert_allclose(log.reference.T_map_imu[:, :3, :3], exact[:, :3, :3], atol=1e-6)
    moved = log.reference.positions - log.reference.positions[0]
    np.testing.assert_allclose(moved, exact[:, :3, 3] - exact[0, :3, 3], atol=1e-3)


def test_missing_files_shift_nothing(copy: Path, small_drive: Street) -> None:
    for number in (0, 4, 5):
        (copy / f"velodyne_points/data/{number:010d}.bin").unlink()
    (copy / "image_02/data/0000000007.png").unlink()
    log = open_drive(copy)
    trajectory = true_trajectory(log, small_drive)
    assert [scan.number for scan in log.scans] == [1, 2, 3, 6, 7, 8, 9, 10, 11]
    for scan in log.scans:
        p_map = points_in_map(scan.read(), scan.stamp, trajectory, log.calibration.T_imu_lidar)
        np.testing.assert_allclose(p_map, small_drive.p_map[scan.number], atol=2e-4)
        image = log.image_at(scan.stamp, 0.05)
        assert (image.number if image else None) == (None if scan.number == 7 else scan.number)
    reasons = [(skip.what, skip.where.split("frames ")[1], skip.reason) for skip in log.skips]
    assert reasons == [
        ("scan", "0 to 0", "1 files missing"),
        ("scan", "4 to 5", "2 files missing"),
        ("image", "7 to 7", "1 files missing"),
    ]


def test_the_100_hz_twin_is_used_for_the_imu_only(copy: Path) -> None:
    twin = copy.with_name(copy.name.replace("_sync", "_extract"))
    shutil.copytree(copy / "oxts", twin / "oxts")
    lines = (twin / "oxts/timestamps.txt").read_text().splitlines()
    (twin / "oxts/timestamps.txt").write_text("\n".join(lines[:10]) + "\n")
    log = open_drive(copy)
    assert len(log.imu.stamps) == 10
    assert len(log.gnss.stamps) == 14


def test_the_first_attitude_is_that_of_the_first_sample_of_the_imu(copy: Path) -> None:
    """The twin begins before the drive, and the vehicle may turn in between."""
    twin = copy.with_name(copy.name.replace("_sync", "_extract"))
    shutil.copytree(copy / "oxts", twin / "oxts")
    first = min((twin / "oxts/data").iterdir())
    values = first.read_text().split()
    values[3:6] = ["0.0", "0.0", "1.25"]  # roll, pitch, yaw
    first.write_text(" ".join(values))
    attitude = open_drive(copy).initial_attitude
    assert attitude is not None
    np.testing.assert_allclose(Rotation.from_matrix(attitude.R_map_imu).as_rotvec(), [0, 0, 1.25])


def test_wheel_speeds_are_read_and_their_bad_rows_reported(small_drive: Street, tmp_path: Path) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    assert open_drive(drive).wheels is None
    rows = [f"{0.05 * k:.2f},{0.1 * k:.1f},7" for k in range(20)]
    spoilt = [*rows[:10], "0.31,nan,7", "0.32,655.35,7", rows[3], ",1.0,7", "9e9,1.0,7", *rows[10:]]
    for lines, dropped in ((rows, 0), (spoilt, 5)):
        (drive / "wheels.csv").write_text("\n".join(["stamp_s,speed_mps,gear", *lines]) + "\n")
        log = open_drive(drive)
        assert log.wheels is not None
        np.testing.assert_allclose(log.wheels.stamps, 0.05 * np.arange(20))
        np.testing.assert_allclose(log.wheels.speeds, 0.1 * np.arange(20))
        told = [skip.reason for skip in log.skips if "wheels.csv" in skip.where]
        assert len(told) == bool(dropped)
        assert all(
            words in told[0]
            for words in ("2 not finite", "1 repeated", "1 faster", "1 with a stamp")
            if dropped
        )


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("stamp_s,gear\n0,1\n", "wheels.csv:.*columns stamp_s,speed_mps"),
        ("stamp_s,speed_mps\n", "wheels.csv: no rows"),
        ("stamp_s,speed_mps\n0,fast\n", "wheels.csv:.*expected numbers"),
        ("stamp_s,speed_mps\n" + "".join(f"{50 * k},1\n" for k in range(9)), "wheels.csv:.*milliseconds"),
    ],
)
def test_a_broken_table_of_wheel_speeds_is_refused(
    small_drive: Street, tmp_path: Path, content: str, says: str
) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    (drive / "wheels.csv").write_text(content)
    with pytest.raises(DataError, match=says):
        open_drive(drive)


@pytest.mark.parametrize(
    ("epoch_ns", "says"),
    [
        (9 * 10**18, r"imu\.csv: the stamp .* of the year 2255, expected one up to 2200"),
        (-9 * 10**18, r"imu\.csv: the stamp .* of the year 1685"),
        (10**30, r"log\.yaml: epoch_ns"),
        (
            1_317_000_000,
            r"imu\.csv: with `epoch_ns: 1317000000` .* of the year 1970.* in nanoseconds",
        ),  # in seconds
    ],
)
def test_a_table_log_of_an_impossible_year_is_refused(
    small_drive: Street, tmp_path: Path, epoch_ns: int, says: str
) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    about = json.loads((drive / "log.yaml").read_text())
    (drive / "log.yaml").write_text(json.dumps(about | {"epoch_ns": epoch_ns}))
    with pytest.raises(DataError, match=says):
        open_drive(drive)


def test_the_real_excerpt_keeps_its_frame_numbers(real_data: Path) -> None:
    log = open_drive(real_data / "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync")
    assert [scan.number for scan in log.scans] == list(range(114, 154))
    assert len(log.gnss.stamps) == 154
    for scan in log.scans[::13]:
        image = log.image_at(scan.stamp, 0.05)
        assert image is not None
        assert image.number == scan.number
        assert image.stamp - scan.stamp == pytest.approx(0.0105, abs=5e-4)
        points = scan.read()
        assert points.stamps is not None
        assert abs(points.stamps.mean() - scan.stamp) < 0.02
        assert 0.09 < np.ptp(points.stamps) < 0.11


def test_the_real_sequence_has_more_poses_than_scans(real_data: Path) -> None:
    log = open_drive(real_data / "semantic_kitti/sequences/08")
    assert [scan.name for scan in log.scans] == [f"{n:06d}" for n in range(10)]
    assert log.given is not None
    assert len(log.given) == 4071
    assert log.calibration.camera().image_size == (1226, 370)


def test_a_raw_drive_is_the_same_through_a_link_and_from_inside(
    small_drive: Street, copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Calibration and the twin with the fast IMU lie beside the drive itself, not beside the link."""
    twin = copy.with_name(copy.name.replace("_sync", "_extract"))
    shutil.copytree(copy / "oxts", twin / "oxts")
    (twin / "oxts/data" / sorted(path.name for path in (twin / "oxts/data").iterdir())[1]).unlink()
    direct = open_drive(copy)
    assert direct.imu is not None
    assert len(direct.imu.stamps) == len(list((twin / "oxts/data").iterdir()))
    link = tmp_path / "elsewhere" / "my_drive"
    link.parent.mkdir()
    link.symlink_to(copy)
    linked = open_drive(link)
    monkeypatch.chdir(copy)
    for log in (linked, open_drive(".")):
        assert log.imu is not None
        np.testing.assert_array_equal(log.imu.stamps, direct.imu.stamps)
        np.testing.assert_array_equal(log.calibration.T_imu_lidar, direct.calibration.T_imu_lidar)
        for name in ("T_camera_lidar", "K"):
            camera, same = log.calibration.camera(), direct.calibration.camera()
            np.testing.assert_array_equal(getattr(camera, name), getattr(same, name))
    assert linked.name == "my_drive"
    assert open_drive(".").name == copy.name


def test_calibration_beside_a_link_comes_first(small_drive: Street, copy: Path, tmp_path: Path) -> None:
    """A date folder may hold links to drives on another disk."""
    date = tmp_path / "links" / "2011_09_26"
    date.mkdir(parents=True)
    for file in copy.parent.glob("calib_*.txt"):
        shutil.move(file, date / file.name)
    (date / copy.name).symlink_to(copy)
    log = open_drive(date / copy.name)
    np.testing.assert_array_equal(
        log.calibration.T_imu_lidar, open_drive(small_drive.drive).calibration.T_imu_lidar
    )
    with pytest.raises(DataError, match="calib_imu_to_velo"):
        open_drive(copy)


def test_scans_and_tables_of_a_log_as_other_programs_write_them(
    small_drive: street.Street, tmp_path: Path
) -> None:
    """Scans as text, and tables with semicolons, decimal commas and UTF-16: the same log to the last bit."""
    plain = street.write_table_log(tmp_path / "plain", small_drive)
    other = street.write_table_log(tmp_path / "other", small_drive)
    for scan in (other / "lidar").glob("*.bin"):
        np.savetxt(scan.with_suffix(".txt"), np.fromfile(scan, "<f4").reshape(-1, 5), fmt="%.9g")
        scan.unlink()
    for table in ("imu.csv", "gnss.csv", "lidar/stamps.csv", "images/stamps.csv"):
        text = (other / table).read_text().replace(",", ";").replace(".", ",")
        (other / table).write_bytes(text.replace("\n", "\r\n").encode("utf-16"))
    one, two = open_drive(plain), open_drive(other)
    assert one.imu is not None
    assert two.imu is not None
    np.testing.assert_array_equal(one.imu.specific_force, two.imu.specific_force)
    assert one.gnss is not None
    assert two.gnss is not None
    np.testing.assert_array_equal(one.gnss.positions, two.gnss.positions)
    assert [image.stamp for image in one.images] == [image.stamp for image in two.images]
    for a, b in zip(one.scans, two.scans, strict=True):
        assert a.stamp == b.stamp
        np.testing.assert_array_equal(a.read().xyz, b.read().xyz)
        np.testing.assert_array_equal(a.read().stamps, b.read().stamps)


def test_a_unit_of_time_that_steps_show_is_among_the_skips(
    small_drive: street.Street, tmp_path: Path
) -> None:
    log = street.write_table_log(tmp_path / "log", small_drive)
    plain, table = open_drive(log), log / "imu.csv"
    assert [skip for skip in plain.skips if skip.what == "unit"] == []
    head, *rows = (line.split(",") for line in table.read_text().splitlines())
    lines = [["time", *head[1:]], *([f"{float(first) * 1e3:.6f}", *rest] for first, *rest in rows)]
    table.write_text("\n".join(map(",".join, lines)))
    found = open_drive(log)
    [told] = [skip for skip in found.skips if skip.what == "unit"]
    assert told.where.endswith("imu.csv")
    assert "milliseconds" in told.reason
    assert found.imu is not None
    assert plain.imu is not None
    np.testing.assert_allclose(found.imu.stamps, plain.imu.stamps, atol=1e-8)


def test_a_unit_in_the_header_and_another_in_the_log_is_one_too_many(
    small_drive: street.Street, tmp_path: Path
) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    text = (drive / "imu.csv").read_text().replace("ax,ay,az", "ax [g],ay [g],az [g]")
    (drive / "imu.csv").write_text(text)
    about = json.loads((drive / "log.yaml").read_text()) | {"force_unit": "g"}
    (drive / "log.yaml").write_text(json.dumps(about))
    with pytest.raises(
        DataError, match=r"imu\.csv: the unit of ax is in its header, and force_unit in log\.yaml"
    ):
        open_drive(drive)

"""SBET and the table of attitudes: read by the format's own definition, against exact motion."""

import csv
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factor_graphs.geodesy import LocalFrame
from factor_graphs.measurements import ImuNoise
from factor_graphs.receiver_rows import ROW_COLUMNS
from factor_graphs.simulation import (
    random_drive,
    simulate_gnss,
    simulate_headings,
    simulate_imu,
    simulate_velocities,
)
from factor_graphs.trajectory import Trajectory
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.export.navigation import write_attitude, write_sbet
from gnss_sem_map.mapping.trajectory import smooth_log
from gnss_sem_map.scans.lidar_odometry import TrajectorySettings

FRAME = LocalFrame(49.0, 8.4, 115.0)
WEDNESDAY_NS = int(np.datetime64("2026-01-07T01:00:00", "ns").astype(np.int64))


def records(path: Path) -> np.ndarray:
    """17 little-endian doubles per record."""
    content = path.read_bytes()
    assert len(content) % 136 == 0
    return np.array(list(struct.iter_unpack("<17d", content)))


def looking(roll: float, pitch: float, heading: float) -> np.ndarray:
    """T_map_imu of a body with these angles, degrees: turned step by step, from one that looks north and is level."""
    north = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # forward north, left west, up
    T = np.eye(4)
    about_up, about_left, about_ahead = (
        Rotation.from_rotvec(np.radians(angle) * np.array(axis)).as_matrix()
        for angle, axis in ((-heading, (0, 0, 1)), (-pitch, (0, 1, 0)), (roll, (1, 0, 0)))
    )
    T[:3, :3] = about_up @ north @ about_left @ about_ahead
    return T


def test_an_sbet_has_time_place_attitude_and_motion(tmp_path: Path) -> None:
    motion = random_drive(30.0, np.random.default_rng(4))
    truth = motion.trajectory(np.arange(0, 30, 0.01))
    write_sbet(truth, FRAME, WEDNESDAY_NS, tmp_path / "trajectory.sbet")
    rows = records(tmp_path / "trajectory.sbet")
    # Wednesday is the third day after Sunday; GPS time was 18 s ahead of UTC
    np.testing.assert_allclose(rows[:, 0], 3 * 86400 + 3600 + 18 + truth.stamps, atol=1e-6)
    places = FRAME.to_map(np.degrees(rows[:, 1]), np.degrees(rows[:, 2]), rows[:, 3])
    np.testing.assert_allclose(places, truth.positions, atol=1e-6)
    north_east_down = truth.velocities[:, [1, 0, 2]] * [1, 1, -1]
    np.testing.assert_allclose(
        rows[:, 4:7], north_east_down, atol=2e-3
    )  # the map's axes, and those of the place
    ahead = truth.T_map_imu[:, :3, 0]
    np.testing.assert_allclose(np.sin(rows[:, 9]), ahead[:, 0] / np.hypot(*ahead[:, :2].T), atol=1e-4)
    np.testing.assert_allclose(np.sin(rows[:, 8]), ahead[:, 2], atol=1e-4)
    assert not rows[:, 10].any()
    turned = np.concatenate([[0.0], np.cumsum((rows[1:, 16] + rows[:-1, 16]) / 2 * 0.01)])
    headings = np.unwrap(rows[:, 9])
    np.testing.assert_allclose(turned, headings - headings[0], atol=0.02)
    speeds = np.concatenate([[0.0], np.cumsum((rows[1:, 11] + rows[:-1, 11]) / 2 * 0.01)])
    assert (
        np.abs(
            speeds - (np.linalg.norm(truth.velocities, axis=1) - np.linalg.norm(truth.velocities[0]))
        ).max()
        < 0.2
    )


def test_what_a_csv_log_has_beside_fixes_takes_part(tmp_path: Path) -> None:
    """Correlations, velocity, heading and surveyed points of the files come to the smoother, and are told."""
    rng, lever = np.random.default_rng(1), np.array([0.5, 0.3, 1.0])
    motion, stamps = random_drive(60.0, rng), np.arange(0.5, 59.0)
    imu = simulate_imu(motion, np.arange(0, 60, 0.02), FRAME, ImuNoise(), rng)
    fixes = simulate_gnss(motion, stamps, (1.0, 1.0, 2.0), lever, rng)
    velocities = simulate_velocities(motion, stamps, (0.05, 0.05, 0.1), lever, rng)
    headings = simulate_headings(motion, stamps, 0.01, rng=rng)
    place = motion.poses([30.0])[0]
    point = FRAME.to_geodetic((place[:3, 3] + place[:3, :3] @ lever)[None])
    tables = {
        "imu": (["stamp_s", "ax", "ay", "az", "wx", "wy", "wz"], [imu.stamps, imu.specific_force, imu.angular_rate]),
        "gnss": (
            ROW_COLUMNS,
            [stamps, *FRAME.to_geodetic(fixes.positions), fixes.stddevs, np.tile([0.3, 0, 0], (len(stamps), 1)),
             velocities.velocities, velocities.stddevs, np.degrees(headings.azimuths), np.degrees(headings.stddevs)],
        ),
    }  # fmt: skip
    for name, (columns, values) in tables.items():
        head = ",".join(columns)
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack(values), "%.12g", ",", header=head, comments="")
    (tmp_path / "control_points.csv").write_text(
        "name,type,stamp_s,lat_deg,lon_deg,alt_m\nP,control,30,"
        + ",".join(f"{x[0]:.10f}" for x in point)
        + "\n"
    )
    (tmp_path / "log.yaml").write_text("p_imu_antenna: [0.5, 0.3, 1]\np_imu_antenna2: [1.5, 0.3, 1]\n")
    log = open_drive(tmp_path)
    found = smooth_log(log, TrajectorySettings())
    assert log.gnss is not None
    assert log.gnss.correlations is not None
    assert [verdict.split(":")[0] for verdict in found.beside] == [
        "GNSS velocity",
        "antenna heading",
        "surveyed points",
    ]
    assert found.points[0].used
    assert max(abs(found.points[0].d_east_m), abs(found.points[0].d_north_m)) < 0.05


@pytest.mark.parametrize("angles", [(0, 0, 0), (10, 0, 90), (0, 20, 180), (-5, 8, 300), (3, -30, 45)])
def test_roll_pitch_and_heading_have_the_signs_of_the_trade(
    tmp_path: Path, angles: tuple[float, ...]
) -> None:
    still = Trajectory(np.array([0.0, 0.1, 0.2]), np.tile(looking(*angles), (3, 1, 1)))
    write_sbet(still, FRAME, WEDNESDAY_NS, tmp_path / "trajectory.sbet")
    np.testing.assert_allclose(np.degrees(records(tmp_path / "trajectory.sbet")[0, 7:10]), angles, atol=1e-6)
    write_attitude(still, FRAME, tmp_path / "attitude.csv")
    [row, *_] = csv.DictReader((tmp_path / "attitude.csv").read_text().splitlines())
    np.testing.assert_allclose(
        [float(row[f"{name}_deg"]) for name in ("roll", "pitch", "heading")], angles, atol=1e-6
    )
    assert row["std_roll_deg"] == ""


def test_deviations_of_angles_are_those_of_samples_and_fixes_are_counted(tmp_path: Path) -> None:
    root = np.random.default_rng(5).standard_normal((6, 6)) * 1e-3
    T, C = looking(5, 20, 130), root @ root.T
    t = np.arange(0, 1.001, 0.05)
    track = Trajectory(t, np.tile(T, (len(t), 1, 1)), covariances=np.tile(C, (len(t), 1, 1)))
    fixes = np.array([-1.0, 0.0, 0.12, 0.15, 0.2, 0.95, 7.0])
    rejected = np.array([True, False, True, False, False, True, True])
    write_attitude(track, FRAME, tmp_path / "attitude.csv", fixes, rejected)
    rows = list(csv.DictReader((tmp_path / "attitude.csv").read_text().splitlines()))
    np.testing.assert_allclose([float(row["stamp_s"]) for row in rows], np.arange(11) * 0.1, atol=1e-6)
    assert [int(row["fixes"]) for row in rows] == [1, 0, 3, 0, 0, 0, 0, 0, 0, 0, 1]
    assert [int(row["fixes_rejected"]) for row in rows] == [0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1]
    used = fixes[~rejected]
    nearest = np.abs(np.arange(11)[:, None] * 0.1 - used).min(axis=1)
    np.testing.assert_allclose([float(row["nearest_fix_s"]) for row in rows], nearest, atol=1e-6)
    drawn = np.random.default_rng(6).multivariate_normal(np.zeros(6), C, 20_000)[:, :3]
    many = np.tile(np.eye(4), (len(drawn), 1, 1))
    many[:, :3, :3] = T[:3, :3] @ Rotation.from_rotvec(drawn).as_matrix()
    write_sbet(Trajectory(np.arange(len(many)) * 0.01, many), FRAME, WEDNESDAY_NS, tmp_path / "many.sbet")
    expected = np.degrees(records(tmp_path / "many.sbet")[:, 7:10].std(axis=0))
    said = [float(rows[3][f"std_{name}_deg"]) for name in ("roll", "pitch", "heading")]
    np.testing.assert_allclose(said, expected, rtol=0.03)
    expected_m = np.sqrt(np.diag(T[:3, :3] @ C[3:, 3:] @ T[:3, :3].T))
    np.testing.assert_allclose([float(rows[3][f"std_{axis}_m"]) for axis in "enu"], expected_m, rtol=1e-6)

"""`imu-noise`: from the log of an IMU alone to settings that its drives take."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import ros
from commands import gnss_sem_map
from PIL import Image
from ros import START_NS

from factor_graphs.imu_noise import ImuNoise
from gnss_sem_map.datasets.log_yaml import read_log_yaml

pytestmark = pytest.mark.integration

RATE, GYROSCOPE, ACCELEROMETER = 20, 1e-3, 1e-2
RNG = np.random.default_rng(7)
STAMPS = np.arange(90 * RATE) / RATE
RATES = GYROSCOPE * np.sqrt(RATE) * RNG.standard_normal((len(STAMPS), 3))
FORCES = ACCELEROMETER * np.sqrt(RATE) * RNG.standard_normal((len(STAMPS), 3)) + [0.0, 0.0, 9.81]


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The IMU alone, in g and degrees per second."""
    log = tmp_path_factory.mktemp("still")
    rows = np.column_stack([STAMPS, FORCES / 9.80665, np.degrees(RATES)])
    header = "stamp_s,ax,ay,az,wx,wy,wz"
    np.savetxt(log / "imu.csv", rows, delimiter=",", header=header, comments="", fmt="%.12g")
    (log / "log.yaml").write_text("force_unit: g\nrate_unit: deg/s\n")
    return log


def test_the_yaml_is_taken_by_the_log_as_its_noise(table: Path, tmp_path: Path) -> None:
    done = gnss_sem_map("imu-noise", table, "-o", tmp_path / "noise")
    assert (done.returncode, done.stderr) == (0, "")
    assert "at rest from 0.0 to 90.0 s of 90.0 s, 20.0 Hz" in done.stdout
    assert "rate random walk" in done.stdout
    assert "not measured: needs" in done.stdout
    snippet = (tmp_path / "noise" / "imu_noise.yaml").read_text("utf-8")
    assert snippet in done.stdout
    (tmp_path / "log.yaml").write_text(snippet, "utf-8")
    noise = read_log_yaml(tmp_path / "log.yaml").imu_noise
    assert noise is not None
    assert noise.gyroscope_noise_density == pytest.approx(GYROSCOPE, rel=0.1)
    assert noise.accelerometer_noise_density == pytest.approx(ACCELEROMETER, rel=0.1)
    assert noise.gyroscope_bias_walk == ImuNoise().gyroscope_bias_walk  # was not measured
    with Image.open(tmp_path / "noise" / "allan_deviation.png") as picture:
        assert picture.size[0] > 1000
    again = gnss_sem_map("imu-noise", table, "-o", tmp_path / "noise")
    assert again.returncode == 1
    assert "exists; move it away" in again.stderr


def test_a_name_with_a_line_break_does_not_end_the_comment(table: Path, tmp_path: Path) -> None:
    log = shutil.copytree(table, tmp_path / "still\nepoch_ns: 1")
    done = gnss_sem_map("imu-noise", log)
    assert done.returncode == 0
    assert not any(line.startswith("epoch_ns") for line in done.stdout.splitlines())


def test_a_bag_with_nothing_else_tells_the_same_as_the_table(table: Path, tmp_path: Path) -> None:
    rig = ros.Rig()
    for stamp, force, rate in zip(STAMPS, FORCES, RATES, strict=True):
        rig.imu(START_NS + round(1e9 * stamp))
        message = rig.messages[-1][2]
        object.__setattr__(message, "linear_acceleration", rig.vector(*force))
        object.__setattr__(message, "angular_velocity", rig.vector(*rate))
    bag = ros.write(tmp_path / "bag", rig)
    found = [json.loads(gnss_sem_map("imu-noise", log, "--json").stdout)["axes"] for log in (table, bag)]
    for of_table, of_bag in zip(*found, strict=True):
        assert of_bag["noise_density"] == pytest.approx(of_table["noise_density"], rel=1e-6)
        assert of_bag["deviations"] == pytest.approx(of_table["deviations"], rel=1e-6)
        assert of_bag["not_measured"].keys() == of_table["not_measured"].keys()


def test_a_real_drive_is_no_record_at_rest(real_data: Path) -> None:
    done = gnss_sem_map("imu-noise", real_data / "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync")
    assert done.returncode == 1
    assert "expected 60 s or more" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_without_its_library_the_command_says_how_to_install_it(
    table: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    done = gnss_sem_map("imu-noise", table)
    assert done.returncode == 1
    assert "-e '.[allan]'" in done.stderr

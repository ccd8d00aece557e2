"""Clocks of files of positions, and the logs that they belong to."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import ros
from receivers import (
    LEAP_NS,
    pos,
    pos_row,
    read,
)
from ros import START_NS

from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.gnss_files import GnssFile, read_gnss_file
from gnss_sem_map.datasets.gnss_files.time_systems import gps_minus_utc_s
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import SensorLog


def test_leap_seconds_at_known_moments() -> None:
    """2012: 15, then 16 from July on; 2017: 18; 1980: none (IERS Bulletin C)."""
    days = ["1980-02-01", "2012-06-30", "2012-07-02", "2016-12-31T23:59:00", "2017-01-02", "2026-06-01"]
    ns = np.array(days, "datetime64[ns]").astype(np.int64)
    assert gps_minus_utc_s(ns).tolist() == [0, 15, 16, 17, 18, 18]


def test_local_time_is_said_or_found(tmp_path: Path) -> None:
    rows = [pos_row(START_NS + LEAP_NS + (7200 + k) * 10**9) for k in range(60)]
    path = pos(tmp_path, rows)
    with pytest.raises(
        DataError, match=r"no fix lies within the drive.*is it local time\? set utc_offset_s: 7200"
    ):
        read(path)
    assert read(path, utc_offset_s=7200).rows[0, 0] == pytest.approx(0.0, abs=1e-6)


def test_the_time_system_may_be_said(tmp_path: Path) -> None:
    path = pos(tmp_path, [pos_row(START_NS)])
    assert read(path, time="utc").rows[0, 0] == pytest.approx(0.0, abs=1e-6)
    before = (START_NS - 60 * 10**9, START_NS)
    assert read(path, before).rows[0, 0] == pytest.approx(-18.0, abs=1e-6)


def test_a_file_of_another_day_is_refused(tmp_path: Path) -> None:
    path = pos(tmp_path, [pos_row(START_NS + 40 * 86_400 * 10**9)])
    with pytest.raises(DataError, match="is it the file of this drive"):
        read(path)


def test_no_file_out_of_the_folder(tmp_path: Path) -> None:
    for name in ("../rover.pos", "/etc/hosts"):
        with pytest.raises(DataError, match="expected a path within this folder"):
            read_gnss_file(GnssFile(path=name), tmp_path, None, None)


def positions_of(log: SensorLog) -> np.ndarray:
    assert log.gnss is not None
    return log.gnss.positions


def test_a_table_log_may_have_its_positions_in_a_file(tmp_path: Path) -> None:
    stamps = np.arange(0, 20, 0.01)
    rows = "".join(f"{t:.2f},0.1,0,9.81,0,0,0.01\n" for t in stamps)
    (tmp_path / "imu.csv").write_text("stamp_s,ax,ay,az,wx,wy,wz\n" + rows)
    pos(tmp_path, [pos_row(START_NS + LEAP_NS + k * 10**9, lat=49 + 1e-5 * k) for k in range(20)])
    (tmp_path / "log.yaml").write_text(json.dumps({"epoch_ns": START_NS, "gnss_file": {"path": "rover.pos"}}))
    log = open_drive(tmp_path)
    assert len(positions_of(log)) == 20
    assert log.gnss is not None
    np.testing.assert_allclose(log.gnss.stamps, np.arange(20.0), atol=1e-6)
    (tmp_path / "gnss.csv").write_text("stamp_s\n")
    with pytest.raises(DataError, match=r"gnss_file in log\.yaml as well"):
        open_drive(tmp_path)


def test_a_bag_may_have_its_positions_in_a_file(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive", ros.drive(), keep=lambda one: one[0] != "/fix")
    pos(bag, [pos_row(START_NS + LEAP_NS + k * 500_000_000, lat=49 + 1e-5 * k) for k in range(4)])
    (bag / "rig.yaml").write_text(json.dumps({"gnss": {"file": {"path": "rover.pos"}}}))
    log = open_drive(bag)
    assert len(positions_of(log)) == 4
    assert log.epoch_ns == pytest.approx(START_NS, abs=1000)
    assert log.scans[0].stamp == pytest.approx(0.0, abs=1e-6)


def test_a_gnss_csv_without_deviations_names_the_setting_with_which_it_is_read(tmp_path: Path) -> None:
    rows = "".join(f"{t:.2f},0.1,0,9.81,0,0,0.01\n" for t in np.arange(0, 20, 0.01))
    (tmp_path / "imu.csv").write_text("stamp_s,ax,ay,az,wx,wy,wz\n" + rows)
    fixes = "".join(f"{START_NS / 1e9 + k:.3f};49.00{k:02d}1;8.4;111.6\n" for k in range(20))
    (tmp_path / "gnss.csv").write_text("Time;Latitude;Longitude;H-MSL\n" + fixes)
    about: dict[str, object] = {"epoch_ns": START_NS}
    (tmp_path / "log.yaml").write_text(json.dumps(about))
    with pytest.raises(DataError, match=r"stddevs_m.*`gnss_file: \{path: gnss\.csv\}` in log\.yaml"):
        open_drive(tmp_path)
    about["gnss_file"] = {"path": "gnss.csv", "stddevs_m": [2, 2, 4], "geoid": 48.5}
    (tmp_path / "log.yaml").write_text(json.dumps(about))
    log = open_drive(tmp_path)
    assert log.frame is not None
    assert log.frame.alt_m == pytest.approx(160.1)
    assert log.gnss is not None
    np.testing.assert_allclose(log.gnss.stamps, np.arange(20.0), atol=1e-5)

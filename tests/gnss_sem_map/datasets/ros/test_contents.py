"""What `inspect` says of a bag, and the rig.yaml that it suggests, which `run` takes where nothing is to choose."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import ros
from ros import START_NS, sweep
from typer.testing import CliRunner

from gnss_sem_map.cli import app
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.ros.bag import Bag
from gnss_sem_map.datasets.ros.contents import Topic, contents_of, suggested_rig
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.structured import parse_yaml


def topics_of(bag: Path) -> dict[str, Topic]:
    return {topic.name: topic for topic in contents_of(Bag(bag))}


def test_topics_have_rates_gaps_and_a_sensor(tmp_path: Path) -> None:
    rig = ros.drive()
    for k in range(100):
        rig.imu(START_NS + 4_500_000_000 + k * 10_000_000)
    found = topics_of(ros.write(tmp_path / "drive", rig))
    imu = found["/imu"]
    assert (imu.taken_for, imu.messages, imu.gaps, imu.frame, imu.notes) == ("IMU", 301, 1, "imu", ())
    assert imu.rate_hz == pytest.approx(100.0)
    assert imu.longest_gap_s == pytest.approx(2.5)
    assert {name: topic.taken_for for name, topic in found.items()} == {
        "/imu": "IMU", "/fix": "receiver", "/points": "LiDAR", "/tf_static": "transforms",
    }  # fmt: skip


def test_what_would_stop_a_run_is_noted(tmp_path: Path) -> None:
    rig = ros.drive(frames=False)
    rig.messages = [one for one in rig.messages if one[0] == "/imu"]
    rig.cloud(START_NS, sweep(np.linspace(0, 0.1, 4), name="ring"))
    rig.fix(START_NS, kind=0)
    rig.image(START_NS, np.zeros((4, 6), np.uint8), "32FC1")
    for k in range(5):
        rig.imu(START_NS + k, 0, topic="/imu_without_clock")
    found = topics_of(ros.write(tmp_path / "drive", rig))
    assert "no time per point among x, y, z, intensity, ring" in found["/points"].notes[0]
    assert "its frame 'lidar' is in no fixed transform" in found["/points"].notes[1]
    assert found["/fix"].notes == ("its covariance is unknown: set stddevs_m",)
    assert "not read: its images have the encoding 32FC1" in found["/image_rect"].notes[0]
    assert found["/imu_without_clock"].notes == ("5 of 5 header stamps are zero: set stamps: received",)


@pytest.mark.parametrize(("off_s", "says"), [(-18, "18.0 s before"), (18, "18.0 s after")])
def test_the_side_on_which_another_clock_lies_is_told(tmp_path: Path, off_s: int, says: str) -> None:
    rig = ros.Rig()
    for k in range(50):
        rig.imu(START_NS + k * 10_000_000, START_NS + k * 10_000_000 + off_s * 10**9)
    [note] = topics_of(ros.write(tmp_path / "drive", rig))["/imu"].notes
    assert f"header stamps are {says} the arrivals" in note


def test_messages_that_are_there_twice_have_the_rate_of_one_and_no_gaps(tmp_path: Path) -> None:
    rig = ros.drive()
    rig.messages = [one for one in rig.messages for _ in range(2)]
    imu = topics_of(ros.write(tmp_path / "drive", rig))["/imu"]
    assert (imu.messages, imu.rate_hz, imu.gaps) == (402, pytest.approx(100.0), 0)


def test_a_camera_without_calibration_is_noted_as_it_stops_a_run(tmp_path: Path) -> None:
    rig = ros.drive()
    rig.image(START_NS, np.zeros((4, 6, 3), np.uint8), "rgb8")
    path = ros.write(tmp_path / "drive", rig)
    notes = topics_of(path)["/image_rect"].notes
    assert notes[0] == "no CameraInfo topic beside it: set info, or K and image_size"
    with pytest.raises(DataError, match=r"/image_rect: no CameraInfo beside it; set info, or K"):
        open_drive(path)


def test_the_suggested_rig_reads_the_bag(tmp_path: Path) -> None:
    path = ros.write(tmp_path / "drive", ros.drive())
    before, bag = open_drive(path), Bag(path)
    (tmp_path / "rig.yaml").write_text(suggested_rig(bag, contents_of(bag)))
    after = open_drive(path)
    assert (len(after.scans), after.epoch_ns) == (len(before.scans), before.epoch_ns)
    np.testing.assert_array_equal(after.calibration.p_imu_antenna, before.calibration.p_imu_antenna)


def test_the_suggested_rig_has_all_that_may_be_a_sensor(tmp_path: Path) -> None:
    rig = ros.drive()
    rig.cloud(START_NS, sweep(np.linspace(0, 0.1, 4)), topic="/rear/points")
    path = ros.write(tmp_path / "drive", rig)
    bag = Bag(path)
    text = suggested_rig(bag, contents_of(bag))
    (path / "rig.yaml").write_text(text)
    both = open_drive(path)
    assert (both.lidar, len(both.scans)) == ("lidar", 10)
    assert [(other.name, len(other.scans)) for other in both.others] == [("rear", 1)]
    (path / "rig.yaml").write_text(text.replace("  rear:\n    topic: /rear/points\n", ""))
    alone = open_drive(path)
    assert (len(alone.scans), alone.others) == (10, ())


def cameras_of(bag: Path) -> dict[str, str]:
    text = suggested_rig(Bag(bag), contents_of(Bag(bag)))
    return {name: about["topic"] for name, about in parse_yaml(text)["cameras"].items()}


def test_an_image_that_is_recorded_raw_and_compressed_is_one_camera(tmp_path: Path) -> None:
    rig = ros.with_camera()
    for name, encoding in (("left", "rgb8"), ("right", "32FC1")):
        pixels = np.zeros((4, 6, 3) if encoding == "rgb8" else (4, 6), np.uint8)
        rig.image(START_NS, pixels, encoding, topic=f"/{name}/image_raw")
        rig.compressed(START_NS, b"", f"/{name}/image_raw/compressed")
    assert cameras_of(ros.write(tmp_path / "drive", rig)) == {
        "left": "/left/image_raw",
        "right": "/right/image_raw/compressed",  # the encoding of the raw one is not read
    }


def test_every_sensor_has_a_name_of_its_own(tmp_path: Path) -> None:
    rig = ros.with_camera()
    for topic in ("/cam/image_raw", "/cam/image_rect", "/cam/image_rect_color", "/cam_2/image_raw"):
        rig.image(START_NS, np.zeros((4, 6, 3), np.uint8), "rgb8", topic=topic)
    assert cameras_of(ros.write(tmp_path / "drive", rig)) == {
        "cam": "/cam/image_raw",
        "cam_2": "/cam/image_rect",
        "cam_3": "/cam/image_rect_color",
        "cam_2_2": "/cam_2/image_raw",
    }


def test_the_command_writes_a_rig_once(tmp_path: Path) -> None:
    bag = ros.write(tmp_path / "drive", ros.drive())
    first = CliRunner().invoke(app, ["inspect", str(bag)])
    assert first.exit_code == 0
    assert "LiDAR                10" in first.output
    file = tmp_path / "rig.yaml"
    file.write_text("mine: true\n")
    again = json.loads(CliRunner().invoke(app, ["inspect", str(bag), "--json"]).output)
    assert (again["rig"], again["written"]) == (str(file), False)
    assert file.read_text() == "mine: true\n"
    assert {topic["name"] for topic in again["topics"]} == {"/imu", "/fix", "/points", "/tf_static"}


def test_a_folder_without_a_bag_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"found no \.bag, \.mcap, \.db3 file, expected a bag"):
        Bag(tmp_path)

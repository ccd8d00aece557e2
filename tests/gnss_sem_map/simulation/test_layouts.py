"""One drive in every layout: what readers find is the same to the bit, and so is the map."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import street

from gnss_sem_map import run
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.sensor_log import SensorLog
from gnss_sem_map.simulation.layouts import Layout, rewrite, write_in_layout

LAYOUTS: tuple[Layout, ...] = ("table", "rosbag1", "mcap")


@pytest.fixture(scope="module")
def layouts(small_drive: street.Street, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The small street in every layout."""
    folder = tmp_path_factory.mktemp("layouts")
    return {layout: rewrite(small_drive.drive, folder / layout, layout) for layout in LAYOUTS}


def arrays(log: SensorLog) -> dict[str, np.ndarray]:
    """All numbers of a log."""
    assert log.imu is not None
    assert log.gnss is not None
    assert log.initial_attitude is not None
    calibration = log.calibration
    camera = calibration.camera()
    found = {
        "imu stamps": log.imu.stamps, "forces": log.imu.specific_force, "rates": log.imu.angular_rate,
        "fix stamps": log.gnss.stamps, "positions": log.gnss.positions, "stddevs": log.gnss.stddevs,
        "attitude": log.initial_attitude.R_map_imu, "attitude stddevs": log.initial_attitude.stddevs,
        "T_imu_lidar": calibration.T_imu_lidar, "T_camera_lidar": camera.T_camera_lidar, "K": camera.K,
        "antenna": calibration.p_imu_antenna,
        "scans": np.array([(scan.number, scan.stamp) for scan in log.scans]),
        "images": np.array([(image.number, image.stamp) for image in log.images]),
    }  # fmt: skip
    for scan in log.scans:
        points = scan.read()
        assert points.stamps is not None
        found |= {f"points {scan.name}": points.rows, f"times {scan.name}": points.stamps}
    return found | {f"pixels {image.number}": image.read() for image in log.images}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_reads_as_the_drive_itself(
    small_drive: street.Street, layouts: dict[str, Path], layout: str
) -> None:
    log, other = open_drive(small_drive.drive), open_drive(layouts[layout])
    expected, found = arrays(log), arrays(other)
    assert expected.keys() == found.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)
    assert (other.epoch_ns, other.frame, other.imu_noise) == (log.epoch_ns, log.frame, log.imu_noise)
    assert other.calibration.image_sizes == log.calibration.image_sizes
    assert other.calibration.camera().time_offset_s == log.calibration.camera().time_offset_s
    assert other.skips == ()


@pytest.mark.slow
@pytest.mark.integration
def test_the_map_is_the_same_in_every_layout(
    small_drive: street.Street, layouts: dict[str, Path], tmp_path: Path
) -> None:
    drives = {"kitti-raw": small_drive.drive, **layouts}
    tiles = {}
    for layout, drive in drives.items():
        run(drive, tmp_path / layout, segmenter=f"labels:{small_drive.labels}", force=True)
        files = [
            path
            for part in ("map", "refined")
            for path in sorted((tmp_path / layout / part).glob("*.parquet"))
        ]
        tiles[layout] = {f"{path.parent.name}/{path.name}": path.read_bytes() for path in files}
    assert len(tiles["kitti-raw"]) > 1
    assert all(tiles[layout] == tiles["kitti-raw"] for layout in LAYOUTS)


def test_the_truth_goes_with_the_drive_and_nothing_is_overwritten(
    small_drive: street.Street, tmp_path: Path
) -> None:
    def simulate(folder: Path) -> Path:
        drive = folder / small_drive.drive.parent.name / small_drive.drive.name
        shutil.copytree(small_drive.drive.parent, drive.parent)
        (drive / "truth").mkdir()
        (drive / "truth" / "world.json").write_text("{}")
        return drive

    made = write_in_layout(tmp_path, "mcap", simulate)
    assert made == tmp_path / "2011_09_26_drive_0999"
    assert (made / "truth" / "world.json").read_text() == "{}"
    assert [path.name for path in made.glob("*.mcap")] == [f"{made.name}.mcap"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [made.name]
    with pytest.raises(DataError, match="is already there"):
        write_in_layout(tmp_path, "mcap", simulate)
    assert write_in_layout(tmp_path, "kitti-raw", simulate).name == small_drive.drive.name

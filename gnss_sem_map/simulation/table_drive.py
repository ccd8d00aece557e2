"""Drives of rigs with several sensors, rendered straight into a CSV log."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from factor_graphs.csv_log import GNSS_COLUMNS, IMU_COLUMNS
from gnss_sem_map.datasets import kitti_oxts
from gnss_sem_map.process.machine import threads
from gnss_sem_map.process.thread_pools import thread_pool
from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.drive import Simulation, refuse_there, write_truth
from gnss_sem_map.simulation.png_files import write_ids, write_photo

Progress = Callable[[int, int], None]


def write_table(
    simulation: Simulation, out: Path, progress: Progress | None = None, workers: int | None = None
) -> Path:
    """Write the drive of a rig as a CSV log with its truth into a folder of `out`; returns the folder.

    `progress(done, frames)` is called after every frame; `workers` threads render (None: one per core). The bytes do
    not depend on the threads. Raises DataError when the drive is already there.
    """
    target = out / simulation.name
    with made_aside(out, target) as drive:
        lidars, cameras = simulation.rig.lidars, simulation.rig.cameras
        for folder in (
            *(f"{part}/{lidar.name}" for part in ("lidar", "truth/labels") for lidar in lidars),
            *(f"{part}/{camera.name}" for part in ("images", "truth/train_ids") for camera in cameras),
        ):
            (drive / folder).mkdir(parents=True)
        _write_tables(simulation, drive)
        (drive / "log.yaml").write_text(json.dumps(_about(simulation), indent=1) + "\n")  # JSON is YAML
        write_truth(simulation, drive / "truth")
        render_frames(simulation, lambda k: _write_frame(simulation, k, drive), progress, workers)
    return target


@contextmanager
def made_aside(out: Path, target: Path) -> Iterator[Path]:
    """A folder to write into, which is moved to `target` when all is written; raises DataError when it is there."""
    refuse_there(target)
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".simulated-", dir=out) as folder:
        drive = Path(folder) / target.name
        drive.mkdir()
        yield drive
        target.parent.mkdir(parents=True, exist_ok=True)
        drive.rename(target)


def render_frames(
    simulation: Simulation, write: Callable[[int], None], progress: Progress | None, workers: int | None
) -> None:
    """Write all frames on some threads (None: one per core)."""
    frames = len(simulation.sweeps)
    with thread_pool(workers or threads()) as pool:
        for done, _ in enumerate(pool.map(write, range(frames)), 1):
            if progress is not None:
                progress(done, frames)


def _write_tables(simulation: Simulation, drive: Path) -> None:
    """imu.csv at 100 Hz, gnss.csv at 10 Hz, and the stamps of scans and images."""
    rows, stamps = simulation.oxts, _seconds(simulation, simulation.oxts_stamps)
    imu = np.column_stack([stamps, rows[:, kitti_oxts.SPECIFIC_FORCE], rows[:, kitti_oxts.ANGULAR_RATE]])
    _write_rows(drive / "imu.csv", IMU_COLUMNS, imu)
    fixes, accuracy = rows[simulation.sync], rows[simulation.sync, kitti_oxts.POSITION_ACCURACY]
    places = fixes[:, [kitti_oxts.LAT, kitti_oxts.LON, kitti_oxts.ALT]]
    gnss = np.column_stack([stamps[simulation.sync], places, accuracy, accuracy, accuracy])
    _write_rows(drive / "gnss.csv", GNSS_COLUMNS, gnss)
    for lidar in simulation.rig.lidars:
        _write_numbers(simulation, drive / "lidar" / lidar.name, simulation.stamps + lidar.sweep_after_s)
    for camera in simulation.rig.cameras:
        _write_numbers(simulation, drive / "images" / camera.name, simulation.stamps + camera.stamp_after_s)


def _write_numbers(simulation: Simulation, folder: Path, stamps: Floats) -> None:
    lines = [f"{k},{stamp!r}\n" for k, stamp in enumerate(_seconds(simulation, stamps).tolist())]
    (folder / "stamps.csv").write_text("number,stamp_s\n" + "".join(lines))


def _seconds(simulation: Simulation, stamps: Floats) -> Floats:
    """Seconds since the log's epoch, in whole nanoseconds."""
    zero_ns = round(simulation.zero_s * 1e9)
    return np.asarray((np.round(stamps * 1e9).astype(np.int64) - zero_ns) * 1e-9)


def _write_rows(path: Path, columns: tuple[str, ...], rows: Floats) -> None:
    lines = [",".join(map(repr, row)) + "\n" for row in rows.tolist()]
    path.write_text(",".join(columns) + "\n" + "".join(lines))


def _about(simulation: Simulation) -> dict[str, Any]:
    cameras = {
        camera.name: {
            "K": camera.sensor.K.tolist(),
            "image_size": [camera.sensor.width, camera.sensor.height],
            "T_imu_camera": camera.T_imu_camera.tolist(),
            "distortion": None if camera.sensor.distortion is None else camera.sensor.distortion.model_dump(),
            "time_offset_s": round(camera.exposure_after_s - camera.stamp_after_s, 6),
        }
        for camera in simulation.rig.cameras
    }
    return {
        "epoch_ns": simulation.morning_ns + round(simulation.zero_s * 1e9),
        "lidars": {
            lidar.name: {"T_imu_lidar": lidar.T_imu_lidar.tolist()} for lidar in simulation.rig.lidars
        },
        "cameras": cameras,
        "imu_noise": kitti_oxts.OXTS_NOISE.model_dump(),
        "initial_attitude": {
            "quaternion_xyzw": kitti_oxts.quaternions(simulation.oxts[:1])[0].tolist(),
            "stddevs_rad": kitti_oxts.ATTITUDE_STDDEVS_RAD.tolist(),
        },
    }


def _write_frame(simulation: Simulation, k: int, drive: Path) -> None:
    name = f"{k:010d}"
    duration = float(np.ptp(simulation.sweeps[k]))
    for number, lidar in enumerate(simulation.rig.lidars):
        scan = simulation.scan(k, number)
        after = (scan.fractions - 0.5) * duration
        rows = np.column_stack([scan.points, after]).astype("<f4")
        (drive / "lidar" / lidar.name / f"{name}.bin").write_bytes(rows.tobytes())
        labels = scan.labels.astype("<u4")
        (drive / "truth" / "labels" / lidar.name / f"{name}.label").write_bytes(labels.tobytes())
    for number, camera in enumerate(simulation.rig.cameras):
        image = simulation.image(k, number)
        write_photo(drive / "images" / camera.name / f"{name}.png", image.rgb)
        write_ids(drive / "truth" / "train_ids" / camera.name / f"{name}.png", image.train_ids)

"""From a seed to a drive on disk: KITTI raw files and the exact truth beside them."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from factor_graphs.geodesy import LocalFrame
from gnss_sem_map.errors import DataError
from gnss_sem_map.files.output_folder import locked
from gnss_sem_map.files.ownership import MARKER, read_list, write_list
from gnss_sem_map.process.machine import threads
from gnss_sem_map.process.thread_pools import thread_pool
from gnss_sem_map.simulation.camera import Camera, SimulatedImage, render_image
from gnss_sem_map.simulation.compiled import Floats
from gnss_sem_map.simulation.jam import drive_through_jam
from gnss_sem_map.simulation.kitti_rig import T_IMU_LIDAR, camera_in_lidar, write_calibration
from gnss_sem_map.simulation.lidar import Lidar, SimulatedScan, render_scan
from gnss_sem_map.simulation.oxts import DATAFORMAT, Gnss, oxts_rows, row_text, sweep_rows
from gnss_sem_map.simulation.png_files import write_ids, write_photo
from gnss_sem_map.simulation.rigs import Rig, kitti
from gnss_sem_map.simulation.sessions import Change, changes, session_of
from gnss_sem_map.simulation.streets import around_the_block
from gnss_sem_map.simulation.town import build_town
from gnss_sem_map.simulation.tracklets import write_tracklets
from gnss_sem_map.simulation.traffic import EARLY_S, LATE_S, drive_through, lap_length, lap_seconds
from gnss_sem_map.simulation.truth import (
    seen_alone,
    seen_boxes,
    write_changes,
    write_trajectory,
    write_vehicles,
)
from gnss_sem_map.simulation.world import World

SECONDS = 30.0  # of a drive, when nothing else is said
_OTHER_SENSOR = 20_011  # apart in the numbers of the noise: a drive of 2000 s has as many frames
_MORNING = np.timedelta64(9 * 60 + 30, "m")  # UTC, stamp zero of the simulation
_PLACE = LocalFrame(lat_deg=49.0131, lon_deg=8.4044, alt_m=115.0)


@dataclass(frozen=True, eq=False)
class Simulation:
    """A drive before it is written: world, times of the measurements, rows of the navigation unit.

    Stamps are seconds since the first row of the drive's oxts; the map is the LocalFrame of that row's position.
    """

    seed: int
    session: int
    world: World
    rig: Rig
    sweeps: Floats
    """(frames, 2) s, start and end of every sweep."""
    oxts_stamps: Floats
    """(n,) s, 100 Hz."""
    oxts: Floats
    """(n, 30)"""
    sync: npt.NDArray[np.int64]
    """(frames,) the row of `oxts` that belongs to every sweep."""
    changes: list[Change]
    """What came and went since session 0, in the simulation's own axes; see `to_map`."""
    jam: bool = False
    """Slow traffic."""

    @property
    def name(self) -> str:
        """Date and number of the drive."""
        return drive_name(self.seed, self.session)

    @property
    def day(self) -> int:
        """Seed of all that another day brings: traffic, light and noise."""
        return day_of(self.seed, self.session)

    @property
    def morning_ns(self) -> int:
        """Unix time of stamp zero of the simulation."""
        return int((_date_of(self.session) + _MORNING).astype("datetime64[ns]").astype(np.int64))

    @property
    def lidar(self) -> Lidar:
        """The first one."""
        return self.rig.lidars[0].sensor

    @property
    def camera(self) -> Camera:
        """The first one."""
        return self.rig.cameras[0].sensor

    @property
    def stamps(self) -> Floats:
        """The stamp of every scan: the middle of its sweep, (frames,) s."""
        return np.asarray(self.sweeps.mean(axis=1))

    @property
    def zero_s(self) -> float:
        """Simulated time of stamp zero of the log: the first row of the drive's oxts."""
        return float(self.oxts_stamps[self.sync[0]])

    @property
    def frame(self) -> LocalFrame:
        """The map's frame: the position that the first row of the drive's oxts reports."""
        return LocalFrame(*(float(v) for v in self.oxts[self.sync[0], :3]))

    @property
    def place(self) -> LocalFrame:
        """The simulation's own axes."""
        return _PLACE

    def to_map(self, points: Floats) -> Floats:
        """From the simulation's own axes (origin at `_PLACE`) to the map that readers of the drive will find."""
        return self.frame.to_map(*_PLACE.to_geodetic(points))

    def scan(self, frame: int, number: int = 0) -> SimulatedScan:
        """The sweep of a frame by a LiDAR of the rig."""
        lidar = self.rig.lidars[number]
        start, end = self.sweeps[frame] + lidar.sweep_after_s
        return render_scan(
            self.world, lidar.T_imu_lidar, start, end,
            lidar=lidar.sensor, seed=self.day, frame=frame + number * _OTHER_SENSOR,
        )  # fmt: skip

    def image(self, frame: int, number: int = 0) -> SimulatedImage:
        """The image of a frame by a camera of the rig, at its moment of exposure."""
        camera = self.rig.cameras[number]
        moment = self.stamps[frame] + camera.exposure_after_s
        T_map_camera = self.world.ego.poses([moment])[0] @ camera.T_imu_camera
        return render_image(
            self.world, T_map_camera, moment,
            camera=camera.sensor, seed=self.day, frame=frame + number * _OTHER_SENSOR,
        )  # fmt: skip

    def project(
        self, frame: int, scan: SimulatedScan
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Floats]:
        """Pixels u, v and depths of the first LiDAR's points in the first camera's image, which is no lens: each point
        at its position of its own stamp, the camera at its pose of the exposure."""
        start, end = self.sweeps[frame]
        columns, column = np.unique(scan.fractions, return_inverse=True)
        exposure = self.stamps[frame] + self.rig.cameras[0].exposure_after_s
        stamps = np.append(start + columns * (end - start), exposure)
        T_map_lidar = self.world.ego.poses(stamps) @ T_IMU_LIDAR
        T = camera_in_lidar(self.camera) @ np.linalg.inv(T_map_lidar[-1]) @ T_map_lidar[:-1]
        p = scan.points[:, :3].astype(np.float64)
        x, y, z = (np.einsum("nij,nj->ni", T[column, :3, :3], p) + T[column, :3, 3]).T
        f, ahead = self.camera.focal_px, np.maximum(z, 1e-3)
        u = np.round(f * x / ahead + self.camera.centre_u_px).astype(np.int64)
        return u, np.round(f * y / ahead + self.camera.centre_v_px).astype(np.int64), z


def _date_of(session: int) -> np.datetime64:
    return np.datetime64("2026-04-18") + np.timedelta64(session, "D")


def drive_name(seed: int, session: int = 0) -> str:
    """Date and number of the drive of this seed in this session."""
    return f"{str(_date_of(session)).replace('-', '_')}_drive_{seed:04d}"


def refuse_there(*places: Path) -> None:
    """Raise DataError for a place of a drive where something is already."""
    for place in places:
        if place.exists():
            raise DataError(f"{place}: is already there; remove it or simulate into another folder")


def day_of(seed: int, session: int) -> int:
    """Seed of all that differs between two sessions of one town, but for the town itself."""
    return seed + 1_000_000 * session


def prepare(
    seconds: float | None,
    seed: int,
    lidar: Lidar | None = None,
    camera: Camera | None = None,
    *,
    laps: int = 1,
    session: int = 0,
    gnss: Gnss = "unit",
    jam: bool = False,
    rig: Rig | None = None,
) -> Simulation:
    """Build the town, the traffic and the measurements of the navigation unit; nothing is rendered yet.

    See `simulate`. `rig`: default is KITTI's, with `lidar` and `camera`.
    """
    rig = rig or kitti(lidar, camera)
    usual = build_town(seed, crossings=4 + int((seconds or SECONDS) / 7.0))
    if laps > 1:
        usual = replace(usual, route=around_the_block(usual.route, laps))
    if seconds is None:
        seconds = lap_seconds(usual, laps) if laps > 1 else SECONDS
    frames = round(10.0 * seconds)
    if frames < 3:
        raise DataError(
            f"a drive of {seconds} s has {frames} scans, expected at least 3; ask for 0.3 s or more"
        )
    day, built = day_of(seed, session), session_of(usual, seed, session)
    town, ego, movers = (
        drive_through_jam(built, seconds, day) if jam
        else drive_through(built, seconds, day, laps=laps, weaves=laps > 1 or session > 0)
    )  # fmt: skip
    rng = np.random.default_rng([day, 5])
    # no two days' scans are of the same places
    first = 0.05 + (float(rng.uniform(0.0, 0.1)) if session else 0.0)
    edges = first + 0.1 * np.arange(frames + 1) + np.concatenate([[0.0], rng.uniform(-4e-4, 4e-4, frames)])
    sweeps = np.column_stack([edges[:-1], edges[1:]])
    ticks = np.arange(-EARLY_S + 0.05, seconds + LATE_S - 0.3, 0.01)
    oxts_stamps = ticks + rng.uniform(-2e-4, 2e-4, len(ticks))
    driven = ego.way(oxts_stamps) / lap_length(town) if laps > 1 else None
    rows = oxts_rows(ego, oxts_stamps, _PLACE, rng, gnss, driven)
    sync = sweep_rows(oxts_stamps, sweeps.mean(axis=1), rng)
    world = World(town, ego, movers)
    world.remember(_moments(rig, sweeps))
    return Simulation(seed, session, world, rig, sweeps, oxts_stamps, rows, sync, changes(usual, built), jam)


def _moments(rig: Rig, sweeps: Floats) -> Floats:
    """When the sensors measure: start, middle and end of every sweep, and every exposure."""
    moments = []
    for lidar in rig.lidars:
        start, end = (sweeps + lidar.sweep_after_s).T
        moments += [start, 0.5 * (start + end), end]
    middles = sweeps.mean(axis=1)
    return np.unique(
        np.concatenate([*moments, *(middles + camera.exposure_after_s for camera in rig.cameras)])
    )


def simulate(
    folder: Path,
    seconds: float | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    *,
    lidar: Lidar | None = None,
    camera: Camera | None = None,
    workers: int | None = None,
    laps: int = 1,
    session: int = 0,
    gnss: Gnss = "unit",
    jam: bool = False,
) -> Path:
    """Write the drive of a seed in KITTI raw format, with its truth, under `folder`; returns the drive's folder.

    `seconds` (None: 30, or as long as the laps take) is the length of the drive. More than one of `laps` lead around a
    block of the town. `session` K is the drive K days later. `gnss`: positions of the inertial unit, or of a consumer's
    receiver of 1 m. `jam`: slow traffic in place of the usual one, in the first street of the route.
    `progress(done, frames)` is called after every frame; `workers` threads render (None: one per core). The bytes
    do not depend on the threads. Raises DataError when the drive is already there or is too short.
    """
    date = str(_date_of(session)).replace("-", "_")
    drive = Path(folder) / date / f"{drive_name(seed, session)}_sync"
    refuse_there(drive, _twin(drive))
    simulation = prepare(seconds, seed, lidar, camera, laps=laps, session=session, gnss=gnss, jam=jam)
    with _for_us_alone(drive) as partial:
        write_calibration(partial / "calibration", camera or Camera())
        _refuse_other_calibration(partial / "calibration", drive.parent)
        _write_still(simulation, partial)
        frames = len(simulation.sweeps)
        seen: list[npt.NDArray[np.uint16]] = []
        with thread_pool(workers or threads()) as pool:
            for done, instances in enumerate(
                pool.map(lambda k: _write_frame(simulation, k, partial / "sync"), range(frames)), 1
            ):
                seen.append(instances)
                if progress is not None:
                    progress(done, frames)
        boxes = seen_boxes(simulation.world, simulation.sweeps, seen)
        write_tracklets(partial / "sync" / "tracklet_labels.xml", boxes)
        for path in (partial / "calibration").iterdir():
            path.rename(drive.parent / path.name)
        (partial / "extract").rename(_twin(drive))
        (partial / "sync").rename(drive)  # the last: a drive is there whole or not at all
    return drive


@contextmanager
def _for_us_alone(drive: Path) -> Iterator[Path]:
    """A marked work folder beside a drive; the rest of an interrupted simulation in it is removed."""
    partial = drive.with_name(f".{drive.name}.partial")
    try:
        drive.parent.mkdir(parents=True, exist_ok=True)
        with locked(drive):
            if os.path.lexists(partial) and read_list(partial) is None and os.listdir(partial):
                raise DataError(f"{partial}: is in the way, and not ours; move it away")
            try:
                _clear(partial)
                partial.mkdir()
                write_list(partial)
                (partial / "calibration").mkdir()
                yield partial
            finally:
                _clear(partial)
    except OSError as error:
        raise DataError(
            f"{drive}: cannot be written ({error.strerror}); free the disk or simulate into another folder"
        ) from None


def _clear(partial: Path) -> None:
    """Remove an unfinished drive; its ownership marker last."""
    if partial.is_dir():
        for part in ("sync", "extract", "calibration"):
            shutil.rmtree(partial / part, ignore_errors=True)
        (partial / MARKER).unlink(missing_ok=True)
        partial.rmdir()


def _refuse_other_calibration(new: Path, date: Path) -> None:
    for path in sorted(new.iterdir()):
        there = date / path.name
        if os.path.lexists(there) and there.read_bytes() != path.read_bytes():
            raise DataError(f"{there}: is the calibration of another drive; simulate into another folder")


def _twin(drive: Path) -> Path:
    return drive.with_name(drive.name.replace("_sync", "_extract"))


def _write_still(simulation: Simulation, folder: Path) -> None:
    """Oxts, stamps, and the truth that needs no rendering."""
    partial = folder / "sync"
    for name in (
        "velodyne_points/data",
        "image_02/data",
        "truth/labels",
        "truth/train_ids",
        "truth/single_frame",
    ):
        (partial / name).mkdir(parents=True)
    morning_ns = simulation.morning_ns
    write_oxts(partial, morning_ns, simulation.oxts_stamps[simulation.sync], simulation.oxts[simulation.sync])
    write_oxts(folder / "extract", morning_ns, simulation.oxts_stamps, simulation.oxts)
    stamps = {"": simulation.stamps, "_start": simulation.sweeps[:, 0], "_end": simulation.sweeps[:, 1]}
    for name, values in stamps.items():
        write_stamps(partial / "velodyne_points" / f"timestamps{name}.txt", morning_ns, values)
    write_stamps(
        partial / "image_02" / "timestamps.txt",
        morning_ns,
        simulation.stamps + simulation.rig.cameras[0].stamp_after_s,
    )
    write_truth(simulation, partial / "truth")


def write_truth(simulation: Simulation, truth: Path) -> None:
    """The truth that needs no rendering, into a folder that is there."""
    frame = simulation.frame
    about = {
        "epoch_ns": simulation.morning_ns + round(simulation.zero_s * 1e9),
        "lat_deg": frame.lat_deg, "lon_deg": frame.lon_deg, "alt_m": frame.alt_m, "seed": simulation.seed,
    }  # fmt: skip
    if simulation.jam:
        about["jam"] = True
    (truth / "world.json").write_text(json.dumps(about, indent=2) + "\n")
    to_map, zero = simulation.to_map, simulation.zero_s
    write_trajectory(truth / "trajectory.tum", simulation.world.ego, simulation.oxts_stamps, zero, to_map)
    write_trajectory(truth / "trajectory_lidar.tum", simulation.world.ego, simulation.stamps, zero, to_map)
    write_vehicles(truth / "vehicles.csv", simulation.world, simulation.stamps, zero, to_map)
    if simulation.session:
        write_changes(truth / "changes.json", simulation.session, simulation.changes, to_map)


def write_oxts(drive: Path, morning_ns: int, stamps: Floats, rows: Floats) -> None:
    """`drive/oxts`: stamps and rows of the navigation unit."""
    (drive / "oxts" / "data").mkdir(parents=True)
    (drive / "oxts" / "dataformat.txt").write_text(DATAFORMAT)
    write_stamps(drive / "oxts" / "timestamps.txt", morning_ns, stamps)
    for k, row in enumerate(rows):
        (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(row_text(row))


def write_stamps(path: Path, morning_ns: int, stamps: Floats) -> None:
    """One line `date time` with nanoseconds for each stamp."""
    times = (morning_ns + np.round(stamps * 1e9).astype(np.int64)).astype("datetime64[ns]")
    path.write_text("".join(str(time).replace("T", " ") + "\n" for time in times))


def write_scan(drive: Path, name: str, scan: SimulatedScan) -> None:
    """The points and the true labels of a sweep."""
    (drive / "velodyne_points" / "data" / f"{name}.bin").write_bytes(scan.points.astype("<f4").tobytes())
    (drive / "truth" / "labels" / f"{name}.label").write_bytes(scan.labels.astype("<u4").tobytes())


def _write_frame(simulation: Simulation, k: int, drive: Path) -> npt.NDArray[np.uint16]:
    """Render and write one scan and one image with their truth; returns the instances that the image shows."""
    name, scan, image = f"{k:010d}", simulation.scan(k), simulation.image(k)
    write_scan(drive, name, scan)
    write_photo(drive / "image_02" / "data" / f"{name}.png", image.rgb)
    write_ids(drive / "truth" / "train_ids" / f"{name}.png", image.train_ids)
    alone = seen_alone(image, *simulation.project(k, scan))
    (drive / "truth" / "single_frame" / f"{name}.label").write_bytes(alone.astype("<u4").tobytes())
    numbers, counts = np.unique(image.instances, return_counts=True)
    return numbers[(numbers > 0) & (counts >= 60)]

"""Readers of drives, labels and positions, each with a file that it takes: made in a folder, by name."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import street
from faults import mutations
from faults.fuzzing import Reader
from pyproj import Transformer
from receivers import LEAP_NS, gga, moment, pos_row, rmc
from ros import START_NS

from factor_graphs.trajectory import Trajectory
from factor_graphs.tum import write_tum
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.gnss_files.time_systems import GPS_EPOCH_NS, WEEK_NS
from gnss_sem_map.export.navigation import write_sbet
from gnss_sem_map.labels import label_set

FRAMES = range(4)


def small_street(folder: Path) -> street.Street:
    """Four scans of few points."""
    folder.mkdir(parents=True)
    return street.write(folder, tuple(FRAMES), beams=4, azimuths=60)


def _whole_drive(drive: Path) -> Callable[[], object]:
    def read() -> object:
        log = open_drive(drive)
        return [item.read() for item in (*log.scans[:1], *log.images[:1])]

    return read


def kitti(name: str, mutate: Callable[..., bytes], folder: Path) -> Reader:
    """A file of a KITTI raw drive."""
    drive = small_street(folder).drive
    return Reader((drive / name).resolve(), _whole_drive(drive), mutate)


def scan_of_text(folder: Path) -> Reader:
    """A scan as `_extract` drives of KITTI have it."""
    drive = small_street(folder).drive
    scan = min((drive / "velodyne_points/data").glob("*.bin"))
    np.savetxt(scan.with_suffix(".txt"), np.fromfile(scan, "<f4").reshape(-1, 4), fmt="%.6g")
    scan.unlink()
    return Reader(scan.with_suffix(".txt"), _whole_drive(drive), mutations.text)


def odometry(name: str, mutate: Callable[..., bytes], folder: Path) -> Reader:
    """A file of an odometry sequence."""
    sequence = street.write_odometry(folder, small_street(folder / "street"))
    return Reader(sequence / name, _whole_drive(sequence), mutate)


def table(name: str, mutate: Callable[..., bytes], folder: Path) -> Reader:
    """A file of a table log."""
    drive = street.write_table_log(folder, small_street(folder / "street"))
    for file in ("imu.csv", "gnss.csv"):
        lines = (drive / file).read_text().splitlines()
        (drive / file).write_text("\n".join(lines[:40]) + "\n")
    return Reader(drive / name, _whole_drive(drive), mutate)


def bag(is_ros1: bool, folder: Path) -> Reader:
    """An MCAP file with messages of all kinds: what is in it, the log, and its first scans and images."""
    import ros
    import ros_drivers
    from mcap.writer import CompressionType

    from gnss_sem_map.datasets.ros.bag import Bag
    from gnss_sem_map.datasets.ros.contents import contents_of, suggested_rig

    folder.mkdir(parents=True)
    file = ros.write_mcap(
        folder / "drive.mcap", ros_drivers.small(is_ros1), "", compression=CompressionType.NONE
    )

    def read() -> object:
        opened = Bag(file)
        log = open_drive(file)
        seen = [item.read() for item in (*log.scans[:2], *log.images[:2])]
        return suggested_rig(opened, contents_of(opened)), seen

    return Reader(file, read, mutations.binary)


def robot(folder: Path) -> Reader:
    """A URDF, which is a message of a bag."""
    import ros_drivers

    from gnss_sem_map.datasets.ros.static_tf import fixed_joints

    folder.mkdir(parents=True)
    file = folder / "robot.urdf"
    file.write_text(ros_drivers.urdf(*(ros_drivers.joint(*edge) for edge in ros_drivers.EDGES)))
    return Reader(
        file, lambda: list(fixed_joints(file.read_bytes().decode("utf-8", "replace"))), mutations.text
    )


def scan(folder: Path) -> Reader:
    """A scan with point times, and the map's idea of where its points are."""
    from factor_graphs.errors import MeasurementError
    from factor_graphs.trajectory import Trajectory
    from gnss_sem_map.scans.deskew import points_in_map

    reader = table("lidar/0.bin", mutations.floats, folder)
    log = open_drive(reader.file.parents[1])
    still = Trajectory(np.array([-2.0, 5.0]), np.tile(np.eye(4), (2, 1, 1)))

    def read() -> object:
        points = log.scans[0].read()
        try:
            return points_in_map(points, log.scans[0].stamp, still, np.eye(4))
        except MeasurementError:
            return None

    object.__setattr__(log.scans[0], "read", functools.partial(_read_now, reader.file, log.scans[0].stamp))
    return Reader(reader.file, read, mutations.floats)


def _read_now(path: Path, stamp: float) -> object:
    from gnss_sem_map.datasets.csv_log import _read_scan
    from gnss_sem_map.datasets.log_yaml import LidarFile

    return _read_scan(path, stamp, LidarFile(T_imu_lidar=np.eye(4).tolist()), None)


def picture(suffix: str, mutate: Callable[..., bytes], folder: Path) -> Reader:
    """A camera image."""
    import cv2

    from gnss_sem_map.files.pictures import read_picture as read_image

    folder.mkdir(parents=True)
    file = folder / f"0{suffix}"
    rng = np.random.default_rng(0)
    cv2.imwrite(str(file), cv2.GaussianBlur(rng.integers(0, 255, (96, 300, 3), np.uint8), (9, 9), 3))
    return Reader(file, lambda: read_image(file, None), mutate)


def label_image(mode: str, folder: Path) -> Reader:
    """An image of class ids of 8 (L) or 16 bits, by a palette (P), or of colours (RGB)."""
    from PIL import Image

    from gnss_sem_map.segmentation.cached import CachedLabels

    folder.mkdir(parents=True)
    ids = np.random.default_rng(0).integers(0, 4, (96, 300), np.uint8)
    colours = np.array([(128, 64, 128), (244, 35, 232), (70, 70, 70), (102, 102, 156)], np.uint8)
    picture = Image.fromarray(
        colours[ids] if mode == "RGB" else ids.astype(np.uint16) if mode == "I;16" else ids
    )
    if mode == "P":
        picture.putpalette(colours.ravel().tolist())
    picture.save(folder / "0.png")
    return Reader(
        folder / "0.png", lambda: CachedLabels(folder, label_set.open_label_set(), None), mutations.png
    )


def probabilities(folder: Path) -> Reader:
    """Class probabilities of an image."""
    from gnss_sem_map.segmentation.cached import CachedLabels

    made = small_street(folder)
    for other in sorted(made.labels.glob("*.npz"))[1:]:
        other.unlink()
    file = next(made.labels.glob("*.npz"))
    return Reader(file, lambda: CachedLabels(made.labels, label_set.open_label_set(), None), mutations.npz)


def point_labels(folder: Path) -> Reader:
    """Labels of points, and the probabilities of them in a file of the same bytes."""
    from gnss_sem_map.datasets.label_files import read_confidence, read_labels

    folder.mkdir(parents=True)
    file = folder / "0.label"
    np.zeros(500, "<u4").tofile(file)
    return Reader(file, lambda: (read_labels(file), read_confidence(file)), mutations.binary)


def tum(folder: Path) -> Reader:
    """A trajectory in TUM format."""
    from gnss_sem_map.datasets.given_trajectory import read_tum

    folder.mkdir(parents=True)
    file = folder / "t.tum"
    file.write_text("".join(f"{k * 0.1:.1f} {k} 0 0 0 0 0 1\n" for k in range(20)))
    return Reader(file, lambda: read_tum(file), mutations.text)


def given(name: str, mutate: Callable[..., bytes], folder: Path) -> Reader:
    """Poses in a file of their own, with the log that they belong to."""
    this = small_street(folder / "street")
    drive, file = street.write_table_log(folder, this), folder / name
    stamps = np.arange(0.0, 0.4, 0.02)
    poses = Trajectory(stamps, this.motion.poses(stamps), covariances=np.tile(np.eye(6), (len(stamps), 1, 1)))
    epoch_ns = int(street.EPOCH.astype(np.int64))
    write = {".tum": write_tum, ".parquet": Trajectory.save}.get(file.suffix)
    if write is None:
        write_sbet(poses, street.FRAME, epoch_ns, file)
    else:
        write(poses, file)
    return Reader(file, lambda: open_drive(drive, trajectory=file), mutate)


def positions(name: str, content: str, folder: Path) -> Reader:
    """Positions of a receiver in a file of its own."""
    from receivers import read

    folder.mkdir(parents=True)
    file = folder / name
    file.write_text(content)
    return Reader(file, lambda: read(file), mutations.text)


def cloud(suffix: str, point_format: int, folder: Path) -> Reader:
    """A georeferenced point cloud that drives are held onto."""
    import laspy
    from pyproj import CRS

    from gnss_sem_map.datasets.laz_cloud import read_base

    folder.mkdir(parents=True)
    file, header = folder / f"cloud{suffix}", laspy.LasHeader(point_format=point_format, version="1.4")
    header.add_crs(CRS.from_epsg(street.FRAME.utm_epsg))
    x, y = Transformer.from_crs(4326, street.FRAME.utm_epsg, always_xy=True).transform(
        street.FRAME.lon_deg, street.FRAME.lat_deg
    )
    header.scales, header.offsets = np.full(3, 1e-3), np.floor([x, y, 0.0])
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.random.default_rng(0).normal([[x], [y], [street.FRAME.alt_m]], 20.0, (3, 500))
    las.write(file)
    return Reader(file, lambda: read_base(file, street.FRAME), mutations.binary)


FIXES = [START_NS + k * 10**9 for k in range(20)]
SOLUTION = (
    "% GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s)\n"
)
EXPORT = """Project:     loop
   Week   GPSTime       Latitude      Longitude     H-Ell SDNorth SDEast SDHeight Q
(weeks)     (sec)     (+/-D M S)     (+/-D M S)       (m)     (m)    (m)      (m)
"""
WEEK, SECONDS = divmod((START_NS + LEAP_NS - GPS_EPOCH_NS) // 10**9, WEEK_NS // 10**9)


DRIVE_FILES: dict[str, Callable[[Path], Reader]] = {
    "oxts row": functools.partial(kitti, "oxts/data/0000000002.txt", mutations.text),
    "oxts stamps": functools.partial(kitti, "oxts/timestamps.txt", mutations.text),
    "sweep stamps": functools.partial(kitti, "velodyne_points/timestamps_end.txt", mutations.text),
    "image stamps": functools.partial(kitti, "image_02/timestamps.txt", mutations.text),
    "calib_imu_to_velo.txt": functools.partial(kitti, "../calib_imu_to_velo.txt", mutations.text),
    "calib_velo_to_cam.txt": functools.partial(kitti, "../calib_velo_to_cam.txt", mutations.text),
    "calib_cam_to_cam.txt": functools.partial(kitti, "../calib_cam_to_cam.txt", mutations.text),
    "calib.txt": functools.partial(odometry, "calib.txt", mutations.text),
    "poses.txt": functools.partial(odometry, "poses.txt", mutations.text),
    "times.txt": functools.partial(odometry, "times.txt", mutations.text),
    "imu.csv": functools.partial(table, "imu.csv", mutations.text),
    "gnss.csv": functools.partial(table, "gnss.csv", mutations.text),
    "log.yaml": functools.partial(table, "log.yaml", mutations.text),
    "stamps.csv": functools.partial(table, "lidar/stamps.csv", mutations.text),
    "MCAP of ROS 1": functools.partial(bag, True),
    "MCAP of ROS 2": functools.partial(bag, False),
    "URDF": robot,
    "scan of four columns": functools.partial(kitti, "velodyne_points/data/0000000000.bin", mutations.floats),
    "scan of five columns": scan,
    "scan of text": scan_of_text,
    "PNG": functools.partial(picture, ".png", mutations.png),
    "JPEG": functools.partial(picture, ".jpg", mutations.binary),
    "label PNG": functools.partial(label_image, "L"),
    "label PNG of 16 bits": functools.partial(label_image, "I;16"),
    "label PNG by a palette": functools.partial(label_image, "P"),
    "label PNG of colours": functools.partial(label_image, "RGB"),
    "probabilities": probabilities,
    "point labels": point_labels,
    "TUM": tum,
    "poses in TUM": functools.partial(given, "poses.tum", mutations.text),
    "poses in Parquet": functools.partial(given, "poses.parquet", mutations.parquet),
    "poses in SBET": functools.partial(given, "poses.sbet", mutations.floats),
    "RTKLIB": functools.partial(
        positions, "a.pos", SOLUTION + "\n".join(pos_row(ns + LEAP_NS) for ns in FIXES)
    ),
    "RTKLIB, baselines": functools.partial(
        positions,
        "a.LLH",
        "% ref pos : 49.0 8.4 150.0\n%  GPST;e-baseline(m);n-baseline(m);u-baseline(m);Q\n"
        + "".join(
            f"{moment(ns + LEAP_NS):%Y/%m/%d %H:%M:%S.000};1.5;2.5;3.5;1;9;0.1;0.1;0.1;0;0;0\n"
            for ns in FIXES
        ),
    ),
    "NMEA": functools.partial(positions, "a.nmea", "".join(rmc(ns) + gga(ns) for ns in FIXES)),
    "Inertial Explorer": functools.partial(
        positions,
        "a.txt",
        EXPORT
        + "".join(
            f"{WEEK} {SECONDS + k} 49 00 0{k % 10}.5 8 24 00.1 160.1 0.1 0.1 0.2 1\n" for k in range(20)
        ),
    ),
    "CSV of positions": functools.partial(
        positions,
        "a.csv",
        "Time;Lat;Lon;H-Ell;sdE;sdN;sdU\n"
        + "".join(f"{moment(ns).isoformat()};49,0;8,4;160,1;0,1;0,1;0,2\n" for ns in FIXES),
    ),
    "LAS": functools.partial(cloud, ".las", 6),
    "LAZ": functools.partial(cloud, ".laz", 7),
    "LAZ before 1.4": functools.partial(cloud, ".laz", 1),
}

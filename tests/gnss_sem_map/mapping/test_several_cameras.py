"""Several cameras: each is projected by its own lens at its own exposure, and the map has what all of them show."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import street
from chunks import assert_same, build_maps
from numpy.typing import NDArray
from street import Street

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping import fingerprints
from gnss_sem_map.mapping.labelled_scans import Drive, labelled_scans
from gnss_sem_map.preflight import camera
from gnss_sem_map.preflight.findings import Level
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.segmentation.cache import write_cache
from gnss_sem_map.segmentation.cached_segmenter import CachedSegmenter, probabilities_folder
from gnss_sem_map.sensor_log import Image

URBAN = open_label_set()
SETTINGS = Settings.model_validate({"dynamics": {"enabled": False}})
FRONT: dict[str, Any] = {
    "K": street.K.tolist(),
    "T_camera_lidar": street.T_CAMERA_LIDAR.tolist(),
    "image_size": [street.WIDTH, street.HEIGHT],
    "time_offset_s": -street.EXPOSED_BEFORE_STAMP_S,
}
SIDE_K, SIDE_SIZE, SIDE_LENS = (
    np.array([[70.0, 0, 110], [0, 70.0, 80], [0, 0, 1]]),
    (220, 160),
    (0.04, -0.01, 0.004, 0.0),
)
SIDE_OFFSET_S = 0.013
T_IMU_SIDE = np.array([[1.0, 0, 0, 0.2], [0, 0, 1, 0.4], [0, -1, 0, 0.1], [0, 0, 0, 1]])
"""It looks to the left."""
SIDE: dict[str, Any] = {
    "K": SIDE_K.tolist(),
    "T_imu_camera": T_IMU_SIDE.tolist(),
    "image_size": SIDE_SIZE,
    "time_offset_s": SIDE_OFFSET_S,
    "distortion": {"model": "fisheye", "coefficients": SIDE_LENS},
}


def with_cameras(folder: Path, driven: Street, **cameras: dict[str, Any]) -> Path:
    """The small street as a CSV log; all cameras have the images and labels of its own."""
    drive = street.write_table_log(folder, driven)
    about = json.loads((drive / "log.yaml").read_text())
    for key in ("K", "T_camera_lidar", "image_size", "camera_time_offset_s"):
        del about[key]
    (drive / "log.yaml").write_text(json.dumps(about | {"cameras": cameras}))
    shutil.move(drive / "images", folder / "images")
    for name in cameras:
        shutil.copytree(folder / "images", drive / "images" / name)
        shutil.copytree(driven.labels, drive / "labels" / name)
    return drive


def job(drive: Path, driven: Street, labels: Path | None = None) -> Drive:
    """The drive with its exact trajectory."""
    log, stamps = open_drive(drive), np.arange(driven.motion.start, driven.motion.end, 0.01)
    trajectory = Trajectory(stamps, driven.motion.poses(stamps), driven.motion.velocities(stamps))
    spec = f"labels:{labels or drive / 'labels'}"
    return Drive(log, trajectory, open_segmenter(spec, URBAN, sizes=log.calibration.image_sizes), SETTINGS)


def side_image(driven: Street, stamp: float) -> NDArray[np.int64]:
    """Classes (h, w) that the fisheye shows: a ray through the middle of every pixel, by OpenCV."""
    u, v = np.meshgrid(np.arange(SIDE_SIZE[0]) + 0.5, np.arange(SIDE_SIZE[1]) + 0.5)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    rays = cv2.fisheye.undistortPoints(pixels, SIDE_K, np.array(SIDE_LENS)).reshape(-1, 2)
    T = driven.motion.poses([stamp])[0] @ T_IMU_SIDE
    directions = np.column_stack([rays, np.ones(len(rays))]) @ T[:3, :3].T
    return street.cast(np.tile(T[:3, 3], (len(rays), 1)), directions)[1].reshape(SIDE_SIZE[::-1])


@pytest.fixture(scope="module")
def surround(tmp_path_factory: pytest.TempPathFactory, small_drive: Street) -> Path:
    """A camera to the front, and a fisheye to the left."""
    drive = with_cameras(tmp_path_factory.mktemp("surround"), small_drive, front=FRONT, side=SIDE)
    for k in small_drive.frames:
        stamp = (k + 0.5) * street.SWEEP_S + street.IMAGE_AFTER_SCAN_S + SIDE_OFFSET_S
        classes = side_image(small_drive, stamp)
        probabilities = (255 * (classes[:, :, None] == np.arange(6))).astype(np.uint8)
        file = drive / f"labels/side/{k:010d}.npz"
        np.savez(file, probabilities=probabilities, class_names=np.array(street.NAMES))
        cv2.imwrite(
            str(drive / f"images/side/{k}.png"),
            np.repeat(40 * classes[:, :, None], 3, axis=2).astype(np.uint8),
        )
    return drive


def test_two_cameras_that_are_one_make_the_map_of_one(tmp_path: Path, small_drive: Street) -> None:
    alone = street.write_table_log(tmp_path / "alone", small_drive)
    twins = with_cameras(tmp_path / "twins", small_drive, front=FRONT, twin=FRONT)
    one, two = RunStats(), RunStats()
    assert_same(
        build_maps(job(alone, small_drive, small_drive.labels), one).static,
        build_maps(job(twins, small_drive), two).static,
    )
    assert one.counts == two.counts
    assert one.counts["points labelled"] > 1000


def test_a_camera_that_is_the_only_one_of_several_keys_has_no_name(
    tmp_path: Path, small_drive: Street
) -> None:
    """Its labels are where those of an only camera are."""
    drive = with_cameras(tmp_path, small_drive, front=FRONT)
    log = open_drive(drive)
    assert [one.name for one in log.cameras] == [""]
    assert len(log.images) == len(small_drive.frames)
    assert [seen.classes.any() for seen in labelled_scans(job(drive, small_drive, drive / "labels/front"))]


def test_a_fisheye_shows_points_their_class_at_its_own_exposure(surround: Path, small_drive: Street) -> None:
    """Of the points that only the fisheye shows, all but a few at borders have the class of their own."""
    both = job(surround, small_drive)
    front = replace(both, log=replace(both.log, images=both.log.images_of("front")))
    right, total, more, before = 0, 0, 0, 0
    for one, two in zip(labelled_scans(front), labelled_scans(both), strict=True):
        true = small_drive.scan_classes[two.scan.number][two.valid]
        only = (one.pixels < 0) & (two.pixels >= 0)
        right, total = right + int((two.labels[only] == true[only]).sum()), total + int(only.sum())
        more, before = more + int((two.pixels >= 0).sum()), before + int((one.pixels >= 0).sum())
    assert right / total > 0.98
    assert more > 2.5 * before


def test_what_is_said_of_a_camera_decides_the_map(surround: Path, small_drive: Street) -> None:
    drive = job(surround, small_drive)
    said = {fingerprints.of_map(drive, "")}
    calibration = drive.log.calibration
    front, side = calibration.cameras
    assert side.distortion is not None
    bent = side.distortion.model_copy(update={"coefficients": (0.0, 0.0, 0.0, 0.0)})
    for other in (
        replace(side, distortion=bent),
        replace(side, time_offset_s=0.0),
        replace(side, K=side.K + np.eye(3)),
    ):
        log = replace(drive.log, calibration=replace(calibration, cameras=(front, other)))
        said.add(fingerprints.of_map(replace(drive, log=log), ""))
    assert len(said) == 4


class ByCamera:
    """A network that tells cameras apart."""

    class_names = ("road", "building")

    def __init__(self) -> None:
        self.asked: list[str] = []

    def __call__(self, image: Image) -> NDArray[np.uint8]:
        self.asked.append(image.frame)
        probabilities = np.zeros((*image.read().shape[:2], 2), np.uint8)
        probabilities[:, :, int(image.camera == "side")] = 255
        return probabilities


def test_answers_of_a_network_are_kept_by_camera(surround: Path, tmp_path: Path) -> None:
    log, network = open_drive(surround), ByCamera()
    images = log.images_of("front")[:2] + log.images_of("side")[:2]
    folder = probabilities_folder(tmp_path / "work", "1", False, log.calibration.image_sizes)
    kept = CachedSegmenter(network, URBAN, log.calibration.image_sizes, folder)
    for _ in range(2):
        for image in images:
            assert kept(image)[
                :, :, URBAN.names.index("building" if image.camera == "side" else "road")
            ].all()
    assert sorted(network.asked) == sorted(image.frame for image in images)
    report = write_cache(images, network, URBAN, tmp_path / "cache", "by camera")
    assert (report.written, report.skips) == (4, ())
    again = write_cache(images, network, URBAN, tmp_path / "cache", "by camera")
    assert (again.written, again.kept) == (0, 4)
    read = open_segmenter(f"labels:{tmp_path / 'cache'}", URBAN, sizes=log.calibration.image_sizes)
    for image in images:
        np.testing.assert_array_equal(read(image).argmax(axis=2), kept(image).argmax(axis=2))


def test_labels_without_the_folders_of_the_cameras_are_refused(surround: Path, small_drive: Street) -> None:
    with pytest.raises(
        DataError, match=r"no <frame number>.npz or .png in the folders of the cameras, front, side"
    ):
        job(surround, small_drive, small_drive.labels)


def test_findings_name_their_camera(surround: Path, small_drive: Street) -> None:
    drive = job(surround, small_drive)
    found = list(camera.check(Sample(drive.log, SETTINGS, drive.segmenter)))
    assert {finding.check.partition(": ")[0] for finding in found} == {"front", "side"}
    assert all(finding.level is Level.GREEN for finding in found)
    front, side = drive.log.calibration.cameras
    wrong = replace(drive.log.calibration, cameras=(front, replace(side, K=side.K.T.copy())))
    (red,) = [
        one
        for one in camera.check(Sample(replace(drive.log, calibration=wrong), SETTINGS, None))
        if one.level is Level.RED
    ]
    assert (red.check, red.mistake) == (
        "side: K",
        "K is not a camera matrix: transposed, or its numbers in another order",
    )


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"T_camera_lidar": FRONT["T_camera_lidar"]}, "expected one of T_camera_lidar and T_imu_camera"),
        (
            {"distortion": {"model": "fisheye", "coefficients": [0.1]}},
            "found 1 coefficients, not 4: fisheye",
        ),
        (
            {"distortion": {"model": "wide", "coefficients": [0.1]}},
            "Input should be 'brown', 'fisheye' or 'mei'",
        ),
        ({"T_imu_camera": (2 * np.eye(4)).tolist()}, "T_imu_camera is no rigid transform"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(
    tmp_path: Path, small_drive: Street, changed: dict[str, Any], says: str
) -> None:
    drive = with_cameras(tmp_path, small_drive, front=FRONT, side=SIDE | changed)
    with pytest.raises(DataError, match=says):
        open_drive(drive)


def test_the_name_of_a_camera_is_no_path(tmp_path: Path, small_drive: Street) -> None:
    drive = street.write_table_log(tmp_path, small_drive)
    about = json.loads((drive / "log.yaml").read_text())
    for key in ("K", "T_camera_lidar", "image_size", "camera_time_offset_s"):
        del about[key]
    (drive / "log.yaml").write_text(json.dumps(about | {"cameras": {"../a": FRONT, "b": SIDE}}))
    with pytest.raises(DataError, match="letters, digits, _ and -"):
        open_drive(drive)

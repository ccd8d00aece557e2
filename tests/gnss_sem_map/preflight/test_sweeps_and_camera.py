"""Each mistake with sweeps, their mounting, the camera and labels is named, and good drives are green."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import street
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.datasets.frames import read_points
from gnss_sem_map.errors import DataError, ImageSizeError, PointTimesError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.preflight import camera, sweeps
from gnss_sem_map.preflight.findings import Finding, Level
from gnss_sem_map.preflight.sample import Sample
from gnss_sem_map.segmentation.cached import CachedLabels
from gnss_sem_map.sensor_log import POSE_OF_LIDAR, Image, Points, SensorLog, Skip
from gnss_sem_map.simulation import Camera, Lidar, simulate

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> SensorLog:
    """Three seconds of town."""
    lidar = Lidar(np.radians(np.linspace(2.0, -18.0, 32)), columns=1000, range_stddev_m=0.01)
    rig = Camera(620, 188, 360.0, 305.0, 86.0)
    return open_drive(simulate(tmp_path_factory.mktemp("town"), 3.0, 3, lidar=lidar, camera=rig, workers=2))


def not_green(log: SensorLog, folder: Path | None = None) -> list[Finding]:
    """What is found of sweeps and camera, and is not green."""
    sizes = log.calibration.image_sizes
    segmenter = None if folder is None else CachedLabels(folder, open_label_set("urban"), sizes)
    sample = Sample(log, Settings(), segmenter)
    found = [*sweeps.check(sample), *camera.check(sample)]
    assert found
    return [finding for finding in found if finding.level is not Level.GREEN]


def mistakes(log: SensorLog) -> str:
    """All mistakes in one text."""
    return "; ".join(finding.mistake for finding in not_green(log))


def calibrated(log: SensorLog, **parts: Array) -> SensorLog:
    """The same drive, with another calibration."""
    return replace(log, calibration=replace(log.calibration, **parts))


def test_a_pose_of_the_lidar_that_is_not_given_is_said(town: SensorLog) -> None:
    assert "is not given" not in mistakes(town)
    log = replace(town, skips=(Skip(POSE_OF_LIDAR, "log.yaml", "not given"),))
    [found] = [finding for finding in not_green(log) if "is not given" in finding.mistake]
    assert (found.level, found.remedy) == (Level.AMBER, "give T_imu_lidar in log.yaml")


def with_camera(log: SensorLog, **parts: Any) -> SensorLog:
    """The same drive, with another calibration of its camera."""
    return replace(
        log, calibration=replace(log.calibration, cameras=(replace(log.calibration.camera(), **parts),))
    )


def turned(T: Array, rotation_deg: tuple[float, float, float]) -> Array:
    """A transform, turned about the axes of its target."""
    by = np.eye(4)
    by[:3, :3] = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix()
    return np.asarray(by @ T)


def with_times(log: SensorLog, change: Callable[[Array], Array]) -> SensorLog:
    """The same drive, with other point times after the stamp."""

    def changed(k: int) -> SensorLog:
        points = log.scans[k].read()
        assert points.stamps is not None
        return replace(points, stamps=log.scans[k].stamp + change(points.stamps - log.scans[k].stamp))

    return replace(
        log, scans=tuple(replace(scan, read=lambda k=k: changed(k)) for k, scan in enumerate(log.scans))
    )


def test_a_good_drive_is_green(town: SensorLog) -> None:
    assert not_green(town) == []


def test_a_street_of_twelve_scans_and_few_beams_is_green(tmp_path: Path) -> None:
    written = street.write(tmp_path)
    assert not_green(open_drive(written.drive), written.labels) == []


@pytest.mark.parametrize(
    "rotation",
    [
        (0, 0, -6),
        (0, 8, 0),
        *(
            pytest.param(one, marks=pytest.mark.slow)
            for one in ((0, 0, 90), (0, 0, 180), (12, 0, 0), (180, 0, 0))
        ),
    ],
)
def test_a_turned_lidar_is_named_with_its_angle(
    town: SensorLog, rotation: tuple[float, float, float]
) -> None:
    found = mistakes(calibrated(town, T_imu_lidar=turned(town.calibration.T_imu_lidar, rotation)))
    angle, axis = found.split("T_imu_lidar is turned by ")[1].split(" deg about ")
    assert axis[0] == "xyz"[int(np.abs(rotation).argmax())]
    assert abs(float(angle) - np.abs(rotation).max()) <= 2


def test_a_lever_arm_in_mm_is_named(town: SensorLog) -> None:
    T = town.calibration.T_imu_lidar.copy()
    T[:3, 3] *= 1000
    assert "T_imu_lidar is in mm" in mistakes(calibrated(town, T_imu_lidar=T))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: 0 * t, "all zero"),
        (lambda t: 0 * t + 0.04, "all the same"),
        (lambda t: -t, "reversed"),
        (lambda t: 1e3 * t, "in ms"),
        (lambda t: 1e6 * t, "in µs"),
        (lambda t: 1e9 * t, "in ns"),
        (lambda t: t + 500.0, "absolute"),
    ],
)
def test_wrong_point_times_are_named(town: SensorLog, change: Callable[[Array], Array], says: str) -> None:
    assert says in mistakes(with_times(town, change))


def test_wrong_point_times_that_a_reader_refuses_are_named_once(town: SensorLog) -> None:
    def refused() -> Points:
        raise PointTimesError("7.bin: 90 of 90 point times are up to 99 s off", "point times are in ms")

    log = replace(town, scans=tuple(replace(scan, read=refused) for scan in town.scans))
    [found] = [finding for finding in not_green(log) if finding.check == "scans"]
    assert str(found).count("point times are in ms") == 1
    assert "7.bin: 90 of 90" in found.evidence


@pytest.mark.parametrize("scale", [255.0, pytest.param(1 / 65535, marks=pytest.mark.slow)])
def test_intensities_of_another_scale_are_named(town: SensorLog, scale: float) -> None:
    def changed(k: int) -> Points:
        points = town.scans[k].read()
        assert points.intensity.any()
        return replace(points, intensity=points.intensity * np.float32(scale))

    scans = tuple(replace(scan, read=partial(changed, k)) for k, scan in enumerate(town.scans))
    [found] = not_green(replace(town, scans=scans))
    assert (found.check, found.level) == ("intensity", Level.AMBER)
    assert "set intensity_max" in found.remedy


@pytest.mark.parametrize(
    "name",
    ["end", pytest.param("start", marks=pytest.mark.slow), pytest.param("stamp", marks=pytest.mark.slow)],
)
def test_a_lost_line_of_sweep_stamps_is_named(town: SensorLog, name: str) -> None:
    """From the tenth sweep on a file gives the stamp of the next."""
    scans = list(town.scans)
    for k in range(10, len(scans) - 1):
        scan, following = scans[k], town.scans[k + 1]
        assert scan.sweep is not None
        assert following.sweep is not None
        if name == "stamp":
            scans[k] = replace(scan, stamp=following.stamp)
        else:
            end = scan.sweep[1] if name == "start" else following.sweep[1]
            scans[k] = replace(scan, sweep=(following.sweep[0] if name == "start" else scan.sweep[0], end))
    part = "" if name == "stamp" else f"_{name}"
    assert f"timestamps{part}.txt" in mistakes(replace(town, scans=tuple(scans[:-1])))


@pytest.mark.parametrize(("missing", "seconds"), [(2, None), (9, None), (12, 1.3)])
def test_a_second_without_scans_is_said(town: SensorLog, missing: int, seconds: float | None) -> None:
    log = replace(town, scans=town.scans[:8] + town.scans[8 + missing :])
    found = [finding for finding in not_green(log) if "no scan for" in finding.evidence]
    assert [finding.level for finding in found] == ([] if seconds is None else [Level.AMBER])
    for finding in found:
        assert f"no scan for {seconds} s after {town.scans[7].stamp:.3f} s" in finding.evidence
        assert "gaps: 1," in finding.evidence


def test_sweeps_that_the_reader_left_out_are_not_forgotten(town: SensorLog) -> None:
    skips = tuple(Skip("scan", str(k), "the sweep ends before it starts") for k in range(20))
    assert "timestamps_start.txt" in mistakes(replace(town, skips=skips))


def test_other_bytes_are_no_scan(tmp_path: Path) -> None:
    path = tmp_path / "0.bin"
    path.write_bytes(np.random.default_rng(1).bytes(16000))
    with pytest.raises(DataError, match="no scan"):
        read_points(path)


def test_points_that_were_not_measured_are_no_reason_to_refuse_a_scan(tmp_path: Path) -> None:
    rows = np.random.default_rng(1).normal(0, 20, (1000, 4)).astype("<f4")
    rows[:300], rows[300:500], rows[500:600] = 0, np.nan, np.inf
    rows.tofile(tmp_path / "0.bin")
    assert len(read_points(tmp_path / "0.bin")) == 1000


@pytest.mark.parametrize("axis", [0, pytest.param(1, marks=pytest.mark.slow), 2])
@pytest.mark.parametrize("angle", [-4.0, pytest.param(3.0, marks=pytest.mark.slow)])
def test_a_turned_camera_is_named_with_axis_and_angle(town: SensorLog, axis: int, angle: float) -> None:
    x, y, z = (angle * np.eye(3)[axis]).tolist()
    found = mistakes(
        with_camera(town, T_camera_lidar=turned(town.calibration.camera().T_camera_lidar, (x, y, z)))
    )
    assert f"about its {'xyz'[axis]} axis" in found
    assert abs(float(found.split("turned by ")[1].split()[0]) - abs(angle)) < 0.7


def test_an_inverted_camera_is_named(town: SensorLog) -> None:
    T = town.calibration.camera().T_camera_lidar
    assert "T_camera_lidar is inverted" in mistakes(with_camera(town, T_camera_lidar=np.linalg.inv(T)))


@pytest.mark.parametrize(
    ("by_s", "says"), [(0.1, "0.10 s late"), (-0.1, "0.10 s early"), (1e4, "another clock")]
)
def test_images_of_another_time_are_named(town: SensorLog, by_s: float, says: str) -> None:
    images = tuple(replace(image, stamp=image.stamp + by_s) for image in town.images)
    assert says in mistakes(replace(town, images=images))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda K: K * [[0.5], [0.5], [1]], "half the size"),
        (lambda K: K * [[0.5, 1, 1], [1, 0.5, 1], [1, 1, 1]], "focal length"),
        (lambda K: K * [[1.25, 1, 1], [1, 1.25, 1], [1, 1, 1]], "focal length"),
        (lambda K: K.T, "not a camera matrix"),
        (lambda K: K + 100.0 * np.eye(3, k=1), "skew"),
        (lambda K: K * [[2, 1, 1], [1, 1, 1], [1, 1, 1]], "fx and fy"),
    ],
)
def test_a_wrong_K_is_named(town: SensorLog, change: Callable[[Array], Array], says: str) -> None:
    assert says in mistakes(with_camera(town, K=change(town.calibration.camera().K.copy())))


def test_images_of_another_size_are_named(town: SensorLog) -> None:
    def read() -> NDArray[np.uint8]:
        raise ImageSizeError("620 x 188", (620, 188))

    images = tuple(replace(image, read=read) for image in town.images)
    wrong = replace(with_camera(town, image_size=(310, 94)), images=images)
    (finding,) = not_green(wrong)
    assert "image size" in finding.mistake
    assert "620 188" in finding.remedy


@pytest.mark.parametrize(("damaged", "seen", "level"), [(2, 1, Level.AMBER), (9, 7, Level.RED)])
def test_label_files_that_are_refused_are_counted(
    tmp_path: Path, damaged: int, seen: int, level: Level
) -> None:
    """The check looks at ten of the twelve frames."""
    written = street.write(tmp_path)
    log = open_drive(written.drive)
    segmenter = CachedLabels(written.labels, open_label_set("urban"), log.calibration.image_sizes)
    for path in sorted(written.labels.glob("*.npz"))[:damaged]:
        path.write_bytes(path.read_bytes()[:-30])
    found = [one for one in camera.check(Sample(log, Settings(), segmenter)) if one.check == "labels"]
    assert found[0].level is level
    assert f"labels of {seen} of 10 frames looked at are refused or missing: " in found[0].evidence
    assert "?ids=" not in found[0].remedy  # probabilities have none


def test_unknown_class_names_are_listed_once(small_drive: street.Street) -> None:
    log = open_drive(small_drive.drive)

    class Network:
        class_names = ("road", "blimp", "sidewalk", "ufo", "blimp")

        def __call__(self, image: Image) -> NDArray[np.float32]:
            return np.full((*image.read().shape[:2], 5), 0.2, np.float32)

    found = [one for one in camera.check(Sample(log, Settings(), Network())) if one.check == "class names"]
    assert len(found) == 1
    assert found[0].level is Level.AMBER
    assert found[0].evidence == "2 of 5 class names are unknown and count as other: blimp, ufo"


@pytest.mark.parametrize("one_class", [False, True])
def test_labels_that_hold_nothing_are_named(tmp_path: Path, one_class: bool) -> None:
    written = street.write(tmp_path)
    for path in written.labels.glob("*.npz"):
        with np.load(path) as content:
            probabilities, names = np.zeros_like(content["probabilities"]), content["class_names"]
        probabilities[:, :, 0] = 255 if one_class else 0
        np.savez_compressed(path, probabilities=probabilities, class_names=names)
    found = not_green(open_drive(written.drive), written.labels)
    assert any("all zero" in finding.mistake for finding in found)


@pytest.mark.parametrize("by", [(0.0, 0.0, 0.0), (0.8, -0.8, 1.0)])
def test_an_inverse_is_named_though_a_rectification_turns_it_a_little(
    town: SensorLog, by: tuple[float, float, float]
) -> None:
    """KITTI's rectification is not inverted with the mounting of the camera."""
    T = turned(np.linalg.inv(town.calibration.camera().T_camera_lidar), by)
    assert "T_camera_lidar is inverted" in mistakes(with_camera(town, T_camera_lidar=T))


def test_a_camera_that_has_all_points_behind_it_is_red_though_edges_are_few(tmp_path: Path) -> None:
    log = open_drive(street.write(tmp_path).drive)
    T = log.calibration.camera().T_camera_lidar.copy()
    T[:3, 3] -= (0, 0, 1000.0)
    (finding,) = [f for f in not_green(with_camera(log, T_camera_lidar=T)) if f.level is Level.RED]
    assert "of another camera" in finding.mistake


def with_scans_later(log: SensorLog, by_s: float) -> SensorLog:
    """The same drive, its scans by another clock."""

    def later(k: int) -> Points:
        points = log.scans[k].read()
        return replace(points, stamps=None if points.stamps is None else points.stamps + by_s)

    scans = [
        replace(scan, stamp=scan.stamp + by_s, sweep=None, read=lambda k=k: later(k))
        for k, scan in enumerate(log.scans)
    ]
    return replace(log, scans=tuple(scans))


def test_scans_of_a_late_clock_are_named(tmp_path: Path) -> None:
    """Some of the scans: the rest of the drive is what they are compared with."""
    lidar = Lidar(np.radians(np.linspace(2.0, -18.0, 32)), columns=600, range_stddev_m=0.01)
    log = open_drive(
        simulate(tmp_path, 6.0, 101, lidar=lidar, camera=Camera(64, 32, 40.0, 32.0, 16.0), workers=2)
    )
    for by_s, word in ((0.0, ""), (0.5, "late"), (-0.5, "early")):
        some = with_scans_later(replace(log, scans=log.scans[8:52], images=()), by_s)
        assert (f"scan stamps are 0.5 s {word}" in mistakes(some)) == bool(word)


def test_scans_of_another_drive_are_named(town: SensorLog) -> None:
    found = not_green(with_scans_later(town, 3600.0))
    [finding] = [finding for finding in found if "scan stamps are of another clock" in finding.mistake]
    assert "`stamps: received` in rig.yaml" in finding.remedy

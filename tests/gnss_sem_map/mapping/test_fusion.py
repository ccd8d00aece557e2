"""Fusion: which scans, images and points count, into which map; the whole chain is that of plain numpy."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy_chain
import pytest
import street
from chunks import Maps, assert_same, build_maps
from numpy.typing import NDArray
from street import Street

from gnss_sem_map.config import Settings
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import DataError, WriteError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.labelled_scans import Drive, label_each_scan, labelled_scans
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.scans.projection import class_image, image_exposed_at
from gnss_sem_map.segmentation import Segmenter
from gnss_sem_map.segmentation.cached_segmenter import CachedSegmenter
from gnss_sem_map.sensor_log import Image, Points, Skip, file_of

URBAN = open_label_set()


def test_a_scan_without_an_image_adds_hits_and_no_evidence_and_is_counted(
    drive: Drive, at_once: tuple[Maps, RunStats]
) -> None:
    """All images but two: the map is that of the others' labels, with every point in it."""
    kept, stats = drive.log.images[3:5], RunStats()
    found = build_maps(replace(drive, log=replace(drive.log, images=kept)), stats).static
    np.testing.assert_array_equal(found.keys, at_once[0].static.keys)
    np.testing.assert_array_equal(found.hits, at_once[0].static.hits)
    shown = [scan for scan in drive.log.scans if scan.number in [image.number for image in kept]]
    few = build_maps(replace(drive, log=replace(drive.log, scans=tuple(shown))), RunStats()).static
    places = found.indices_of(few.keys)
    np.testing.assert_array_equal(found.evidence[places], few.evidence)
    assert found.observed.sum() == few.observed.sum() > 0
    reasons = [(skip.what, skip.reason) for skip in stats.skips]
    assert reasons == [("labels", "no image near its stamp")] * (len(drive.log.scans) - 2)


def test_images_exposed_outside_the_trajectory_cost_the_labels_and_never_the_scans(
    drive: Drive, at_once: tuple[Maps, RunStats]
) -> None:
    settings, stats = drive.settings, RunStats()
    late = settings.labelling.model_copy(update={"camera_time_offset_s": 3600.0, "image_within_s": 4000.0})
    found = build_maps(replace(drive, settings=settings.model_copy(update={"labelling": late})), stats).static
    np.testing.assert_array_equal(found.keys, at_once[0].static.keys)
    np.testing.assert_array_equal(found.hits, at_once[0].static.hits)
    assert not found.observed.any()
    assert [skip.what for skip in stats.skips] == ["labels"] * len(drive.log.scans)
    assert all("trajectory" in skip.reason for skip in stats.skips)


class Refusing:
    """A segmenter that cannot do one image."""

    def __init__(self, segmenter: Segmenter, refused: int) -> None:
        self._segmenter, self._refused = segmenter, refused
        self.class_names = segmenter.class_names

    def __call__(self, image: Image) -> NDArray[np.uint8] | NDArray[np.float32]:
        if image.number == self._refused:
            raise DataError("this image is damaged")
        return self._segmenter(image)


def test_an_image_that_cannot_be_segmented_costs_its_own_labels_only(
    drive: Drive, at_once: tuple[Maps, RunStats], tmp_path: Path
) -> None:
    """A live network's answers are kept; so is nothing that it refused."""
    assert drive.segmenter is not None
    sizes = drive.log.calibration.image_sizes
    refusing = CachedSegmenter(Refusing(drive.segmenter, 5), URBAN, sizes, tmp_path)
    for _ in range(2):
        stats = RunStats()
        found = build_maps(replace(drive, segmenter=refusing), stats)
        assert stats.skips == [Skip("labels", "frame 5", "this image is damaged")]
        np.testing.assert_array_equal(found.static.hits, at_once[0].static.hits)
        counts = stats.counts
        parts = ("points left out", "points unlabelled", "points labelled")
        assert counts["points"] == sum(counts[part] for part in parts)
        assert 0 < counts["points labelled"] < at_once[1].counts["points labelled"]


def test_what_is_left_out_is_listed_in_the_order_of_the_scans(drive: Drive) -> None:
    """A thread that reads ahead finds the one, and the thread that deskews the other."""

    class Hopeless:
        class_names = ("road", "other")

        def __call__(self, image: Image) -> NDArray[np.uint8]:
            raise DataError("this network is broken")

    nothing = Points(np.full((5, 3), np.nan, np.float32), np.zeros(5, np.float32), None)
    scans = [replace(scan, read=lambda: nothing) for scan in drive.log.scans]
    stats = RunStats()
    for _ in label_each_scan(replace(drive, segmenter=Hopeless()), scans, stats):
        time.sleep(0.02)  # the reader is ahead
    assert [(skip.what, skip.where) for skip in stats.skips] == [
        (what, f"frame {scan.number}") for scan in scans for what in ("labels", "scan")
    ]


def test_a_network_that_can_do_nothing_is_named_and_the_map_is_made(drive: Drive) -> None:
    class Hopeless:
        class_names = ("road", "other")

        def __call__(self, image: Image) -> NDArray[np.uint8]:
            raise DataError("this network is broken")

    stats = RunStats()
    assert len(build_maps(replace(drive, segmenter=Hopeless()), stats).static) > 1000
    assert stats.counts["points labelled"] == 0
    first = drive.log.scans[0].number
    assert stats.warnings == [
        "no point got a label, and the map shows geometry only; a classifier of drives with labels would name it"
        " (--set geometric_classifier.model=FILE of `gnss-sem-map fit-classifier`); first reason:"
        f" frame {first}: this network is broken"
    ]


def test_a_full_disk_is_no_fault_of_an_image_and_ends_the_run(drive: Drive, tmp_path: Path) -> None:
    assert drive.segmenter is not None
    sizes = drive.log.calibration.image_sizes
    nowhere = CachedSegmenter(drive.segmenter, URBAN, sizes, tmp_path / "removed")
    with pytest.raises(WriteError, match="cannot be written"):
        build_maps(replace(drive, segmenter=nowhere), RunStats())


@pytest.mark.parametrize("layout", ["raw", "odometry", "table"])
def test_every_reader_says_which_files_it_reads(small_drive: Street, tmp_path: Path, layout: str) -> None:
    write = {"raw": None, "odometry": street.write_odometry, "table": street.write_table_log}[layout]
    log = open_drive(small_drive.drive if write is None else write(tmp_path, small_drive))
    for item in (*log.scans, *log.images):
        file = file_of(item)
        assert file is not None
        assert int(file.stem) == item.number


def test_the_whole_chain_equals_plain_numpy_bit_for_bit(drive: Drive, at_once: tuple[Maps, RunStats]) -> None:
    """Deskewing, keys, projection, occlusion and fusion, scan by scan and as a map."""
    settings, log = drive.settings, drive.log
    plain = numpy_chain.NumpyMap(settings.mapping.voxel_size_m, URBAN)
    for seen in labelled_scans(drive):
        points = seen.scan.read()
        p_map = numpy_chain.points_in_map(
            points, seen.scan.stamp, drive.trajectory, log.calibration.T_imu_lidar,
            drive.nearest_m, settings.mapping.farthest_m,
        )  # fmt: skip
        np.testing.assert_array_equal(seen.p_map, p_map)
        image = image_exposed_at(seen.scan.stamp, log, log.calibration.camera(), settings.labelling)
        assert image is not None
        assert drive.segmenter is not None
        classes = class_image(
            drive.segmenter(image),
            drive.segmenter.class_names,
            URBAN,
            log.calibration.camera().image_size,
            "",
        )
        pixels = numpy_chain.pixels_seen(
            p_map, image, drive.trajectory, log.calibration, classes, settings.labelling
        )
        np.testing.assert_array_equal(seen.pixels >= 0, pixels >= 0)
        np.testing.assert_array_equal(seen.classes, classes.rows[pixels[pixels >= 0]])
        voxel_size_m = settings.mapping.voxel_size_m
        keys, heights = (of(p_map, voxel_size_m) for of in (numpy_chain.keys_of, numpy_chain.heights_of))
        plain.add(keys, pixels, classes.rows, heights)
    assert_same(plain.to_map(), at_once[0].static)


def test_the_car_itself_is_not_mapped(real_data: Path) -> None:
    """A real car shows itself in every sweep, at the corners of its roof: a ghost beside the whole track, if kept."""
    log = open_drive(real_data / "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync")
    assert log.reference is not None
    there, kept = 0, 0
    for seen in labelled_scans(Drive(log, log.reference, None, Settings())):
        x, y, z = seen.points.xyz.T
        of_the_car = (np.abs(x) < 2) & (np.abs(y) < 1.5) & (z > -1.2)
        there, kept = there + int(of_the_car.sum()), kept + int(of_the_car[seen.valid].sum())
    assert there > 1000
    assert kept == 0

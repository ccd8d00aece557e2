"""A resumed run uses the finished search for moving objects, and never a damaged one or that of another run."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from damage import flipped, halved
from street import Street

from gnss_sem_map import Settings, run
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.dynamics.motion_state import Motion, TrackedObject
from gnss_sem_map.dynamics.moving_objects import MovingObjects
from gnss_sem_map.dynamics.range_images import empty_image
from gnss_sem_map.dynamics.visibility import KeyframeScans
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.labelled_scans import Drive
from gnss_sem_map.mapping.motion_checkpoint import open_checkpoint
from gnss_sem_map.segmentation import open_segmenter

MEASURED = {"seconds", "peak_memory_mb"}
SETTINGS = Settings.model_validate({"mapping": {"scans_per_chunk": 4}})


class Interrupted(Exception):
    """The run is interrupted."""


class Stages:
    """Collects the stages that report progress; can interrupt a run while it maps."""

    def __init__(self, interrupt: bool = False) -> None:
        self.seen: set[str] = set()
        self._interrupt = interrupt

    def __call__(self, stage: str, done: int, total: int) -> None:
        self.seen.add(stage)
        if self._interrupt and stage == "mapping" and done == 6:
            raise Interrupted


def run_street(small_drive: Street, out: Path, stages: Stages, resume: bool = False) -> Path:
    labels = f"labels:{small_drive.labels}"
    run(
        small_drive.drive, out, labels, SETTINGS,
        resume=resume, write_labels=True, force=True, progress=stages,
    )  # fmt: skip
    return out


def interrupted(small_drive: Street, out: Path) -> Path:
    """A run that is interrupted while it maps; returns the checkpoint of its search."""
    with pytest.raises(Interrupted):
        run_street(small_drive, out, Stages(interrupt=True))
    return out.with_name(f".{out.name}.work") / "motion"


def results_of(out: Path) -> dict[str, object]:
    """Every file of a run folder; figures of time and memory, and what depends on them, are left out."""
    found: dict[str, object] = {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in out.rglob("*")
        if path.is_file() and path.name != ".gnss-sem-map.json"
    }
    about = json.loads((out / "run.json").read_text())
    about["preflight"].pop("seconds")
    found["run.json"] = {name: value for name, value in about.items() if name not in MEASURED}
    report = (out / "report.html").read_text()
    found["report.html"] = re.sub(r"<h2>Time and memory</h2>.*?</table>|[\d.]+ s\b", "", report, flags=re.S)
    return found


@pytest.fixture(scope="module")
def whole(small_drive: Street, tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    stages = Stages()
    results = results_of(run_street(small_drive, tmp_path_factory.mktemp("whole") / "out", stages))
    assert "motion" in stages.seen
    return results


@pytest.mark.integration
def test_a_resumed_run_does_not_search_again_and_gives_the_same_folder(
    small_drive: Street, whole: dict[str, object], tmp_path: Path
) -> None:
    interrupted(small_drive, tmp_path / "out")
    stages = Stages()
    out = run_street(small_drive, tmp_path / "out", stages, resume=True)
    assert "mapping" in stages.seen
    assert "motion" not in stages.seen
    assert results_of(out) == whole
    assert [path.name for path in tmp_path.iterdir()] == ["out"], "nothing stays beside the results"


@pytest.mark.integration
def test_without_resume_it_searches_again(small_drive: Street, tmp_path: Path) -> None:
    interrupted(small_drive, tmp_path / "out")
    stages = Stages()
    run_street(small_drive, tmp_path / "out", stages)
    assert "motion" in stages.seen


@pytest.mark.integration
@pytest.mark.parametrize(
    ("damage", "name"),
    [
        (flipped, "about.json"), (halved, "about.json"), (Path.unlink, "about.json"),
        (flipped, "objects.json"), (halved, "moving_points.npz"), (Path.unlink, "keyframes.npz"),
    ],
)  # fmt: skip
def test_a_damaged_search_is_done_again(
    small_drive: Street,
    whole: dict[str, object],
    tmp_path: Path,
    damage: Callable[[Path], None],
    name: str,
) -> None:
    damage(interrupted(small_drive, tmp_path / "out") / name)
    stages = Stages()
    out = run_street(small_drive, tmp_path / "out", stages, resume=True)
    assert "motion" in stages.seen
    assert results_of(out) == whole


FOUND = MovingObjects(
    {7: np.array([0, 5, 2**20]), 8: np.empty(0, np.int64)},
    (
        TrackedObject(
            Motion.STOPPED_AND_LEFT, 1 / 3, False, "hit 2 times, 3.0 °", (3, 1), 12, 0.1, 2 / 3,
            np.array([[0.1, -2.7], [np.pi, 1e-9]]),
        ),
        TrackedObject(Motion.MOVING, 1.0, True, "", (4,), 6, 1.0, 1.0, np.array([[1.0, 2.0]])),
    ),
    KeyframeScans(
        np.stack([empty_image(), empty_image() // 2]), np.random.default_rng(1).normal(size=(2, 4, 4))
    ),
)  # fmt: skip


@pytest.fixture
def drive(small_drive: Street) -> Drive:
    log = open_drive(small_drive.drive)
    assert log.reference is not None
    size = log.calibration.image_size
    segmenter = open_segmenter(f"labels:{small_drive.labels}", open_label_set(), expected_size=size)
    return Drive(log, log.reference, segmenter, SETTINGS)


@pytest.mark.parametrize("found", [FOUND, replace(FOUND, keyframes=None), MovingObjects({}, ())])
def test_everything_comes_back_exactly(drive: Drive, tmp_path: Path, found: MovingObjects) -> None:
    open_checkpoint(tmp_path / "work", drive, "", resume=False).write(found)
    read = open_checkpoint(tmp_path / "work", drive, "", resume=True).read()
    assert read is not None
    assert list(read.points) == list(found.points)
    for number, indices in found.points.items():
        assert read.points[number].dtype == np.int64
        np.testing.assert_array_equal(read.points[number], indices)
    assert len(read.objects) == len(found.objects)
    for here, there in zip(read.objects, found.objects, strict=True):
        for field in fields(TrackedObject):
            np.testing.assert_array_equal(getattr(here, field.name), getattr(there, field.name))
            assert type(getattr(here, field.name)) is type(getattr(there, field.name))
    assert (read.keyframes is None) == (found.keyframes is None)
    if read.keyframes is not None and found.keyframes is not None:
        np.testing.assert_array_equal(read.keyframes.images, found.keyframes.images)
        np.testing.assert_array_equal(read.keyframes.T_lidar_map, found.keyframes.T_lidar_map)


def with_settings(drive: Drive, **sections: dict[str, object]) -> Drive:
    return replace(drive, settings=Settings.model_validate(SETTINGS.model_dump() | sections))


def test_the_search_of_another_run_is_not_used(drive: Drive, tmp_path: Path) -> None:
    work = tmp_path / "work"
    open_checkpoint(work, drive, "labels:here", resume=False).write(FOUND)
    poses = drive.trajectory.T_map_imu.copy()
    poses[0, 0, 3] += 1e-9
    others = [
        replace(drive, from_lidar_odometry=True),
        replace(drive, trajectory=replace(drive.trajectory, T_map_imu=poses)),
        replace(drive, log=replace(drive.log, scans=drive.log.scans[1:])),
        with_settings(drive, dynamics={"gate_m": 1.4}),
        with_settings(drive, labelling={"image_within_s": 0.01}),
        with_settings(drive, mapping={"nearest_m": 3.0}),
    ]
    for other in others:
        assert open_checkpoint(work, other, "labels:here", resume=True).read() is None
    assert open_checkpoint(work, drive, "labels:there", resume=True).read() is None
    assert open_checkpoint(work, drive, "labels:here", resume=True).read() is not None
    assert open_checkpoint(work, drive, "labels:here", resume=False).read() is None


def test_no_flipped_bit_is_read_and_none_is_an_error(drive: Drive, tmp_path: Path) -> None:
    checkpoint = open_checkpoint(tmp_path / "work", drive, "", resume=False)
    checkpoint.write(FOUND)
    for path in sorted(checkpoint.folder.iterdir()):
        content = path.read_bytes()
        for place in range(0, len(content), 7):
            damaged = bytearray(content)
            damaged[place] ^= 1 << place % 8
            path.write_bytes(damaged)
            assert checkpoint.read() is None, (path.name, place)
        path.write_bytes(content)
    assert checkpoint.read() is not None

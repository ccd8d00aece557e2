"""Every mistake with a log that we know, injected into simulated and real drives: the pre-flight must name it.

A good drive must never be red, or nobody reads the page.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from faults import mistakes_camera, mistakes_inertial, mistakes_lidar
from faults.layouts import as_odometry, as_table_log, copy_of
from faults.mistakes import Mistake

from gnss_sem_map import config, preflight
from gnss_sem_map.datasets import open_drive
from gnss_sem_map.errors import SemMapError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.preflight.findings import Level, Preflight
from gnss_sem_map.process.run_stats import RunStats
from gnss_sem_map.runs import pipeline
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.simulation import Camera, simulate, write_corrupted_labels

MISTAKES: list[Mistake] = [
    *mistakes_inertial.MISTAKES,
    *mistakes_lidar.MISTAKES,
    *mistakes_camera.MISTAKES,
    *mistakes_camera.LABEL_MISTAKES,
]
SPOILED_SEED, SECONDS = 0, 12.0
WITH_BENDS_S, FRAMES = 30.0, range(120)
"""A drive of seed 0 that is so long begins with bends; a straight one does not tell what only turns show."""
GOOD_SEEDS = (0, 101, 102, 103, 104, 105)
IN_CI = 15
CAMERA = Camera(621, 188, 360.8, 304.8, 86.4)  # in CI: a quarter of the pixels of KITTI's
"""Every so many of the mistakes are tried in CI."""
REAL = "2011_09_26_drive_0005_sync"
NAMED = 0.95
PROBABILITIES = "probabilities"
"""Folder of class probabilities, beside the date folder of a KITTI raw drive or in a table log or sequence."""


def page_of(drive: Path) -> tuple[Preflight | None, str]:
    """What the pre-flight says of a drive, or why it cannot even be opened."""
    try:
        log, settings = open_drive(drive), config.load()
        folder = next(
            (p for p in (drive / PROBABILITIES, drive.parent.parent / PROBABILITIES) if p.is_dir()), None
        )
        segmenter = None
        if folder is not None:
            label_set = open_label_set(settings.classes)
            segmenter = open_segmenter(f"labels:{folder}", label_set, sizes=log.calibration.image_sizes)
        return preflight.check(log, settings, segmenter), ""
    except SemMapError as error:
        return None, str(error)


def names(page: Preflight | None, refusal: str, mistake: Mistake) -> bool:
    """Whether a red or amber finding, or the refusal of the reader, says one of the words of a mistake."""
    said = [refusal]
    if page is not None:
        said = [
            f"{found.mistake} {found.remedy}"
            for level in (Level.RED, Level.AMBER)
            for found in page.of(level)
        ]
    return any(word in text.lower() for text in said for word in mistake.says)


@pytest.fixture(scope="session")
def layouts_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., dict[str, Path]]:
    """A drive in the three layouts that mistakes are made in, with its class probabilities; made once per drive."""
    made: dict[Path, dict[str, Path]] = {}

    def make(drive: Path, probabilities: Path | None, frames: range | None = None) -> dict[str, Path]:
        if drive not in made:
            folder = tmp_path_factory.mktemp("layouts")
            raw = copy_of(drive, folder, frames)
            log = open_drive(raw)
            trajectory, _ = pipeline.estimate_trajectory(log, config.load(), RunStats())
            made[drive] = {
                "kitti-raw": raw,
                "table": as_table_log(raw, folder),
                "odometry": as_odometry(raw, folder, trajectory),
            }
            if probabilities is not None:
                for place in (folder, made[drive]["table"]):
                    shutil.copytree(probabilities, place / PROBABILITIES)
        return made[drive]

    return make


def spoiled(mistake: Mistake, layouts: dict[str, Path], folder: Path) -> Path:
    """A copy of the drive in the layout of the mistake, with the mistake in it."""
    source = layouts["kitti-raw" if mistake.layout == "labels" else mistake.layout]
    if mistake.layout not in ("kitti-raw", "labels"):
        drive = folder / source.name
        shutil.copytree(source, drive)
        mistake.inject(drive)
        return drive
    drive = copy_of(source, folder)
    if (source.parent.parent / PROBABILITIES).is_dir():
        shutil.copytree(source.parent.parent / PROBABILITIES, folder / PROBABILITIES)
    mistake.inject(folder / PROBABILITIES if mistake.layout == "labels" else drive)
    return drive


def missed(
    mistakes: list[Mistake], layouts: dict[str, Path], folder: Path, trial: Callable[..., None]
) -> Iterator[str]:
    """The mistakes that are not named, each with what is said in place of it."""
    for k, mistake in enumerate(mistakes):
        place = folder / str(k)
        place.mkdir()
        page, refusal = page_of(spoiled(mistake, layouts, place))
        trial(f"mistakes, {mistake.layout}")
        if not names(page, refusal, mistake):
            said = refusal if page is None else [str(f) for f in page.findings if f.level is not Level.GREEN]
            yield f"{mistake.name} ({mistake.layout}): {said}"
        shutil.rmtree(place)


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., tuple[Path, Path]]:
    """A simulated drive with class probabilities beside it; made once."""
    made: dict[tuple[int, float, Camera | None], tuple[Path, Path]] = {}

    def make(seed: int, seconds: float = SECONDS, camera: Camera | None = None) -> tuple[Path, Path]:
        if (seed, seconds, camera) not in made:
            folder = tmp_path_factory.mktemp(f"seed{seed}")
            drive = simulate(folder, seconds, seed, camera=camera)
            write_corrupted_labels(drive, folder / PROBABILITIES, seed)
            made[seed, seconds, camera] = drive, folder / PROBABILITIES
        return made[seed, seconds, camera]

    return make


@pytest.mark.slow
def test_some_mistakes_in_a_simulated_drive_are_named(simulated, layouts_of, trial, tmp_path: Path) -> None:
    some = MISTAKES[::IN_CI]
    wrong = list(missed(some, layouts_of(*simulated(SPOILED_SEED, camera=CAMERA)), tmp_path, trial))
    assert len(wrong) <= (1 - NAMED) * len(some), "\n".join(wrong)


@pytest.mark.faults
def test_all_mistakes_in_a_simulated_drive_are_named(simulated, layouts_of, trial, tmp_path: Path) -> None:
    layouts = layouts_of(*simulated(SPOILED_SEED, WITH_BENDS_S), FRAMES)
    wrong = list(missed(MISTAKES, layouts, tmp_path, trial))
    assert len(wrong) <= (1 - NAMED) * len(MISTAKES), "\n".join(wrong)


@pytest.mark.faults
def test_all_mistakes_in_a_real_drive_are_named(real_data: Path, layouts_of, trial, tmp_path: Path) -> None:
    drive = real_data / "kitti_raw/2011_09_26" / REAL
    layouts = layouts_of(drive, real_data / "labels/kitti_raw_0005/probabilities")
    wrong = list(missed(MISTAKES, layouts, tmp_path, trial))
    assert len(wrong) <= (1 - NAMED) * len(MISTAKES), "\n".join(wrong)


@pytest.mark.faults
@pytest.mark.parametrize("seed", GOOD_SEEDS)
def test_a_good_simulated_drive_is_not_red(seed: int, simulated, trial) -> None:
    page, refusal = page_of(simulated(seed)[0])
    assert page is not None, refusal
    trial("good drives", [str(found) for found in page.of(Level.RED)])


@pytest.mark.parametrize(
    "drive",
    [
        f"kitti_raw/2011_09_26/{REAL}",
        *(pytest.param(f"semantic_kitti/sequences/{n}", marks=pytest.mark.slow) for n in ("00", "08")),
    ],
)
def test_a_good_real_drive_is_not_red(real_data: Path, drive: str, trial) -> None:
    page, refusal = page_of(real_data / drive)
    assert page is not None, refusal
    trial("good drives", [str(found) for found in page.of(Level.RED)])

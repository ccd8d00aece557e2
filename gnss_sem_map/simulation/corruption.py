"""Simulated segmentation errors: class probabilities as of a network, computed from true class images.

Borders wobble and are blurred, coherent patches take the look-alike for the truth (building and vegetation, road and
sidewalk, vehicle and what is behind it), and every pixel keeps some doubt. Patches change slowly from frame to frame,
so neighbouring frames err together, as those of a real network do.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from gnss_sem_map.errors import DataError
from gnss_sem_map.process.machine import threads
from gnss_sem_map.process.thread_pools import thread_pool
from gnss_sem_map.simulation.compiled import Bytes, Floats, Singles, kernel
from gnss_sem_map.simulation.noise import value_noise

CLASS_NAMES: Final = ("road", "sidewalk", "vehicle", "building", "vegetation", "other")
_ROAD, _SIDEWALK, _VEHICLE, _BUILDING, _VEGETATION, _OTHER = range(6)
_CLASSES: Final = np.full(256, _OTHER, np.uint8)
_CLASSES[[0, 1, 2, 8]] = _ROAD, _SIDEWALK, _BUILDING, _VEGETATION
_CLASSES[13:18] = _VEHICLE

_FRAMES_PER_PATTERN: Final = 12
_OTHER_CAMERA: Final = 1_000_003
# confusions: the wrong class of each class, the threshold of the noise, and the strength
_LOOKALIKES: Final = np.array([_SIDEWALK, _ROAD, _OTHER, _VEGETATION, _BUILDING, _BUILDING], np.int64)
_THRESHOLDS: Final = np.array([0.84, 0.74, 0.84, 0.78, 0.76, 0.78])
_STRENGTH: Final = 0.78


@kernel
def _pattern(seed: int, frame: float, x: float, y: float) -> float:
    """Noise in [0, 1) over the image that turns into another within _FRAMES_PER_PATTERN frames."""
    turn = frame / _FRAMES_PER_PATTERN
    number = int(np.floor(turn))
    share = turn - number
    share = share * share * (3.0 - 2.0 * share)
    before, after = value_noise(seed * 4096 + number, x, y), value_noise(seed * 4096 + number + 1, x, y)
    return before + share * (after - before)


@kernel
def _believe(
    classes: Bytes,
    seed: int,
    frame: float,
    lookalikes: npt.NDArray[np.int64],
    thresholds: Floats,
    probabilities: Singles,
) -> None:
    """Probabilities at half resolution: the mean over two by two pixels."""
    height, width = classes.shape
    for v in range(2 * probabilities.shape[0]):
        for u in range(2 * probabilities.shape[1]):
            shift_u = 7.0 * (_pattern(seed + 1, frame, u / 9.0, v / 9.0) - 0.5)
            shift_v = 7.0 * (_pattern(seed + 2, frame, u / 9.0, v / 9.0) - 0.5)
            row = min(height - 1, max(0, int(np.floor(v + shift_v + 0.5))))
            column = min(width - 1, max(0, int(np.floor(u + shift_u + 0.5))))
            c = classes[row, column]
            sure = 0.80 + 0.17 * _pattern(seed + 3, frame, u / 30.0, v / 30.0)
            wrong = (_pattern(seed + 10 + c, frame, u / 60.0, v / 40.0) - thresholds[c]) / 0.08
            wrong = sure * _STRENGTH * min(1.0, max(0.0, wrong))
            for k in range(6):
                p = (1.0 - sure) / 5.0
                if k == c:
                    p = sure - wrong
                elif k == lookalikes[c]:
                    p += wrong
                probabilities[v // 2, u // 2, k] += np.float32(0.25 * p)


def corrupt_class_image(
    train_ids: npt.NDArray[np.uint8], seed: int = 0, frame: int = 0
) -> npt.NDArray[np.uint8]:
    """Probabilities of CLASS_NAMES, (h // 2, w // 2, 6) as round(255 p), from a class image (h, w) of trainIds.

    The same arguments give the same bytes; consecutive frames have errors in similar positions.
    """
    if train_ids.ndim != 2 or train_ids.dtype != np.uint8:
        raise DataError(
            f"class image: found {train_ids.dtype} {train_ids.shape}, expected uint8 (h, w) of trainIds"
        )
    height, width = train_ids.shape
    probabilities = np.zeros((height // 2, width // 2, len(CLASS_NAMES)), np.float32)
    key = seed * 1000 + 17
    _believe(_CLASSES[train_ids], key, float(frame), _LOOKALIKES, _THRESHOLDS, probabilities)
    blurred = cv2.blur(cv2.blur(probabilities, (3, 3)), (3, 3))
    return np.round(255.0 * blurred).astype(np.uint8)


def write_corrupted_labels(
    drive: Path,
    folder: Path,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    *,
    workers: int | None = None,
) -> Path:
    """Corrupt all class images of a simulated drive's truth: `<folder>/<frame>.npz`, which `labels:FOLDER` reads.

    Each holds `probabilities` and `class_names`. Of several cameras, each has a folder of its name, and errs in its own
    way. `progress(done, frames)` is called after every frame; `workers` threads share the work (None: one per core).
    Raises DataError when the drive has no class images.
    """
    truth = Path(drive) / "truth" / "train_ids"
    paths = sorted(truth.rglob("*.png"))
    if not paths:
        raise DataError(f"{drive}: found no truth/train_ids/*.png, expected a simulated drive")
    cameras = sorted({path.parent for path in paths})
    targets = {camera: Path(folder) / camera.relative_to(truth) for camera in cameras}
    for target in targets.values():
        target.mkdir(parents=True, exist_ok=True)
    keys = {camera: seed + _OTHER_CAMERA * number for number, camera in enumerate(cameras)}

    def write(path: Path) -> None:
        _write_corrupted(path, targets[path.parent], keys[path.parent])

    with thread_pool(workers or threads()) as pool:
        for done, _ in enumerate(pool.map(write, paths), 1):
            if progress is not None:
                progress(done, len(paths))
    return Path(folder)


def _write_corrupted(path: Path, folder: Path, seed: int) -> None:
    train_ids = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if train_ids is None or not path.stem.isdecimal():
        raise DataError(f"{path}: found no class image named by its frame; simulate the drive again")
    probabilities = corrupt_class_image(np.asarray(train_ids), seed, int(path.stem))
    np.savez_compressed(folder / f"{path.stem}.npz", probabilities=probabilities, class_names=CLASS_NAMES)

"""Readers of settings, networks, runs and maps, each with a file that it takes: made in a folder, by name."""

from __future__ import annotations

import functools
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from faults import mutations
from faults.drive_files import small_street
from faults.fuzzing import Reader

from factor_graphs.trajectory import Trajectory
from gnss_sem_map import config
from gnss_sem_map.labels import label_set, sensor_model
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.map_json import read_frame

CLASSES = ("road", "sidewalk", "vehicle", "building", "vegetation")


def settings(folder: Path) -> Reader:
    """The settings of a run."""
    folder.mkdir(parents=True)
    file = folder / "config.yaml"
    file.write_text(config.Settings().to_yaml())
    return Reader(file, lambda: config.load(file), mutations.text)


def one_setting(folder: Path) -> Reader:
    """A setting on the command line, which the file holds here."""
    folder.mkdir(parents=True)
    file = folder / "set"
    file.write_text("mapping.voxel_size_m=0.2")

    def read() -> object:
        return config.load(None, [file.read_bytes().decode("utf-8", "surrogateescape")])

    return Reader(file, read, mutations.text)


def segmenter(folder: Path) -> Reader:
    """How a segmenter is asked for, which the file holds here."""
    from gnss_sem_map.segmentation import open_segmenter

    folder.mkdir(parents=True)
    file, there = folder / "spec", small_street(folder / "street").labels
    file.write_text(f"labels:{there}")
    other = [
        b"python:json:loads?classes=road,sidewalk&x",
        b"onnx:/etc?mean=1,2,3&std=0",
        b"labels:/?ids=1&taxonomy=/",
    ]

    def mutate(seed: bytes, rng: np.random.Generator) -> bytes:
        return mutations.text(seed if rng.random() < 0.5 else other[int(rng.integers(0, 3))], rng)

    def read() -> object:
        spec = file.read_bytes().decode("utf-8", "surrogateescape")
        return open_segmenter(spec, label_set.open_label_set(), "cpu", None)

    return Reader(file, read, mutate)


def shipped(name: str, opened: Callable[[Path], object], folder: Path) -> Reader:
    """A class set or a taxonomy of the user's own."""
    folder.mkdir(parents=True)
    file = folder / "own.yaml"
    shutil.copy(Path(label_set.__file__).parent / f"{name}.yaml", file)
    return Reader(file, lambda: opened(file), mutations.text)


def _taxonomy(file: Path) -> object:
    found = label_set.taxonomy(file)
    return [found.lookup(label_set.open_label_set(), kind) for kind in found.ids]


def calibration(folder: Path) -> Reader:
    """What a network's answers are worth."""
    folder.mkdir(parents=True)
    file, n = folder / "calibration.yaml", len(CLASSES)
    one = sensor_model.CalibrationDrive(
        "a", np.full((n, n + 1), 7, np.int64), np.full((n, *sensor_model.CELLS), 2, np.int64)
    )
    file.write_text(sensor_model.LabelCalibration("urban", CLASSES, (one,), 1.5).to_yaml())
    urban = label_set.open_label_set()
    return Reader(file, lambda: sensor_model.read(file, urban).log_likelihoods, mutations.text)


def geometric_classifier(folder: Path) -> Reader:
    """A classifier by shape, which says something of ten voxels once it is read."""
    from gnss_sem_map.geometric_classifier import classifier, features
    from gnss_sem_map.geometric_classifier.trees import INNER, LEAVES, BoostedTrees

    folder.mkdir(parents=True)
    file, rng, count = folder / "classifier.npz", np.random.default_rng(0), len(features.NAMES)
    trees = BoostedTrees(
        np.array([0, 3, 5], np.int8),
        np.zeros(3, np.float32),
        rng.integers(0, count, (6, INNER), np.int16),
        rng.normal(size=(6, INNER)).astype(np.float32),
        rng.normal(size=(6, LEAVES)).astype(np.float32),
    )
    file.write_bytes(classifier.Classifier(CLASSES, 0.2, (trees, trees), 1.5, True).to_bytes())
    urban, rows = label_set.open_label_set(), rng.normal(size=(10, count)).astype(np.float32)

    def read() -> object:
        found = classifier.read(file, urban, 0.2)
        return found.log_probabilities(rows, np.arange(10) << 40, np.zeros(10, np.bool_))

    return Reader(file, read, mutations.npz)


def run_json(folder: Path) -> Reader:
    """What a run says of itself, as `calibrate` and the report read it."""
    from gnss_sem_map.files.run_json import inputs_of, read_run

    folder.mkdir(parents=True)
    file = folder / "run.json"
    about = {
        "name": "a",
        "inputs": {"drive": "/d", "segmenter": "none"},
        "counts": {"scans": 1},
        "epoch_ns": 0,
    }
    file.write_text(json.dumps(about, indent=1))
    return Reader(file, lambda: (read_run(folder), inputs_of(folder)), mutations.text)


def small_map(folder: Path) -> Path:
    """The folder of a map of some voxels."""
    from factor_graphs.geodesy import LocalFrame
    from gnss_sem_map.voxels.semantic_map import SemanticMap
    from gnss_sem_map.voxels.voxel_map import VoxelMap, pack

    rng = np.random.default_rng(0)
    keys = np.unique(pack(rng.integers(-300, 300, (400, 3))))
    evidence = -rng.integers(0, 5000, (len(keys), len(CLASSES))).astype(np.int32)
    heights = rng.integers(0, 256, len(keys))
    of_images = rng.integers(0, 99, (len(keys), 2), np.int32)
    ones = np.ones(len(keys), np.uint32)
    voxels = VoxelMap(0.2, label_set.open_label_set(), keys, evidence, ones, heights, of_images)
    folder.mkdir(parents=True)
    tiles.write(SemanticMap.of(voxels), folder / "map", LocalFrame(49, 8, 100))
    return folder / "map"


def map_json(folder: Path) -> Reader:
    """What says which tiles a map has."""
    where = small_map(folder)
    return Reader(where / "map.json", lambda: (tiles.read(where), read_frame(where)), mutations.text)


def tile(folder: Path) -> Reader:
    """A tile whose checksum is right, whatever it holds."""
    where = small_map(folder)
    file, about = min(where.glob("*.parquet")), json.loads((where / "map.json").read_text())

    def read() -> object:
        about["files"][file.name]["sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
        (where / "map.json").write_text(json.dumps(about))
        return tiles.read(where)

    return Reader(file, read, mutations.parquet)


def trajectory(folder: Path) -> Reader:
    """A saved trajectory with velocities and covariances."""

    folder.mkdir(parents=True)
    file, k = folder / "trajectory.parquet", 20
    T = np.tile(np.eye(4), (k, 1, 1))
    Trajectory(np.arange(k) * 0.1, T, np.zeros((k, 3)), np.tile(np.eye(6), (k, 1, 1))).save(file)
    return Reader(file, lambda: Trajectory.load(file).at([0.5]), mutations.parquet)


def checkpoint(suffix: str, folder: Path) -> Reader:
    """The weights of a network."""
    import torch
    from safetensors.torch import save_file

    from gnss_sem_map.segmentation.checkpoints import read_checkpoint

    folder.mkdir(parents=True)
    file, tensors = folder / f"network{suffix}", {"a.weight": torch.ones(3, 4), "a.bias": torch.ones(4)}
    if suffix == ".safetensors":
        save_file(tensors, file, {"gnss_sem_map": json.dumps({"class_names": ["road"], "scale": 1.0})})
    else:
        torch.save(tensors, file)
    return Reader(file, lambda: read_checkpoint(file), mutations.binary)


def image_processor(folder: Path) -> Reader:
    """The settings of the image processor of a network of transformers."""
    from transformers import SegformerConfig

    from gnss_sem_map.segmentation.huggingface import preparation

    folder.mkdir(parents=True)
    about = {"image_processor_type": "SegformerImageProcessor", "image_mean": [0.5, 0.4, 0.3], "do_rescale": True,
             "rescale_factor": 0.004, "image_std": [0.2, 0.2, 0.2], "size": {"height": 512, "width": 512}}  # fmt: skip
    file = folder / "preprocessor_config.json"
    file.write_text(json.dumps(about, indent=1))
    SegformerConfig().save_pretrained(folder)
    pixels = np.zeros((1, 32, 64, 3), np.uint8)
    return Reader(file, lambda: preparation(str(folder), SegformerConfig())(pixels), mutations.text)


OWN_FILES: dict[str, Callable[[Path], Reader]] = {
    "image processor": image_processor,
    "settings": settings,
    "--set": one_setting,
    "segmenter": segmenter,
    "class set": functools.partial(shipped, "urban", label_set.open_label_set),
    "taxonomy": functools.partial(shipped, "cityscapes", _taxonomy),
    "label calibration": calibration,
    "geometric classifier": geometric_classifier,
    "run.json": run_json,
    "map.json": map_json,
    "tile": tile,
    "trajectory": trajectory,
    "safetensors": functools.partial(checkpoint, ".safetensors"),
    "torch file": functools.partial(checkpoint, ".pt"),
}

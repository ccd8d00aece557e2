"""The demo's network: small, at home in simulated streets it has never seen, made by the trainer that users have."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from gnss_sem_map.labels import sensor_model
from gnss_sem_map.labels.label_set import open_label_set, taxonomy
from gnss_sem_map.segmentation import DEMO_CALIBRATION, DEMO_NETWORK, open_segmenter
from gnss_sem_map.segmentation.training import TrainingSettings, train
from gnss_sem_map.segmentation.training_data import LabelledFolder
from gnss_sem_map.sensor_log import Image
from gnss_sem_map.simulation import prepare

URBAN = open_label_set("urban")
DEMO_SEED = 0


@pytest.fixture(scope="module")
def streets() -> list[tuple[np.ndarray, np.ndarray]]:
    """Images (h, w, 3) and trainIds (h, w) of the demo's own drive, on which the network was not trained."""
    simulation = prepare(6.0, DEMO_SEED)
    images = [simulation.image(frame) for frame in (0, 20, 40)]
    return [(image.rgb, image.train_ids) for image in images]


def test_the_network_is_small_enough_to_ship() -> None:
    assert DEMO_NETWORK.stat().st_size <= 5e6


def test_it_knows_the_classes_of_the_map_in_streets_it_has_not_seen(
    streets: list[tuple[np.ndarray, np.ndarray]],
) -> None:
    segment = open_segmenter("demo", URBAN, device="cpu")
    assert segment.class_names == (*URBAN.names, "other")
    classes = taxonomy("cityscapes").lookup(URBAN, "train_id")
    confusion = np.zeros((6, 6), np.int64)
    for number, (pixels, ids) in enumerate(streets):
        seen = segment(Image(number, 0.0, lambda pixels=pixels: pixels)).argmax(2)
        truth = classes[ids[: 2 * seen.shape[0] : 2, : 2 * seen.shape[1] : 2]]
        np.add.at(confusion, (truth[truth >= 0], seen[truth >= 0]), 1)
    iou = confusion.diagonal() / (confusion.sum(0) + confusion.sum(1) - confusion.diagonal())
    assert iou[:5].mean() > 0.7, dict(zip(segment.class_names, iou.round(3), strict=True))


def test_its_calibration_is_of_other_streets_than_the_demos_and_trusts_its_answers() -> None:
    found = sensor_model.read(DEMO_CALIBRATION, URBAN)
    seeds = {int(street.name.split("_drive_")[1].split("_")[0]) for street in found.drives}
    assert seeds == {101, 102}
    assert found.log_likelihoods[:5].argmax(axis=1).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.slow
def test_the_trainer_that_made_it_learns_from_simulated_streets(
    streets: list[tuple[np.ndarray, np.ndarray]], tmp_path: Path
) -> None:
    for kind in ("images", "labels"):
        (tmp_path / kind).mkdir()
    for number, (pixels, ids) in enumerate(streets):
        cv2.imwrite(str(tmp_path / "images" / f"{number}.png"), pixels[:, :, ::-1])
        cv2.imwrite(str(tmp_path / "labels" / f"{number}.png"), ids)
    folder = LabelledFolder(tmp_path / "images", tmp_path / "labels")
    settings = TrainingSettings(
        width=32, steps=30, batch_size=3, crop_px=(128, 80), image_scale=0.25, validate_every=10, warmup_steps=3,
        learning_rate=3e-3,
    )  # fmt: skip
    train([folder], [folder], tmp_path / "out", URBAN, settings=settings, device="cpu")
    rows = list(csv.DictReader((tmp_path / "out" / "log.csv").read_text().splitlines()))
    assert float(rows[-1]["loss"]) < 0.9 * float(rows[0]["loss"])

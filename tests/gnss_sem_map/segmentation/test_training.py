"""Training learns, forgets nothing when it is interrupted, and gives the same weights for the same seed."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.files.ownership import MARKER, write_list
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.segmentation.training import (
    NETWORK,
    STATE,
    TrainingSettings,
    learning_rate,
    precision_on,
    train,
)
from gnss_sem_map.segmentation.training_data import (
    IGNORE,
    LabelledFolder,
    augmented,
    class_weights,
    labelled_images,
)
from gnss_sem_map.sensor_log import Image

URBAN = open_label_set("urban")
CALM = TrainingSettings(
    width=16, steps=4, batch_size=2, crop_px=(64, 32), validate_every=2, learning_rate=3e-3, warmup_steps=2
)


def street(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Sky above, a house on one side, trees on the other, road below: trainIds and the colours that go with them."""
    dice = np.random.default_rng(seed)
    ids = np.full((48, 96), 10, np.uint8)
    ids[8:, : int(dice.integers(30, 60))] = 2
    ids[12:, int(dice.integers(62, 80)) :] = 8
    ids[30:] = 0
    ids[30:34] = 1
    ids[36:44, 10 : int(dice.integers(20, 40))] = 13
    colours = {
        10: (120, 170, 230),
        2: (190, 140, 80),
        8: (50, 120, 40),
        0: (90, 90, 95),
        1: (170, 160, 165),
        13: (180, 20, 30),
    }
    pixels = np.zeros((*ids.shape, 3))
    for k, colour in colours.items():
        pixels[ids == k] = colour
    return np.clip(pixels + dice.normal(0, 8, pixels.shape), 0, 255).astype(np.uint8), ids


def write_streets(folder: Path, seeds: range) -> LabelledFolder:
    images, labels = folder / "images", folder / "labels"
    for path in (images, labels):
        path.mkdir(parents=True)
    for seed in seeds:
        pixels, ids = street(seed)
        cv2.imwrite(str(images / f"{seed:06d}.png"), pixels[:, :, ::-1])
        cv2.imwrite(str(labels / f"{seed:06d}.png"), ids)
    return LabelledFolder(images, labels)


@pytest.fixture(scope="module")
def streets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[LabelledFolder]]:
    folder = tmp_path_factory.mktemp("streets")
    return {
        "training": [write_streets(folder / "a", range(6)), write_streets(folder / "b", range(10, 12))],
        "validation": [write_streets(folder / "c", range(20, 23))],
    }


def run(streets: Any, out: Path, plan: TrainingSettings = CALM, **more: Any) -> dict[str, torch.Tensor]:
    train(**streets, out=out, label_set=URBAN, settings=plan, device="cpu", **more)
    state: dict[str, torch.Tensor] = torch.load(out / STATE, weights_only=True)["network"]
    return state


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(streets: Any, tmp_path: Path) -> None:
    first = run(streets, tmp_path / "1")
    torch.randn(17)  # whatever else uses randomness has no say
    assert_same(first, run(streets, tmp_path / "2"))
    assert (tmp_path / "1" / NETWORK).read_bytes() == (tmp_path / "2" / NETWORK).read_bytes()
    other = run(streets, tmp_path / "3", CALM.model_copy(update={"seed": 1}))
    assert not torch.equal(first["segm.weight"], other["segm.weight"])


@pytest.mark.slow
def test_half_precision_gives_other_weights_but_the_same_for_the_same_seed(
    streets: Any, tmp_path: Path
) -> None:
    half = CALM.model_copy(update={"precision": "bfloat16"})
    first = run(streets, tmp_path / "1", half)
    assert_same(first, run(streets, tmp_path / "2", half))
    assert not torch.equal(first["segm.weight"], run(streets, tmp_path / "3")["segm.weight"])
    assert all(weight.dtype != torch.bfloat16 for weight in first.values())


@pytest.mark.parametrize(
    ("device", "asked", "found"),
    [("cpu", "auto", torch.float32), ("cuda", "auto", torch.float16), ("cuda", "bfloat16", torch.bfloat16)],
)
def test_layers_calculate_in_what_the_device_is_fast_at(device: str, asked: str, found: torch.dtype) -> None:
    assert precision_on(torch.device(device), TrainingSettings(precision=asked)) is found


def test_an_interrupted_training_ends_as_if_it_had_not_been(streets: Any, tmp_path: Path) -> None:
    def stop(stage: str, done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(streets, tmp_path / "a", progress=stop)
    resumed = run(streets, tmp_path / "a", resume=True)
    assert_same(resumed, run(streets, tmp_path / "b"))
    for name in (NETWORK, "log.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_folder_with_a_training_is_neither_overwritten_nor_mixed(streets: Any, tmp_path: Path) -> None:
    run(streets, tmp_path)
    with pytest.raises(ConfigError, match="holds a training"):
        run(streets, tmp_path)
    with pytest.raises(ConfigError, match=r"other settings .*'steps': \(4, 6\)"):
        run(streets, tmp_path, CALM.model_copy(update={"steps": 6}), resume=True)


def test_a_folder_that_holds_a_run_is_no_place_for_a_training(streets: Any, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/run.json").write_text("{}")
    write_list(tmp_path / "out")
    with pytest.raises(ConfigError, match=r"out: holds run.json, no training; choose another folder$"):
        run(streets, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [MARKER, "run.json"]


@pytest.mark.slow
def test_it_learns_the_streets_and_the_file_opens_as_a_segmenter(streets: Any, tmp_path: Path) -> None:
    plan = CALM.model_copy(update={"steps": 240, "validate_every": 80, "batch_size": 4, "warmup_steps": 5})
    report = train(**streets, out=tmp_path, label_set=URBAN, settings=plan, device="cpu")
    rows = list(csv.DictReader((tmp_path / "log.csv").read_text().splitlines()))
    assert [int(row["step"]) for row in rows] == [80, 160, 240]
    assert float(rows[-1]["loss"]) < 0.6 * float(rows[0]["loss"])
    assert report.best_mean_iou == pytest.approx(max(float(row["mean_iou"]) for row in rows), abs=1e-4)
    segment = open_segmenter(f"refinenet:{report.network}?shrink=1", URBAN, "cpu")
    assert segment.class_names == (*URBAN.names, "other")
    pixels, ids = street(99)
    seen = segment(Image(0, 0.0, lambda: pixels)).argmax(2)
    assert (seen[ids == 0] == URBAN.index("road")).mean() > 0.8


def test_fine_tuning_begins_with_the_weights_it_is_given(streets: Any, tmp_path: Path) -> None:
    before = run(streets, tmp_path / "a")
    timid = CALM.model_copy(update={"steps": 1, "learning_rate": 1e-12, "weight_decay": 0.0})
    after = run(streets, tmp_path / "b", timid, initial=tmp_path / "a" / NETWORK)
    best = load_file(tmp_path / "a" / NETWORK)
    for name in before:
        if not name.endswith(("running_mean", "running_var", "num_batches_tracked")):
            torch.testing.assert_close(after[name], best[name].float(), atol=1e-9, rtol=1e-6)


def test_another_class_set_gets_a_new_last_layer_on_the_old_network(streets: Any, tmp_path: Path) -> None:
    before = run(streets, tmp_path / "a")
    ground = tmp_path / "ground.yaml"
    ground.write_text(
        "name: ground\nclasses:\n"
        "  - {name: drivable, colour: [1, 2, 3], semantic_kitti_id: 40, asprs_code: 11}\n"
        "  - {name: raised, colour: [4, 5, 6], semantic_kitti_id: 48, asprs_code: 65}\n"
        "sources:\n  cityscapes: {road: drivable, sidewalk: raised}\n"
    )
    timid = CALM.model_copy(update={"steps": 1, "learning_rate": 1e-12, "weight_decay": 0.0})
    train(
        **streets, out=tmp_path / "b", label_set=open_label_set(ground), settings=timid, device="cpu",
        initial=tmp_path / "a" / NETWORK,
    )  # fmt: skip
    after = torch.load(tmp_path / "b" / STATE, weights_only=True)["network"]
    assert after["segm.weight"].shape[0] == 3
    assert before["segm.weight"].shape[0] == 6
    torch.testing.assert_close(
        after["conv8.weight"], load_file(tmp_path / "a" / NETWORK)["conv8.weight"].float()
    )


def test_the_learning_rate_rises_and_then_falls_to_nothing() -> None:
    plan = TrainingSettings(steps=1000, warmup_steps=100)
    rates = [learning_rate(step, plan) for step in range(1, 1001)]
    top = int(np.argmax(rates))
    assert 80 < top < 120
    assert np.all(np.diff(rates[:top]) > 0)
    assert np.all(np.diff(rates[top + 1 :]) < 0)
    assert max(rates) <= plan.learning_rate
    assert rates[-1] < 1e-5 * plan.learning_rate


@given(seed=st.integers(0, 2**32 - 1), shape=st.tuples(st.integers(8, 60), st.integers(8, 60)))
@settings(max_examples=40, deadline=None)
def test_pixels_and_truth_are_moved_together(seed: int, shape: tuple[int, int]) -> None:
    truth = np.zeros(shape, np.uint8)
    truth[:, shape[1] // 2 :] = 1
    pixels = np.where(truth[..., None] == 1, 200, 60).astype(np.uint8).repeat(3, 2)
    seen, said = augmented(pixels, truth, (32, 24), (0.6, 1.7), np.random.default_rng(seed))
    assert seen.shape == (24, 32, 3)
    assert said.shape == (24, 32)
    assert not seen[said == IGNORE].any()
    inner = cv2.erode((said != IGNORE).astype(np.uint8), np.ones((3, 3))) == 1
    borders = cv2.morphologyEx(said, cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)) > 0
    bright, dark = seen[(said == 1) & inner & ~borders], seen[(said == 0) & inner & ~borders]
    if bright.size and dark.size:
        assert bright.min() > dark.max()


def test_rare_classes_weigh_more_and_the_mean_is_one(streets: Any) -> None:
    data = labelled_images(streets["training"], URBAN, "cityscapes")
    weights = class_weights(data)
    assert weights.mean() == pytest.approx(1)
    assert weights[URBAN.index("vehicle")] > weights[URBAN.index("road")]


def test_of_a_drive_every_so_manieth_image_is_used_in_the_order_of_the_names(tmp_path: Path) -> None:
    folder = write_streets(tmp_path, range(7))
    thinned = LabelledFolder.parse(f"{folder.images},{folder.labels},3")
    data = labelled_images([folder, thinned], URBAN, "cityscapes")
    assert [int(image.stem) for image, _ in data.pairs] == [*range(7), 0, 3, 6]
    assert all(image.stem == label.stem for image, label in data.pairs)


@pytest.mark.parametrize(("ids", "suffix"), [("train_id", "labelTrainIds"), ("label_id", "labelIds")])
def test_the_layout_of_cityscapes_is_understood(tmp_path: Path, ids: str, suffix: str) -> None:
    for city in ("aachen", "bonn"):
        for path in (tmp_path / "leftImg8bit" / city, tmp_path / "gtFine" / city):
            path.mkdir(parents=True)
        pixels, truth = street(1)
        cv2.imwrite(str(tmp_path / "leftImg8bit" / city / f"{city}_000000_000019_leftImg8bit.png"), pixels)
        cv2.imwrite(str(tmp_path / "gtFine" / city / f"{city}_000000_000019_gtFine_{suffix}.png"), truth)
    folder = LabelledFolder(tmp_path / "leftImg8bit", tmp_path / "gtFine")
    data = labelled_images([folder], URBAN, "cityscapes", ids)
    assert [label.parent.name for _, label in data.pairs] == ["aachen", "bonn"]
    assert all(label.is_file() for _, label in data.pairs)


@pytest.mark.parametrize("text", ["", "images", "images,", "a,b,0", "a,b,-1", "a,b,c", "a,b,1,2"])
def test_a_folder_that_is_not_well_said_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="IMAGES,LABELS"):
        LabelledFolder.parse(text)


def broken(folder: Path, what: str) -> LabelledFolder:
    written = write_streets(folder, range(2))
    images, labels = written.images, written.labels
    match what:
        case "no labels":
            (labels / "000001.png").unlink()
        case "colours":
            cv2.imwrite(str(labels / "000000.png"), np.full((48, 96, 3), (0, 9, 0), np.uint8))
        case "size":
            cv2.imwrite(str(labels / "000000.png"), np.zeros((48, 95), np.uint8))
        case "ids":
            cv2.imwrite(str(labels / "000000.png"), np.full((48, 96), 77, np.uint8))
        case "image":
            (images / "000000.png").write_bytes(b"\x89PNG")
        case "grey":
            cv2.imwrite(str(images / "000000.png"), np.zeros((48, 96), np.uint8))
        case "deep":
            cv2.imwrite(str(images / "000000.png"), np.zeros((48, 96, 3), np.uint16))
        case "void":
            for file in labels.iterdir():
                cv2.imwrite(str(file), np.full((48, 96), 255, np.uint8))
        case "empty":
            for file in images.iterdir():
                file.unlink()
    return written


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("no labels", r"2 images, 1 without labels .*000001"),
        ("colours", "not colours"),
        ("size", r"found \(48, 95\)"),
        ("ids", r"000000\.png: found ids \[77\]"),
        ("image", r"000000\.png: damaged image"),
        ("grey", r"000000\.png: found uint8 \(48, 96, 1\)"),
        ("deep", "found uint16"),
        ("void", "found no pixel of"),
        ("empty", "0 images"),
    ],
)
def test_training_data_that_is_not_right_is_named(
    streets: Any, tmp_path: Path, what: str, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        run(streets | {"training": [broken(tmp_path / "data", what)]}, tmp_path / "out")


def test_a_damaged_state_is_not_resumed(streets: Any, tmp_path: Path) -> None:
    run(streets, tmp_path)
    (tmp_path / STATE).write_bytes(b"nonsense")
    with pytest.raises(DataError, match=r"state\.pt: damaged"):
        run(streets, tmp_path, resume=True)


@pytest.mark.parametrize("in_the_way", ["", "network.safetensors.part", "state.pt.part", "log.csv"])
def test_a_folder_that_cannot_be_written_is_named(streets: Any, tmp_path: Path, in_the_way: str) -> None:
    out = tmp_path / "out"
    if in_the_way:
        out.mkdir()
        write_list(out)  # ours, or it would be refused for another reason
        (out / in_the_way).mkdir()
    else:
        out.write_text("a file where the folder should be")
    with pytest.raises(DataError, match=r"out: cannot be written"):
        run(streets, out)


def test_a_full_memory_is_our_error_and_says_what_helps(
    streets: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> Any:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    monkeypatch.setattr("gnss_sem_map.segmentation.training.cross_entropy", full)
    with pytest.raises(DataError, match="memory is full; try a smaller crop_px"):
        run(streets, tmp_path)


def test_a_loss_that_is_not_finite_ends_the_training(
    streets: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = lambda logits, *_, **__: logits.sum() * torch.nan  # noqa: E731
    monkeypatch.setattr("gnss_sem_map.segmentation.training.cross_entropy", nothing)
    with pytest.raises(DataError, match="loss of step 1 is not finite"):
        run(streets, tmp_path)
    assert not (tmp_path / NETWORK).exists()

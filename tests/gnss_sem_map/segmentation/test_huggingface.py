"""Networks of transformers, saved and opened again, against what their own outputs add up to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate
from transformers_networks import (
    FAMILIES,
    NAMES,
    PIXELS,
    beit,
    camera,
    data2vec,
    dpt,
    eomt,
    mask2former,
    normalised,
    oneformer,
    processor_of,
    saved,
    segformer,
    transformers,
)

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.labels.label_set import open_label_set, taxonomy
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.segmentation.cache import quantised
from gnss_sem_map.segmentation.classes import unknown_classes

URBAN = open_label_set("urban")
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))


def mask_masses(classes: torch.Tensor, masks: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Query by query, in a loop: its classes but for "no object", where its mask is."""
    total = torch.zeros(len(NAMES), *size)
    enlarged = interpolate(masks, size, mode="bilinear")[0].sigmoid()
    for query, mask in zip(classes[0].softmax(1), enlarged, strict=True):
        total += query[:-1, None, None] * mask
    return total


def test_a_network_of_logits_gives_their_softmax(tmp_path: Path) -> None:
    model = saved(tmp_path, segformer())
    segment = open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")
    with torch.inference_mode():
        logits = interpolate(model(normalised(*IMAGENET)).logits, (32, 48), mode="bilinear")
    assert segment.class_names == NAMES
    np.testing.assert_allclose(segment(camera()), logits.softmax(1)[0].permute(1, 2, 0), atol=1e-5)


@pytest.mark.parametrize("build", [mask2former, oneformer])
def test_a_network_of_masks_gives_every_class_its_share(tmp_path: Path, build: Any) -> None:
    model = saved(tmp_path, build())
    task = {}
    if build is oneformer:
        tokenizer = transformers.AutoTokenizer.from_pretrained(tmp_path)
        tokens = tokenizer("the task is semantic", padding="max_length", max_length=12, truncation=True)
        task = {"task_inputs": torch.tensor([tokens["input_ids"]]) * torch.tensor([tokens["attention_mask"]])}
    with torch.inference_mode():
        answer = model(pixel_values=normalised(*IMAGENET), **task)
        mass = mask_masses(answer.class_queries_logits, answer.masks_queries_logits, (32, 48))
    seen = open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")(camera())
    np.testing.assert_allclose(seen, (mass / mass.sum(0)).permute(1, 2, 0), atol=1e-4)
    assert (np.sort(seen, 2)[:, :, :-1].sum(2) > 0.01).all()  # not the best class alone


def test_a_network_of_a_fixed_square_sees_a_wide_image_in_overlapping_windows(tmp_path: Path) -> None:
    model = saved(tmp_path, eomt())
    image, total, count = normalised(*IMAGENET), torch.zeros(6, 64, 96), torch.zeros(96)
    with torch.inference_mode():
        for left in (0, 32):  # 96 pixels wide in two windows of 64
            answer = model(pixel_values=image[..., left : left + 64])
            mass = mask_masses(answer.class_queries_logits, answer.masks_queries_logits, (64, 64))
            total[:, :, left : left + 64] += mass
            count[left : left + 64] += 1
        half = interpolate((total / count)[None], (32, 48), mode="bilinear")[0]
    seen = open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")(camera())
    np.testing.assert_allclose(seen, (half / half.sum(0)).permute(1, 2, 0), atol=1e-4)


@pytest.mark.parametrize("build", [segformer, mask2former, eomt])
def test_any_image_size_gives_probabilities_at_half_of_it(tmp_path: Path, build: Any) -> None:
    saved(tmp_path, build())
    seen = open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")(camera(PIXELS[:45, :83]))
    assert seen.shape == (22, 41, 6)
    np.testing.assert_allclose(seen.sum(2), 1, atol=1e-4)


@pytest.mark.parametrize("build", FAMILIES)
@pytest.mark.parametrize(
    "shape", [(45, 173), *(pytest.param(shape, marks=pytest.mark.slow) for shape in ((173, 45), (70, 70)))]
)
def test_every_family_gives_probabilities_of_images_of_any_shape(
    tmp_path: Path, build: Any, shape: tuple[int, int]
) -> None:
    saved(tmp_path, build())
    pixels = np.random.default_rng(4).integers(0, 256, (*shape, 3), dtype=np.uint8)
    seen = open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")(camera(pixels))
    assert seen.shape == (shape[0] // 2, shape[1] // 2, 6)
    np.testing.assert_allclose(seen.sum(2), 1, atol=1e-4)


@pytest.mark.parametrize("build", [dpt, beit, data2vec])
def test_logits_of_a_network_of_squares_are_averaged_where_windows_overlap(
    tmp_path: Path, build: Any
) -> None:
    model = saved(tmp_path, build())
    processor_of(model.config)(image_mean=[0.5, 0.4, 0.3], image_std=[0.3] * 3).save_pretrained(tmp_path)
    image, total, count = (
        normalised((0.5, 0.4, 0.3), (0.3, 0.3, 0.3)),
        torch.zeros(6, 64, 96),
        torch.zeros(96),
    )
    with torch.inference_mode():
        for left in (0, 32):
            logits = interpolate(model(image[..., left : left + 64]).logits, (64, 64), mode="bilinear")
            total[:, :, left : left + 64] += logits[0].softmax(0)
            count[left : left + 64] += 1
    expected = interpolate((total / count)[None], (32, 48), mode="bilinear")[0]
    seen = open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")(camera())
    np.testing.assert_allclose(seen, expected.permute(1, 2, 0), atol=1e-5)


def test_an_error_inside_a_network_names_network_image_and_shape(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved(tmp_path, segformer())
    segment = open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")

    def fails(self: object, pixel_values: torch.Tensor) -> torch.Tensor:
        return torch.zeros(3) @ pixel_values

    monkeypatch.setattr(transformers.SegformerForSemanticSegmentation, "forward", fails)
    with pytest.raises(
        DataError, match=rf"hf:{tmp_path} on image 0 of 96 x 64 pixels: RuntimeError"
    ) as caught:
        segment(camera())
    assert "\n" not in str(caught.value)


def test_classes_can_be_named_where_the_model_has_only_numbers(tmp_path: Path) -> None:
    model = segformer()
    model.config.id2label = {i: f"LABEL_{i}" for i in range(6)}
    saved(tmp_path, model)
    with pytest.raises(ConfigError, match="LABEL_0"):
        open_segmenter(f"hf:{tmp_path}", URBAN)
    segment = open_segmenter(f"hf:{tmp_path}?classes=kitti6", URBAN, device="cpu")
    assert segment.class_names[:2] == ("sky", "building")


@pytest.mark.parametrize(
    ("source", "spelling", "known"),
    [
        ("ade20k", str, 150),
        ("mapillary", str, 65),
        ("cityscapes", lambda name: name.replace(" ", "_").upper(), 19),
    ],
)
def test_networks_of_public_data_sets_need_no_names(
    tmp_path: Path, source: str, spelling: Any, known: int
) -> None:
    table = taxonomy(source).ids[taxonomy(source).usual_ids]
    names = [spelling(name) for name in sorted(table, key=lambda name: table[name])]
    config = transformers.SegformerConfig(
        hidden_sizes=[8, 16, 24, 32], depths=[1, 1, 1, 1], num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=16, id2label=dict(enumerate(names)), label2id={name: i for i, name in enumerate(names)},
    )  # fmt: skip
    saved(tmp_path, transformers.SegformerForSemanticSegmentation(config))
    segment = open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")
    assert unknown_classes(segment.class_names, URBAN) is None
    seen = segment(camera())
    assert seen.shape[2] == known
    summed = quantised(seen, segment.class_names, URBAN)
    ours = [URBAN.of_source(source, name) for name in sorted(table, key=lambda name: table[name])]
    vehicle = [i for i, target in enumerate(ours) if target == URBAN.index("vehicle")]
    assert len(vehicle) > 4
    np.testing.assert_allclose(summed[:, :, URBAN.index("vehicle")], 255 * seen[:, :, vehicle].sum(2), atol=2)


def test_opening_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    saved(tmp_path, segformer())
    capfd.readouterr()
    open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")
    assert capfd.readouterr() == ("", "")


def test_a_model_that_is_not_on_this_machine_is_answered_with_how_to_get_it() -> None:
    with pytest.raises(DataError, match="hf download nobody/nothing"):
        open_segmenter("hf:nobody/nothing", URBAN)


@pytest.mark.parametrize("path", ["./nowhere", "/nowhere/net", "runs/net/checkpoint-900"])
def test_a_folder_that_is_not_there_is_not_taken_for_a_model_of_the_hub(path: str) -> None:
    with pytest.raises(DataError, match=r"no such folder; expected one with config\.json"):
        open_segmenter(f"hf:{path}", URBAN)


def test_a_network_that_does_not_segment_is_refused(tmp_path: Path) -> None:
    transformers.ViTConfig(hidden_size=8, num_hidden_layers=1).save_pretrained(tmp_path)
    with pytest.raises(DataError, match="vit is no segmentation network"):
        open_segmenter(f"hf:{tmp_path}", URBAN)


def test_a_network_that_needs_a_task_is_refused_without_its_tokenizer(tmp_path: Path) -> None:
    oneformer().save_pretrained(tmp_path)
    with pytest.raises(DataError, match="tokenizer does not know"):
        open_segmenter(f"hf:{tmp_path}", URBAN)


@pytest.mark.parametrize("name", ["model.safetensors", "config.json"])
def test_a_damaged_file_is_one_line(tmp_path: Path, name: str) -> None:
    saved(tmp_path, segformer())
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:40])
    with pytest.raises(DataError, match=rf"hf:{tmp_path}: cannot be read \(") as caught:
        open_segmenter(f"hf:{tmp_path}", URBAN)
    assert "\n" not in str(caught.value)


def test_weights_that_lack_tensors_are_refused(tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    saved(tmp_path, segformer())
    tensors = load_file(tmp_path / "model.safetensors")
    tensors.pop("decode_head.classifier.weight")
    save_file(tensors, tmp_path / "model.safetensors", {"format": "pt"})
    with pytest.raises(DataError, match="lacks 1 tensors of the network"):
        open_segmenter(f"hf:{tmp_path}", URBAN)

"""Small networks of transformers, saved and opened again, against what their own outputs add up to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

transformers = pytest.importorskip("transformers", reason="needs the extra [hf]")

from gnss_sem_map.errors import ConfigError, DataError  # noqa: E402
from gnss_sem_map.labels.label_set import open_label_set, taxonomy  # noqa: E402
from gnss_sem_map.segmentation import open_segmenter  # noqa: E402
from gnss_sem_map.segmentation.cache import quantised  # noqa: E402
from gnss_sem_map.segmentation.classes import unknown_classes  # noqa: E402
from gnss_sem_map.sensor_log import Image  # noqa: E402

URBAN = open_label_set("urban")
NAMES = ("road", "sidewalk", "car", "building", "vegetation", "sky")
LABELS = {"id2label": dict(enumerate(NAMES)), "label2id": {name: i for i, name in enumerate(NAMES)}}
PIXELS = np.random.default_rng(1).integers(0, 256, (64, 96, 3), dtype=np.uint8)
SWIN = {
    "embed_dim": 12,
    "depths": [1, 1, 1, 1],
    "num_heads": [1, 1, 2, 2],
    "window_size": 4,
    "image_size": 64,
}


def camera(pixels: np.ndarray = PIXELS) -> Image:
    return Image(0, 0.0, lambda: pixels)


def segformer() -> Any:
    config = transformers.SegformerConfig(
        hidden_sizes=[8, 16, 24, 32], depths=[1, 1, 1, 1], num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=16, **LABELS,
    )  # fmt: skip
    return transformers.SegformerForSemanticSegmentation(config)


def mask2former() -> Any:
    config = transformers.Mask2FormerConfig(
        backbone_config=transformers.SwinConfig(**SWIN, out_features=["stage1", "stage2", "stage3", "stage4"]),
        feature_size=32, mask_feature_size=32, hidden_dim=32, encoder_feedforward_dim=32, encoder_layers=1,
        decoder_layers=2, num_attention_heads=2, dim_feedforward=32, num_queries=7, **LABELS,
    )  # fmt: skip
    return transformers.Mask2FormerForUniversalSegmentation(config)


def eomt() -> Any:
    config = transformers.EomtConfig(
        hidden_size=16, num_hidden_layers=3, num_attention_heads=2, image_size=64, patch_size=16, num_blocks=1,
        num_upscale_blocks=1, num_queries=7, mlp_ratio=2, **LABELS,
    )  # fmt: skip
    return transformers.EomtForUniversalSegmentation(config)


def oneformer() -> Any:
    config = transformers.OneFormerConfig(
        backbone_config=transformers.SwinConfig(**SWIN, out_features=["stage1", "stage2", "stage3", "stage4"]),
        hidden_dim=32, conv_dim=32, mask_dim=32, encoder_feedforward_dim=32, encoder_layers=1, decoder_layers=2,
        num_attention_heads=2, dim_feedforward=32, num_queries=9, text_encoder_width=16, text_encoder_num_layers=1,
        text_encoder_context_length=12, text_encoder_vocab_size=64, task_seq_len=12, max_seq_len=12, query_dec_layers=1,
        text_encoder_n_ctx=2, **LABELS,
    )  # fmt: skip
    return transformers.OneFormerForUniversalSegmentation(config)


def mobilevit() -> Any:
    config = transformers.MobileViTConfig(
        hidden_sizes=[16, 16, 16], neck_hidden_sizes=[8, 8, 8, 16, 16, 16, 16], num_attention_heads=2,
        aspp_out_channels=8, image_size=64, **LABELS,
    )  # fmt: skip
    return transformers.MobileViTForSemanticSegmentation(config)


def mobilenet() -> Any:
    return transformers.MobileNetV2ForSemanticSegmentation(
        transformers.MobileNetV2Config(depth_multiplier=0.25, image_size=64, **LABELS)
    )


VIT = {"hidden_size": 16, "num_hidden_layers": 4, "num_attention_heads": 2, "intermediate_size": 16}


def dpt() -> Any:
    config = transformers.DPTConfig(
        **VIT, image_size=64, patch_size=16, backbone_out_indices=[0, 1, 2, 3], neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8, **LABELS,
    )  # fmt: skip
    return transformers.DPTForSemanticSegmentation(config)


def beit() -> Any:
    config = transformers.BeitConfig(
        **VIT, image_size=64, patch_size=16, out_indices=[1, 2, 3, 4], pool_scales=[1], auxiliary_channels=8,
        use_auxiliary_head=False, **LABELS,
    )  # fmt: skip
    return transformers.BeitForSemanticSegmentation(config)


def data2vec() -> Any:
    config = transformers.Data2VecVisionConfig(
        **VIT, image_size=64, patch_size=16, out_indices=[1, 2, 3, 4], pool_scales=[1], use_auxiliary_head=False,
        **LABELS,
    )  # fmt: skip
    return transformers.Data2VecVisionForSemanticSegmentation(config)


def upernet() -> Any:
    swin = transformers.SwinConfig(**SWIN, out_features=["stage1", "stage2", "stage3", "stage4"])
    config = transformers.UperNetConfig(
        backbone_config=swin, hidden_size=8, pool_scales=[1], use_auxiliary_head=False, **LABELS
    )
    return transformers.UperNetForSemanticSegmentation(config)


def maskformer() -> Any:
    config = transformers.MaskFormerConfig(
        backbone_config=transformers.SwinConfig(**SWIN, out_features=["stage1", "stage2", "stage3", "stage4"]),
        decoder_config=transformers.DetrConfig(
            d_model=16, encoder_layers=1, decoder_layers=1, encoder_attention_heads=2, decoder_attention_heads=2,
            encoder_ffn_dim=16, decoder_ffn_dim=16, num_queries=7,
        ),
        fpn_feature_size=32, mask_feature_size=32, **LABELS,
    )  # fmt: skip
    return transformers.MaskFormerForInstanceSegmentation(config)


FAMILIES = (
    segformer,
    mobilevit,
    mobilenet,
    dpt,
    beit,
    data2vec,
    upernet,
    maskformer,
    mask2former,
    oneformer,
    eomt,
)


def save_tokenizer(folder: Path) -> None:
    """A byte-pair vocabulary that can spell "the task is semantic" letter by letter."""
    letters = sorted(set("thetaskissemantic"))
    tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{letter}</w>" for letter in letters)]
    (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(tokens)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    tokenizer = transformers.CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"))
    tokenizer.save_pretrained(folder)


def saved(folder: Path, model: Any) -> Any:
    """The network in its folder, with weights large enough that classes differ."""
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.ndim > 1:
                parameter.mul_(1.5)
    model.save_pretrained(folder)
    if model.config.model_type == "oneformer":
        save_tokenizer(folder)
    return model.eval()


def normalised(mean: tuple[float, ...], std: tuple[float, ...]) -> torch.Tensor:
    x = (PIXELS / 255.0 - np.array(mean)) / np.array(std)
    return torch.tensor(x, dtype=torch.float32).permute(2, 0, 1)[None]


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


def test_the_image_processors_normalisation_is_used(tmp_path: Path) -> None:
    model = saved(tmp_path, segformer())
    about = {
        "image_processor_type": "SegformerImageProcessor",
        "image_mean": [0.5, 0.4, 0.3],
        "image_std": [0.2, 0.3, 0.4],
    }
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(about))
    with torch.inference_mode():
        logits = interpolate(
            model(normalised((0.5, 0.4, 0.3), (0.2, 0.3, 0.4))).logits, (32, 48), mode="bilinear"
        )
    seen = open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")(camera())
    np.testing.assert_allclose(seen, logits.softmax(1)[0].permute(1, 2, 0), atol=1e-5)


SETTINGS: list[dict[str, Any]] = [
    {},
    {"do_normalize": False},
    {"do_rescale": False},
    {"rescale_factor": 1 / 127.5, "image_mean": [1.0, 1.0, 1.0], "image_std": [1.0, 1.0, 1.0]},
    {"do_flip_channel_order": True, "image_mean": [0.1, 0.2, 0.3], "image_std": [0.9, 0.5, 0.2]},
    {"do_flip_channel_order": False, "do_reduce_labels": True},
]


def captured(folder: Path, pixels: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> torch.Tensor:
    """What the network in the folder is given for an image."""
    given: list[torch.Tensor] = []
    segment = open_segmenter(f"hf:{folder}?shrink=1", URBAN, device="cpu")
    see = segment._probabilities  # type: ignore[attr-defined]
    monkeypatch.setattr(
        segment, "_probabilities", lambda images, size: (given.append(images), see(images, size))[1]
    )
    segment(camera(pixels))
    return given[0]


def processor_of(config: Any) -> Any:
    """The class of a family's image processor, without torchvision."""
    from transformers.models.auto import image_processing_auto as auto

    return auto.get_image_processor_class_from_name(
        auto.IMAGE_PROCESSOR_MAPPING_NAMES[config.model_type]["pil"]
    )


@pytest.mark.parametrize("build", FAMILIES)
def test_every_family_sees_what_its_own_image_processor_makes_of_an_image_of_its_size(
    tmp_path: Path, build: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = saved(tmp_path, build())
    about = processor_of(model.config)
    by_edges = (
        {"shortest_edge": 64, "longest_edge": 96} if "Former" in about.__name__ else {"shortest_edge": 64}
    )
    size = {"height": 64, "width": 96} if "height" in dict(about.size) else by_edges
    extra = {"task_inputs": ["semantic"]} if build is oneformer else {}
    for settings in SETTINGS:
        theirs = about(**{"size": size, "crop_size": {"height": 64, "width": 96}, **settings})
        if build is eomt:
            theirs.do_resize = False  # its windows are made elsewhere
        theirs.save_pretrained(tmp_path)
        wanted = theirs(PIXELS, return_tensors="pt", **extra)["pixel_values"]
        np.testing.assert_array_equal(captured(tmp_path, PIXELS, monkeypatch), wanted.float())


@pytest.mark.parametrize("build", FAMILIES)
def test_without_a_file_the_image_processor_of_the_kind_is_used(
    tmp_path: Path, build: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs = processor_of(saved(tmp_path, build()).config)()
    x = PIXELS[:, :, ::-1] / 255 if "MobileViT" in str(type(theirs)) else PIXELS / 255
    if theirs.do_normalize:
        x = (x - np.array(theirs.image_mean)) / np.array(theirs.image_std)
    np.testing.assert_allclose(
        captured(tmp_path, PIXELS, monkeypatch)[0].permute(1, 2, 0), x, atol=1e-5, rtol=1e-5
    )


@pytest.mark.parametrize("build", FAMILIES)
@pytest.mark.parametrize("shape", [(45, 173), (173, 45), (70, 70)])
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


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"image_mean": "red"}', '{"image_processor_type": "Oven"}', "\0"]
)
def test_a_damaged_image_processor_is_our_error_on_opening(tmp_path: Path, content: str) -> None:
    saved(tmp_path, segformer())
    (tmp_path / "preprocessor_config.json").write_text(content)
    with pytest.raises(DataError, match=r"preprocessor_config\.json.* cannot be used: ") as caught:
        open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")
    assert "\n" not in str(caught.value)


def test_an_error_inside_a_network_names_network_image_and_shape(tmp_path: Path) -> None:
    saved(tmp_path, segformer())
    segment = open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")
    segment._probabilities = lambda images, size: torch.zeros(3) @ images  # type: ignore[attr-defined]
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
    with pytest.raises(DataError, match="a vit is no segmentation network"):
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

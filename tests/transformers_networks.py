"""Small networks of transformers, one of each family, with random weights, as folders that can be opened."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gnss_sem_map.sensor_log import Image

transformers = pytest.importorskip("transformers", reason="needs the extra [hf]")

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


def processor_of(config: Any) -> Any:
    """The class of a family's image processor, without torchvision."""
    from transformers.models.auto import image_processing_auto as auto

    return auto.get_image_processor_class_from_name(
        auto.IMAGE_PROCESSOR_MAPPING_NAMES[config.model_type]["pil"]
    )

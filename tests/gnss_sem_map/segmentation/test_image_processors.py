"""The image of a network of transformers is prepared as its own image processor prepares it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate
from transformers_networks import (
    FAMILIES,
    PIXELS,
    camera,
    eomt,
    normalised,
    oneformer,
    processor_of,
    saved,
    segformer,
    transformers,
)

from gnss_sem_map.errors import DataError
from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.segmentation import open_segmenter
from gnss_sem_map.segmentation.huggingface import preparation

URBAN = open_label_set("urban")


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


def prepared(folder: Path, pixels: np.ndarray) -> torch.Tensor:
    """What the network in the folder is given for an image."""
    return preparation(str(folder), transformers.AutoConfig.from_pretrained(folder))(pixels[None])


@pytest.mark.parametrize("build", FAMILIES)
def test_every_family_sees_what_its_own_image_processor_makes_of_an_image_of_its_size(
    tmp_path: Path, build: Any
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
        np.testing.assert_array_equal(prepared(tmp_path, PIXELS), wanted.float())


@pytest.mark.slow
@pytest.mark.parametrize("build", FAMILIES)
def test_without_a_file_the_image_processor_of_the_kind_is_used(tmp_path: Path, build: Any) -> None:
    theirs = processor_of(saved(tmp_path, build()).config)()
    x = PIXELS[:, :, ::-1] / 255 if "MobileViT" in str(type(theirs)) else PIXELS / 255
    if theirs.do_normalize:
        x = (x - np.array(theirs.image_mean)) / np.array(theirs.image_std)
    np.testing.assert_allclose(prepared(tmp_path, PIXELS)[0].permute(1, 2, 0), x, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"image_mean": "red"}', '{"image_processor_type": "Oven"}', "\0"]
)
def test_a_damaged_image_processor_is_our_error_on_opening(tmp_path: Path, content: str) -> None:
    saved(tmp_path, segformer())
    (tmp_path / "preprocessor_config.json").write_text(content)
    with pytest.raises(DataError, match=r"preprocessor_config\.json.* cannot be used: ") as caught:
        open_segmenter(f"hf:{tmp_path}", URBAN, device="cpu")
    assert "\n" not in str(caught.value)
